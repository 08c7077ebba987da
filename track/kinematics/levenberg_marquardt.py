"""Levenberg-Marquardt on one hand's pose, compiled: E_IK with limits, a prior and a robust loss."""

from __future__ import annotations

from typing import Any, Final

import numba
import numpy as np

from handsim.hand.topology import NUM_JOINTS
from handsim.kernels.rotations import rotate_quaternion
from track.kinematics.marker_kinematics import FAST, NUM_UNKNOWNS, gather, place_markers

MARKER_NOISE: Final = 0.001  # [m] one standard deviation, which everything else is weighed against
_MARKER_WEIGHT: Final = MARKER_NOISE**-2
_LIMIT_WEIGHT: Final = np.deg2rad(2.0) ** -2  # of a hinge beyond its range
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-10, 1e8
_SMALL_GAIN = (1e-6 / MARKER_NOISE) ** 2  # markers nearer by a micron; what is left after that is far less


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def descend(
    hand: Any,
    target: Any,
    qpos: Any,
    center: Any,
    pull: Any,
    tightness: Any,
    most_steps: Any,
    work: Any,
) -> Any:
    """Bring a pose to a minimum of its cost; returns the cost and how many steps were tried.

    Args:
        hand: The hand and its glove.
        target: Markers (M, 3) [m]; NaN where missing.
        qpos: Pose (27,) to start from, overwritten.
        center: Pose (27,) that the prior draws the hand to.
        pull: How strongly it does (26,), as a step's unknowns go [1/rad^2, 1/m^2, 1/rad^2].
        tightness: Squared inverse of the distance from which a marker loses its say [1/m^2]; zero for never.
        most_steps: Steps at most.
        work: Room for the arithmetic.
    """
    trial = qpos.copy()
    weights = np.zeros(len(target))
    cost = _find_cost(hand, target, qpos, center, pull, tightness, work)
    _linearize(hand, qpos, center, pull, tightness, weights, work)
    damping, steps = _FIRST_DAMPING, 0
    while steps < most_steps and damping < _MOST_DAMPING:
        steps += 1
        gain = _solve(hand.starts, damping, work)
        if gain < 0.0:
            damping *= 10.0
            continue
        move_wrist(qpos, work.step, trial)
        for hinge in range(NUM_JOINTS):
            trial[7 + hinge] = qpos[7 + hinge] + work.step[hinge]
        trial_cost = _find_cost(hand, target, trial, center, pull, tightness, work)
        better = trial_cost < cost
        if better:
            qpos[:] = trial
            cost = trial_cost
        if gain < _SMALL_GAIN:
            break
        if better:
            _linearize(hand, qpos, center, pull, tightness, weights, work)
        damping = max(damping * 0.1, _LEAST_DAMPING) if better else damping * 10.0
    return cost, steps


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def find_misses(hand: Any, target: Any, qpos: Any, work: Any) -> None:
    """Place the hand's markers and carry those looked for into the wrist's frame."""
    place_markers(hand, qpos[7:], work)
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    for marker in range(len(target)):
        a, b, c = (
            target[marker, 0] - qpos[0],
            target[marker, 1] - qpos[1],
            target[marker, 2] - qpos[2],
        )
        # The inverse turn: v + 2 w (v x u) + 2 (v x u) x u, with u the quaternion's vector.
        i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
        place, miss = work.markers[marker], work.misses[marker]
        miss[0] = place[0] - a - 2.0 * (w * i + j * z - k * y)
        miss[1] = place[1] - b - 2.0 * (w * j + k * x - i * z)
        miss[2] = place[2] - c - 2.0 * (w * k + i * y - j * x)


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _find_cost(hand: Any, target: Any, qpos: Any, center: Any, pull: Any, tightness: Any, work: Any) -> Any:
    find_misses(hand, target, qpos, work)
    cost = 0.0
    for marker in range(len(target)):
        miss = work.misses[marker]
        square = miss[0] * miss[0] + miss[1] * miss[1] + miss[2] * miss[2]
        if not np.isnan(square):
            cost += _MARKER_WEIGHT * square / (1.0 + tightness * square)  # Geman and McClure 1987
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        off = angle - center[7 + hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        cost += pull[hinge] * off * off + _LIMIT_WEIGHT * beyond * beyond
    if pull[NUM_JOINTS] > 0.0:
        wrist_offsets(center, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            cost += pull[unknown] * work.step[unknown] ** 2
    return cost


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _linearize(hand: Any, qpos: Any, center: Any, pull: Any, tightness: Any, weights: Any, work: Any) -> None:
    """Normal matrix and half the gradient where `find_misses` was last called."""
    for marker in range(len(weights)):
        miss = work.misses[marker]
        square = miss[0] * miss[0] + miss[1] * miss[1] + miss[2] * miss[2]
        weights[marker] = 0.0 if np.isnan(square) else _MARKER_WEIGHT / (1.0 + tightness * square) ** 2
    gather(hand, weights, work)
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        work.gradient[hinge] += pull[hinge] * (angle - center[7 + hinge])
        work.normal[hinge, hinge] += pull[hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        if beyond != 0.0:
            work.gradient[hinge] += _LIMIT_WEIGHT * beyond
            work.normal[hinge, hinge] += _LIMIT_WEIGHT
    if pull[NUM_JOINTS] > 0.0:
        wrist_offsets(center, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            work.gradient[unknown] += pull[unknown] * work.step[unknown]
            work.normal[unknown, unknown] += pull[unknown]


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _solve(starts: Any, damping: Any, work: Any) -> Any:
    """Step down the damped normal equations by a skyline Cholesky factor.

    Returns by how much the cost should fall; a negative number when there is no factor.
    """
    factor, step, gain = work.factor, work.step, 0.0
    for row in range(NUM_UNKNOWNS):
        start, own = starts[row], factor[row]
        rest = -work.gradient[row]
        pivot = work.normal[row, row] * (1.0 + damping)
        for column in range(start, row):
            other = factor[column]
            entry = work.normal[column, row]
            for k in range(max(start, starts[column]), column):
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
        for column in range(starts[row], row):
            step[column] -= factor[row, column] * step[row]
    return gain


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def move_wrist(qpos: Any, step: Any, moved: Any) -> None:
    """Shift and turn the wrist along its own axes, which are the last six of a step."""
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    a, b, c = step[NUM_JOINTS], step[NUM_JOINTS + 1], step[NUM_JOINTS + 2]
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    moved[0] = qpos[0] + a + 2.0 * (w * i + y * k - z * j)
    moved[1] = qpos[1] + b + 2.0 * (w * j + z * i - x * k)
    moved[2] = qpos[2] + c + 2.0 * (w * k + x * j - y * i)
    rotate_quaternion(qpos[3:7], step[NUM_JOINTS + 3 : NUM_JOINTS + 6], moved[3:7])


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def wrist_offsets(before: Any, now: Any, step: Any) -> None:
    """How the wrist moved and turned, along its own axes now: the last six of a step; the first stay."""
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
