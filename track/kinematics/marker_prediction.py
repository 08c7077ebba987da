"""Predicted positions of a pose's markers and their covariances, from the normal matrix of the fit; compiled.

The neighbors of a missing marker may determine its position nearly, or leave it free along the arc of one
hinge. The normal matrix of the fit together with the prior of the hinges tells which.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from handsim.hand.shape import NUM_JOINTS
from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import write_quaternion_matrix
from track.kinematics.levenberg_marquardt import invert_positive, marker_residuals, solve_positive
from track.kinematics.marker_kinematics import (
    NUM_UNKNOWNS,
    HandArrays,
    Workspace,
    accumulate_normal_equations,
    compute_markers,
    workspace,
)

if TYPE_CHECKING:
    from track.kinematics.joint_prior import JointPrior


_FEWEST_ON_DIGIT: Final = 3  # markers that determine the four hinges of a digit, also when it is straight
_ARC: Final = 0.04  # [m] usual radius of the arcs that markers move on: the length of a finger's bones
_LEAST_INFORMATION: Final = 1e-9  # share of a marker's precision on the diagonal, so that it has an inverse


class MarkerPrediction(NamedTuple):
    """Positions of the markers and angles of the hinges at a fitted pose, with their covariances."""

    qpos: Float[np.ndarray, "27"]
    """The pose; hinges of digits that lack markers are moved to the optimum of markers and prior."""
    positions: Float[np.ndarray, "M 3"]
    """Markers in the world [m]."""
    covariances: Float[np.ndarray, "M 3 3"]
    """Covariance of each marker in the world [m^2]: that of the pose, and the marker's own variance."""
    rotations: Float[np.ndarray, "M 3 3"]
    """Rotation in the world of the bone with the largest weight of each marker."""
    joint_covariance: Float[np.ndarray, "20 20"]
    """Covariance of the hinges [rad^2]."""
    information_matrix: Float[np.ndarray, "20 20"]
    """Information of the markers alone on the hinges, the palm being held [1/rad^2]."""
    information_vector: Float[np.ndarray, "20"]
    """The matrix times the angles that the markers alone would give [1/rad]."""


def empty_prediction(num_markers: int) -> MarkerPrediction:
    """A `MarkerPrediction` to be filled."""
    return MarkerPrediction(
        np.empty(7 + NUM_JOINTS),
        np.empty((num_markers, 3)),
        np.empty((num_markers, 3, 3)),
        np.empty((num_markers, 3, 3)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty(NUM_JOINTS),
    )


@kernel
def predict_markers(
    hand: HandArrays,
    on_part: Int[np.ndarray, "6"],
    pose: Float[np.ndarray, "27"],
    target: Float[np.ndarray, "M 3"],
    joint_prior: JointPrior,
    wrist_spread: tuple[float, float],
    variance: Float[np.ndarray, "M"],
    noise: float,
    out: MarkerPrediction,
) -> None:
    """Fill a `MarkerPrediction`.

    Args:
        on_part: Markers on each digit, and on the palm (last).
        target: The markers it was fitted to [m]; NaN where missing.
        joint_prior: Distribution of the hinges before the fit.
        wrist_spread: Standard deviations of the wrist's position [m] and orientation [rad] before the fit.
        variance: Variance of each marker around its position on the hand [m^2].
        noise: Standard deviation of the markers around the pose's [m].
        out: The prediction that is filled.
    """
    count = len(target)
    work, wrist, weights = workspace(count), np.empty((3, 3)), np.zeros(count)
    write_quaternion_matrix(wrist, pose[3], pose[4], pose[5], pose[6])
    out.qpos[:] = pose
    marker_residuals(hand, target, pose, work)
    seen = np.zeros(len(on_part), dtype=np.int64)
    for marker in range(count):
        if not np.isnan(work.residuals[marker, 0]):
            weights[marker] = 1.0 / noise**2
            seen[hand.digits[marker]] += 1
    accumulate_normal_equations(hand, weights, work)
    if _settle(hand, seen, on_part, joint_prior, work, out.qpos):
        marker_residuals(hand, target, out.qpos, work)
        accumulate_normal_equations(hand, weights, work)
    posterior = work.factor
    for row in range(NUM_UNKNOWNS):
        for column in range(row + 1):
            posterior[row, column] = work.normal[column, row]
        posterior[row, row] += _LEAST_INFORMATION / noise**2
        if row >= NUM_JOINTS:
            posterior[row, row] += wrist_spread[(row - NUM_JOINTS) // 3] ** -2.0
    for row in range(NUM_JOINTS):
        out.information_vector[row] = -work.gradient[row]
        for column in range(NUM_JOINTS):
            out.information_matrix[row, column] = posterior[max(row, column), min(row, column)]
            out.information_vector[row] += out.information_matrix[row, column] * out.qpos[7 + column]
    posterior[:NUM_JOINTS, :NUM_JOINTS] += joint_prior.precision
    invert_positive(posterior)
    out.joint_covariance[:] = posterior[:NUM_JOINTS, :NUM_JOINTS]
    for marker in range(count):
        _marker_covariance(hand, marker, posterior, wrist, variance[marker], work, out.covariances[marker])
        bone = work.rotations[hand.bones[marker, 0]]
        for i in range(3):
            out.positions[marker, i] = pose[i]
            for j in range(3):
                out.positions[marker, i] += wrist[i, j] * work.markers[marker, j]
                out.rotations[marker, i, j] = 0.0
                for k in range(3):
                    out.rotations[marker, i, j] += wrist[i, k] * bone[k, j]


@kernel
def _marker_covariance(
    hand: HandArrays,
    marker: int,
    posterior: Float[np.ndarray, "26 26"],
    wrist: Float[np.ndarray, "3 3"],
    variance: float,
    work: Workspace,
    covariance: Float[np.ndarray, "3 3"],
) -> None:
    """Covariance of a marker in the world [m^2], from the unknowns' posterior and its own variance."""
    first, last = hand.hinge_span[marker, 0], hand.hinge_span[marker, 1]
    count = last - first + 6
    jacobian, in_world = work.jacobian[marker], np.zeros((3, count))
    for number in range(count):
        unknown = first + number if number < last - first else NUM_JOINTS + number - (last - first)
        for i in range(3):
            for j in range(3):
                in_world[i, number] += wrist[i, j] * jacobian[j, unknown]
    covariance[:] = 0.0
    for one in range(count):
        row = first + one if one < last - first else NUM_JOINTS + one - (last - first)
        for other in range(count):
            column = first + other if other < last - first else NUM_JOINTS + other - (last - first)
            share = posterior[row, column]
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += in_world[i, one] * share * in_world[j, other]
    # A marker moves on an arc, not on its tangent: a variance along the tangent means a deviation
    # across it, by the square over twice the radius.
    bend = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / (2.0 * _ARC)
    for i in range(3):
        covariance[i, i] += variance + bend**2


@kernel
def _settle(
    hand: HandArrays,
    seen: Int[np.ndarray, "6"],
    on_part: Int[np.ndarray, "6"],
    joint_prior: JointPrior,
    work: Workspace,
    qpos: Float[np.ndarray, "27"],
) -> bool:
    """Move hinges of digits that lack markers to the optimum of prior and markers; False without such digits.

    The hinges of the other digits are held, and inform those of their neighbors through the prior's
    covariance.
    """
    weak = np.zeros(NUM_JOINTS, dtype=np.int64)
    count = 0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        if seen[digit] < max(on_part[digit], _FEWEST_ON_DIGIT):
            weak[count] = hinge
            count += 1
    if count == 0:
        return False
    matrix, change = np.empty((count, count)), np.empty(count)
    for row in range(count):
        one = weak[row]
        change[row] = -work.gradient[one]
        for hinge in range(NUM_JOINTS):
            change[row] -= joint_prior.precision[one, hinge] * (qpos[7 + hinge] - joint_prior.angles[hinge])
        for column in range(count):
            other = weak[column]
            information = work.normal[min(one, other), max(one, other)]
            matrix[row, column] = information + joint_prior.precision[one, other]
    solve_positive(matrix, change)
    for row in range(count):
        hinge = weak[row]
        low, high = hand.ranges[hinge, 0], hand.ranges[hinge, 1]
        qpos[7 + hinge] = min(max(qpos[7 + hinge] + change[row], low), high)
    return True


@kernel
def world_markers(
    hand: HandArrays, pose: Float[np.ndarray, "27"], positions: Float[np.ndarray, "M 3"]
) -> None:
    """Write the positions of a pose's markers in the world [m] to `positions`."""
    work, wrist = workspace(len(positions)), np.empty((3, 3))
    write_quaternion_matrix(wrist, pose[3], pose[4], pose[5], pose[6])
    compute_markers(hand, pose[7:], work)
    for marker in range(len(positions)):
        positions[marker] = pose[:3] + wrist @ work.markers[marker]
