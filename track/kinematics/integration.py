"""Poses on the move, compiled: a step along MuJoCo's velocities, and the velocity between two poses.

The wrist's place moves along the world's axes, its orientation turns in its own frame, hinges add up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


def move(qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"]) -> Float[np.ndarray, "T 27"]:
    """Poses after a step."""
    moved = np.empty_like(qpos)
    _move(np.ascontiguousarray(qpos), np.ascontiguousarray(step), moved)
    return moved


def velocity_of(
    before: Float[np.ndarray, "27"], after: Float[np.ndarray, "27"], span: float
) -> Float[np.ndarray, "26"]:
    """How fast a hand went from one pose to another in a time [s], the shorter way round."""
    velocity = np.empty(len(before) - 1)
    _find_velocity(before, after, span, velocity)
    return velocity


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _move(qpos: Any, step: Any, moved: Any) -> None:
    for row in range(len(qpos)):
        before, by, after = qpos[row], step[row], moved[row]
        for n in range(3):
            after[n] = before[n] + by[n]
        for n in range(7, len(before)):
            after[n] = before[n] + by[n - 1]
        turn_by(before[3:7], by[3:6], after[3:7])


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def turn_by(before: Any, vector: Any, after: Any) -> None:
    """Turn a unit quaternion (4,) wxyz by a rotation vector (3,) [rad] in its own frame."""
    w, x, y, z = before[0], before[1], before[2], before[3]
    a, b, c = vector[0], vector[1], vector[2]
    angle = np.sqrt(a * a + b * b + c * c)
    share = 0.5 if angle < 1e-8 else np.sin(0.5 * angle) / angle
    e, a, b, c = np.cos(0.5 * angle), share * a, share * b, share * c
    after[0] = w * e - x * a - y * b - z * c
    after[1] = w * a + x * e + y * c - z * b
    after[2] = w * b - x * c + y * e + z * a
    after[3] = w * c + x * b - y * a + z * e
    scale = 1.0 / np.sqrt(after[0] ** 2 + after[1] ** 2 + after[2] ** 2 + after[3] ** 2)
    for n in range(4):
        after[n] *= scale


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _find_velocity(before: Any, after: Any, span: Any, velocity: Any) -> None:
    p, q, r, s = before[3], -before[4], -before[5], -before[6]
    w, x, y, z = after[3], after[4], after[5], after[6]
    cosine = p * w - q * x - r * y - s * z
    turn = velocity[3:6]
    turn[0] = p * x + q * w + r * z - s * y
    turn[1] = p * y - q * z + r * w + s * x
    turn[2] = p * z + q * y - r * x + s * w
    sine = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    share = 2.0 if sine < 1e-8 else 2.0 * np.arctan2(sine, abs(cosine)) / sine
    for n in range(3):
        velocity[n] = (after[n] - before[n]) / span
        turn[n] *= (share if cosine >= 0.0 else -share) / span
    for n in range(7, len(before)):
        velocity[n - 1] = (after[n] - before[n]) / span
