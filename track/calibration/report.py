"""Diagnostics of a calibration: noise, standard errors, contact gaps and joints that did not move."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel, build_skeleton
from handsim.hand.shape import JOINT_NAMES, NUM_JOINTS, PALM, HandShape
from handsim.hand.skin import rest_vertices
from handsim.space.transforms import quaternion_matrix, rigid_fit
from track.calibration.contacts import contact_geometry, initialize_contacts
from track.calibration.energy import HEIGHT_SPREAD, POSITION_SPREAD, Estimate, Fit, Problem
from track.calibration.hand_parameters import BONE_LENGTHS, LENGTH, NUM_PARAMETERS, shape_jacobian
from track.calibration.skin_coordinates import SkinPatch, skin_points, skin_weights
from track.calibration.solver import shared_covariance

_ENOUGH_RANGE: Final = 0.3  # share of a joint's range that the user should cover
_LEAST_NOISE, _MOST_NOISE = 0.0001, 0.003  # [m]
_CHI2_MEDIAN: Final = 2.366  # median of the chi-squared distribution with three degrees of freedom
_USUAL_WORTH: Final = 12.0  # coordinates of markers that the usual spread counts as
_INDEPENDENT_POSES: Final = 14.0  # frames whose deformation of the flesh is independent


def marker_noise(problem: Problem, fit: Fit) -> float:
    """Standard deviation of a marker's coordinates [m] by the median residual and its degrees of freedom."""
    squares = (fit.residuals**2).sum(axis=2)[problem.present]
    freedom = 3 * len(squares) - 26 * len(fit.residuals) - NUM_PARAMETERS - 3 * fit.residuals.shape[1]
    remaining = max(freedom, 1) / (3 * len(squares))
    return float(np.clip(np.sqrt(np.median(squares) / (_CHI2_MEDIAN * remaining)), _LEAST_NOISE, _MOST_NOISE))


def repeated_share(qpos: Float[np.ndarray, "T 27"], residuals: Float[np.ndarray, "T M 3"]) -> float:
    """Share of the residuals' variance that repeats in a similar pose: flesh that moves with the joints.

    It is the correlation of each frame's residuals, in the wrist's frame, with those of the frame whose joint
    angles are nearest. Noise that is independent from frame to frame gives zero. There are two poses at
    least.
    """
    from scipy.spatial import cKDTree

    local = np.einsum("tji,tmj->tmi", quaternion_matrix(qpos[:, 3:7]), residuals)
    nearest = cKDTree(qpos[:, 7:]).query(qpos[:, 7:], k=2)[1][:, 1]
    products, squares = local * local[nearest], 0.5 * (local**2 + local[nearest] ** 2)
    both = np.isfinite(products)
    return float(np.clip(products[both].sum() / max(squares[both].sum(), 1e-18), 0.0, 1.0))


def effective_noise(noise: float, repeated: float, num_frames: int) -> float:
    """Noise [m] for the weights of the residuals, so that correlated frames do not count as independent ones.

    What repeats (`repeated_share`) in every similar pose is flesh that moves with the pose: many frames carry
    the information of a few about it.
    """
    flesh = repeated * noise**2
    return float(np.sqrt(noise**2 + flesh * max(num_frames / _INDEPENDENT_POSES - 1.0, 0.0)))


def learn_spreads(problem: Problem, estimate: Estimate, fit: Fit) -> None:
    """Set the spreads of marker places and heights to what the data tell of this glove (MacKay 1992).

    Each marker counts as far as the data determine its place, beside a few of the usual spread.
    """
    covariance = shared_covariance(problem, estimate, fit)
    own = [slice(first, first + 3) for first in range(NUM_PARAMETERS, len(covariance), 3)]
    blocks, normals = np.array([covariance[one, one] for one in own]), fit.normals
    across = np.einsum("mi,mij,mj->m", normals, blocks, normals)
    along = np.trace(blocks, axis1=1, axis2=2) - across
    off = fit.design_residuals
    slips = (off**2).sum(axis=1) - (off * normals).sum(axis=1) ** 2
    lifts = (estimate.coordinates.heights - problem.heights) ** 2
    problem.position_spread = _learned(slips, along, 2, problem.position_spread, POSITION_SPREAD)
    problem.height_spread = _learned(lifts, across, 1, problem.height_spread, HEIGHT_SPREAD)


def _learned(
    squares: NDArray[np.float64], variances: NDArray[np.float64], axes: int, spread: float, usual: float
) -> float:
    """A spread [m] of offsets from zero, by their squares and posterior variances summed over axes."""
    determined = np.clip(axes - variances / spread**2, 0.0, None).sum()
    return float(np.sqrt((squares.sum() + _USUAL_WORTH * usual**2) / (determined + _USUAL_WORTH)))


def standard_errors(
    problem: Problem, estimate: Estimate, fit: Fit
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard errors of marker positions on their bones (M,) and of bone lengths (5, 3) [m].

    Where the wrist is in the palm is a convention: of the palm's markers it is the error among the knuckles.
    """
    covariance = shared_covariance(problem, estimate, fit)
    weights = skin_weights(estimate.coordinates)
    bones, patch = weights.argmax(axis=1), SkinPatch(estimate.coordinates.faces)

    def on_bones(shapes: list[HandShape]) -> NDArray[np.float64]:
        local, knuckles = [], fit.model.skeleton.offsets[1::3]
        for shape, vertices in zip(shapes, rest_vertices(shapes), strict=True):
            skeleton = build_skeleton(shape)
            rest = skeleton.rest_transforms()[bones]
            points = skin_points(estimate.coordinates, patch.corners(vertices))[0]
            rotation, translation = rigid_fit(skeleton.offsets[1::3], knuckles)
            among_knuckles = points @ rotation.T + translation
            own = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3])
            local.append(np.where((bones == PALM)[:, None], among_knuckles, own))
        return np.array(local)

    count = len(bones)
    jacobian = np.zeros((count, 3, len(covariance)))
    jacobian[..., :NUM_PARAMETERS] = shape_jacobian(problem.shape, estimate.parameters, on_bones)
    rotations = fit.model.rest_transforms[bones][:, :3, :3].swapaxes(1, 2)
    for marker in range(count):
        first = NUM_PARAMETERS + 3 * marker
        jacobian[marker, :, first : first + 3] = rotations[marker]
    positions = np.sqrt(np.einsum("mis,st,mit->m", jacobian, covariance, jacobian, optimize=True))
    own = covariance[BONE_LENGTHS, BONE_LENGTHS].diagonal()
    logs = own + covariance[LENGTH, LENGTH] + 2.0 * covariance[BONE_LENGTHS, LENGTH]
    return positions, fit.model.shape.bone_lengths * np.sqrt(logs).reshape(5, 3)


def contact_gaps(
    model: HandModel, touches: list[tuple[int, str]], qpos: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Gaps between thumb and finger (K,) [m] of touches on a hand.

    Args:
        model: A right hand.
        touches: Frame and finger of each.
        qpos: Poses of these frames (K, 27).
    """
    bones = model.forward_kinematics(qpos)
    contacts = initialize_contacts(model, touches, bones)
    faces = np.concatenate([contacts.thumb_coordinates.faces, contacts.finger_coordinates.faces])
    return contact_geometry(contacts, SkinPatch(faces).corners(model.surface.vertices), model, bones).gaps


def still_joints(
    angles: Float[np.ndarray, "T 20"], complete: Bool[np.ndarray, "T 5"], model: HandModel
) -> tuple[str, ...]:
    """Joints that covered too little of their range while all markers of their digit were seen."""
    ranges = model.skeleton.ranges
    still = []
    for joint in range(NUM_JOINTS):
        seen = angles[complete[:, joint // 4], joint]
        covered = np.ptp(np.quantile(seen, [0.02, 0.98])) if len(seen) else 0.0
        if covered < _ENOUGH_RANGE * (ranges[joint, 1] - ranges[joint, 0]):
            still.append(JOINT_NAMES[joint])
    return tuple(still)
