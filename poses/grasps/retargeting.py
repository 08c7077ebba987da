"""Retargeting: the joint angles that bring a hand's fingertips where a hand of mean proportions has them."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.jacobian import skinned_jacobian
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import shape_from_measures
from handsim.hand.topology import DIGITS, NUM_JOINTS, bones_of
from poses.shapes.couplings import HIGH, LOW

_ROUNDS: Final = 12
_STIFFNESS: Final = 0.006  # [m/rad]: residual of a tip that weighs as much as a joint's deviation
_LONGEST_STEP: Final = 0.2  # [rad]


def retarget_angles(model: HandModel, angles: Float[np.ndarray, "P 20"]) -> Float[np.ndarray, "P 20"]:
    """Joint angles [rad] that bring the last joints and the tips of a hand where the mean hand has them.

    The mean hand has the same length and breadth. `angles` are its poses; the result differs as little from
    them as the other proportions need.
    """
    shape = model.shape
    mean = HandModel(shape_from_measures(shape.length, shape.breadth, side=shape.side))
    targets = _marks(mean, angles)[0]
    solutions = angles.copy()
    stiff = _STIFFNESS * np.eye(NUM_JOINTS)
    for _ in range(_ROUNDS):
        placed, jacobians = _marks(model, solutions)
        for number, jacobian in enumerate(jacobians):
            away = (targets - placed)[number].ravel()
            residuals = np.concatenate([away, _STIFFNESS * (angles - solutions)[number]])
            system = np.concatenate([jacobian.reshape(-1, NUM_JOINTS), stiff])
            step = np.linalg.lstsq(system, residuals, rcond=None)[0]
            solutions[number] += np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        solutions = np.clip(solutions, LOW, HIGH)
    return solutions


def _marks(model: HandModel, angles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Last joints and tips (P, 10, 3) in the wrist's frame [m]; Jacobians (P, 10, 3, 20) [m/rad]."""
    last = np.array([bones_of(digit)[2] for digit in DIGITS])
    rest = model.rest_transforms[last]
    tips = rest[:, :3, 3] + model.skeleton.lengths[last, None] * rest[:, :3, 0]
    points = np.concatenate([rest[:, :3, 3], tips])
    indices = np.zeros((len(points), 4), dtype=np.int64)
    indices[:, 0] = np.tile(last, 2)
    weights = np.zeros((len(points), 4))
    weights[:, 0] = 1.0
    bones = model.forward_kinematics(join_qpos(angles))
    carried = bones[:, indices[:, 0]] @ np.linalg.inv(model.rest_transforms[indices[:, 0]])
    placed = np.einsum("pmij,mj->pmi", carried[..., :3, :3], points) + carried[..., :3, 3]
    return placed, skinned_jacobian(model, bones, points, indices, weights)[..., 6:]
