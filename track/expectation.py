"""Where a pose has its markers and how surely: the covariance that the fit leaves them, compiled.

A marker that is missing may still be nearly pinned down by its neighbours, or free along the arc of one
hinge; the normal matrix of the fit knows which, together with what is believed of the hinges themselves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from handsim.topology import NUM_JOINTS
from track.gloved_hand import NUM_UNKNOWNS, gather, place_markers, workspace
from track.pose_descent import find_misses
from track.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Float

_FEWEST_ON_A_DIGIT: Final = 3  # markers that tell its four hinges also when it is straight


class Expectation(NamedTuple):
    """Markers and hinges as a fitted pose has them."""

    qpos: Float[np.ndarray, "27"]
    """The pose, digits that lack markers being settled between those and what is believed."""
    places: Float[np.ndarray, "M 3"]
    """[m] in the world."""
    covariances: Float[np.ndarray, "M 3 3"]
    """What the fit leaves open [m^2], in the world."""
    turns: Float[np.ndarray, "M 3 3"]
    """Rotations of the bones that carry most of each marker, in the world."""
    hinges: Float[np.ndarray, "20 20"]
    """Covariance of the hinges [rad^2]."""
    told: Float[np.ndarray, "20 20"]
    """What the markers alone tell of the hinges, the palm being held: an information matrix [1/rad^2]."""
    pull: Float[np.ndarray, "20"]
    """Where the markers draw the hinges to: that matrix times the angles at which they would rest [1/rad]."""


def expectation(num_markers: int) -> Expectation:
    """Room for one."""
    return Expectation(
        np.empty(7 + NUM_JOINTS),
        np.empty((num_markers, 3)),
        np.empty((num_markers, 3, 3)),
        np.empty((num_markers, 3, 3)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty(NUM_JOINTS),
    )


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def expect_markers(
    hand: Any, on_part: Any, pose: Any, target: Any, mean: Any, precision: Any, weight: Any, out: Any
) -> None:
    """Fill an `Expectation`.

    Args:
        hand: The hand and its glove.
        on_part: Markers on each digit, and the palm (6,).
        pose: The fitted pose (27,).
        target: The markers it was fitted to (M, 3) [m]; NaN where missing.
        mean: Angles (20,) that the hinges were believed to have [rad].
        precision: How surely, and how surely the wrist was where the pose has it (26, 26).
        weight: Inverse variance of the markers [1/m^2].
        out: What is filled.
    """
    count = len(target)
    work, wrist, weights = workspace(count), np.empty((3, 3)), np.zeros(count)
    write_rotation(pose[3:7], wrist)
    out.qpos[:] = pose
    find_misses(hand, target, pose, work)
    seen = np.zeros(len(on_part), dtype=np.int64)
    for marker in range(count):
        if not np.isnan(work.misses[marker, 0]):
            weights[marker] = weight
            seen[hand.digits[marker]] += 1
    gather(hand, weights, work)
    if _settle(hand, seen, on_part, mean, precision, work, out.qpos):
        find_misses(hand, target, out.qpos, work)
        gather(hand, weights, work)
    normal = work.normal
    for row in range(NUM_UNKNOWNS):
        normal[row, row] += 1e-9 * weight
        for column in range(row):
            normal[row, column] = normal[column, row]
    out.told[:] = normal[:NUM_JOINTS, :NUM_JOINTS]
    out.pull[:] = out.told @ out.qpos[7:] - work.gradient[:NUM_JOINTS]
    normal += precision
    inverse = np.linalg.inv(normal)
    out.hinges[:] = inverse[:NUM_JOINTS, :NUM_JOINTS]
    for marker in range(count):
        slopes = wrist @ work.slopes[marker]
        out.covariances[marker] = slopes @ inverse @ slopes.T
        out.turns[marker] = wrist @ work.rotations[hand.bones[marker, 0]]
        out.places[marker] = pose[:3] + wrist @ work.markers[marker]


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _settle(hand: Any, seen: Any, on_part: Any, mean: Any, precision: Any, work: Any, qpos: Any) -> Any:
    """Move the hinges of digits that lack markers to where belief and markers balance; whether any did.

    The others' are given: what is seen of one finger tells of the next.
    """
    weak = np.zeros(NUM_JOINTS, dtype=np.int64)
    count = 0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        if seen[digit] < max(on_part[digit], _FEWEST_ON_A_DIGIT):
            weak[count] = hinge
            count += 1
    if count == 0:
        return False
    matrix, rest = np.empty((count, count)), np.empty(count)
    away = np.ascontiguousarray(precision[:NUM_JOINTS, :NUM_JOINTS]) @ (qpos[7:] - mean)
    for row in range(count):
        one = weak[row]
        rest[row] = -work.gradient[one] - away[one]
        for column in range(count):
            other = weak[column]
            told = work.normal[min(one, other), max(one, other)]
            matrix[row, column] = told + precision[one, other]
    step = np.linalg.solve(matrix, rest)
    for row in range(count):
        hinge = weak[row]
        low, high = hand.ranges[hinge, 0], hand.ranges[hinge, 1]
        qpos[7 + hinge] = min(max(qpos[7 + hinge] + step[row], low), high)
    return True


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def carry_markers(hand: Any, pose: Any, places: Any) -> None:
    """Places (M, 3) [m] of a pose's markers in the world."""
    work, wrist = workspace(len(places)), np.empty((3, 3))
    write_rotation(pose[3:7], wrist)
    place_markers(hand, pose[7:], work)
    for marker in range(len(places)):
        places[marker] = pose[:3] + wrist @ work.markers[marker]
