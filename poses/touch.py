"""Poses of one person's hand in which the thumb touches a finger.

In a touch, the capsules of the last bones of thumb and finger meet, and their pads face each other. A real
hand gives this kind of ground truth without any instrument.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_array, check_choice
from handsim.errors import PoseError
from handsim.hand.capsules import Capsules
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS, NUM_JOINTS, bones_of
from handsim.kernels import kernel, segment_distance_squared
from poses.shapes import HIGH, LOW, MAX_PENETRATION, gesture, is_valid, make_valid

FINGERS: Final = DIGITS[1:]
MAX_OVERLAP: Final = 0.0006
"""Deepest overlap [m] of the two last bones of a solved touch; the least is 0."""
MIN_FACING: Final = 0.5
"""Smallest cosine between a pad's direction and the direction to the other bone in a solved touch."""
_PAD_SHARE: Final = 0.6  # where the pad is, as a share of the last bone's capsule
# Residuals are divided by these scales [m]: overlap of the last bones, other penetration, pad distance.
_OVERLAP_SCALE: Final = 5e-5
_PENETRATION_SCALE: Final = 1e-4
_PAD_SCALE: Final = 3e-2
_FACING_WEIGHT: Final = 5.0
_ANGLE_WEIGHTS: Final = 2.0 * np.array([1.0, 1.0, 1.0, 1.0, 2.0, 1.0, 1.0, 1.0])
_TARGET_FACING: Final = 0.55
_MAX_ROUNDS: Final = 4
_ANGLE_STEP: Final = 1e-6  # step of the finite differences [rad]


@dataclass(frozen=True, slots=True, eq=False)
class ThumbContact:
    """Relative position of the last bones of thumb and one finger in each frame."""

    overlap: Float[np.ndarray, "T"]
    """How deep the two capsules overlap [m]; negative: the gap between them."""
    facing: Float[np.ndarray, "T 2"]
    """Cosine between pad direction and direction to the other bone, for thumb and finger; 1: pad to pad."""


def thumb_contact(model: HandModel, angles: Float[np.ndarray, "T 20"], finger: str) -> ThumbContact:
    """Overlap and facing of the last bones of thumb and finger ("index", "middle", "ring" or "little")."""
    check_choice(finger, FINGERS, noun="finger")
    return _bones_contact(model.capsules, model.forward_kinematics(join_qpos(angles)), finger)


def _bones_contact(capsules: Capsules, frames: NDArray[np.float64], finger: str) -> ThumbContact:
    bones = bones_of("thumb")[2], bones_of(finger)[2]
    indices = [int(np.flatnonzero(capsules.bones == bone)[0]) for bone in bones]
    segments, radii = capsules.posed(frames)[:, indices], capsules.radii[indices]
    ends = _nearest_points(segments)
    direction = ends[:, 1] - ends[:, 0]
    distance = np.linalg.norm(direction, axis=1)
    direction /= distance[:, None]
    facing = (frames[:, bones][..., :3, 2] * direction[:, None]).sum(axis=2) * [-1.0, 1.0]
    return ThumbContact(radii.sum() - distance, facing)


def touching_angles(
    model: HandModel, finger: str, start: Float[np.ndarray, "*starts 20"] | None = None
) -> Float[np.ndarray, "20"]:
    """Joint angles [rad] at which the pads of thumb and finger touch; only these two digits move.

    The last bones overlap by 0 to `MAX_OVERLAP`, their pads face each other, and nothing else penetrates
    deeper than `MAX_PENETRATION`. The search begins at each pose of `start` [rad] in turn, by default at the
    library's pinches of this finger.
    """
    check_choice(finger, FINGERS, noun="finger")
    if start is None:
        pinches = [gesture(f"{kind}_{finger}") for kind in ("pinch_pad", "pinch_tip")]
        starts = make_valid(model, np.stack(pinches))
    else:
        starts = check_array("start", start, (NUM_JOINTS,)).reshape(-1, NUM_JOINTS)
    for begin in np.clip(starts, LOW, HIGH):
        angles = begin
        for _ in range(_MAX_ROUNDS):  # A solution stays near its start, so a far touch needs several rounds.
            angles = _solve_touch(model, finger, angles)
            if is_touching(model, angles[None], finger)[0]:
                return angles
    raise PoseError(
        f"this hand's thumb and {finger} finger could not be brought to touch pad to pad: "
        "another start or finger may do"
    )


def is_touching(model: HandModel, angles: Float[np.ndarray, "T 20"], finger: str) -> NDArray[np.bool_]:
    """Which poses (T,) are valid and touch as `touching_angles` defines it."""
    contact = thumb_contact(model, angles, finger)
    touching = (contact.overlap >= 0.0) & (contact.overlap <= MAX_OVERLAP)
    facing = (contact.facing >= MIN_FACING).all(axis=1)
    return np.asarray(touching & facing & is_valid(model, angles))


def _solve_touch(model: HandModel, finger: str, start: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.optimize import least_squares

    number = DIGITS.index(finger)
    moving = np.r_[0:4, 4 * number : 4 * number + 4]
    low, high = LOW[moving], HIGH[moving]
    residuals = _residuals(model, finger, start, moving)

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        steps = np.where(x + _ANGLE_STEP > high, -_ANGLE_STEP, _ANGLE_STEP)
        moved = residuals(np.vstack([x, x + np.diag(steps)]))
        return np.asarray((moved[1:] - moved[0]).T / steps)

    inside = np.clip(start[moving], low + 1e-4, high - 1e-4)
    solution = least_squares(
        lambda x: residuals(x[None])[0], inside, jac=jacobian, bounds=(low, high), max_nfev=60, xtol=1e-6,
        ftol=1e-6,
    )  # fmt: skip
    angles: NDArray[np.float64] = start.copy()
    angles[moving] = solution.x
    return angles


def _residuals(
    model: HandModel, finger: str, start: NDArray[np.float64], moving: NDArray[np.int64]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The residuals (T, R) as a function of the moving angles (T, 8) [rad]."""
    capsules = model.capsules
    bones = bones_of("thumb")[2], bones_of(finger)[2]
    pads = []  # the middle of each last bone's pad, in the bone's frame [m]
    for bone in bones:
        index = int(np.flatnonzero(capsules.bones == bone)[0])
        pads.append(capsules.starts[index] + _PAD_SHARE * (capsules.ends[index] - capsules.starts[index]))
        pads[-1][2] -= capsules.radii[index]
    pairs = capsules.touching_pairs()
    pairs = pairs[~np.isin(capsules.bones[pairs], bones).all(axis=1)]

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        angles = np.tile(start, (len(x), 1))
        angles[:, moving] = x
        frames = model.forward_kinematics(join_qpos(angles))
        overlaps = _overlaps(capsules.posed(frames), capsules.radii, pairs)
        contact = _bones_contact(capsules, frames, finger)
        positions = [
            np.einsum("tij,j->ti", frames[:, bone, :3, :3], pad) + frames[:, bone, :3, 3]
            for bone, pad in zip(bones, pads, strict=True)
        ]
        return np.concatenate(
            [
                (contact.overlap - 0.5 * MAX_OVERLAP)[:, None] / _OVERLAP_SCALE,
                np.maximum(0.0, overlaps - 0.7 * MAX_PENETRATION) / _PENETRATION_SCALE,
                _FACING_WEIGHT * np.maximum(0.0, _TARGET_FACING - contact.facing),
                (positions[0] - positions[1]) / _PAD_SCALE,
                _ANGLE_WEIGHTS * (x - start[moving]),
            ],
            axis=1,
        )

    return residuals


def _nearest_points(segments: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest points (T, 2, 3) of two segments (T, 2, 2, 3)."""
    start, along = segments[:, :, 0], segments[:, :, 1] - segments[:, :, 0]
    apart = start[:, 0] - start[:, 1]
    uu, vv = (along**2).sum(axis=2).T
    uv = (along[:, 0] * along[:, 1]).sum(axis=1)
    uw, vw = (along * apart[:, None]).sum(axis=2).T
    determinant = np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv)
    first = np.clip((uv * vw - vv * uw) / determinant, 0.0, 1.0)
    second = np.clip((uv * first + vw) / vv, 0.0, 1.0)
    first = np.clip((uv * second - uw) / uu, 0.0, 1.0)
    return start + np.stack([first, second], axis=1)[..., None] * along


@kernel
def _overlaps(
    segments: Float[np.ndarray, "T K 2 3"], radii: Float[np.ndarray, "K"], pairs: Int[np.ndarray, "P 2"]
) -> Any:
    """Overlaps (T, P) [m] of pairs of capsules; minus the gap where they are apart."""
    overlaps = np.empty((len(segments), len(pairs)))
    for frame in range(len(segments)):
        for pair in range(len(pairs)):
            i, j = pairs[pair, 0], pairs[pair, 1]
            squared = segment_distance_squared(
                segments[frame, i, 0], segments[frame, i, 1], segments[frame, j, 0], segments[frame, j, 1]
            )
            overlaps[frame, pair] = radii[i] + radii[j] - np.sqrt(squared)
    return overlaps
