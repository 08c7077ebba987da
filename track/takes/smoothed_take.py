"""Poses of a tracked take, smoothed over its whole time, forward and backward.

A pose fitted to the markers of one frame has their noise: on a short bone a millimeter is ten degrees. Here
all poses of a hand between two initializations are solved together, with white noise as acceleration of all
unknowns and the tracker's prior of joint angles. The tracker itself knows only the past, and learns marker
biases meanwhile; smoothed poses do not depend on where in a file their frame is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.fit import GloveFit
from gloves.takes.take import INITIALIZED, LOST, Take
from handsim.arrays import Doubles
from handsim.hand.angles import WRIST_NAMES
from handsim.hand.shape import DIGITS, JOINT_NAMES, NUM_JOINTS, NUM_KEYPOINTS
from handsim.kernels import kernel, move, velocity_of
from handsim.space.transforms import quaternion_matrix
from track.bodies.forearm import wrist_variances
from track.kinematics.marker_kinematics import (
    LIMIT_PRECISION,
    NUM_UNKNOWNS,
    HandArrays,
    accumulate_normal_equations,
    hand_arrays,
    marker_residuals,
    workspace,
)
from track.kinematics.pose_solver import OUTLIER_DISTANCE
from track.kinematics.pose_spread import (
    SOURCES,
    SpreadModel,
    are_still,
    freedom_factor,
    resting_prior,
    usual_angle_variances,
)
from track.user import hand_origin, read_errors

# Chosen on realistic simulated hands; the error hardly changes within a factor of ten.
_ACCELERATION_DENSITY: Final = np.repeat([10.0, 0.5, 10.0], [NUM_JOINTS, 3, 3])
"""Power spectral density of acceleration: joints [rad^2/s^3], wrist [m^2/s^3], [rad^2/s^3]."""
_PRIOR_RATE: Final = 30.0  # [1/s] The prior counts this often, because errors of markers last that long.
_KNOWN_ANGLE_SPREAD: Final = float(np.deg2rad(3.0))
"""Standard deviation of an angle measured by goniometer [rad]: 95 % of a therapist's finger angles repeat
within 5 degrees (Ellis and Bruton 2002), and a joint bends a little between the measurements."""
# [1/m^2, 1/rad^2] makes an unseen wrist solvable
_WRIST_PRECISION: Final = np.repeat([0.0, 1.0], [NUM_JOINTS, 6])
_WINDOW_FRAMES, _MARGIN_FRAMES = 2000, 200  # frames solved together, and additional ones at either end
_ROUNDS: Final = 5  # Gauss-Newton steps
# Quick hands raise the acceleration by this factor, this often at most.
_ACCELERATION_FACTOR, _MOST_RAISES = 10.0, 4
_COUNTED_STRIDE: Final = 8  # One frame in eight shows how many coordinates of markers a pose can follow.
_LEAST_FREEDOM: Final = 0.1  # lower bound of the share of marker coordinates that a pose cannot follow
_LONGEST_STEP: Final = 0.5  # [rad], [m] bound of each step
_FIRST_NOISE, _LEAST_NOISE = 0.0015, 0.0001  # [m] standard deviation of markers: first value, lower bound
_ERROR_PER_BIAS: Final = 1.4  # ratio of a marker's place error to its mean residual, as poses absorb a part
# Permutations between a step's unknowns (joints, wrist position and rotation) and MuJoCo's order.
_TO_MUJOCO: Final = np.r_[NUM_JOINTS:NUM_UNKNOWNS, 0:NUM_JOINTS]
_FROM_MUJOCO: Final = np.argsort(_TO_MUJOCO)


class _Window(NamedTuple):
    """Frames whose poses are solved together."""

    frames: slice
    kept: slice
    """Frames whose poses are kept; those near the ends of a window belong to its neighbors."""

    @property
    def inner(self) -> slice:
        """The kept frames, counted from the window's first."""
        first = self.frames.start
        return slice(self.kept.start - first, self.kept.stop - first)


def smooth_take(take: Take) -> Take:
    """Smooth the poses of a take's hands, and compute their standard deviations.

    Labels and statuses stay. The settings get for each hand under "filter" the cut-off of each joint angle
    [Hz], and under "budget" its standard deviation by `SOURCES` [deg]; under "wrist_budget" those of a wrist
    whose forearm is tracked.
    """
    qpos, rms = take.qpos.copy(), take.rms.copy()
    angles = np.full((*rms.shape, NUM_JOINTS), np.nan)
    keypoints, cutoffs, budgets = np.full((*rms.shape, NUM_KEYPOINTS), np.nan), {}, {}
    wrists, wrist_budgets = np.full((*rms.shape, len(WRIST_NAMES)), np.nan), {}
    for number, side in enumerate(take.sides):
        windows = _windows(take.status[:, number])
        if windows:
            hand = _SmoothedHand(take, number)
            cutoff, variances = hand.solve(windows)
            cutoffs[side], budgets[side] = np.round(cutoff, 2).tolist(), _budget(variances[:, :NUM_JOINTS])
            qpos[:, number], fits = hand.qpos, np.isfinite(rms[:, number])
            rms[fits, number] = hand.rms()[fits]
            angles[:, number], keypoints[:, number] = hand.angles, hand.keypoints
            if take.forearm_index(side) is not None:
                parts = wrist_variances(take, side, variances[:, -3:])
                known = np.isfinite(parts).any(axis=(0, 2))
                if known.any():
                    wrists[:, number] = np.sqrt(parts.sum(axis=-1))
                    wrist_budgets[side] = _budget(parts[:, known])  # Without an elbow pronation is the last.
    settings = {**take.settings, "filter": cutoffs, "budget": budgets}
    return dataclasses.replace(
        take,
        qpos=qpos,
        rms=rms,
        angle_spread=angles,
        keypoint_spread=keypoints,
        wrist_spread=wrists if wrist_budgets else None,
        settings=settings | ({"wrist_budget": wrist_budgets} if wrist_budgets else {}),
    )


def _budget(variances: Float[np.ndarray, "T K 5"]) -> list[list[float]]:
    """Root mean square over the known frames of standard deviations of angles by `SOURCES` [deg]."""
    found: list[list[float]] = np.rad2deg(np.sqrt(np.nanmean(variances, axis=0))).round(3).tolist()
    return found


def spread_model(take: Take, hand: GloveFit) -> SpreadModel:
    """Model of the standard deviations of a take's hand, from the user that the settings record."""
    errors = read_errors(take.settings.get("errors", {}), take.hands)
    origin = hand_origin(str(take.settings.get("user", "")), hand.side)
    return SpreadModel(hand, origin, errors.get(hand.side))


def times_unseen(times: Float[np.ndarray, "T"], seen: Bool[np.ndarray, "T M"]) -> Float[np.ndarray, "T M"]:
    """Time to the nearest frame that shows each marker [s]; infinite if there is none."""
    last = np.maximum.accumulate(np.where(seen, times[:, None], -np.inf), axis=0)
    following = np.minimum.accumulate(np.where(seen, times[:, None], np.inf)[::-1], axis=0)[::-1]
    return np.asarray(np.minimum(times[:, None] - last, following - times[:, None]))


def _windows(status: Int[np.ndarray, "T"]) -> list[_Window]:
    """The windows of a hand; a window starts anew where the hand is initialized."""
    windows = []
    for first, last in runs_of(status != LOST):
        begins = first + np.flatnonzero(status[first : last + 1] == INITIALIZED)
        bounds = np.unique([first, *begins, last + 1])
        for start, stop in pairwise(bounds.tolist()):
            for kept in range(start, stop, _WINDOW_FRAMES):
                end = min(kept + _WINDOW_FRAMES, stop)
                frames = slice(max(kept - _MARGIN_FRAMES, start), min(end + _MARGIN_FRAMES, stop))
                windows.append(_Window(frames, slice(kept, end)))
    return windows


class _SmoothedHand:
    """A hand of a take whose poses are being smoothed."""

    def __init__(self, take: Take, number: int) -> None:
        worn = self._worn = take.hands[number]
        self.qpos = take.qpos[:, number].copy()  # (T, 27), NaN where the hand is lost
        # Standard deviations of joint angles (T, 20) [rad] and of keypoints (T, 21) [m].
        self.angles = np.full((take.num_frames, NUM_JOINTS), np.nan)
        self.keypoints = np.full((take.num_frames, NUM_KEYPOINTS), np.nan)
        self._targets = np.ascontiguousarray(take.observed(worn.side))
        self._unseen = times_unseen(take.times, np.isfinite(self._targets[..., 0]))
        self._residuals = np.full_like(self._targets, np.nan)  # in the frames of the bones [m]
        self._hand, self.model, self._rate = hand_arrays(worn), spread_model(take, worn), take.rate
        spans, seen = self._hand.hinge_span, np.isfinite(self._targets[..., 0]).any(axis=0)
        joints = np.arange(NUM_JOINTS)[:, None]
        # Whether each joint moves a marker that is seen.
        self._moves_seen = ((spans[:, 0] <= joints) & (joints < spans[:, 1]) & seen).any(axis=1)
        known = take.settings.get("known", {})
        names = [(f"{worn.side}:{name}", name) for name in JOINT_NAMES]
        self._known = np.deg2rad([known.get(one, known.get(each, np.nan)) for one, each in names])
        self._accelerations = _ACCELERATION_DENSITY
        # precision of known angles [1/rad^2]
        self._known_precision = np.diag(np.isfinite(self._known) / _KNOWN_ANGLE_SPREAD**2)
        # The prior of usual angles does not hold for a digit with a known angle.
        has_known = np.isfinite(self._known).reshape(len(DIGITS), -1).any(axis=1).repeat(4)
        self._unusual = has_known & self._moves_seen
        # Number of seen marker coordinates of each frame, and how many of them the pose can follow.
        self._coordinates = np.zeros((take.num_frames, 2))
        self._reset_noise()

    def _reset_noise(self) -> None:
        """Forget all that residuals have shown."""
        self._prior = self._prior_of(self._unusual)
        # Standard deviations [m] of noise, of the slow motion in the residuals, and of the flesh that causes
        # it.
        self._noise, self._drift, self._flesh = _FIRST_NOISE, 0.0, 0.0
        self._places = np.zeros((len(self._hand.digits), 2))  # RMS error along the skin, off it [m]

    def solve(self, windows: Sequence[_Window]) -> tuple[Doubles, Doubles]:
        """Solve all poses; return the angles' cut-offs (20,) [Hz], and all variances (T, 26, 5) by source."""
        self._solve_poses(windows)
        cutoffs, wide = [], self._prior_of(self._moves_seen)
        parts = np.full((len(self.qpos), NUM_UNKNOWNS, len(SOURCES)), np.nan)
        # A calibration knows no more of a joint that does not move than a measurement does.
        still, models = np.flatnonzero(are_still(self._angles()) & self._moves_seen), [self.model]
        if len(still) and self.model.is_calibrated:
            models.append(SpreadModel(self._worn, "measured"))
        for window in windows:
            equations = self._equations(window)
            covariances = self._step(window, equations)
            kept, inner = window.kept, window.inner
            equations[0][:, :NUM_JOINTS, :NUM_JOINTS] += wide - self._prior
            alone = np.linalg.inv(equations[0])[inner]
            # Errors of the prior and of known angles are equal in successive frames.
            by_hinges = alone[:, :, :NUM_JOINTS]
            same = by_hinges @ (self._prior_weight * wide + self._known_precision) @ by_hinges.swapaxes(1, 2)
            (variances, self.keypoints[kept]), *measured = (
                model.variances(
                    self.qpos[kept],
                    self._unseen[kept],
                    self._weight_noise,
                    self._flesh,
                    self._places,
                    covariances[inner] + same,
                    wide + self._known_precision,
                )
                for model in models
            )
            for other, _ in measured:
                variances[:, still] = np.maximum(variances, other)[:, still]
            self.angles[kept] = np.sqrt(variances[:, :NUM_JOINTS].sum(axis=-1))
            # The error by the prior belongs to the person, so it moves from noise to that source.
            pulled = same.diagonal(axis1=1, axis2=2)
            parts[kept] = variances + pulled[..., None] * [-1.0, 0.0, 0.0, 1.0, 0.0]
            spreads = alone[:, range(NUM_JOINTS), range(NUM_JOINTS)]
            cutoffs.append((self._accelerations[:NUM_JOINTS] * self._rate / spreads) ** 0.25 / (2.0 * np.pi))
        return np.median(np.concatenate(cutoffs), axis=0), parts

    def _solve_poses(self, windows: Sequence[_Window]) -> None:
        """Solve the poses, and again with larger accelerations while they lag behind the hand.

        Residuals of single-frame poses are the markers' noise, less the share that a pose follows. Smoothed
        poses with larger residuals lag behind the hand; their lag would count as noise, and grow.
        """
        single, left = self.qpos.copy(), np.nanmean(self.rms() ** 2)
        for turn in range(_MOST_RAISES + 1):
            for _ in range(_ROUNDS):
                for window in windows:
                    self._step(window, self._equations(window))
                self._estimate_noise()
                self._prior = self._prior_of(self._unusual)
            if not np.nanmean(self.rms() ** 2) * self._freedom > left or turn == _MOST_RAISES:
                return
            self.qpos, self._accelerations = single.copy(), _ACCELERATION_FACTOR * self._accelerations
            self._reset_noise()

    @property
    def _freedom(self) -> float:
        """Share of the markers' coordinates that a pose cannot follow."""
        shown, followed = self._coordinates.sum(axis=0)
        return float(max(1.0 - followed / max(shown, 1.0), _LEAST_FREEDOM))

    def rms(self) -> Float[np.ndarray, "T"]:
        """RMS distance of the markers from those of the smoothed poses [m]; NaN without markers."""
        there = np.isfinite(self.qpos).all(axis=1)
        squares = np.full(self._targets.shape[:2], np.nan)
        squares[there] = ((self._worn.markers(self.qpos[there])[0] - self._targets[there]) ** 2).sum(axis=-1)
        seen = np.isfinite(squares)
        count = np.where(seen.any(axis=1), seen.sum(axis=1), np.nan)
        return np.asarray(np.sqrt(squares.sum(axis=1, where=seen) / count))

    @property
    def _prior_weight(self) -> float:
        """Weight of the prior of joint angles in one frame."""
        return min(1.0, _PRIOR_RATE / self._rate)

    def _angles(self) -> Float[np.ndarray, "F 20"]:
        """The joint angles of the frames with a pose [rad]."""
        return self.qpos[np.isfinite(self.qpos).all(axis=1), 7:]

    def _prior_of(self, joints: Bool[np.ndarray, "20"]) -> Float[np.ndarray, "20 20"]:
        """Precision of the prior of the joint angles in one frame [1/rad^2].

        It is weak for those of the given joints that do not move.
        """
        own = usual_angle_variances(self._angles()) * joints
        return np.asarray(self._prior_weight * np.linalg.inv(resting_prior().covariance + np.diag(own)))

    @property
    def _weight_noise(self) -> float:
        """Standard deviation that weights a marker [m]: noise and slow motion together.

        For gloves with few markers it is larger than noise and flesh. There a misplaced marker misleads a
        pose most, so the prior counts more.
        """
        slow = np.sqrt(3.0) * self._drift * freedom_factor(len(self._places))
        return float(np.hypot(self._noise, slow))

    def _equations(self, window: _Window) -> tuple[Doubles, Doubles]:
        """Normal matrices (F, 26, 26) and gradients (F, 26) of single frames."""
        qpos, prior = self.qpos[window.frames], self._prior
        normal, gradient, self._residuals[window.frames] = _frame_equations(
            self._hand, self._targets[window.frames], qpos, self._weight_noise**-2, OUTLIER_DISTANCE**-2
        )
        markers = normal[::_COUNTED_STRIDE].copy()
        normal[:, :NUM_JOINTS, :NUM_JOINTS] += prior + self._known_precision
        normal += np.diag(_WRIST_PRECISION)
        counted = slice(window.frames.start, window.frames.stop, _COUNTED_STRIDE)
        self._count_fit(counted, markers, normal[::_COUNTED_STRIDE])
        gradient[:, :NUM_JOINTS] += (qpos[:, 7:] - resting_prior().angles) @ prior
        gradient[:, :NUM_JOINTS] += np.nan_to_num(qpos[:, 7:] - self._known) @ self._known_precision
        return normal, gradient

    def _count_fit(self, frames: slice, markers: Doubles, whole: Doubles) -> None:
        """Count coordinates, from the normal matrices by markers and limits alone, and with the prior."""
        angles, (low, high) = self.qpos[frames, 7:], self._hand.ranges.T
        hinges = np.arange(NUM_JOINTS)
        markers[:, hinges, hinges] -= LIMIT_PRECISION * ((angles < low) | (angles > high))
        self._coordinates[frames, 0] = 3 * np.isfinite(self._targets[frames, :, 0]).sum(axis=1)
        self._coordinates[frames, 1] = np.linalg.solve(whole, markers).trace(axis1=1, axis2=2)

    def _step(self, window: _Window, equations: tuple[Doubles, Doubles]) -> Doubles:
        """Move the poses of a window by a Gauss-Newton step; return the covariances of its unknowns."""
        # The wrist's position is solved in world axes, because its acceleration is penalized there.
        normal, gradient = equations[0].copy(), equations[1].copy()
        qpos = self.qpos[window.frames]
        turns = np.tile(np.eye(NUM_UNKNOWNS), (len(qpos), 1, 1))
        place = slice(NUM_JOINTS, NUM_JOINTS + 3)
        turns[:, place, place] = quaternion_matrix(qpos[:, 3:7])
        normal = turns @ normal @ turns.swapaxes(1, 2)
        gradient = np.einsum("tij,tj->ti", turns, gradient)
        precision = self._rate**3 / self._accelerations
        if len(qpos) > 2:
            velocities = np.array([velocity_of(*pair, 1.0) for pair in pairwise(qpos)])[:, _FROM_MUJOCO]
            pull = precision * np.diff(velocities, axis=0)
            gradient[:-2] += pull
            gradient[1:-1] -= 2.0 * pull
            gradient[2:] += pull
        step, covariances = _solve_in_time(normal, gradient, precision)
        moved = move(qpos, np.clip(-step, -_LONGEST_STEP, _LONGEST_STEP)[:, _TO_MUJOCO])
        self.qpos[window.kept] = moved[window.inner]
        return np.asarray(turns.swapaxes(1, 2) @ covariances @ turns)

    def _estimate_noise(self) -> None:
        """Estimate noise, flesh motion and place errors of the markers from their residuals."""
        residuals = self._residuals
        seen = np.isfinite(residuals[..., 0])
        bias = np.nan_to_num(np.nansum(residuals, axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None])
        changes = np.diff(residuals, axis=0)
        noise = _spread(changes[seen[1:] & seen[:-1]]) / np.sqrt(2.0)
        self._noise = max(noise, _LEAST_NOISE)
        self._drift = float(np.sqrt(max(_spread((residuals - bias)[seen]) ** 2 - noise**2, 0.0)))
        # Residuals contain flesh only in the coordinates that poses cannot follow.
        self._flesh = self._drift / float(np.sqrt(self._freedom))
        lifts = (bias * self._hand.normals).sum(axis=1)
        slips = np.sqrt(np.maximum((bias**2).sum(axis=1) - lifts**2, 0.0) / 2.0)
        for part in (self._hand.digits < 0, self._hand.digits >= 0):
            shown = part & seen.any(axis=0)
            self._places[part] = [_ERROR_PER_BIAS * _spread(of[shown]) for of in (slips, lifts)]


def _spread(values: Doubles) -> float:
    """Standard deviation of values around zero [m], without outliers."""
    near = values[np.abs(values) < OUTLIER_DISTANCE]
    return float(np.sqrt(np.mean(near**2))) if len(near) else 0.0


@kernel
def _frame_equations(
    hand: HandArrays,
    targets: Float[np.ndarray, "T M 3"],
    qpos: Float[np.ndarray, "T 27"],
    precision: float,
    robust_scale: float,
) -> tuple[Doubles, Doubles, Doubles]:
    """Normal matrices, gradients and residuals (in the bones' frames) of each frame."""
    frames, count = targets.shape[:2]
    normal, gradient = np.zeros((frames, NUM_UNKNOWNS, NUM_UNKNOWNS)), np.zeros((frames, NUM_UNKNOWNS))
    local, work, weights = np.zeros((frames, count, 3)), workspace(count), np.empty(count)
    for frame in range(frames):
        marker_residuals(hand, targets[frame], qpos[frame], work)
        for marker in range(count):
            residual, bone = work.residuals[marker], work.rotations[hand.bones[marker, 0]]
            square = 0.0
            for i in range(3):
                square += residual[i] ** 2
                for j in range(3):
                    local[frame, marker, i] += bone[j, i] * residual[j]
            seen = not np.isnan(square)
            weights[marker] = precision / (1.0 + robust_scale * square) ** 2 if seen else 0.0
        accumulate_normal_equations(hand, weights, work)
        for row in range(NUM_UNKNOWNS):
            gradient[frame, row] = work.gradient[row]
            for column in range(NUM_UNKNOWNS):
                normal[frame, row, column] = work.normal[min(row, column), max(row, column)]
        for hinge in range(NUM_JOINTS):
            angle = qpos[frame, 7 + hinge]
            beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
            if beyond != 0.0:
                gradient[frame, hinge] += LIMIT_PRECISION * beyond
                normal[frame, hinge, hinge] += LIMIT_PRECISION
    return normal, gradient, local


def _solve_in_time(
    normal: Float[np.ndarray, "T U U"], gradient: Float[np.ndarray, "T U"], precision: Float[np.ndarray, "U"]
) -> tuple[Float[np.ndarray, "T U"], Float[np.ndarray, "T U U"]]:
    """Solve frames coupled by second differences of a given precision; also return their covariances."""
    # Pairs of frames are the blocks of a block tridiagonal system: eliminate forward, then substitute.
    count, size = gradient.shape
    pairs = (count + 1) // 2
    connected = np.zeros((3, 2 * pairs))  # coefficient of two frames by their distance, stored at the first
    for distance, values in enumerate(((1.0, 4.0, 1.0), (-2.0, -2.0), (1.0,))):
        for start, value in enumerate(values):
            connected[distance, start : max(count - 2, 0) + start] += value
    process = connected[:, :, None, None] * np.diag(precision)
    own = np.tile(np.eye(size), (2 * pairs, 1, 1))
    own[:count] = normal + process[0, :count]
    right = np.zeros((2 * pairs, size))
    right[:count] = gradient
    nothing = np.zeros_like(own[::2])
    blocks = np.block([[own[::2], process[1, ::2]], [process[1, ::2], own[1::2]]])
    ahead = np.block([[process[2, ::2], nothing], [process[1, 1::2], process[2, 1::2]]])
    right = right.reshape(pairs, 2 * size)
    covariances, back = np.empty_like(blocks), np.empty_like(blocks)
    for pair in range(pairs):
        if pair:
            blocks[pair] -= ahead[pair - 1].T @ back[pair - 1]
            right[pair] -= back[pair - 1].T @ right[pair - 1]
        covariances[pair] = np.linalg.inv(blocks[pair])
        back[pair] = covariances[pair] @ ahead[pair]
    solution = np.einsum("pij,pj->pi", covariances, right)
    for pair in range(pairs - 2, -1, -1):
        solution[pair] -= back[pair] @ solution[pair + 1]
        covariances[pair] += back[pair] @ covariances[pair + 1] @ back[pair].T
    both = np.stack([covariances[:, :size, :size], covariances[:, size:, size:]], axis=1)
    return solution.reshape(-1, size)[:count], both.reshape(-1, size, size)[:count]
