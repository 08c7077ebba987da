"""The energy of a calibration and its Gauss-Newton normal equations.

The energy is that of Han et al. 2018, section 4.5, with the hand's shape as a further unknown. Its unit is
the variance of the markers' noise:

    E = E_data + E_prior(M) + E_contact + prior of hand shapes + prior and limits of joint angles

Contact points slide on the skin after each step. What remains of a contact is its gap along the normal, which
sliding does not change to first order.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel, skinned_jacobian
from handsim.hand.shape import NUM_BONES, HandShape
from handsim.hand.skin import rest_vertices
from handsim.kernels.integration import move
from track.calibration.contacts import (
    PAD_COMPRESSION,
    ContactGeometry,
    Contacts,
    contact_geometry,
    contact_weights,
)
from track.calibration.hand_parameters import (
    NUM_PARAMETERS,
    shape_at,
    shape_jacobian,
    shape_precision,
    skeleton_jacobian,
    skinned_shape_jacobian,
    skinning_terms,
)
from track.calibration.skin_coordinates import (
    Corners,
    SkinCoordinates,
    SkinPatch,
    build_skin,
    project_onto_skin,
    skin_points,
    skin_weight_jacobian,
    skin_weights,
)
from track.kinematics.joint_prior import resting_prior

ALPHA_NORMAL, ALPHA_ALONG = 2.0, 1.0
"""Weights of E_prior along the normal and in the skin (Han et al. 2018, section 4.5)."""
POSITION_SPREAD: Final = 0.002
"""Standard deviation of a marker's slip along the skin [m], to begin with; (noise / spread)^2 is the paper's
lambda_1."""
HEIGHT_SPREAD: Final = 0.0005
"""The same of a marker center's height around that of the design [m]."""
CONTACT_SPREAD: Final = 0.0007
"""Standard deviation of a pad's compression around `PAD_COMPRESSION` [m]; (noise / spread)^2 is lambda_2."""
_LIMIT_SPREAD: Final = np.deg2rad(2.0)  # of an angle beyond its range
_GESTURES: Final = 4.0  # that a capture counts as, however many frames it has: they are much alike
RELINEARIZE: Final = 0.005
"""Change of a parameter (log lengths, [rad], [m]) that renews the skin's jacobian."""
_STEP: Final = 1e-5  # of finite differences


@dataclass(frozen=True, eq=False)
class Estimate:
    """All unknowns of a calibration at one iteration."""

    parameters: Float[np.ndarray, "53"]
    """Hand shape, see `hand_parameters`."""
    points: Float[np.ndarray, "M 3"]
    """Marker centers on the rest hand of this shape, in the wrist's frame [m]."""
    coordinates: SkinCoordinates
    """The same points in coordinates of its skin."""
    qpos: Float[np.ndarray, "F 27"]
    contacts: Contacts | None = None
    """Their frames count in `qpos`."""


class Fit(NamedTuple):
    """Residuals and energy of an estimate."""

    model: HandModel
    bones: Float[np.ndarray, "F L 4 4"]
    """`T_world_bone` in every frame."""
    residuals: Float[np.ndarray, "F M 3"]
    """Model minus marker [m], zero where a marker is missing."""
    design_residuals: Float[np.ndarray, "M 3"]
    """Marker minus its position by the glove's design on this hand, in the wrist's frame [m]."""
    normals: Float[np.ndarray, "M 3"]
    """Unit normals of the rest skin under the markers."""
    geometry: ContactGeometry | None
    """How the pads of the contacts lie to each other."""
    cost: float


class NormalEquations(NamedTuple):
    """Gauss-Newton matrix and gradient in blocks: the poses of each frame, and the S shared unknowns."""

    pose: Float[np.ndarray, "F 26 26"]
    mixed: Float[np.ndarray, "F 26 S"]
    shared: Float[np.ndarray, "S S"]
    pose_gradient: Float[np.ndarray, "F 26"]
    shared_gradient: Float[np.ndarray, "S"]


class Problem:
    """The data of a calibration; once a hand nearly fits, `robust_scale` and the markers' spreads change.

    Args:
        shape: Right hand that the parameters start from.
        design: Skin coordinates of the markers by the glove's design.
        heights: Heights of the marker centers above the skin, as designed [m].
        targets: Labeled markers of the chosen frames [m]; NaN where missing.
        noise: Standard deviation of a marker's coordinates [m].
        robust_scale: Distance [m] at which a residual has half the cost of a quadratic one
            (Geman and McClure 1987).
        relinearize: Change of a parameter that renews the skin's jacobian.
    """

    def __init__(
        self,
        shape: HandShape,
        design: SkinCoordinates,
        heights: Float[np.ndarray, "M"],
        targets: Float[np.ndarray, "F M 3"],
        *,
        noise: float,
        robust_scale: float,
        relinearize: float = RELINEARIZE,
    ) -> None:
        self._relinearize = relinearize
        self.shape, self.design, self.heights = shape, design, heights
        self.present: Bool[np.ndarray, "F M"] = np.isfinite(targets).all(axis=2)
        """Markers that are not missing."""
        self.targets = np.where(self.present[..., None], targets, 0.0)
        self.noise, self.robust_scale = noise, robust_scale
        self._pose_precision = min(1.0, _GESTURES / len(targets)) * resting_prior().precision
        self.position_spread, self.height_spread = POSITION_SPREAD, HEIGHT_SPREAD
        self.precision = shape_precision()
        self._ranges = HandModel(shape).skeleton.ranges
        self._surface_jacobian: NDArray[np.float64] | None = None
        self._linearized_at = np.zeros(NUM_PARAMETERS)

    def fit(self, estimate: Estimate) -> Fit:
        """Residuals and energy of an estimate."""
        model = HandModel(shape_at(self.shape, estimate.parameters))
        bones = model.forward_kinematics(estimate.qpos)
        weights = skin_weights(estimate.coordinates)
        _, by_bone = skinning_terms(model, bones, estimate.points, weights)
        predicted = np.einsum("ml,tmli->tmi", weights, by_bone, optimize=True)
        residuals = np.where(self.present[..., None], predicted - self.targets, 0.0)
        faces, count = self._faces(estimate), len(estimate.points)
        corners = SkinPatch(faces).corners(model.surface.vertices)
        _, normals = skin_points(estimate.coordinates, _part(corners, 0, count))
        design, _ = skin_points(self.design, _part(corners, count, 2 * count))
        geometry = None
        if estimate.contacts is not None:
            pads = _part(corners, 2 * count, len(faces))
            geometry = contact_geometry(estimate.contacts, pads, model, bones[estimate.contacts.frames])
        fit = Fit(model, bones, residuals, estimate.points - design, normals, geometry, 0.0)
        return fit._replace(cost=self._cost(estimate, fit))

    def _faces(self, estimate: Estimate) -> NDArray[np.int64]:
        """Triangles of the markers, of their design, and of the contacts on thumb and fingers."""
        faces = [estimate.coordinates.faces, self.design.faces]
        if estimate.contacts is not None:
            faces += [estimate.contacts.thumb_coordinates.faces, estimate.contacts.finger_coordinates.faces]
        return np.concatenate(faces)

    def _cost(self, estimate: Estimate, fit: Fit) -> float:
        squares = (fit.residuals**2).sum(axis=2)
        cost = (squares / (1.0 + squares / self.robust_scale**2)).sum() / self.noise**2
        cost += estimate.parameters @ self.precision @ estimate.parameters
        cost += (fit.design_residuals * self._apply_position_precision(fit, fit.design_residuals)).sum()
        cost += ((estimate.coordinates.heights - self.heights) ** 2).sum() / self.height_spread**2
        beyond, off = self._joint_angle_residuals(estimate)
        cost += (beyond**2).sum() / _LIMIT_SPREAD**2
        cost += ((off @ self._pose_precision) * off).sum()
        if fit.geometry is not None and estimate.contacts is not None:
            weights = contact_weights(fit.geometry, estimate.contacts.fingers)
            cost += (weights * fit.geometry.gaps**2).sum() / CONTACT_SPREAD**2
        return float(cost)

    def _apply_position_precision(self, fit: Fit, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """E_prior's precision matrix of each marker [1/m^2] times vectors (M, 3)."""
        along = (vectors * fit.normals).sum(axis=1, keepdims=True) * fit.normals
        product: NDArray[np.float64] = ALPHA_ALONG * vectors + (ALPHA_NORMAL - ALPHA_ALONG) * along
        return product / self.position_spread**2

    def _joint_angle_residuals(self, estimate: Estimate) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Joint angles (F, 20) [rad] beyond their limits, and from the mean of gestures."""
        angles = estimate.qpos[:, 7:]
        low, high = self._ranges.T
        beyond = np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)
        return beyond, angles - resting_prior().angles

    def normal_equations(self, estimate: Estimate, fit: Fit) -> NormalEquations:
        """Gauss-Newton's equations; the shared unknowns are the parameters, then three per marker [m]."""
        count = len(estimate.points)
        skin = fit.model.surface.vertices
        patch = SkinPatch(self._faces(estimate))
        corners, rest = patch.corners(skin), self._rest_jacobian(estimate, patch, skin)
        skeleton = skeleton_jacobian(self.shape, estimate.parameters)
        by_pose, by_shared = self._marker_jacobians(
            estimate, fit, _part(corners, 0, count), rest[:count], skeleton
        )
        squares = (fit.residuals**2).sum(axis=2)
        weights = self.present / (1.0 + squares / self.robust_scale**2) ** 2 / self.noise**2
        rows = np.repeat(weights, 3, axis=1)[..., None]
        residual = fit.residuals.reshape(len(fit.residuals), -1, 1)
        pose = by_pose.swapaxes(1, 2) @ (rows * by_pose)
        mixed = by_pose.swapaxes(1, 2) @ (rows * by_shared)
        flat = (np.sqrt(rows) * by_shared).reshape(-1, by_shared.shape[2])
        shared = flat.T @ flat
        pose_gradient = (by_pose.swapaxes(1, 2) @ (rows * residual))[..., 0]
        shared_gradient = np.einsum("fns,fn->s", by_shared, (rows * residual)[..., 0])
        result = NormalEquations(pose, mixed, shared, pose_gradient, shared_gradient)
        self._add_priors(estimate, fit, rest[:count] - rest[count : 2 * count], result)
        if estimate.contacts is not None and fit.geometry is not None:
            self._add_contacts(estimate, fit, rest[2 * count :], skeleton, result)
        return result

    def _rest_jacobian(
        self, estimate: Estimate, patch: SkinPatch, skin: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivative of points at fixed skin coordinates on the rest hand by the parameters (P, 3, 53).

        The skin is built for every estimate, its derivative only when a parameter has changed: by 0.005 or
        more changes the result by less than a micrometer, while four times as much is noticeable.
        """
        if (
            self._surface_jacobian is None
            or np.abs(estimate.parameters - self._linearized_at).max() > self._relinearize
        ):
            self._surface_jacobian = shape_jacobian(self.shape, estimate.parameters, rest_vertices)
            self._linearized_at = estimate.parameters
        coordinates = self._all_coordinates(estimate)
        here, _ = skin_points(coordinates, patch.corners(skin))
        columns = []
        for number in range(NUM_PARAMETERS):
            grown = skin + _STEP * self._surface_jacobian[..., number]
            columns.append((skin_points(coordinates, patch.corners(grown))[0] - here) / _STEP)
        return np.stack(columns, axis=-1)

    def _all_coordinates(self, estimate: Estimate) -> SkinCoordinates:
        """Of the markers, of their design, and of compressed pads at the contacts, as in `_faces`."""
        parts = [estimate.coordinates, self.design]
        if estimate.contacts is not None:
            parts += [
                side._replace(heights=np.full(len(estimate.contacts.frames), -PAD_COMPRESSION))
                for side in (estimate.contacts.thumb_coordinates, estimate.contacts.finger_coordinates)
            ]
        return SkinCoordinates(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    def _marker_jacobians(
        self,
        estimate: Estimate,
        fit: Fit,
        corners: Corners,
        rest: NDArray[np.float64],
        skeleton: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Jacobians of all markers by the poses (F, 3 M, 26) and by the shared unknowns (F, 3 M, S)."""
        frames, count = len(estimate.qpos), len(estimate.points)
        weights = skin_weights(estimate.coordinates)
        all_bones = np.tile(np.arange(NUM_BONES), (count, 1))
        by_pose = skinned_jacobian(fit.model, fit.bones, estimate.points, all_bones, weights)
        by_shape = skinned_shape_jacobian(fit.model, fit.bones, estimate.points, weights) @ skeleton
        by_point, by_bone = skinning_terms(fit.model, fit.bones, estimate.points, weights)
        by_shape += by_point @ rest
        weight_jacobian = skin_weight_jacobian(estimate.coordinates, corners)
        by_point += np.einsum("tmli,mlj->tmij", by_bone, weight_jacobian, optimize=True)
        by_shared = np.zeros((frames, count, 3, NUM_PARAMETERS + 3 * count))
        by_shared[..., :NUM_PARAMETERS] = by_shape
        for marker in range(count):
            first = NUM_PARAMETERS + 3 * marker
            by_shared[:, marker, :, first : first + 3] = by_point[:, marker]
        return by_pose.reshape(frames, 3 * count, -1), by_shared.reshape(frames, 3 * count, -1)

    def _add_priors(
        self, estimate: Estimate, fit: Fit, design_jacobian: NDArray[np.float64], result: NormalEquations
    ) -> None:
        """Add the priors; `design_jacobian` (M, 3, 53): marker minus design, at fixed skin coordinates."""
        count = len(estimate.points)
        first = NUM_PARAMETERS
        result.shared[:first, :first] += self.precision
        result.shared_gradient[:first] += self.precision @ estimate.parameters
        jacobian = np.concatenate([design_jacobian, np.zeros((count, 3, 3 * count))], axis=2)
        heights = np.zeros((count, result.shared.shape[0]))
        for marker in range(count):
            mine = slice(first + 3 * marker, first + 3 * marker + 3)
            jacobian[marker, :, mine] = np.eye(3)
            heights[marker, mine] = fit.normals[marker]
        columns = [self._apply_position_precision(fit, jacobian[..., s]) for s in range(jacobian.shape[2])]
        weighted = np.stack(columns, axis=-1)
        result.shared[:] += np.einsum("mis,mir->sr", jacobian, weighted, optimize=True)
        result.shared_gradient[:] += np.einsum("mi,mis->s", fit.design_residuals, weighted)
        result.shared[:] += heights.T @ heights / self.height_spread**2
        result.shared_gradient[:] += (
            (estimate.coordinates.heights - self.heights) @ heights / self.height_spread**2
        )
        beyond, off = self._joint_angle_residuals(estimate)
        result.pose[:, 6:, 6:] += self._pose_precision
        angles = np.arange(6, 26)
        result.pose[:, angles, angles] += (beyond != 0.0) / _LIMIT_SPREAD**2
        result.pose_gradient[:, 6:] += beyond / _LIMIT_SPREAD**2 + off @ self._pose_precision

    def _add_contacts(
        self,
        estimate: Estimate,
        fit: Fit,
        rest: NDArray[np.float64],
        skeleton: NDArray[np.float64],
        result: NormalEquations,
    ) -> None:
        """Add each contact's gap; `rest` (2 K, 3, 53): jacobian of the pads' rest points."""
        contacts, geometry = estimate.contacts, fit.geometry
        assert contacts is not None
        assert geometry is not None
        count = len(contacts.frames)
        coordinates = self._all_coordinates(estimate)
        pads = SkinCoordinates(*(values[len(values) - 2 * count :] for values in coordinates))
        points, _ = skin_points(pads, SkinPatch(pads.faces).corners(fit.model.surface.vertices))
        weights = skin_weights(pads)
        precision = contact_weights(geometry, contacts.fingers) / CONTACT_SPREAD**2
        all_bones = np.tile(np.arange(NUM_BONES), (2, 1))
        for number, frame in enumerate(contacts.frames):
            both = [number, count + number]
            bones, share = fit.bones[frame : frame + 1], weights[both]
            by_pose = skinned_jacobian(fit.model, bones, points[both], all_bones, share)[0]
            by_shape = skinned_shape_jacobian(fit.model, bones, points[both], share)[0] @ skeleton
            by_shape += skinning_terms(fit.model, bones, points[both], share)[0][0] @ rest[both]
            direction = geometry.directions[number]
            pose = direction @ (by_pose[1] - by_pose[0])
            shared = np.zeros(result.shared.shape[0])
            shared[:NUM_PARAMETERS] = direction @ (by_shape[1] - by_shape[0])
            result.pose[frame] += precision[number] * np.outer(pose, pose)
            result.mixed[frame] += precision[number] * np.outer(pose, shared)
            result.shared[:] += precision[number] * np.outer(shared, shared)
            result.pose_gradient[frame] += precision[number] * geometry.gaps[number] * pose
            result.shared_gradient[:] += precision[number] * geometry.gaps[number] * shared

    def apply_step(
        self, estimate: Estimate, pose_step: Float[np.ndarray, "F 26"], shared_step: Float[np.ndarray, "S"]
    ) -> Estimate:
        """The estimate after a step, with new coordinates of its markers on the new hand's skin.

        Args:
            estimate: The estimate before the step.
            pose_step: Change of each pose [m, rad], in tangent coordinates of qpos; clipped at 0.5.
            shared_step: Change of the parameters, then of each marker's rest position [m].
        """
        parameters = estimate.parameters + shared_step[:NUM_PARAMETERS]
        shape = shape_at(self.shape, parameters)
        skin = build_skin(shape)
        carried, _ = skin_points(estimate.coordinates, skin.corners(estimate.coordinates.faces))
        points = carried + shared_step[NUM_PARAMETERS:].reshape(-1, 3)
        qpos = move(estimate.qpos, np.clip(pose_step, -0.5, 0.5))
        coordinates = project_onto_skin(estimate.coordinates, points, skin)
        return dataclasses.replace(
            estimate, parameters=parameters, points=points, coordinates=coordinates, qpos=qpos
        )


def _part(corners: Corners, first: int, last: int) -> Corners:
    return Corners(corners.points[first:last], corners.normals[first:last])
