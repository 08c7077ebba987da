"""Poses along MuJoCo's velocities, compiled: a step from a pose, and the velocity between two poses.

The wrist's position moves along the world's axes, its orientation rotates in its own frame, joint angles add
up.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import quaternion_product, rotate_quaternion


def move(qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"]) -> Float[np.ndarray, "T 27"]:
    """Poses after a step: what `mj_integratePos` computes.

    Args:
        qpos: Wrist position [m], wrist orientation (wxyz, unit), joint angles [rad].
        step: Wrist translation in the world [m], wrist rotation vector in its own frame [rad], joint angles
            [rad].
    """
    moved = np.empty_like(qpos)
    _move(np.ascontiguousarray(qpos), np.ascontiguousarray(step), moved)
    return moved


def velocity_of(
    before: Float[np.ndarray, "27"], after: Float[np.ndarray, "27"], span: float
) -> Float[np.ndarray, "26"]:
    """Velocity that takes a hand from one pose to another, the shorter way round: `mj_differentiatePos`.

    Returns:
        Wrist velocity in the world [m/s], its angular velocity in its own frame [rad/s], joint rates [rad/s].
    """
    velocity = np.empty(len(before) - 1)
    _find_velocity(before, after, span, velocity)
    return velocity


@kernel
def _move(
    qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"], moved: Float[np.ndarray, "T 27"]
) -> None:
    """Write `qpos` after `step` into `moved`; units as in `move`."""
    for row in range(len(qpos)):
        before, by, after = qpos[row], step[row], moved[row]
        for n in range(3):
            after[n] = before[n] + by[n]
        for n in range(7, len(before)):
            after[n] = before[n] + by[n - 1]
        rotate_quaternion(before[3:7], by[3:6], after[3:7])


@kernel
def _find_velocity(
    before: Float[np.ndarray, "27"],
    after: Float[np.ndarray, "27"],
    span: float,
    velocity: Float[np.ndarray, "26"],
) -> None:
    """Write the velocity from `before` to `after` into `velocity`; units as in `velocity_of`."""
    rate = velocity[3:6]
    cosine, rate[0], rate[1], rate[2] = quaternion_product(
        before[3], -before[4], -before[5], -before[6], after[3], after[4], after[5], after[6]
    )
    sine = np.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    share = 2.0 if sine < 1e-8 else 2.0 * np.arctan2(sine, abs(cosine)) / sine
    for n in range(3):
        velocity[n] = (after[n] - before[n]) / span
        rate[n] *= (share if cosine >= 0.0 else -share) / span
    for n in range(7, len(before)):
        velocity[n - 1] = (after[n] - before[n]) / span
