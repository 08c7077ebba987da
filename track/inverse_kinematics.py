"""Pose from labelled markers: Levenberg-Marquardt on the paper's E_IK (Han et al. 2018, section 4.3).

Many frames are solved at once; a missing marker is NaN. Two terms keep what the markers leave open near rest:
a hinge beyond its range is pulled back, and a weak prior that only matters where markers are missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.attach import Attachment
from handsim._checks import check_array
from handsim.errors import ShapeError
from handsim.jacobian import NUM_VELOCITIES, skinned_jacobian
from handsim.model import HandModel, join_qpos
from handsim.topology import NUM_JOINTS, NUM_QPOS
from handsim.transforms import multiply_quaternions, rigid_fit, rotation_quaternions, vector_quaternions

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_MARKER_NOISE: Final = 0.001  # [m] one standard deviation, which the priors below are weighed against
_RANGE_SLACK: Final = np.deg2rad(2.0)  # standard deviation of a hinge beyond its range
_REST_SPREAD: Final = np.deg2rad(90.0)  # and of any hinge around rest
_RESTING: Final = np.tile(np.deg2rad([0.0, 25.0, 35.0, 20.0]), 5)
_FEWEST_MARKERS: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Poses and how well they fit."""

    qpos: Float[np.ndarray, "T 27"]
    rms: Float[np.ndarray, "T"]
    """3D RMS distance over the markers that are there [m]."""
    residuals: Float[np.ndarray, "T M 3"]
    """Model minus marker [m], NaN where a marker is missing."""


def first_guess(
    model: HandModel, attachment: Attachment, targets: Float[np.ndarray, "T M 3"]
) -> Float[np.ndarray, "T 27"]:
    """Relaxed hands laid on the markers by a rigid fit, frame by frame."""
    qpos = join_qpos(np.tile(_RESTING, (len(targets), 1)))
    markers = attachment.centres(model, model.forward_kinematics(qpos[:1]))
    for frame, target in enumerate(targets):
        there = np.isfinite(target).all(axis=1)
        rotation, translation = rigid_fit(markers[0, there], target[there])
        qpos[frame, :3] = translation
        qpos[frame, 3:7] = rotation_quaternions(rotation[None])[0]
    return qpos


def solve_poses(
    model: HandModel,
    attachment: Attachment,
    targets: Float[np.ndarray, "T M 3"],
    *,
    initial: Float[np.ndarray, "T 27"] | None = None,
    iterations: int = 30,
) -> PoseFit:
    """Poses whose markers come nearest to labelled ones, all frames at once.

    Args:
        model: The hand.
        attachment: Its glove.
        targets: Labelled markers in the glove's order [m]; NaN where missing.
        initial: Poses to start from; a rigid fit of the relaxed hand when not given.
        iterations: Steps at most; a frame stops counting when it no longer improves.

    Raises:
        ShapeError: `targets` do not fit the glove, or a frame has fewer than 4 markers.
    """
    targets = np.asarray(targets, dtype=np.float64)
    if targets.ndim != 3 or targets.shape[1:] != attachment.points.shape:
        raise ShapeError(f"targets have shape {targets.shape}, wanted (T, {len(attachment.points)}, 3)")
    there = np.isfinite(targets).all(axis=-1)
    if len(targets) and there.sum(axis=1).min() < _FEWEST_MARKERS:
        frame = int(there.sum(axis=1).argmin())
        raise ShapeError(
            f"frame {frame} has {int(there[frame].sum())} markers, wanted at least {_FEWEST_MARKERS}"
        )
    qpos = first_guess(model, attachment, targets) if initial is None else initial.copy()
    check_array("initial", qpos, (None, NUM_QPOS))
    damping = np.full(len(targets), 1e-2)
    cost, gradient, normal = _linearise(model, attachment, targets, there, qpos)
    for _ in range(iterations):
        diagonal = np.einsum("tii->ti", normal)
        damped = normal + (damping[:, None] * diagonal)[..., None] * np.eye(NUM_VELOCITIES)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial = move(qpos, step)
        trial_cost, trial_gradient, trial_normal = _linearise(model, attachment, targets, there, trial)
        better = trial_cost < cost
        gain = np.where(better, cost - trial_cost, 0.0)
        qpos[better], gradient[better], normal[better] = (
            trial[better],
            trial_gradient[better],
            trial_normal[better],
        )
        settled = bool((gain <= 1e-6 * cost)[better].all() and (damping[~better] > 1e3).all())
        cost = np.minimum(cost, trial_cost)
        damping = np.clip(np.where(better, damping * 0.3, damping * 8.0), 1e-9, 1e6)
        if settled:
            break
    markers = attachment.centres(model, model.forward_kinematics(qpos))
    residuals = markers - targets
    rms = np.sqrt(np.nanmean((residuals**2).sum(axis=-1), axis=1)) if len(targets) else np.zeros(0)
    return PoseFit(qpos, rms, residuals)


def move(qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"]) -> Float[np.ndarray, "T 27"]:
    """Poses after a step along MuJoCo's velocities: the wrist turns in its own frame."""
    moved = np.empty_like(qpos)
    moved[:, :3] = qpos[:, :3] + step[:, :3]
    moved[:, 3:7] = multiply_quaternions(qpos[:, 3:7], vector_quaternions(step[:, 3:6]))
    moved[:, 7:] = qpos[:, 7:] + step[:, 6:]
    return moved


def _linearise(
    model: HandModel,
    attachment: Attachment,
    targets: NDArray[np.float64],
    there: NDArray[np.bool_],
    qpos: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cost (T,), gradient (T, 26) and normal matrix (T, 26, 26) of every frame."""
    bones = model.forward_kinematics(qpos)
    markers = attachment.centres(model, bones)
    residual = np.where(there[..., None], markers - targets, 0.0).reshape(len(qpos), -1) / _MARKER_NOISE
    jacobian = skinned_jacobian(
        model, bones, attachment.points, attachment.bone_indices, attachment.bone_weights
    )
    jacobian = np.where(there[..., None, None], jacobian, 0.0).reshape(len(qpos), -1, NUM_VELOCITIES)
    jacobian /= _MARKER_NOISE
    low, high = model.skeleton.ranges.T
    angles = qpos[:, 7:]
    beyond = (np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)) / _RANGE_SLACK
    off_rest = (angles - _RESTING) / _REST_SPREAD
    cost = (residual**2).sum(1) + (beyond**2).sum(1) + (off_rest**2).sum(1)
    gradient = np.einsum("tnv,tn->tv", jacobian, residual)
    gradient[:, 6:] += beyond / _RANGE_SLACK + off_rest / _REST_SPREAD
    normal = jacobian.transpose(0, 2, 1) @ jacobian
    hinges = np.arange(6, 6 + NUM_JOINTS)
    normal[:, hinges, hinges] += (beyond != 0.0) / _RANGE_SLACK**2 + 1.0 / _REST_SPREAD**2
    return cost, gradient, normal
