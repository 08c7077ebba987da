"""Where a pose has its markers and how surely: the covariance that the fit leaves them, compiled.

A marker that is missing may still be nearly pinned down by its neighbors, or free along the arc of one
hinge; the normal matrix of the fit knows which, together with what is believed of the hinges themselves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from handsim.hand.topology import NUM_JOINTS
from track.kinematics.levenberg_marquardt import find_misses
from track.kinematics.marker_kinematics import NUM_UNKNOWNS, gather, place_markers, workspace
from track.kinematics.small_systems import invert_positive, solve_positive
from track.kinematics.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Float

_FEWEST_ON_A_DIGIT: Final = 3  # markers that tell its four hinges also when it is straight
_ARC: Final = 0.04  # [m] radius of the arcs that markers move on


class Expectation(NamedTuple):
    """Markers and hinges as a fitted pose has them."""

    qpos: Float[np.ndarray, "27"]
    """The pose, digits that lack markers being settled between those and what is believed."""
    places: Float[np.ndarray, "M 3"]
    """[m] in the world."""
    covariances: Float[np.ndarray, "M 3 3"]
    """How far they may be from there [m^2], in the world: what the fit leaves open, and how they tremble."""
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
    hand: Any,
    on_part: Any,
    pose: Any,
    target: Any,
    belief: Any,
    wrist_spread: Any,
    variance: Any,
    noise: Any,
    out: Any,
) -> None:
    """Fill an `Expectation`.

    Args:
        hand: The hand and its glove.
        on_part: Markers on each digit, and the palm (6,).
        pose: The fitted pose (27,).
        target: The markers it was fitted to (M, 3) [m]; NaN where missing.
        belief: What was believed of the hinges before that, a `HingeBelief`.
        wrist_spread: How far the wrist may be from where the pose has it, [m] and [rad].
        variance: Of each marker around its place on the hand (M,) [m^2].
        noise: Standard deviation of the markers around the pose's [m].
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
            weights[marker] = 1.0 / noise**2
            seen[hand.digits[marker]] += 1
    gather(hand, weights, work)
    if _settle(hand, seen, on_part, belief, work, out.qpos):
        find_misses(hand, target, out.qpos, work)
        gather(hand, weights, work)
    posterior = work.factor
    for row in range(NUM_UNKNOWNS):
        for column in range(row + 1):
            posterior[row, column] = work.normal[column, row]
        posterior[row, row] += 1e-9 / noise**2
        if row >= NUM_JOINTS:
            posterior[row, row] += wrist_spread[(row - NUM_JOINTS) // 3] ** -2.0
    for row in range(NUM_JOINTS):
        out.pull[row] = -work.gradient[row]
        for column in range(NUM_JOINTS):
            out.told[row, column] = posterior[max(row, column), min(row, column)]
            out.pull[row] += out.told[row, column] * out.qpos[7 + column]
    posterior[:NUM_JOINTS, :NUM_JOINTS] += belief.precision
    invert_positive(posterior)
    out.hinges[:] = posterior[:NUM_JOINTS, :NUM_JOINTS]
    for marker in range(count):
        _spread(hand, marker, posterior, wrist, variance[marker], work, out.covariances[marker])
        bone = work.rotations[hand.bones[marker, 0]]
        for i in range(3):
            out.places[marker, i] = pose[i]
            for j in range(3):
                out.places[marker, i] += wrist[i, j] * work.markers[marker, j]
                out.turns[marker, i, j] = 0.0
                for k in range(3):
                    out.turns[marker, i, j] += wrist[i, k] * bone[k, j]


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _spread(
    hand: Any, marker: Any, posterior: Any, wrist: Any, variance: Any, work: Any, covariance: Any
) -> None:
    """How far a marker may be from where the pose has it, in the world."""
    first, last = hand.reach[marker, 0], hand.reach[marker, 1]
    count = last - first + 6
    slopes, turned = work.slopes[marker], np.zeros((3, count))
    for number in range(count):
        unknown = first + number if number < last - first else NUM_JOINTS + number - (last - first)
        for i in range(3):
            for j in range(3):
                turned[i, number] += wrist[i, j] * slopes[j, unknown]
    covariance[:] = 0.0
    for one in range(count):
        row = first + one if one < last - first else NUM_JOINTS + one - (last - first)
        for other in range(count):
            column = first + other if other < last - first else NUM_JOINTS + other - (last - first)
            share = posterior[row, column]
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += turned[i, one] * share * turned[j, other]
    # An arc leaves its tangent: open along it means open across it, by the square over twice its radius.
    bend = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / (2.0 * _ARC)
    for i in range(3):
        covariance[i, i] += variance + bend**2


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _settle(hand: Any, seen: Any, on_part: Any, belief: Any, work: Any, qpos: Any) -> Any:
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
    for row in range(count):
        one = weak[row]
        rest[row] = -work.gradient[one]
        for hinge in range(NUM_JOINTS):
            rest[row] -= belief.precision[one, hinge] * (qpos[7 + hinge] - belief.angles[hinge])
        for column in range(count):
            other = weak[column]
            told = work.normal[min(one, other), max(one, other)]
            matrix[row, column] = told + belief.precision[one, other]
    solve_positive(matrix, rest)
    for row in range(count):
        hinge = weak[row]
        low, high = hand.ranges[hinge, 0], hand.ranges[hinge, 1]
        qpos[7 + hinge] = min(max(qpos[7 + hinge] + rest[row], low), high)
    return True


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def carry_markers(hand: Any, pose: Any, places: Any) -> None:
    """Places (M, 3) [m] of a pose's markers in the world."""
    work, wrist = workspace(len(places)), np.empty((3, 3))
    write_rotation(pose[3:7], wrist)
    place_markers(hand, pose[7:], work)
    for marker in range(len(places)):
        places[marker] = pose[:3] + wrist @ work.markers[marker]
