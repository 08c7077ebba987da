"""Compiled Levenberg-Marquardt on one hand's pose: E_IK with joint limits, a prior and a robust loss.

The energy is that of Han et al. 2018, section 4.3. Small positive-definite systems are solved here for all
fits of hands: a call of LAPACK costs more than their solution.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from handsim.hand.shape import NUM_JOINTS
from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import rotate_quaternion
from track.kinematics.marker_kinematics import (
    NUM_UNKNOWNS,
    HandArrays,
    Workspace,
    accumulate_normal_equations,
    compute_markers,
)

MARKER_NOISE: Final = 0.001
"""Standard deviation of a marker [m]: the scale of all costs; optical systems and gloves reach about this."""
_MARKER_PRECISION: Final = MARKER_NOISE**-2  # [1/m^2]
_LIMIT_PRECISION: Final = np.deg2rad(2.0) ** -2  # [1/rad^2] of a hinge beyond its range: a soft limit
_FIRST_DAMPING: Final = 1e-4  # share of the diagonal; small, because most starts are near the minimum
_LEAST_DAMPING: Final = 1e-10  # share of the diagonal; keeps the factor positive
_MOST_DAMPING: Final = 1e8  # share of the diagonal; steps are nothing from there on


@kernel
def levenberg_marquardt(
    hand: HandArrays,
    target: Float[np.ndarray, "M 3"],
    qpos: Float[np.ndarray, "27"],
    prior_mean: Float[np.ndarray, "27"],
    precision: Float[np.ndarray, "26"],
    robust_scale: float,
    most_steps: int,
    small_gain: float,
    work: Workspace,
) -> tuple[float, int]:
    """Bring a pose to a minimum of its cost.

    Args:
        target: Markers in the world [m]; NaN where missing.
        qpos: Pose to start from, overwritten.
        prior_mean: Mean of the prior, a pose.
        precision: Diagonal precision of the prior, in the order of a step's unknowns
            [1/rad^2, 1/m^2, 1/rad^2]; zero where there is no prior.
        robust_scale: Inverse square of the distance at which the robust loss levels off [1/m^2]; zero for
            plain least squares.
        small_gain: Expected decrease of the cost from which on a step is the last one.

    Returns:
        The cost (squared standard deviations), and how many steps were tried.
    """
    trial = qpos.copy()
    weights = np.zeros(len(target))
    cost = _cost(hand, target, qpos, prior_mean, precision, robust_scale, work)
    _linearize(hand, qpos, prior_mean, precision, robust_scale, weights, work)
    damping, steps = _FIRST_DAMPING, 0
    while steps < most_steps and damping < _MOST_DAMPING:
        steps += 1
        gain = _solve(hand.skyline, damping, work)
        if gain < 0.0:
            damping *= 10.0
            continue
        move_wrist(qpos, work.step, trial)
        for hinge in range(NUM_JOINTS):
            trial[7 + hinge] = qpos[7 + hinge] + work.step[hinge]
        trial_cost = _cost(hand, target, trial, prior_mean, precision, robust_scale, work)
        better = trial_cost < cost
        if better:
            qpos[:] = trial
            cost = trial_cost
        if gain < small_gain:
            break
        if better:
            _linearize(hand, qpos, prior_mean, precision, robust_scale, weights, work)
        damping = max(damping * 0.1, _LEAST_DAMPING) if better else damping * 10.0
    return cost, steps


@kernel
def marker_residuals(
    hand: HandArrays, target: Float[np.ndarray, "M 3"], qpos: Float[np.ndarray, "27"], work: Workspace
) -> None:
    """Forward kinematics, and the residuals of the markers in the wrist's frame.

    Args:
        target: Markers in the world [m]; NaN where missing.
        work: Filled as by `compute_markers`, and `residuals` too.
    """
    compute_markers(hand, qpos[7:], work)
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    for marker in range(len(target)):
        a, b, c = (
            target[marker, 0] - qpos[0],
            target[marker, 1] - qpos[1],
            target[marker, 2] - qpos[2],
        )
        # The inverse rotation: v + 2 w (v x u) + 2 (v x u) x u, with u the quaternion's vector part.
        i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
        position, residual = work.markers[marker], work.residuals[marker]
        residual[0] = position[0] - a - 2.0 * (w * i + j * z - k * y)
        residual[1] = position[1] - b - 2.0 * (w * j + k * x - i * z)
        residual[2] = position[2] - c - 2.0 * (w * k + i * y - j * x)


@kernel
def _cost(
    hand: HandArrays,
    target: Float[np.ndarray, "M 3"],
    qpos: Float[np.ndarray, "27"],
    prior_mean: Float[np.ndarray, "27"],
    precision: Float[np.ndarray, "26"],
    robust_scale: float,
    work: Workspace,
) -> float:
    """Cost of a pose (squared standard deviations); fills `work` as `marker_residuals` does."""
    marker_residuals(hand, target, qpos, work)
    cost = 0.0
    for marker in range(len(target)):
        residual = work.residuals[marker]
        square = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2]
        if not np.isnan(square):
            cost += _MARKER_PRECISION * square / (1.0 + robust_scale * square)  # Geman and McClure 1987
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        deviation = angle - prior_mean[7 + hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        cost += precision[hinge] * deviation * deviation + _LIMIT_PRECISION * beyond * beyond
    if precision[NUM_JOINTS] > 0.0:
        wrist_offsets(prior_mean, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            cost += precision[unknown] * work.step[unknown] ** 2
    return cost


@kernel
def _linearize(
    hand: HandArrays,
    qpos: Float[np.ndarray, "27"],
    prior_mean: Float[np.ndarray, "27"],
    precision: Float[np.ndarray, "26"],
    robust_scale: float,
    weights: Float[np.ndarray, "M"],
    work: Workspace,
) -> None:
    """Normal matrix and half gradient at the pose for which `marker_residuals` was last called.

    The robust loss is taken into account by reweighting; `weights` [1/m^2] is a buffer and is overwritten.
    """
    for marker in range(len(weights)):
        residual = work.residuals[marker]
        square = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2]
        weights[marker] = 0.0 if np.isnan(square) else _MARKER_PRECISION / (1.0 + robust_scale * square) ** 2
    accumulate_normal_equations(hand, weights, work)
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        work.gradient[hinge] += precision[hinge] * (angle - prior_mean[7 + hinge])
        work.normal[hinge, hinge] += precision[hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        if beyond != 0.0:
            work.gradient[hinge] += _LIMIT_PRECISION * beyond
            work.normal[hinge, hinge] += _LIMIT_PRECISION
    if precision[NUM_JOINTS] > 0.0:
        wrist_offsets(prior_mean, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            work.gradient[unknown] += precision[unknown] * work.step[unknown]
            work.normal[unknown, unknown] += precision[unknown]


@kernel
def _solve(skyline: Int[np.ndarray, "26"], damping: float, work: Workspace) -> float:
    """Solve the damped normal equations by a skyline Cholesky factor; `factor` and `step` are filled.

    Returns the expected decrease of the cost; a negative number when the matrix has no factor.
    """
    factor, step, gain = work.factor, work.step, 0.0
    for row in range(NUM_UNKNOWNS):
        start, own = skyline[row], factor[row]
        rest = -work.gradient[row]
        pivot = work.normal[row, row] * (1.0 + damping)
        for column in range(start, row):
            other = factor[column]
            entry = work.normal[column, row]
            for k in range(max(start, skyline[column]), column):
                entry -= own[k] * other[k]
            entry *= other[column]
            own[column] = entry
            pivot -= entry * entry
            rest -= entry * step[column]
        if not pivot > 0.0:
            return -1.0
        own[row] = 1.0 / np.sqrt(pivot)
        step[row] = rest * own[row]
        gain += step[row] * step[row]
    for row in range(NUM_UNKNOWNS - 1, -1, -1):
        step[row] *= factor[row, row]
        for column in range(skyline[row], row):
            step[column] -= factor[row, column] * step[row]
    return gain


@kernel
def move_wrist(
    qpos: Float[np.ndarray, "27"], step: Float[np.ndarray, "26"], moved: Float[np.ndarray, "27"]
) -> None:
    """Translate and rotate the wrist along its own axes by the last six unknowns of a step.

    Args:
        qpos: The pose before.
        step: The step [rad, m, rad].
        moved: The pose after; only its first seven numbers are written.
    """
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    a, b, c = step[NUM_JOINTS], step[NUM_JOINTS + 1], step[NUM_JOINTS + 2]
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    moved[0] = qpos[0] + a + 2.0 * (w * i + y * k - z * j)
    moved[1] = qpos[1] + b + 2.0 * (w * j + z * i - x * k)
    moved[2] = qpos[2] + c + 2.0 * (w * k + x * j - y * i)
    rotate_quaternion(qpos[3:7], step[NUM_JOINTS + 3 : NUM_JOINTS + 6], moved[3:7])


@kernel
def wrist_offsets(
    before: Float[np.ndarray, "27"], now: Float[np.ndarray, "27"], step: Float[np.ndarray, "26"]
) -> None:
    """Fill the last six numbers of a step: translation and rotation of the wrist from one pose to another.

    They are along its axes in the second; the rotation is to first order, twice the vector part of the
    quaternion.
    """
    w, x, y, z = now[3], now[4], now[5], now[6]
    a, b, c = now[0] - before[0], now[1] - before[1], now[2] - before[2]
    i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
    step[NUM_JOINTS] = a + 2.0 * (w * i + j * z - k * y)
    step[NUM_JOINTS + 1] = b + 2.0 * (w * j + k * x - i * z)
    step[NUM_JOINTS + 2] = c + 2.0 * (w * k + i * y - j * x)
    p, q, r, s = before[3], -before[4], -before[5], -before[6]
    e = p * w - q * x - r * y - s * z
    share = 2.0 if e >= 0.0 else -2.0
    step[NUM_JOINTS + 3] = share * (p * x + q * w + r * z - s * y)
    step[NUM_JOINTS + 4] = share * (p * y - q * z + r * w + s * x)
    step[NUM_JOINTS + 5] = share * (p * z + q * y - r * x + s * w)


@kernel
def invert_positive(matrix: Float[np.ndarray, "N N"]) -> None:
    """Overwrite a symmetric positive-definite matrix by its inverse; only its lower triangle is read."""
    count = len(matrix)
    for row in range(count):
        for column in range(row + 1):
            entry = matrix[row, column]
            for k in range(column):
                entry -= matrix[row, k] * matrix[column, k]
            matrix[row, column] = np.sqrt(entry) if row == column else entry / matrix[column, column]
    for row in range(count):
        scale = 1.0 / matrix[row, row]
        for column in range(row):
            entry = 0.0
            for k in range(column, row):
                entry -= matrix[row, k] * matrix[k, column]
            matrix[row, column] = entry * scale
        matrix[row, row] = scale
    for row in range(count):
        for column in range(row + 1):
            entry = 0.0
            for k in range(row, count):
                entry += matrix[k, row] * matrix[k, column]
            matrix[row, column] = entry
            matrix[column, row] = entry


@kernel
def eliminate(
    matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"], first: int, last: int
) -> None:
    """Eliminate unknowns `first` to before `last` of a symmetric positive-definite system (Schur complement).

    Matrix and right side are overwritten; the block below and right of the eliminated unknowns stays
    symmetric and complete.
    """
    for pivot in range(first, last):
        scale = 1.0 / matrix[pivot, pivot]
        for row in range(pivot + 1, len(matrix)):
            share = matrix[row, pivot] * scale
            if share != 0.0:
                for column in range(pivot + 1, len(matrix)):
                    matrix[row, column] -= share * matrix[pivot, column]
                right_side[row] -= share * right_side[pivot]


@kernel
def solve_positive(matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"]) -> None:
    """Solve a symmetric positive-definite system; both are overwritten, the right side by the solution."""
    count = len(matrix)
    eliminate(matrix, right_side, 0, count)
    for row in range(count - 1, -1, -1):
        for column in range(row + 1, count):
            right_side[row] -= matrix[row, column] * right_side[column]
        right_side[row] /= matrix[row, row]
