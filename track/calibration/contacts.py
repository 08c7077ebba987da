"""Contacts of the thumb with other fingers: detection in a tracked motion, and contact points on the skin.

The capture has no annotation of touches. A touch is a moment at which the last bones of thumb and one finger
are near and hold still relative to each other. A false detection has a gap unlike the others of its finger
and gets a small weight.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.captures.capture import runs_of
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, bones_of
from poses.touch import FINGERS, thumb_contact
from track.calibration.skin_coordinates import (
    Corners,
    Skin,
    SkinCoordinates,
    build_skin,
    nearest_coordinates,
    project_onto_skin,
    skin_points,
    skin_weights,
)

PAD_COMPRESSION: Final = 0.001
"""Compression of each pad in a touch [m]: simulated pads overlap by 1.6 to 2.4 mm together."""
_MOST_GAP: Final = 0.012  # [m] between the two pads of a touch
_MOST_SPEED: Final = 0.02  # [m/s] of the finger relative to the thumb
_SHORTEST_HOLD: Final = 0.06  # [s] that a touch lasts
_MOST_PER_FINGER: Final = 10
_SPEED_WINDOW: Final = 0.025  # [s] before and after a frame, over which speed is measured
_GAP_SCALE: Final = 0.002  # [m] from its finger's usual gap, at which a touch has a quarter of its weight
_PAD_DEPTH: Final = 0.006  # [m] below the skin: about the middle of a pad
_SLIDE_ROUNDS: Final = 3
_GAP_QUANTILE: Final = 0.35  # of a finger's gaps: the usual one
_FACING_COSINE: Final = -0.8  # cosine between the normals of pads that face each other
_MOST_OFFSET: Final = 0.002  # [m] between the contact points, across their direction


class Contacts(NamedTuple):
    """K contacts of the thumb, each in one frame, with a point on either pad."""

    frames: Int[np.ndarray, "K"]
    fingers: Int[np.ndarray, "K"]
    """Indices into `topology.DIGITS`."""
    thumb_coordinates: SkinCoordinates
    finger_coordinates: SkinCoordinates


class ContactGeometry(NamedTuple):
    """How the pads of K contacts lie to each other in the world."""

    directions: Float[np.ndarray, "K 3"]
    """Unit vectors from thumb to finger."""
    gaps: Float[np.ndarray, "K"]
    """Distance of the pads, both compressed by `PAD_COMPRESSION` [m]; negative where they press harder."""
    facing: Bool[np.ndarray, "K"]
    """Whether the points are on the last bones and face each other."""


def find_touches(
    model: HandModel,
    angles: Float[np.ndarray, "T 20"],
    complete: Bool[np.ndarray, "T 5"],
    rate: float,
) -> list[tuple[int, str]]:
    """Frames and fingers of possible touches.

    Args:
        model: A right hand.
        complete: Whether all markers of a digit were seen.
    """
    by_finger = [thumb_contact(model, angles, finger) for finger in FINGERS]
    gaps = np.stack([-contact.overlap for contact in by_finger], axis=1)
    window = max(1, round(_SPEED_WINDOW * rate))
    touches: list[tuple[int, str]] = []
    for number, finger in enumerate(FINGERS):
        speed = _speed(model, angles, finger, window, rate)
        good = (speed < _MOST_SPEED) & (gaps[:, number] < _MOST_GAP) & (gaps.argmin(axis=1) == number)
        good &= complete[:, 0] & complete[:, number + 1]
        shortest = max(2, round(_SHORTEST_HOLD * rate))
        stillest = [
            first + int(speed[first : last + 1].argmin())
            for first, last in runs_of(good)
            if last + 1 - first >= shortest
        ]
        stillest.sort(key=lambda frame, number=number: float(gaps[frame, number]))  # type: ignore[misc]
        touches += [(frame, finger) for frame in stillest[:_MOST_PER_FINGER]]
    return sorted(touches)


def _speed(
    model: HandModel, angles: NDArray[np.float64], finger: str, window: int, rate: float
) -> NDArray[np.float64]:
    """Speed of the finger's tip in the frame of the thumb's last bone (T,) [m/s]."""
    qpos = np.zeros((len(angles), 27))
    qpos[:, 3], qpos[:, 7:] = 1.0, angles
    bones = model.forward_kinematics(qpos)
    thumb, other = bones_of("thumb")[2], bones_of(finger)[2]
    tip = bones[:, other, :3, 3] + model.skeleton.lengths[other] * bones[:, other, :3, 0]
    position = np.einsum("tji,tj->ti", bones[:, thumb, :3, :3], tip - bones[:, thumb, :3, 3])
    speed = np.full(len(position), np.inf)
    if len(position) > 2 * window:
        distance = np.linalg.norm(position[2 * window :] - position[: -2 * window], axis=1)
        speed[window:-window] = distance * rate / (2 * window)
    return speed


def initialize_contacts(
    model: HandModel, touches: list[tuple[int, str]], T_world_bone: Float[np.ndarray, "K L 4 4"]
) -> Contacts:
    """Contacts of touches, their points first where the two last bones come nearest.

    Args:
        model: A right hand.
        touches: Frame and finger of each.
    """
    points = np.empty((2, len(touches), 3))
    for number, (_, finger) in enumerate(touches):
        ends = _nearest_skin_points(model, T_world_bone[number], finger)
        for part, digit in enumerate(("thumb", finger)):
            bone = bones_of(digit)[2]
            local = np.linalg.inv(T_world_bone[number, bone]) @ np.append(ends[part], 1.0)
            points[part, number] = (model.rest_transforms[bone] @ local)[:3]
    sides = [nearest_coordinates(side, model.shape)._replace(heights=np.zeros(len(side))) for side in points]
    frames = np.array([frame for frame, _ in touches], dtype=np.int64)
    fingers = np.array([DIGITS.index(finger) for _, finger in touches], dtype=np.int64)
    return slide_contacts(Contacts(frames, fingers, *sides), model, T_world_bone)


def _nearest_skin_points(model: HandModel, bones: NDArray[np.float64], finger: str) -> NDArray[np.float64]:
    """Points (2, 3) [m] on the skins of the two last bones, each nearest to the other bone."""
    pads = []
    for digit in ("thumb", finger):
        bone = bones_of(digit)[2]
        shape, number = model.shape, DIGITS.index(digit)
        along = np.linspace(0.2, 1.0, 9) * (shape.bone_lengths[number, 2] - shape.radii[number, 3])
        pads.append(bones[bone, :3, 3] + along[:, None] * bones[bone, :3, 0])
    apart = np.linalg.norm(pads[0][:, None] - pads[1], axis=2)
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    ends = np.stack([pads[0][first], pads[1][second]])
    direction = (ends[1] - ends[0]) / apart.min()
    radii = model.shape.radii[[0, DIGITS.index(finger)], 2:].mean(axis=1)
    skin: NDArray[np.float64] = ends + radii[:, None] * np.stack([direction, -direction])
    return skin


def slide_contacts(
    contacts: Contacts, model: HandModel, T_world_bone: Float[np.ndarray, "K L 4 4"]
) -> Contacts:
    """Slide the contact points on the skin to where thumb and finger come nearest.

    Each point moves to the point of its skin nearest to a target inside the other pad. A target on the other
    skin would fail where the skins overlap.

    Args:
        model: A right hand.
        T_world_bone: Its bones in the frame of each contact.
    """
    skin = build_skin(model.shape)
    sides = [contacts.thumb_coordinates, contacts.finger_coordinates]
    for _ in range(_SLIDE_ROUNDS):
        for own, other in ((0, 1), (1, 0)):
            inner = sides[other]._replace(heights=np.full(len(contacts.frames), -_PAD_DEPTH))
            target = _posed_points(inner, skin, model, T_world_bone)
            blend = _blend_transforms(sides[own], model, T_world_bone)
            rest = np.linalg.solve(blend[:, :, :3], (target - blend[:, :, 3])[..., None])[..., 0]
            slid = project_onto_skin(sides[own], rest, skin)
            sides[own] = slid._replace(heights=np.zeros(len(contacts.frames)))
    return contacts._replace(thumb_coordinates=sides[0], finger_coordinates=sides[1])


def contact_geometry(
    contacts: Contacts, corners: Corners, model: HandModel, T_world_bone: NDArray[np.float64]
) -> ContactGeometry:
    """How the pads lie to each other.

    Args:
        corners: Triangles of the thumb's points, then of the fingers' (2 K).
        model: A right hand.
        T_world_bone: Its bones in the frame of each contact (K, L, 4, 4).
    """
    count = len(contacts.frames)
    points, normals = [], []
    for part, coordinates in enumerate((contacts.thumb_coordinates, contacts.finger_coordinates)):
        mine = slice(part * count, (part + 1) * count)
        rest, normal = skin_points(coordinates, Corners(corners.points[mine], corners.normals[mine]))
        blend = _blend_transforms(coordinates, model, T_world_bone)
        points.append(np.einsum("kij,kj->ki", blend[:, :, :3], rest) + blend[:, :, 3])
        normals.append(np.einsum("kij,kj->ki", blend[:, :, :3], normal))
    direction = normals[0] - normals[1]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = points[1] - points[0]
    along = (offset * direction).sum(axis=1)
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    normals = [normal / np.linalg.norm(normal, axis=1, keepdims=True) for normal in normals]
    facing = (
        ((normals[0] * normals[1]).sum(axis=1) < _FACING_COSINE)
        & (across < _MOST_OFFSET)
        & _on_tips(contacts)
    )
    return ContactGeometry(direction, along + 2.0 * PAD_COMPRESSION, facing)


def _on_tips(contacts: Contacts) -> NDArray[np.bool_]:
    """Whether both points are on last bones and have not slid away (K,)."""
    last = np.array([bones_of(digit)[2] for digit in DIGITS])
    rows = np.arange(len(contacts.frames))
    thumb = skin_weights(contacts.thumb_coordinates)[:, last[0]]
    finger = skin_weights(contacts.finger_coordinates)[rows, last[contacts.fingers]]
    tips: NDArray[np.bool_] = np.minimum(thumb, finger) > 0.5
    return tips


def contact_weights(geometry: ContactGeometry, fingers: Int[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Weight of each contact, 0 to 1: small where its gap is unlike the others of its finger.

    Geman and McClure's weights (1987), around a lower quantile: a touch is the nearest that the thumb comes.
    Contacts that do not face each other get none.
    """
    weights = np.zeros(len(geometry.gaps))
    for finger in np.unique(fingers[geometry.facing]):
        mine = (fingers == finger) & geometry.facing
        deviation = geometry.gaps[mine] - np.quantile(geometry.gaps[mine], _GAP_QUANTILE)
        weights[mine] = (1.0 + (deviation / _GAP_SCALE) ** 2) ** -2.0
    return weights


def _posed_points(
    coordinates: SkinCoordinates, skin: Skin, model: HandModel, T_world_bone: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points in the world (K, 3) [m], each in its frame."""
    rest, _ = skin_points(coordinates, skin.corners(coordinates.faces))
    blend = _blend_transforms(coordinates, model, T_world_bone)
    posed: NDArray[np.float64] = np.einsum("kij,kj->ki", blend[:, :, :3], rest) + blend[:, :, 3]
    return posed


def _blend_transforms(
    coordinates: SkinCoordinates, model: HandModel, T_world_bone: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Blended transforms (K, 3, 4) from the rest hand to the world, each for its point and frame."""
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    blends: NDArray[np.float64] = np.einsum("kl,klij->kij", skin_weights(coordinates), motion)
    return blends
