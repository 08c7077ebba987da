"""Compiled fit of one digit to the points of a hypothesis: Levenberg-Marquardt on four hinges."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from handsim.kernels.kernel import kernel
from track.kinematics.levenberg_marquardt import eliminate, solve_positive
from track.kinematics.marker_kinematics import (
    HandArrays,
    Workspace,
    compute_digit,
    compute_marker,
    marker_jacobian,
)

_STEPS: Final = 10  # Levenberg-Marquardt steps at most; a digit needs about four
_SMALL_GAIN: Final = 0.01  # of the cost (half squared standard deviations); no decision hangs on less
_LIMIT_PRECISION: Final = np.deg2rad(2.0) ** -2  # [1/rad^2] of a hinge beyond its range: a soft limit
_ROBUST_SQUARE: Final = 20.0  # squared standard deviations of the prior at which its loss levels off


@kernel
def fit_hypothesis(
    hand: HandArrays,
    digit: int,
    markers: Int[np.ndarray, "K"],
    points: Float[np.ndarray, "C 3"],
    variance: Float[np.ndarray, "M"],
    hypothesis: Int[np.ndarray, "K"],
    mean: Float[np.ndarray, "4"],
    precision: Float[np.ndarray, "4 4"],
    cutoff: float,
    angles: Float[np.ndarray, "4"],
    work: Workspace,
) -> tuple[float, float]:
    """Fit the four hinges of a digit to a hypothesis by Levenberg-Marquardt.

    Args:
        hand: The hand, its markers shifted by their biases.
        points: The candidates in the wrist's frame [m].
        variance: Variance of each marker of the hand [m^2].
        hypothesis: Candidate of each of the digit's markers, -1 for none.
        mean: Mean of the digit's prior [rad].
        precision: Precision of the digit's prior [1/rad^2].
        cutoff: Cost beyond which the fit stops early if it would end there.
        angles: Hinges to start from [rad], overwritten.

    Returns:
        The cost of markers and prior (half squared standard deviations), and the complexity term: half the
        log ratio of the hinges' precision after and before (Laplace's approximation), because a hypothesis
        that any pose would fit is little evidence.
    """
    trial, factor, step = angles.copy(), np.empty((4, 4)), np.empty(4)
    normal, gradient = np.empty((4, 4)), np.empty(4)
    new_normal, new_gradient = np.empty((4, 4)), np.empty(4)
    cost = _accumulate_normal_equations(
        hand, digit, markers, points, variance, hypothesis, mean, precision, angles, work, normal, gradient
    )
    damping = 1e-3
    for _ in range(_STEPS):
        for row in range(4):
            step[row] = -gradient[row]
            for column in range(4):
                factor[row, column] = normal[row, column]
            factor[row, row] *= 1.0 + damping
        solve_positive(factor, step)
        gain = 0.0
        for row in range(4):
            gain -= gradient[row] * step[row]
            trial[row] = angles[row] + step[row]
        if gain < _SMALL_GAIN:
            break
        if cost - 2.0 * gain > cutoff:
            cost -= 2.0 * gain
            break
        tried = _accumulate_normal_equations(
            hand,
            digit,
            markers,
            points,
            variance,
            hypothesis,
            mean,
            precision,
            trial,
            work,
            new_normal,
            new_gradient,
        )
        if tried < cost:
            small = cost - tried < _SMALL_GAIN
            cost = tried
            angles[:] = trial
            normal[:] = new_normal
            gradient[:] = new_gradient
            damping = max(damping * 0.1, 1e-9)
            if small:
                break
        else:
            damping *= 30.0
            if damping > 1e5:
                break
    return cost, 0.5 * (_log_determinant(normal) - _log_determinant(precision))


@kernel
def _accumulate_normal_equations(
    hand: HandArrays,
    digit: int,
    markers: Int[np.ndarray, "K"],
    points: Float[np.ndarray, "C 3"],
    variance: Float[np.ndarray, "M"],
    hypothesis: Int[np.ndarray, "K"],
    mean: Float[np.ndarray, "4"],
    precision: Float[np.ndarray, "4 4"],
    angles: Float[np.ndarray, "4"],
    work: Workspace,
    normal: Float[np.ndarray, "4 4"],
    gradient: Float[np.ndarray, "4"],
) -> float:
    """Cost at some angles [rad]; its normal matrix and half its gradient are filled.

    The arguments are those of `fit_hypothesis`.
    """
    normal[:] = 0.0
    gradient[:] = 0.0
    cost, first = 0.0, 4 * digit
    compute_digit(hand, digit, angles, work)
    for slot in range(len(markers)):
        if hypothesis[slot] < 0:
            continue
        marker, point = markers[slot], points[hypothesis[slot]]
        compute_marker(hand, marker, work)
        marker_jacobian(hand, marker, work)
        weight, jacobian, position = 1.0 / variance[marker], work.jacobian[marker], work.markers[marker]
        x, y, z = position[0] - point[0], position[1] - point[1], position[2] - point[2]
        cost += 0.5 * weight * (x * x + y * y + z * z)
        for row in range(4):
            a, b, c = jacobian[0, first + row], jacobian[1, first + row], jacobian[2, first + row]
            a, b, c = weight * a, weight * b, weight * c
            gradient[row] += a * x + b * y + c * z
            for column in range(row + 1):
                other = first + column
                normal[row, column] += (
                    a * jacobian[0, other] + b * jacobian[1, other] + c * jacobian[2, other]
                )
    for row in range(4):
        for column in range(row):
            normal[column, row] = normal[row, column]
    square = 0.0
    for row in range(4):
        for column in range(4):
            square += (angles[row] - mean[row]) * precision[row, column] * (angles[column] - mean[column])
    weight_of_prior = 1.0 / (1.0 + square / _ROBUST_SQUARE)
    cost += 0.5 * _ROBUST_SQUARE * np.log(1.0 + square / _ROBUST_SQUARE)
    for row in range(4):
        for column in range(4):
            gradient[row] += weight_of_prior * precision[row, column] * (angles[column] - mean[column])
            normal[row, column] += weight_of_prior * precision[row, column]
        low, high = hand.ranges[first + row, 0], hand.ranges[first + row, 1]
        beyond = max(angles[row] - high, 0.0) + min(angles[row] - low, 0.0)
        if beyond != 0.0:
            cost += 0.5 * _LIMIT_PRECISION * beyond * beyond
            gradient[row] += _LIMIT_PRECISION * beyond
            normal[row, row] += _LIMIT_PRECISION
    return cost  # type: ignore[no-any-return]


@kernel
def _log_determinant(matrix: Float[np.ndarray, "4 4"]) -> float:
    """Log determinant of a positive-definite matrix, by elimination."""
    factor, total = matrix.copy(), 0.0
    eliminate(factor, np.zeros(4), 0, 4)
    for row in range(4):
        total += np.log(factor[row, row])
    return total
