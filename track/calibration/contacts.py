"""Where the thumb touches other fingers: found in a tracked motion, kept as points that slide on the skin.

Nobody says when the user touches. A touch is a moment at which the last bones of thumb and one finger are
near and hold still against each other; what only looks like one lies apart from the others of its finger, and
loses its say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.hand.model import HandModel
from handsim.hand.topology import DIGITS, bones_of
from poses.shapes.touch import FINGERS, thumb_contact
from track.calibration.skin_walk import (
    Corners,
    Skin,
    SkinPlaces,
    nearest_places,
    place_points,
    place_weights,
    skin_of,
    slide,
)

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

PRESS: Final = 0.001
"""How far each pad gives way in a touch [m]: simulated pads press into each other by 1.6 to 2.4 mm in all."""
_NEAR: Final = 0.012  # [m] between the flesh of the two, from which a moment may be a touch
_STILL: Final = 0.02  # [m/s]
_SHORTEST: Final = 0.06  # [s]
_MOST_OF_A_FINGER: Final = 10
_SPEED_TIME: Final = 0.025  # [s] before and after, over which speed is taken
_ODD: Final = 0.002  # [m] off its finger's others, where a touch has lost half its say and more
_DEPTH: Final = 0.006  # [m] below the skin, about a pad's middle
_SLIDES: Final = 3
_USUAL: Final = 0.35
_OPPOSED: Final = -0.8  # cosine between the normals of pads that face each other
_ASIDE: Final = 0.002  # [m]


class Contacts(NamedTuple):
    """Touches of the thumb, each in one frame, with the place on either pad."""

    frames: Int[np.ndarray, "K"]
    fingers: Int[np.ndarray, "K"]
    """Places in `topology.DIGITS`."""
    thumb_places: SkinPlaces
    finger_places: SkinPlaces


class Meeting(NamedTuple):
    """How the pads of some contacts lie to each other in the world."""

    directions: Float[np.ndarray, "K 3"]
    """From thumb to finger."""
    gaps: Float[np.ndarray, "K"]
    """Between the pads, both having given way by `PRESS` [m]; negative where they press harder."""
    square: Bool[np.ndarray, "K"]
    """Whether the places are on the last bones and face each other."""


def find_touches(
    model: HandModel,
    angles: Float[np.ndarray, "T 20"],
    trusted: Bool[np.ndarray, "T 5"],
    rate: float,
) -> list[tuple[int, str]]:
    """Frames and fingers of what may be touches.

    Args:
        model: A right hand.
        angles: Its tracked motion [rad].
        trusted: Whether all markers of a digit were there.
        rate: Frames a second [Hz].
    """
    meetings = [thumb_contact(model, angles, finger) for finger in FINGERS]
    gaps = np.stack([-meeting.overlap for meeting in meetings], axis=1)
    reach = max(1, round(_SPEED_TIME * rate))
    found: list[tuple[int, str]] = []
    for number, finger in enumerate(FINGERS):
        speed = _speed(model, angles, finger, reach, rate)
        good = (speed < _STILL) & (gaps[:, number] < _NEAR) & (gaps.argmin(axis=1) == number)
        good &= trusted[:, 0] & trusted[:, number + 1]
        holds = _runs(good, max(2, round(_SHORTEST * rate)))
        stillest = [first + int(speed[first:last].argmin()) for first, last in holds]
        stillest.sort(key=lambda frame, number=number: float(gaps[frame, number]))  # type: ignore[misc]
        found += [(frame, finger) for frame in stillest[:_MOST_OF_A_FINGER]]
    return sorted(found)


def _speed(
    model: HandModel, angles: NDArray[np.float64], finger: str, reach: int, rate: float
) -> NDArray[np.float64]:
    """Speed [m/s] of the finger's last bone as the thumb's sees it."""
    qpos = np.zeros((len(angles), 27))
    qpos[:, 3], qpos[:, 7:] = 1.0, angles
    bones = model.forward_kinematics(qpos)
    thumb, other = bones_of("thumb")[2], bones_of(finger)[2]
    tip = bones[:, other, :3, 3] + model.skeleton.lengths[other] * bones[:, other, :3, 0]
    place = np.einsum("tji,tj->ti", bones[:, thumb, :3, :3], tip - bones[:, thumb, :3, 3])
    speed = np.full(len(place), np.inf)
    if len(place) > 2 * reach:
        way = np.linalg.norm(place[2 * reach :] - place[: -2 * reach], axis=1)
        speed[reach:-reach] = way * rate / (2 * reach)
    return speed


def _runs(good: NDArray[np.bool_], shortest: int) -> list[tuple[int, int]]:
    """First frames and those after the last of the runs that are long enough."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= shortest]


def place_contacts(
    model: HandModel, touches: list[tuple[int, str]], T_world_bone: Float[np.ndarray, "K L 4 4"]
) -> Contacts:
    """Touches with their first places on the pads: where the two bones come nearest.

    Args:
        model: A right hand.
        touches: Frame and finger of each.
        T_world_bone: The hand in those frames.
    """
    points = np.empty((2, len(touches), 3))
    for number, (_, finger) in enumerate(touches):
        ends = _flesh(model, T_world_bone[number], finger)
        for part, digit in enumerate(("thumb", finger)):
            bone = bones_of(digit)[2]
            local = np.linalg.inv(T_world_bone[number, bone]) @ np.append(ends[part], 1.0)
            points[part, number] = (model.rest_transforms[bone] @ local)[:3]
    sides = [nearest_places(side, model.shape)._replace(heights=np.zeros(len(side))) for side in points]
    frames = np.array([frame for frame, _ in touches], dtype=np.int64)
    fingers = np.array([DIGITS.index(finger) for _, finger in touches], dtype=np.int64)
    return slide_contacts(Contacts(frames, fingers, *sides), model, T_world_bone)


def _flesh(model: HandModel, bones: NDArray[np.float64], finger: str) -> NDArray[np.float64]:
    """Points (2, 3) of the two last bones' skins that lie nearest to the other bone."""
    pads = []
    for digit in ("thumb", finger):
        bone = bones_of(digit)[2]
        shape, number = model.shape, DIGITS.index(digit)
        along = np.linspace(0.2, 1.0, 9) * (shape.bone_lengths[number, 2] - shape.radii[number, 3])
        pads.append(bones[bone, :3, 3] + along[:, None] * bones[bone, :3, 0])
    apart = np.linalg.norm(pads[0][:, None] - pads[1], axis=2)
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    ends = np.stack([pads[0][first], pads[1][second]])
    way = (ends[1] - ends[0]) / apart.min()
    radii = model.shape.radii[[0, DIGITS.index(finger)], 2:].mean(axis=1)
    skin: NDArray[np.float64] = ends + radii[:, None] * np.stack([way, -way])
    return skin


def slide_contacts(
    contacts: Contacts, model: HandModel, T_world_bone: Float[np.ndarray, "K L 4 4"]
) -> Contacts:
    """Let the points slide to where thumb and finger come nearest.

    Each goes to the place of its skin that is nearest to a point inside the other pad, not on it, so that the
    pair is found as well where skins press into each other.
    """
    skin = skin_of(model.shape)
    sides = [contacts.thumb_places, contacts.finger_places]
    for _ in range(_SLIDES):
        for own, other in ((0, 1), (1, 0)):
            inner = sides[other]._replace(heights=np.full(len(contacts.frames), -_DEPTH))
            target = _posed(inner, skin, model, T_world_bone)
            blend = _blends(sides[own], model, T_world_bone)
            rest = np.linalg.solve(blend[:, :, :3], (target - blend[:, :, 3])[..., None])[..., 0]
            slid = slide(sides[own], rest, skin)
            sides[own] = slid._replace(heights=np.zeros(len(contacts.frames)))
    return contacts._replace(thumb_places=sides[0], finger_places=sides[1])


def meet(
    contacts: Contacts, corners: Corners, model: HandModel, T_world_bone: NDArray[np.float64]
) -> Meeting:
    """How the pads lie to each other.

    Args:
        contacts: The touches.
        corners: Triangles of the thumb's places, then of the fingers'.
        model: A right hand.
        T_world_bone: It in the frame of each contact.
    """
    count = len(contacts.frames)
    points, normals = [], []
    for part, places in enumerate((contacts.thumb_places, contacts.finger_places)):
        mine = slice(part * count, (part + 1) * count)
        rest, normal = place_points(places, Corners(corners.points[mine], corners.normals[mine]))
        blend = _blends(places, model, T_world_bone)
        points.append(np.einsum("kij,kj->ki", blend[:, :, :3], rest) + blend[:, :, 3])
        normals.append(np.einsum("kij,kj->ki", blend[:, :, :3], normal))
    direction = normals[0] - normals[1]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    way = points[1] - points[0]
    along = (way * direction).sum(axis=1)
    aside = np.linalg.norm(way - along[:, None] * direction, axis=1)
    normals = [normal / np.linalg.norm(normal, axis=1, keepdims=True) for normal in normals]
    square = ((normals[0] * normals[1]).sum(axis=1) < _OPPOSED) & (aside < _ASIDE) & _on_tips(contacts)
    return Meeting(direction, along + 2.0 * PRESS, square)


def _on_tips(contacts: Contacts) -> NDArray[np.bool_]:
    """Whether both places are on last bones, and have not slid away."""
    last = np.array([bones_of(digit)[2] for digit in DIGITS])
    every = np.arange(len(contacts.frames))
    thumb = place_weights(contacts.thumb_places)[:, last[0]]
    finger = place_weights(contacts.finger_places)[every, last[contacts.fingers]]
    tips: NDArray[np.bool_] = np.minimum(thumb, finger) > 0.5
    return tips


def trust(meeting: Meeting, fingers: Int[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """How much each touch counts, 0 to 1: little where its gap is unlike its finger's others.

    Geman and McClure's weights (1987), around a lower quantile, as touches are the nearest a thumb comes.
    """
    weights = np.zeros(len(meeting.gaps))
    for finger in np.unique(fingers[meeting.square]):
        mine = (fingers == finger) & meeting.square
        off = meeting.gaps[mine] - np.quantile(meeting.gaps[mine], _USUAL)
        weights[mine] = (1.0 + (off / _ODD) ** 2) ** -2.0
    return weights


def _posed(
    places: SkinPlaces, skin: Skin, model: HandModel, T_world_bone: NDArray[np.float64]
) -> NDArray[np.float64]:
    rest, _ = place_points(places, skin.corners(places.faces))
    blend = _blends(places, model, T_world_bone)
    posed: NDArray[np.float64] = np.einsum("kij,kj->ki", blend[:, :, :3], rest) + blend[:, :, 3]
    return posed


def _blends(places: SkinPlaces, model: HandModel, T_world_bone: NDArray[np.float64]) -> NDArray[np.float64]:
    """The blended transforms (K, 3, 4) that carry each place in its own frame."""
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    blends: NDArray[np.float64] = np.einsum("kl,klij->kij", place_weights(places), motion)
    return blends
