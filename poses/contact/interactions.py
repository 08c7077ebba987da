"""Interactions of two hands, from `data/interactions.json`, and random meetings drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim._checks import check_choice
from handsim.errors import ArgumentError
from handsim.files.json_files import package_data
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS, bones_of
from handsim.space.transforms import MIRROR, euler_matrix
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture, gesture_names
from poses.shapes.validity import is_valid, make_valid, resting_angles

_FLEXION_NOISE: Final = np.deg2rad(4.0)
_ABDUCTION_NOISE: Final = np.deg2rad(1.5)
_NOISE: Final = np.tile([_ABDUCTION_NOISE, _FLEXION_NOISE, _FLEXION_NOISE, _FLEXION_NOISE], len(DIGITS))
_SNUG: Final = 0.0007  # self-penetration [m] up to which fingers may wander
_WANDER: Final = 0.4  # noise from beat to beat, as a share of the noise that a whole interaction keeps


INTERACTIONS: Final[tuple[str, ...]] = tuple(package_data("poses", "interactions")["interactions"])
"""Names of all interactions."""


@dataclass(frozen=True, slots=True, eq=False)
class Fingers:
    """Joint angles of one hand, one row per beat."""

    opened: Float[np.ndarray, "K 20"]
    """Open fingers [rad]."""
    closed: Float[np.ndarray, "K 20"]
    """Closed fingers if nothing blocks them [rad]."""
    strength: Float[np.ndarray, "K 5"]
    """Share of that path that each digit closes."""

    def at(self, beats: Float[np.ndarray, "T"]) -> Fingers:
        """Interpolated between beats, which count from 0."""
        return Fingers(*(at_beats(keys, beats) for keys in (self.opened, self.closed, self.strength)))


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """Interactions as they were drawn: poses of the moving hand in the wrist frame of the still one."""

    still: Fingers
    moving: Fingers
    rotations: Float[np.ndarray, "K 3"]
    """Rotation vectors [rad], to be applied after `rotation`."""
    rotation: Float[np.ndarray, "K 3 3"]
    """The same for all beats of one interaction."""
    targets: Float[np.ndarray, "K 3"]
    """Points of the still hand [m]."""
    anchors: Float[np.ndarray, "K 3"]
    """Points of the moving hand [m] that are put on them."""
    axis: Float[np.ndarray, "K 3"]
    """Unit direction in which the moving hand backs off; the same for all beats of one interaction."""

    def directions(self, beats: Float[np.ndarray, "T"]) -> NDArray[np.float64]:
        """Unit directions (T, 3) in which the moving hand backs off."""
        directions: NDArray[np.float64] = self.axis[beats.astype(int)]
        return directions

    def placement(self, beats: Float[np.ndarray, "T"]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Orientations (T, 3, 3) and positions (T, 3) [m] of the moving wrist before it backs off."""
        tilts = Rotation.from_rotvec(at_beats(self.rotations, beats)).as_matrix()
        rotations = tilts @ self.rotation[beats.astype(int)]
        anchors = np.einsum("tij,tj->ti", rotations, at_beats(self.anchors, beats))
        return rotations, at_beats(self.targets, beats) - anchors


def at_beats(keys: Float[np.ndarray, "K *n"], beats: Float[np.ndarray, "T"]) -> NDArray[np.float64]:
    """Values between keys, `beats` counting keys from 0."""
    low = np.minimum(beats.astype(int), max(len(keys) - 2, 0))
    share = (beats - low)[:, None]
    values: NDArray[np.float64] = keys[low] + share * (keys[np.minimum(low + 1, len(keys) - 1)] - keys[low])
    return values


def check_names(names: tuple[str, ...]) -> None:
    """Raise an `ArgumentError` that lists the valid names when one is unknown, or when there is none."""
    if not names:
        raise ArgumentError(f"no interactions were named; valid names: {', '.join(INTERACTIONS)}")
    for name in names:
        check_choice(name, INTERACTIONS, noun="interaction")


def draw_variant(name: str, *, rng: np.random.Generator) -> dict[str, Any]:
    """One of the variants of an interaction, chosen at random."""
    variants = package_data("poses", "interactions")["interactions"][name]
    variant: dict[str, Any] = variants[rng.integers(len(variants))]
    return variant


class Sketch(NamedTuple):
    """The random part of an interaction's beats, before hands give it their size."""

    variant: dict[str, Any]
    """Its description, from `draw_variant`."""
    still: _FingerSketch
    moving: _FingerSketch
    targets: Float[np.ndarray, "K 3"]
    """Points of the still hand [hand lengths]."""
    tilts: Float[np.ndarray, "K 3"]
    """Rotation of the moving hand [rad]."""


class _FingerSketch(NamedTuple):
    """Fingers of one hand (K, ...), not valid yet."""

    opened: NDArray[np.float64]
    closed: NDArray[np.float64]
    wander: NDArray[np.float64]
    """Change of the open fingers from beat to beat [rad]."""
    strength: NDArray[np.float64]


def sketch_meeting(
    variant: dict[str, Any], count: int, *, together: bool, rng: np.random.Generator
) -> Sketch:
    """Random positions, orientations and fingers for `count` beats.

    Args:
        variant: Its description, from `draw_variant`.
        count: Number of beats, K.
        together: Whether beats belong to one meeting, and so resemble each other, or are independent.
    """
    noise = _Noise(count, together, rng)
    still, moving = (
        _sketch_fingers(variant[role], variant["relaxing"], noise, rng) for role in ("still", "moving")
    )
    targets = np.tile(variant["target"], (count, 1))
    targets[:, :2] += noise.around(np.array(variant["jitter"]), 0.0) + _offsets(variant, count, rng)
    return Sketch(variant, still, moving, targets, noise.around(np.deg2rad(variant["tilt"]), 0.3))


def meet(sketches: Sequence[Sketch], still: HandModel, moving: HandModel) -> Meeting:
    """The beats of all sketches, one sketch after another, with valid fingers of these hands.

    Args:
        sketches: What was drawn, from `sketch_meeting`.
        still: The hand that holds still.
        moving: The other hand, of the other side.
    """
    mirror = np.eye(3) if still.shape.side == "right" else MIRROR
    counts = [len(sketch.targets) for sketch in sketches]
    fingers = _valid_fingers(moving, [sketch.moving for sketch in sketches])
    opened = np.split(fingers.opened, np.cumsum(counts)[:-1])
    tilts = np.concatenate([sketch.tilts for sketch in sketches])[:, ::-1]
    rotation = [euler_matrix(np.deg2rad(sketch.variant["rotation"])) for sketch in sketches]
    axis = np.array([sketch.variant["axis"] for sketch in sketches], dtype=np.float64) @ mirror
    return Meeting(
        still=_valid_fingers(still, [sketch.still for sketch in sketches]),
        moving=fingers,
        rotations=-tilts @ mirror if still.shape.side == "left" else tilts,
        rotation=np.repeat(mirror @ np.array(rotation) @ mirror, counts, axis=0),
        targets=still.shape.length * np.concatenate([sketch.targets for sketch in sketches]) @ mirror,
        anchors=np.concatenate(
            [
                _anchors(sketch.variant["anchor"], moving, part)
                for sketch, part in zip(sketches, opened, strict=True)
            ]
        ),
        axis=np.repeat(axis / np.linalg.norm(axis, axis=1, keepdims=True), counts, axis=0),
    )


class _Noise:
    """Gaussian noise with a part that all beats share, clipped at two standard deviations."""

    def __init__(self, count: int, together: bool, rng: np.random.Generator) -> None:
        self.count, self.together, self.rng = count, together, rng

    def around(
        self, scale: NDArray[np.float64], wander: float, *, common: float = 1.0
    ) -> NDArray[np.float64]:
        """Noise (K, n): `common` standard deviations `scale` (n,) that last, `wander` new at each beat."""
        size = (self.count, len(scale))
        lasting = np.clip(self.rng.standard_normal((1, size[1]) if self.together else size), -2.0, 2.0)
        new = np.clip(self.rng.standard_normal(size), -2.0, 2.0)
        return scale * (common * lasting + wander * new)


def _offsets(variant: dict[str, Any], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Offsets (K, 2) of the beats from the middle one, in hand lengths."""
    reach = np.array(variant["place"])
    if variant["pattern"] == "random":
        return reach * rng.uniform(-1.0, 1.0, size=(count, 2))
    side = (-1.0) ** np.arange(count)[:, None]
    direction = reach * np.array([1.0, rng.uniform(-1.0, 1.0)])
    offsets: NDArray[np.float64] = side * direction * rng.uniform(0.6, 1.0, size=(count, 1))
    return offsets


def _sketch_fingers(
    role: dict[str, str], relaxing: float, noise: _Noise, rng: np.random.Generator
) -> _FingerSketch:
    weaker = rng.random((noise.count, len(DIGITS))) < relaxing
    strength = np.where(weaker, rng.uniform(0.4, 1.0, size=weaker.shape), 1.0)
    opened = _angles(role["open"]) + noise.around(_NOISE, 0.0)
    closed = _angles(role["closed"]) + noise.around(_NOISE, 0.0)
    return _FingerSketch(opened, closed, _WANDER * noise.around(_NOISE, 1.0, common=0.0), strength)


def _valid_fingers(model: HandModel, sketches: Sequence[_FingerSketch]) -> Fingers:
    """The fingers of all sketches, one after another, none in another's way."""
    opened, closed, wander, strength = (np.concatenate(parts) for parts in zip(*sketches, strict=True))
    # Poses with deep contact come a little nearer to rest, because fingers need room.
    angles = make_valid(model, np.clip(opened, LOW, HIGH))
    hard = ~is_valid(model, angles, max_penetration=_SNUG)
    angles[hard] += 0.1 * (resting_angles(model) - angles[hard])
    lasting = angles
    wandering = np.clip(lasting + wander, LOW, HIGH)
    valid = is_valid(model, wandering, max_penetration=_SNUG)
    return Fingers(np.where(valid[:, None], wandering, lasting), np.clip(closed, LOW, HIGH), strength)


def _angles(name: str) -> NDArray[np.float64]:
    """Joint angles [rad] of a gesture, or of a hand pose of this data file alone."""
    if name in gesture_names():
        return gesture(name)
    return np.deg2rad(np.ravel(package_data("poses", "interactions")["hands"][name]))


def _anchors(
    anchor: str | list[float], moving: HandModel, opened: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (K, 3) of the moving hand in its wrist frame [m]."""
    if isinstance(anchor, str):
        bone = bones_of(anchor)[-1]
        frames = moving.forward_kinematics(join_qpos(opened))[:, bone]
        tips: NDArray[np.float64] = frames[:, :3, 3] + moving.skeleton.lengths[bone] * frames[:, :3, 0]
        return tips
    mirror = MIRROR if moving.shape.side == "left" else np.eye(3)
    return np.tile(moving.shape.length * np.array(anchor) @ mirror, (len(opened), 1))
