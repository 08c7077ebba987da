"""The energy of a calibration and its Gauss-Newton normal equations.

The energy is that of Han et al. 2018, section 4.5, with the hand's shape as an additional unknown, in units
of the variance of the markers' noise:

    E = E_data + E_prior(M) + E_contact + prior of hand shapes + prior and limits of joint angles

Contact points slide on the skin after each step. Only the gap along the normal remains in a contact's energy:
sliding does not change it to first order.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.fit import GloveFit
from handsim.arrays import Doubles, Integers
from handsim.hand.model import NUM_VELOCITIES, HandModel, join_qpos, skinned_jacobian
from handsim.hand.shape import BONES, DIGITS, NUM_BONES, NUM_JOINTS, HandShape, bones_of
from handsim.hand.skin import rest_vertices
from handsim.kernels import move
from handsim.space.transforms import quaternion_matrix
from poses.touch import FINGERS, thumb_contact
from track.calibration.hand_parameters import (
    DIFFERENCE_STEP,
    NUM_PARAMETERS,
    Corners,
    SkinCoordinates,
    SkinPatch,
    attachment_at,
    build_skin,
    nearest_coordinates,
    project_onto_skin,
    shape_at,
    shape_jacobian,
    shape_precision,
    skin_points,
    skin_weight_jacobian,
    skin_weights,
    skinned_shape_jacobian,
    skinning_terms,
)
from track.kinematics.pose_spread import resting_prior

ALPHA_NORMAL, ALPHA_ALONG = 2.0, 1.0
"""Weights of E_prior along the normal and in the skin (Han et al. 2018, section 4.5)."""
POSITION_SPREAD: Final = 0.002
"""Initial standard deviation of a marker's slip along the skin [m]; (noise / spread)^2 is the paper's
lambda_1."""
HEIGHT_SPREAD: Final = 0.0005  # [m] initial standard deviation of a marker's height over the design's
_HAND_CORRELATION: Final = 0.6
"""Correlation of a marker's slips on both hands of a person. On two people of Mocap_SIG18_Data whose hands
were measured apart it is 0.83 to 0.94, as on one hand in two captures; in simulated captures 0. With 0.8
angles of simulated hands are 0.15 degrees farther off, and as many labels of the real hands are right."""
CONTACT_SPREAD: Final = 0.0007
"""Standard deviation of a pad's compression around `PAD_COMPRESSION` [m]; (noise / spread)^2 is lambda_2."""
_LIMIT_SPREAD: Final = np.deg2rad(2.0)  # [rad] standard deviation of an angle beyond its range
# The frames of a capture are similar: together they count as this many gestures in the pose prior.
_GESTURES_OF_CAPTURE: Final = 4.0
GESTURES_OF_USER: Final = np.repeat([1.0, _GESTURES_OF_CAPTURE], [4, 16])
"""Number of independent gestures, by joint angle, whose mean varies as much as the mean of a capture varies
between people."""
# [rad] A digit's flesh patterns are normalized by its RMS motion, at least this.
_LEAST_DIGIT_MOTION: Final = np.deg2rad(1.0)
RELINEARIZE: Final = 0.005  # The skin's jacobian is renewed after such a change (log lengths, [rad], [m]).
PAD_COMPRESSION: Final = 0.001
"""Compression of each pad in a touch [m]: simulated pads overlap by 1.6 to 2.4 mm together."""
_MOST_TOUCH_GAP: Final = 0.012  # [m] largest gap between the pads of a touch
_MOST_TOUCH_SPEED: Final = 0.02  # [m/s] largest speed of the finger relative to the thumb
_SHORTEST_HOLD: Final = 0.06  # [s] shortest touch
_MOST_TOUCHES_PER_FINGER: Final = 10
_SPEED_WINDOW: Final = 0.025  # [s] before and after a frame, in which speed is measured
_GAP_SCALE: Final = 0.002  # [m] A touch whose gap differs this much from the usual has a quarter weight.
_PAD_CENTER_DEPTH: Final = 0.006  # [m] depth of a pad's middle below the skin
_SLIDE_ROUNDS: Final = 3
_GAP_QUANTILE: Final = 0.35  # quantile of a finger's gaps that counts as its usual gap
_FACING_COSINE: Final = -0.8  # Normals of facing pads have a smaller cosine.
_MOST_PAD_OFFSET: Final = 0.002  # [m] largest offset of the contact points across their direction
Progress = Callable[[int], None]
"""Called after each step with its number."""
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-8
_DAMPING_RAISE, _DAMPING_CUT = 10.0, 0.2  # factors after a failed and a good step
_LEAST_RAISED_DAMPING: Final = 1e-6
_MOST_DAMPING_TRIALS: Final = 8
SMALL_GAIN: Final = 1e-4  # A step that gains a smaller share of the energy is the last one.
QUICK_OPTIONS: Final = {"noise": 0.003, "robust_scale": 0.015, "relinearize": 0.05}
"""Options of a `Problem` with few frames [m]; the noise is that of flesh, which repeats in similar frames."""
QUICK_GAIN: Final = 1e-3
"""`SMALL_GAIN` of a problem with `QUICK_OPTIONS`; it may leave a hand's length off by 0.2 mm."""
COARSE_RELINEARIZE: Final = 0.2
"""`relinearize` of a search for marker places; less changes no probability by more than 0.01."""


class Contacts(NamedTuple):
    """K contacts of the thumb, each in one frame and with a point on either pad; none by default."""

    frames: Int[np.ndarray, "K"] = np.empty(0, dtype=np.int64)
    fingers: Int[np.ndarray, "K"] = np.empty(0, dtype=np.int64)  # indices into `DIGITS`
    pads: SkinCoordinates = SkinCoordinates(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty(0))
    """Points on the thumb, then those on the fingers."""

    def part(self, some: Bool[np.ndarray, "K"]) -> Contacts:
        """Some of the contacts."""
        pads = SkinCoordinates(*(values[np.tile(some, 2)] for values in self.pads))
        return Contacts(self.frames[some], self.fingers[some], pads)


@dataclass(frozen=True, eq=False)
class Estimate:
    """All unknowns of a calibration at one iteration."""

    parameters: Float[np.ndarray, "53"]  # parameters of the shape, see `hand_parameters`
    points: Float[np.ndarray, "M 3"]  # marker centers on the rest hand, in the wrist's frame [m]
    coordinates: SkinCoordinates  # skin coordinates of these points
    qpos: Float[np.ndarray, "F 27"]
    contacts: Contacts = field(default_factory=Contacts)  # with indices into `qpos` as frames


class Fit(NamedTuple):
    """Residuals and energy of an estimate."""

    model: HandModel
    bones: Float[np.ndarray, "F L 4 4"]  # `T_world_bone` in every frame
    residuals: Float[np.ndarray, "F M 3"]  # model minus marker [m], zero where a marker is missing
    design_residuals: Float[np.ndarray, "M 3"]  # marker minus its designed position, in the wrist's frame [m]
    normals: Float[np.ndarray, "M 3"]  # unit normals of the rest skin under the markers
    geometry: ContactGeometry  # relation of the contacts' pads
    cost: float


class NormalEquations(NamedTuple):
    """Gauss-Newton matrix and gradient in blocks: poses of each frame, and S shared unknowns."""

    pose: Float[np.ndarray, "F 26 26"]
    mixed: Float[np.ndarray, "F 26 S"]
    shared: Float[np.ndarray, "S S"]
    pose_gradient: Float[np.ndarray, "F 26"]
    shared_gradient: Float[np.ndarray, "S"]


WeightedJacobians = tuple[Doubles, Doubles, Doubles, Doubles]


class Problem:
    """Data of a calibration; `robust_scale` and the spreads of marker places are adapted on the way."""

    def __init__(
        self,
        shape: HandShape,  # right hand at which all parameters are zero
        design: SkinCoordinates,  # designed markers
        heights: Float[np.ndarray, "M"],  # designed heights of marker centers above the skin [m]
        targets: Float[np.ndarray, "F M 3"],  # labeled markers in F frames [m]; NaN where missing
        *,
        noise: float,  # standard deviation of marker coordinates [m]
        robust_scale: float,  # [m] scale of the robust loss, which halves a square there (Geman, McClure)
        relinearize: float = RELINEARIZE,
        gestures: Float[np.ndarray, "20"] | float = _GESTURES_OF_CAPTURE,  # that the capture counts as
    ) -> None:
        self._relinearize = relinearize
        self.shape, self.design, self.heights = shape, design, heights
        self._set_targets(targets)
        self.noise, self.robust_scale = noise, robust_scale
        roots = np.sqrt(np.minimum(1.0, gestures / np.full(NUM_JOINTS, len(targets))))
        self.pose_precision = np.outer(roots, roots) * resting_prior().precision
        self.position_spread, self.height_spread = POSITION_SPREAD, HEIGHT_SPREAD
        self.place_weights = np.ones(targets.shape[1])
        """Weights (M,) of the prior of each marker's place."""
        self.design_shift = np.zeros((targets.shape[1], 3))
        """Shift of each marker's designed position that costs nothing, in the wrist's frame [m]."""
        self.coupling: Doubles = np.eye(1)
        """Precision of a slip of unit variance over the hands (H, H) whose markers follow each other."""
        self.data_noise = noise
        """Standard deviation of a marker's coordinates [m] without the flesh, for which `noise` is larger."""
        self.precision = shape_precision()
        self._ranges = HandModel(shape).skeleton.ranges
        self._surface_jacobian: Doubles | None = None
        self._linearized_at = np.zeros(NUM_PARAMETERS)

    def with_targets(self, targets: Float[np.ndarray, "F M 3"]) -> Problem:
        """Return a copy of this problem for other labeled markers [m], NaN where missing."""
        other = copy.copy(self)
        other._set_targets(targets)
        return other

    def _set_targets(self, targets: Float[np.ndarray, "F M 3"]) -> None:
        self.present: Bool[np.ndarray, "F M"] = np.isfinite(targets).all(axis=2)
        """Whether each marker is present."""
        self.targets = np.where(self.present[..., None], targets, 0.0)

    def fit(self, estimate: Estimate) -> Fit:
        """Compute residuals and energy of an estimate."""
        model = HandModel(shape_at(self.shape, estimate.parameters))
        bones = model.forward_kinematics(estimate.qpos)
        weights = skin_weights(estimate.coordinates)
        _, by_bone = skinning_terms(model, bones, estimate.points, weights)
        predicted = np.einsum("ml,tmli->tmi", weights, by_bone, optimize=True)
        residuals = np.where(self.present[..., None], predicted - self.targets, 0.0)
        contacts, count = estimate.contacts, len(estimate.points)
        corners = SkinPatch(self._all_coordinates(estimate).faces).corners(model.surface.vertices)
        _, normals = skin_points(estimate.coordinates, corners.part(0, count))
        design, _ = skin_points(self.design, corners.part(count, 2 * count))
        pads = corners.part(2 * count, None)
        geometry = contact_geometry(contacts, pads, model, bones[contacts.frames])
        off = estimate.points - design - self.design_shift
        fit = Fit(model, bones, residuals, off, normals, geometry, 0.0)
        return fit._replace(cost=self._cost(estimate, fit))

    def _cost(self, estimate: Estimate, fit: Fit) -> float:
        squares = (fit.residuals**2).sum(axis=2)
        cost = (squares / (1.0 + squares / self.robust_scale**2)).sum() / self.noise**2
        cost += estimate.parameters @ self.precision @ estimate.parameters
        off = fit.design_residuals
        cost += np.einsum("mi,mij,mj->", off, self.position_precision(fit), self._coupled(off))
        cost += ((estimate.coordinates.heights - self.heights) ** 2).sum() / self.height_spread**2
        beyond, off = self._joint_angle_residuals(estimate)
        cost += (beyond**2).sum() / _LIMIT_SPREAD**2
        cost += ((off @ self.pose_precision) * off).sum()
        weights = contact_weights(fit.geometry, estimate.contacts.fingers)
        cost += (weights * fit.geometry.gaps**2).sum() / CONTACT_SPREAD**2
        return float(cost)

    def position_precision(self, fit: Fit) -> Doubles:
        """Precision matrix of E_prior for each marker (M, 3, 3) [1/m^2], the same on all hands."""
        hands = len(self.coupling)
        normal = (fit.normals[:, :, None] * fit.normals[:, None]).reshape(hands, -1, 3, 3).mean(axis=0)
        precision = np.tile(ALPHA_ALONG * np.eye(3) + (ALPHA_NORMAL - ALPHA_ALONG) * normal, (hands, 1, 1))
        return np.asarray(precision * self.place_weights[:, None, None] / self.position_spread**2)

    def _coupled(self, values: Float[np.ndarray, "M *N"]) -> Float[np.ndarray, "M *N"]:
        """Values of all markers times the precision of slips over the hands."""
        hands = values.reshape(len(self.coupling), -1, *values.shape[1:])
        return np.tensordot(self.coupling, hands, axes=1).reshape(values.shape)

    def _joint_angle_residuals(self, estimate: Estimate) -> tuple[Doubles, Doubles]:
        """Joint angles (F, 20) [rad] beyond their limits, and relative to the mean of the gestures."""
        angles = estimate.qpos[:, 7:]
        low, high = self._ranges.T
        beyond = np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)
        return beyond, angles - resting_prior().angles

    def roots(self, fit: Fit) -> Float[np.ndarray, "F M"]:
        """Roots of the markers' weights [1/m]."""
        squares = (fit.residuals**2).sum(axis=2)
        return np.asarray(self.present / (1.0 + squares / self.robust_scale**2) / self.noise)

    def weighted_jacobians(self, estimate: Estimate, fit: Fit) -> WeightedJacobians:
        """Jacobians by poses and by shared unknowns and residuals, each times the root of its weight.

        The last array is the jacobian of markers minus designs by the parameters (M, 3, 53).
        """
        count, frames = len(estimate.points), len(estimate.qpos)
        skin = fit.model.surface.vertices
        patch = SkinPatch(self._all_coordinates(estimate).faces)
        corners, rest = patch.corners(skin).part(0, count), self._rest_jacobian(estimate, patch, skin)
        # A frame has one row per marker coordinate, and a last row for the gap of its contact.
        by_pose = np.zeros((frames, 3 * count + 1, NUM_VELOCITIES))
        by_shared = np.zeros((frames, 3 * count + 1, NUM_PARAMETERS + 3 * count))
        residuals, precision = np.zeros((2, frames, 3 * count + 1))
        poses, shapes, by_point, by_bone = self._point_jacobians(
            fit, estimate, slice(None), estimate.points, skin_weights(estimate.coordinates), rest[:count]
        )
        weight_jacobian = skin_weight_jacobian(estimate.coordinates, corners)
        by_point += np.einsum("tmli,mlj->tmij", by_bone, weight_jacobian, optimize=True)
        by_pose[:, :-1] = poses.reshape(frames, 3 * count, -1)
        by_shared[:, :-1, :NUM_PARAMETERS] = shapes.reshape(frames, 3 * count, -1)
        by_marker = by_shared[:, :-1, NUM_PARAMETERS:].reshape(frames, count, 3, count, 3)
        by_marker[:, np.arange(count), :, np.arange(count)] = by_point.swapaxes(0, 1)
        residuals[:, :-1] = fit.residuals.reshape(frames, -1)
        precision[:, :-1] = np.repeat(self.roots(fit) ** 2, 3, axis=1)
        if len(estimate.contacts.frames):
            at = estimate.contacts.frames, -1
            gaps = self._gap_jacobians(estimate, fit, rest[2 * count :])
            by_pose[at], by_shared[*at, :NUM_PARAMETERS] = gaps
            residuals[at] = fit.geometry.gaps
            precision[at] = contact_weights(fit.geometry, estimate.contacts.fingers) / CONTACT_SPREAD**2
        root = np.sqrt(precision)[..., None]
        moved = rest[:count] - rest[count : 2 * count]
        return root * by_pose, root * by_shared, root[..., 0] * residuals, moved

    def normal_equations(
        self, estimate: Estimate, fit: Fit, jacobians: WeightedJacobians | None = None
    ) -> NormalEquations:
        """Gauss-Newton's equations; the shared unknowns are the parameters, then three per marker [m].

        The weighted jacobians are computed unless they are given.
        """
        by_pose, by_shared, residuals, moved = jacobians or self.weighted_jacobians(estimate, fit)
        transposed, flat = by_pose.swapaxes(1, 2), by_shared.reshape(-1, by_shared.shape[2])
        gradients = (transposed @ residuals[..., None])[..., 0], residuals.ravel() @ flat
        result = NormalEquations(transposed @ by_pose, transposed @ by_shared, flat.T @ flat, *gradients)
        self._add_priors(estimate, fit, moved, result)
        return result

    def _rest_jacobian(self, estimate: Estimate, patch: SkinPatch, skin: Doubles) -> Doubles:
        """Derivatives of points at fixed skin coordinates of the rest hand by the parameters (P, 3, 53)."""
        # The default of `relinearize` affects the result by less than a micrometer; four times as much would
        # be noticeable.
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
            grown = skin + DIFFERENCE_STEP * self._surface_jacobian[..., number]
            columns.append((skin_points(coordinates, patch.corners(grown))[0] - here) / DIFFERENCE_STEP)
        return np.stack(columns, axis=-1)

    def _all_coordinates(self, estimate: Estimate) -> SkinCoordinates:
        """Skin coordinates of the markers, the designed markers, and the compressed pads at the contacts."""
        pads = estimate.contacts.pads
        pads = pads._replace(heights=np.full(len(pads.faces), -PAD_COMPRESSION))
        parts = zip(estimate.coordinates, self.design, pads, strict=True)
        return SkinCoordinates(*map(np.concatenate, parts))

    def _add_priors(self, estimate: Estimate, fit: Fit, by_shape: Doubles, result: NormalEquations) -> None:
        """Add the priors; `by_shape` (M, 3, 53) is the jacobian of marker minus design, coordinates fixed."""
        first, count = NUM_PARAMETERS, len(estimate.points)
        by_marker = np.eye(3 * count).reshape(count, 3, -1)
        result.shared[:first, :first] += self.precision
        result.shared_gradient[:first] += self.precision @ estimate.parameters
        jacobian = np.concatenate([by_shape, by_marker], axis=2)
        weighted = self._coupled(self.position_precision(fit) @ jacobian)
        result.shared[:] += np.einsum("mis,mir->sr", jacobian, weighted, optimize=True)
        result.shared_gradient[:] += np.einsum("mi,mis->s", fit.design_residuals, weighted)
        lifts, higher = np.einsum("mi,mis->ms", fit.normals, by_marker), estimate.coordinates.heights
        result.shared[first:, first:] += lifts.T @ lifts / self.height_spread**2
        result.shared_gradient[first:] += (higher - self.heights) @ lifts / self.height_spread**2
        beyond, off = self._joint_angle_residuals(estimate)
        result.pose[:, 6:, 6:] += self.pose_precision
        angles = np.arange(6, 26)
        result.pose[:, angles, angles] += (beyond != 0.0) / _LIMIT_SPREAD**2
        result.pose_gradient[:, 6:] += beyond / _LIMIT_SPREAD**2 + off @ self.pose_precision

    def gap_spreads(self, estimate: Estimate, fit: Fit) -> Float[np.ndarray, "K"]:
        """Standard deviations of the contacts' gaps [m] that markers and priors leave open."""
        alone = dataclasses.replace(estimate, contacts=Contacts())
        covariance, answers = shared_covariance(self, alone, self.fit(alone))
        patch = SkinPatch(self._all_coordinates(estimate).faces)
        rest = self._rest_jacobian(estimate, patch, fit.model.surface.vertices)
        by_pose, by_shape = self._gap_jacobians(estimate, fit, rest[2 * len(estimate.points) :])
        moved = -np.einsum("kp,kps->ks", by_pose, answers[estimate.contacts.frames])
        moved[:, :NUM_PARAMETERS] += by_shape
        return np.asarray(np.sqrt(np.einsum("ks,st,kt->k", moved, covariance, moved)))

    def _gap_jacobians(self, estimate: Estimate, fit: Fit, rest: Doubles) -> list[Doubles]:
        """Jacobians of the gaps by poses (K, 26) and parameters (K, 53); `rest` is that of rest points."""
        frames, count = estimate.contacts.frames, len(estimate.contacts.frames)
        rows, pads = np.arange(count), self._all_coordinates(estimate).part(-2 * count, None)
        points, _ = skin_points(pads, SkinPatch(pads.faces).corners(fit.model.surface.vertices))
        by = self._point_jacobians(fit, estimate, frames, points, skin_weights(pads), rest)
        apart = (one[rows, count + rows] - one[rows, rows] for one in by[:2])
        return [np.einsum("ki,kis->ks", fit.geometry.directions, one) for one in apart]

    def _point_jacobians(
        self,
        fit: Fit,
        estimate: Estimate,
        frames: Integers | slice,
        points: Doubles,
        weights: Doubles,
        rest: Doubles,
    ) -> tuple[Doubles, Doubles, Doubles, Doubles]:
        """Jacobians of skinned points by poses, parameters and rest points; points moved by each bone."""
        bones = fit.bones[frames]
        by_point, by_bone = skinning_terms(fit.model, bones, points, weights)
        all_bones = np.tile(np.arange(NUM_BONES), (len(points), 1))
        by_pose = skinned_jacobian(fit.model, bones, points, all_bones, weights)
        by_shape = skinned_shape_jacobian(fit.model, estimate.parameters, bones, points, weights, by_bone)
        return by_pose, by_shape + by_point @ rest, by_point, by_bone

    def apply_step(
        self, estimate: Estimate, pose_step: Float[np.ndarray, "F 26"], shared_step: Float[np.ndarray, "S"]
    ) -> Estimate:
        """Apply a step, and update the markers' coordinates on the new hand's skin."""
        parameters = estimate.parameters + shared_step[:NUM_PARAMETERS]
        shape = shape_at(self.shape, parameters)
        skin = build_skin(shape)
        carried, _ = skin_points(estimate.coordinates, skin.corners(estimate.coordinates.faces))
        points = carried + shared_step[NUM_PARAMETERS:].reshape(-1, 3)
        qpos = move(estimate.qpos, np.clip(pose_step, -0.5, 0.5))
        coordinates = project_onto_skin(estimate.coordinates, points, skin)
        changes = {"parameters": parameters, "points": points, "coordinates": coordinates, "qpos": qpos}
        return dataclasses.replace(estimate, **changes)


def first_estimate(
    hand: GloveFit, targets: Float[np.ndarray, "F M 3"], qpos: Float[np.ndarray, "F 27"], **options: Any
) -> tuple[Problem, Estimate]:
    """The problem of a right hand's labeled markers [m], and that hand as the first estimate.

    Targets may have the markers of several such hands, one after the other: places are their own, and alike.
    """
    worn, copies = hand.attachment, targets.shape[1] // hand.layout.num_markers
    one = nearest_coordinates(worn.points, worn.feet, worn.main_bones, hand.shape)
    coordinates = SkinCoordinates(*(np.concatenate([values] * copies) for values in one))
    heights, points = np.tile(worn.layout.heights, copies), np.tile(worn.points, (copies, 1))
    problem = Problem(hand.shape, coordinates, heights, targets, **options)
    problem.coupling = np.asarray(
        np.linalg.inv(_HAND_CORRELATION + (1.0 - _HAND_CORRELATION) * np.eye(copies)), dtype=np.float64
    )
    return problem, Estimate(np.zeros(NUM_PARAMETERS), points, coordinates, qpos)


class ContactGeometry(NamedTuple):
    """Relation of the pads of K contacts in the world."""

    directions: Float[np.ndarray, "K 3"]  # unit vectors from thumb to finger
    gaps: Float[np.ndarray, "K"]  # distance of the compressed pads [m]; negative if they press harder
    facing: Bool[np.ndarray, "K"]  # whether both points are on last bones and face each other


def find_touches(
    model: HandModel, angles: Float[np.ndarray, "T 20"], complete: Bool[np.ndarray, "T 5"], rate: float
) -> list[tuple[int, str]]:
    """Find frames and fingers of possible touches."""
    by_finger = [thumb_contact(model, angles, finger) for finger in FINGERS]
    gaps = np.stack([-contact.overlap for contact in by_finger], axis=1)
    window = max(1, round(_SPEED_WINDOW * rate))
    touches: list[tuple[int, str]] = []
    for number, finger in enumerate(FINGERS):
        speed = _finger_speed(model, angles, finger, window, rate)
        good = (speed < _MOST_TOUCH_SPEED) & (gaps[:, number] < _MOST_TOUCH_GAP)
        good &= (gaps.argmin(axis=1) == number) & complete[:, 0] & complete[:, number + 1]
        shortest = max(2, round(_SHORTEST_HOLD * rate))
        holds = [(first, last) for first, last in runs_of(good) if last + 1 - first >= shortest]
        stillest = [first + int(speed[first : last + 1].argmin()) for first, last in holds]
        stillest.sort(key=lambda frame, number=number: float(gaps[frame, number]))  # type: ignore[misc]
        touches += [(frame, finger) for frame in stillest[:_MOST_TOUCHES_PER_FINGER]]
    return sorted(touches)


def _finger_speed(model: HandModel, angles: Doubles, finger: str, window: int, rate: float) -> Doubles:
    """Speed (T,) of the finger's tip relative to the thumb's last bone [m/s]."""
    bones = model.forward_kinematics(join_qpos(angles))
    thumb, other = bones_of("thumb")[2], bones_of(finger)[2]
    tip = bones[:, other, :3, 3] + model.skeleton.lengths[other] * bones[:, other, :3, 0]
    position = np.einsum("tji,tj->ti", bones[:, thumb, :3, :3], tip - bones[:, thumb, :3, 3])
    speed = np.full(len(position), np.inf)
    if len(position) > 2 * window:
        distance = np.linalg.norm(position[2 * window :] - position[: -2 * window], axis=1)
        speed[window:-window] = distance * rate / (2 * window)
    return speed


def initialize_contacts(
    model: HandModel, touches: list[tuple[int, str]], T_world_bone: Float[np.ndarray, "K L 4 4"]
) -> Contacts:
    """Contacts of touches, with points where the two last bones are nearest."""
    points, bones = np.empty((2, len(touches), 3)), np.empty((2, len(touches)), dtype=np.int64)
    for number, (_, finger) in enumerate(touches):
        nearest = _nearest_skin_points(model, T_world_bone[number], finger)
        for part, digit in enumerate(("thumb", finger)):
            bone = bones[part, number] = bones_of(digit)[2]
            local = np.linalg.inv(T_world_bone[number, bone]) @ np.append(nearest[part], 1.0)
            points[part, number] = (model.rest_transforms[bone] @ local)[:3]
    ends = points.reshape(-1, 3)
    pads = nearest_coordinates(ends, ends, bones.ravel(), model.shape)
    pads = pads._replace(heights=np.zeros(len(pads.faces)))
    frames = np.array([frame for frame, _ in touches], dtype=np.int64)
    fingers = np.array([DIGITS.index(finger) for _, finger in touches], dtype=np.int64)
    return slide_contacts(Contacts(frames, fingers, pads), model, T_world_bone)


def are_touches(gaps: Float[np.ndarray, "K"], spreads: Float[np.ndarray, "K"]) -> Bool[np.ndarray, "K"]:
    """Whether pads touch rather than rest anywhere near each other, by gaps without contacts [m]."""
    # Gaps of touching pads are normally distributed around zero; gaps of others are uniform up to a largest
    # one.
    spreads = np.hypot(spreads, CONTACT_SPREAD)
    odds = _MOST_TOUCH_GAP / (np.sqrt(2.0 * np.pi) * spreads) * np.exp(-0.5 * (gaps / spreads) ** 2)
    return np.asarray((gaps < 0.0) | (odds > 1.0))


def _nearest_skin_points(model: HandModel, bones: Doubles, finger: str) -> Doubles:
    """Points (2, 3) [m] on the skins of the two last bones, each where the other bone is nearest."""
    pads = []
    for digit in ("thumb", finger):
        bone = bones_of(digit)[2]
        shape, number = model.shape, DIGITS.index(digit)
        along = np.linspace(0.2, 1.0, 9) * (shape.bone_lengths[number, 2] - shape.radii[number, 3])
        pads.append(bones[bone, :3, 3] + along[:, None] * bones[bone, :3, 0])
    apart = np.linalg.norm(pads[0][:, None] - pads[1], axis=2)
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    ends = np.stack([pads[0][first], pads[1][second]])
    direction = (ends[1] - ends[0]) / apart.min()
    radii = model.shape.radii[[0, DIGITS.index(finger)], 2:].mean(axis=1)
    return np.asarray(ends + radii[:, None] * np.stack([direction, -direction]))


def slide_contacts(contacts: Contacts, model: HandModel, T_world_bone: Doubles) -> Contacts:
    """Slide contact points on the skin to where thumb and finger are nearest, in a pose (L, 4, 4) each."""
    # Each point moves to where its skin is nearest to a target inside the other pad. A target on the surface
    # of the other pad would fail if the pads overlap.
    skin, count = build_skin(model.shape), len(contacts.frames)
    sides = [contacts.pads.part(0, count), contacts.pads.part(count, None)]
    for _ in range(_SLIDE_ROUNDS):
        for own, other in ((0, 1), (1, 0)):
            inner = sides[other]._replace(heights=np.full(count, -_PAD_CENTER_DEPTH))
            points, _ = skin_points(inner, skin.corners(inner.faces))
            blend = _blend_transforms(inner, model, T_world_bone)
            target = np.einsum("kij,kj->ki", blend[:, :, :3], points) + blend[:, :, 3]
            blend = _blend_transforms(sides[own], model, T_world_bone)
            rest = np.linalg.solve(blend[:, :, :3], (target - blend[:, :, 3])[..., None])[..., 0]
            slid = project_onto_skin(sides[own], rest, skin)
            sides[own] = slid._replace(heights=np.zeros(count))
    return contacts._replace(pads=SkinCoordinates(*map(np.concatenate, zip(*sides, strict=True))))


def contact_geometry(
    contacts: Contacts, corners: Corners, model: HandModel, T_world_bone: Doubles
) -> ContactGeometry:
    """Directions and gaps of contacts, and whether their pads face each other."""
    rest, rest_normals = skin_points(contacts.pads, corners)
    blend = _blend_transforms(contacts.pads, model, np.concatenate([T_world_bone, T_world_bone]))
    points = (np.einsum("kij,kj->ki", blend[:, :, :3], rest) + blend[:, :, 3]).reshape(2, -1, 3)
    normals = np.einsum("kij,kj->ki", blend[:, :, :3], rest_normals).reshape(2, -1, 3)
    direction = normals[0] - normals[1]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = points[1] - points[0]
    along = (offset * direction).sum(axis=1)
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    # Both points must be on last bones, and must not have slid away.
    last = np.array([bones_of(digit)[2] for digit in DIGITS])
    bones = np.append(np.full(len(offset), last[0]), last[contacts.fingers])
    on_tips = (skin_weights(contacts.pads)[np.arange(len(bones)), bones] > 0.5).reshape(2, -1).all(axis=0)
    facing = (normals[0] * normals[1]).sum(axis=1) < _FACING_COSINE
    facing &= (across < _MOST_PAD_OFFSET) & on_tips
    return ContactGeometry(direction, along + 2.0 * PAD_COMPRESSION, facing)


def contact_weights(geometry: ContactGeometry, fingers: Int[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Weight of each contact from 0 to 1, small if its gap differs from the others of its finger."""
    # Geman and McClure's weights (1987) are centered on a low quantile, because a touch has the smallest gap.
    weights = np.zeros(len(geometry.gaps))
    for finger in np.unique(fingers[geometry.facing]):
        mine = (fingers == finger) & geometry.facing
        deviation = geometry.gaps[mine] - np.quantile(geometry.gaps[mine], _GAP_QUANTILE)
        weights[mine] = (1.0 + (deviation / _GAP_SCALE) ** 2) ** -2.0
    return weights


def _blend_transforms(coordinates: SkinCoordinates, model: HandModel, T_world_bone: Doubles) -> Doubles:
    """Blended transforms (K, 3, 4) from the rest hand to the world, for each point in its frame."""
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    return np.asarray(np.einsum("kl,klij->kij", skin_weights(coordinates), motion))


def levenberg_marquardt(
    problem: Problem,
    estimate: Estimate,
    steps: int,
    most: int,
    progress: Progress | None,
    small_gain: float = SMALL_GAIN,
) -> tuple[Estimate, Fit, int]:
    """Minimize until a step gains too small a share, or step `most`; also return the number of steps."""
    fit, damping = problem.fit(estimate), _FIRST_DAMPING
    while steps < most:
        before, equations = fit.cost, problem.normal_equations(estimate, fit)
        for _ in range(_MOST_DAMPING_TRIALS):
            trial = problem.apply_step(estimate, *_damped_step(equations, damping))
            trial_fit = problem.fit(trial)
            if trial_fit.cost < before:
                estimate, fit = _with_slid_contacts(problem, trial, trial_fit)
                damping = max(_DAMPING_CUT * damping, _LEAST_DAMPING)
                break
            damping = max(_DAMPING_RAISE * damping, _LEAST_RAISED_DAMPING)
        steps += 1
        if progress is not None:
            progress(steps)
        if abs(before - fit.cost) < small_gain * before:
            break
    return estimate, fit, steps


def user_hand(right: GloveFit, problem: Problem, estimate: Estimate) -> GloveFit:
    """The estimated right hand in its glove."""
    shape = shape_at(problem.shape, estimate.parameters)
    return GloveFit(HandModel(shape), attachment_at(right.attachment.layout, estimate.coordinates, shape))


def eliminate_poses(equations: NormalEquations, damping: float) -> tuple[Doubles, Doubles]:
    """Schur complement of the damped poses (S, S + 1), gradient last, and their solution (F, 26, S + 1)."""
    pose = equations.pose.copy()
    diagonal = np.arange(pose.shape[1])
    pose[:, diagonal, diagonal] *= 1.0 + damping
    right = np.concatenate([equations.mixed, equations.pose_gradient[..., None]], axis=2)
    solved = np.linalg.solve(pose, right)
    flat = equations.mixed.reshape(-1, equations.mixed.shape[2])
    reduced = np.concatenate([equations.shared, equations.shared_gradient[:, None]], axis=1)
    reduced -= flat.T @ solved.reshape(len(flat), -1)
    return reduced, solved


def shared_covariance(
    problem: Problem, estimate: Estimate, fit: Fit
) -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "F 26 S"]]:
    """Covariance of the shared unknowns, marginalized over poses, and derivative of poses by them."""
    reduced, solved = eliminate_poses(problem.normal_equations(estimate, fit), 0.0)
    return np.linalg.inv(reduced[:, :-1]), solved[..., :-1]


def error_covariance(problem: Problem, estimate: Estimate, fit: Fit) -> Float[np.ndarray, "S S"]:
    """Covariance of the errors of the shared unknowns.

    Many frames average noise, but neither flesh that follows the angles of its digit, nor the difference
    between a user's gestures and those of other people.
    """
    by_pose, by_shared, residuals, _ = jacobians = problem.weighted_jacobians(estimate, fit)
    equations = problem.normal_equations(estimate, fit, jacobians)
    reduced, solved = eliminate_poses(equations, 0.0)
    inverse, pose_derivatives = np.linalg.inv(reduced[:, :-1]), solved[..., :-1]
    flat = by_shared.reshape(-1, len(reduced))
    share = (problem.data_noise / problem.noise) ** 2
    errors = share * reduced[:, :-1] + (1.0 - share) * (equations.shared - flat.T @ flat)
    turns = pose_derivatives[:, 6:].sum(axis=0).T @ problem.pose_precision / np.sqrt(GESTURES_OF_USER)
    errors += turns @ resting_prior().covariance @ turns.T
    # The fit absorbs part of the flesh's motion. The squared size of that motion is its part of the
    # residuals, divided by what motion of unit size would leave in them.
    patterns = _flesh_patterns(problem, estimate, fit)
    bases = np.stack([np.linalg.qr(one.reshape(-1, one.shape[2]))[0] for one in patterns])
    bases, forces, unit_residual = bases.reshape(patterns.shape), [], 0.0
    for marker, moved in enumerate(patterns):
        rows = slice(3 * marker, 3 * marker + 3)
        poses = by_pose[:, rows].swapaxes(1, 2) @ moved
        force = np.tensordot(by_shared[:, rows], moved, ((0, 1), (0, 1)))
        forces.append(force - np.tensordot(pose_derivatives, poses, ((0, 1), (0, 1))))
        shared = inverse @ forces[-1]
        moved_poses = pose_derivatives @ shared - np.linalg.solve(equations.pose, poses)
        rest = by_pose @ moved_poses - by_shared @ shared
        rest[:, rows] += moved
        by_marker = rest[:, :-1].reshape(len(rest), len(patterns), 3, -1)
        unit_residual += np.square(np.einsum("mfkb,fmkc->mbc", bases, by_marker, optimize=True)).sum()
    seen = residuals[:, :-1].reshape(len(residuals), -1, 3)
    found = np.square(np.einsum("mfkb,fmk->mb", bases, seen, optimize=True)).sum()
    of_noise = share * bases[:, 0, 0].size * (1.0 - (by_pose[:, 0].size + len(reduced)) / seen.size)
    flesh = max(found - of_noise, 0.0) / unit_residual
    across = np.concatenate(forces, axis=1)
    return np.asarray(inverse @ (errors + flesh * across @ across.T) @ inverse)


def _flesh_patterns(problem: Problem, estimate: Estimate, fit: Fit) -> Float[np.ndarray, "M F 3 12"]:
    """Patterns in which flesh moves each marker, in the wrist's frame, with the angles of its digit.

    They are weighted as residuals are; before weighting, each has a mean square of a quarter over the frames.
    Flesh on the palm follows the flexions of the MCP joints.
    """
    patterns, turned = [], quaternion_matrix(estimate.qpos[:, 3:7])
    roots = problem.roots(fit)
    for marker, bone in enumerate(skin_weights(estimate.coordinates).argmax(axis=1)):
        digit = BONES[bone].digit
        angles = estimate.qpos[:, 12::4] if digit < 0 else estimate.qpos[:, 7 + 4 * digit : 11 + 4 * digit]
        off = problem.present[:, marker, None] * (angles - angles.mean(axis=0))
        off *= roots[:, marker, None] / max(float(np.sqrt((off**2).sum(axis=1).mean())), _LEAST_DIGIT_MOTION)
        patterns.append(np.einsum("fki,fj->fkij", turned, off).reshape(len(off), 3, -1))
    return np.stack(patterns)


def _damped_step(
    equations: NormalEquations, damping: float
) -> tuple[Float[np.ndarray, "F 26"], Float[np.ndarray, "S"]]:
    """Steps of the poses (F, 26) and of the shared unknowns (S,)."""
    reduced, solved = eliminate_poses(equations, damping)
    system = reduced[:, :-1] + np.diag(damping * equations.shared.diagonal())
    shared = -np.linalg.solve(system, reduced[:, -1])
    return -solved[..., -1] - solved[..., :-1] @ shared, shared


def _with_slid_contacts(problem: Problem, estimate: Estimate, fit: Fit) -> tuple[Estimate, Fit]:
    """Slide the contact points of an estimate, and fit it again."""
    if not len(estimate.contacts.frames):
        return estimate, fit
    contacts = slide_contacts(estimate.contacts, fit.model, fit.bones[estimate.contacts.frames])
    slid = dataclasses.replace(estimate, contacts=contacts)
    return slid, problem.fit(slid)
