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
from numpy.typing import NDArray

from gloves.captures.capture import runs_of
from gloves.fit import GloveFit
from gloves.takes.take import INITIALIZED, LOST, Take
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
from track.kinematics.pose_spread import (
    SOURCES,
    SpreadModel,
    are_still,
    freedom_factor,
    own_variances,
    resting_prior,
)
from track.user import hand_origin, read_errors

# Chosen on realistic simulated hands; the error hardly changes within a factor of ten.
_ACCELERATIONS: Final = np.repeat([10.0, 0.5, 10.0], [NUM_JOINTS, 3, 3])
"""Power spectral density of acceleration: joints [rad^2/s^3], wrist [m^2/s^3], [rad^2/s^3]."""
_GESTURES: Final = 30.0  # [1/s] how often the prior counts: errors of markers last this long
_KNOWN: Final = float(np.deg2rad(3.0))
"""Standard deviation of an angle that a goniometer found [rad]: a therapist's finger angles repeat within
5 degrees in 95 % (Ellis and Bruton 2002), and joints are bent a little on the way."""
_WEAK: Final = np.repeat([0.0, 1.0], [NUM_JOINTS, 6])  # [1/m^2, 1/rad^2] keeps an unseen wrist solvable
_WINDOW, _MARGIN = 2000, 200  # frames solved together, and additional ones at either end
_ROUNDS: Final = 5  # Gauss-Newton steps
_QUICKER, _TIMES_QUICKER = 10.0, 4  # factor of the accelerations of quick hands, and how often at most
_COUNTED: Final = 8  # Every eighth frame tells how many coordinates of markers a pose can follow.
_LEAST_FREEDOM: Final = 0.1  # lower bound of the share of marker coordinates that a pose cannot follow
_LONGEST_STEP: Final = 0.5  # [rad], [m] bound of each step
_FIRST_NOISE, _LEAST_NOISE = 0.0015, 0.0001  # [m] standard deviation of markers: first value, lower bound
_FROM_BIAS: Final = 1.4  # ratio of a marker's place error to its mean residual: poses absorb half of it
_OUTLIER: Final = 0.01  # [m] scale of the robust loss (Geman and McClure 1987)
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
    """Model of the standard deviations of a take's hand, given what the settings record of the user."""
    errors = read_errors(take.settings.get("errors", {}), take.hands)
    origin = hand_origin(str(take.settings.get("user", "")), hand.side)
    return SpreadModel(hand, origin, errors.get(hand.side))


def times_unseen(times: Float[np.ndarray, "T"], seen: Bool[np.ndarray, "T M"]) -> Float[np.ndarray, "T M"]:
    """Time to the nearest frame that shows each marker [s]; infinite if there is none."""
    last = np.maximum.accumulate(np.where(seen, times[:, None], -np.inf), axis=0)
    following = np.minimum.accumulate(np.where(seen, times[:, None], np.inf)[::-1], axis=0)[::-1]
    return np.asarray(np.minimum(times[:, None] - last, following - times[:, None]))


def _windows(status: Int[np.ndarray, "T"]) -> list[_Window]:
    """The windows of a hand; none spans a frame in which the hand is initialized."""
    windows = []
    for first, last in runs_of(status != LOST):
        begins = first + np.flatnonzero(status[first : last + 1] == INITIALIZED)
        bounds = np.unique([first, *begins, last + 1])
        for start, stop in pairwise(bounds.tolist()):
            for kept in range(start, stop, _WINDOW):
                end = min(kept + _WINDOW, stop)
                frames = slice(max(kept - _MARGIN, start), min(end + _MARGIN, stop))
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
        self._shown = ((spans[:, 0] <= joints) & (joints < spans[:, 1]) & seen).any(axis=1)
        known = take.settings.get("known", {})
        names = [(f"{worn.side}:{name}", name) for name in JOINT_NAMES]
        self._known = np.deg2rad([known.get(one, known.get(each, np.nan)) for one, each in names])
        self._accelerations = _ACCELERATIONS
        self._sure = np.diag(np.isfinite(self._known) / _KNOWN**2)  # precision of known angles [1/rad^2]
        # A digit with a known angle is not as digits usually are.
        self._stiff = np.isfinite(self._known).reshape(len(DIGITS), -1).any(axis=1).repeat(4) & self._shown
        # Coordinates of the markers that are seen in a frame, and how many of them the pose can follow.
        self._coordinates = np.zeros((take.num_frames, 2))
        self._begin()

    def _begin(self) -> None:
        """Know nothing yet of what the residuals show."""
        self._prior = self._prior_of(self._stiff)
        # Standard deviations [m] of noise, of slow motion that residuals show, and of the flesh behind it.
        self._noise, self._slow, self._flesh = _FIRST_NOISE, 0.0, 0.0
        self._places = np.zeros((len(self._hand.digits), 2))  # RMS error along the skin, off it [m]

    def solve(
        self, windows: Sequence[_Window]
    ) -> tuple[Float[np.ndarray, "20"], Float[np.ndarray, "T 26 5"]]:
        """Solve all poses; return the cut-off of each angle [Hz] and the unknowns' variances by `SOURCES`."""
        self._follow(windows)
        cutoffs, wide = [], self._prior_of(self._shown)
        parts = np.full((len(self.qpos), NUM_UNKNOWNS, len(SOURCES)), np.nan)
        # Of a joint that does not move a calibration finds no more than measuring does.
        still, models = np.flatnonzero(are_still(self._angles()) & self._shown), [self.model]
        if len(still) and self.model.is_calibrated:
            models.append(SpreadModel(self._worn, "measured"))
        for window in windows:
            equations = self._equations(window)
            covariances = self._step(window, equations)
            kept, inner = window.kept, window.inner
            equations[0][:, :NUM_JOINTS, :NUM_JOINTS] += wide - self._prior
            alone = np.linalg.inv(equations[0])[inner]
            # Errors of the prior and of known angles are alike in successive frames.
            by_hinges = alone[:, :, :NUM_JOINTS]
            same = by_hinges @ (self._share * wide + self._sure) @ by_hinges.swapaxes(1, 2)
            (variances, self.keypoints[kept]), *measured = (
                model.variances(
                    self.qpos[kept],
                    self._unseen[kept],
                    self._weight_noise,
                    self._flesh,
                    self._places,
                    covariances[inner] + same,
                    wide + self._sure,
                )
                for model in models
            )
            for other, _ in measured:
                variances[:, still] = np.maximum(variances, other)[:, still]
            self.angles[kept] = np.sqrt(variances[:, :NUM_JOINTS].sum(axis=-1))
            # How far the prior pulls an unknown stays the same, as the person does.
            pulled = same.diagonal(axis1=1, axis2=2)
            parts[kept] = variances + pulled[..., None] * [-1.0, 0.0, 0.0, 1.0, 0.0]
            spreads = alone[:, range(NUM_JOINTS), range(NUM_JOINTS)]
            cutoffs.append((self._accelerations[:NUM_JOINTS] * self._rate / spreads) ** 0.25 / (2.0 * np.pi))
        return np.median(np.concatenate(cutoffs), axis=0), parts

    def _follow(self, windows: Sequence[_Window]) -> None:
        """Solve the poses, and again with larger accelerations while they do not follow the hand.

        Residuals of poses of single frames are the markers' noise, less the share that a pose follows.
        Smoothed poses with larger residuals lag behind the hand; their lag would count as noise, and grow.
        """
        single, left = self.qpos.copy(), np.nanmean(self.rms() ** 2)
        for turn in range(_TIMES_QUICKER + 1):
            for _ in range(_ROUNDS):
                for window in windows:
                    self._step(window, self._equations(window))
                self._estimate_noise()
                self._prior = self._prior_of(self._stiff)
            if not np.nanmean(self.rms() ** 2) * self._freedom > left or turn == _TIMES_QUICKER:
                return
            self.qpos, self._accelerations = single.copy(), _QUICKER * self._accelerations
            self._begin()

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
    def _share(self) -> float:
        """Weight of the prior of joint angles in one frame."""
        return min(1.0, _GESTURES / self._rate)

    def _angles(self) -> Float[np.ndarray, "F 20"]:
        """The joint angles of the frames with a pose [rad]."""
        return self.qpos[np.isfinite(self.qpos).all(axis=1), 7:]

    def _prior_of(self, joints: Bool[np.ndarray, "20"]) -> Float[np.ndarray, "20 20"]:
        """Precision of the prior of the joint angles in one frame [1/rad^2].

        The prior says nothing of those of the given joints that do not move.
        """
        own = own_variances(self._angles()) * joints
        return np.asarray(self._share * np.linalg.inv(resting_prior().covariance + np.diag(own)))

    @property
    def _weight_noise(self) -> float:
        """Noise and slow motion together [m], which weight a marker.

        Of gloves with few markers this is more than noise and flesh: the wrong place of a marker misleads a
        pose most there, and the prior makes up for that.
        """
        slow = np.sqrt(3.0) * self._slow * freedom_factor(len(self._places))
        return float(np.hypot(self._noise, slow))

    def _equations(self, window: _Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normal matrices (F, 26, 26) and gradients (F, 26) of single frames."""
        qpos, prior = self.qpos[window.frames], self._prior
        normal, gradient, self._residuals[window.frames] = _frame_equations(
            self._hand, self._targets[window.frames], qpos, self._weight_noise**-2, _OUTLIER**-2
        )
        markers = normal[::_COUNTED].copy()
        normal[:, :NUM_JOINTS, :NUM_JOINTS] += prior + self._sure
        normal += np.diag(_WEAK)
        self._count(slice(window.frames.start, window.frames.stop, _COUNTED), markers, normal[::_COUNTED])
        gradient[:, :NUM_JOINTS] += (qpos[:, 7:] - resting_prior().angles) @ prior
        gradient[:, :NUM_JOINTS] += np.nan_to_num(qpos[:, 7:] - self._known) @ self._sure
        return normal, gradient

    def _count(self, frames: slice, markers: NDArray[np.float64], whole: NDArray[np.float64]) -> None:
        """Count coordinates; normal matrices are given by markers and limits alone, and with the prior."""
        angles, (low, high) = self.qpos[frames, 7:], self._hand.ranges.T
        hinges = np.arange(NUM_JOINTS)
        markers[:, hinges, hinges] -= LIMIT_PRECISION * ((angles < low) | (angles > high))
        self._coordinates[frames, 0] = 3 * np.isfinite(self._targets[frames, :, 0]).sum(axis=1)
        self._coordinates[frames, 1] = np.linalg.solve(whole, markers).trace(axis1=1, axis2=2)

    def _step(
        self, window: _Window, equations: tuple[NDArray[np.float64], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Move the poses of a window by a Gauss-Newton step; return the covariances of its unknowns."""
        # The wrist's position is solved in world axes, in which its acceleration is penalized.
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
        self._slow = float(np.sqrt(max(_spread((residuals - bias)[seen]) ** 2 - noise**2, 0.0)))
        # Residuals show flesh only in the coordinates that poses cannot follow.
        self._flesh = self._slow / float(np.sqrt(self._freedom))
        lifts = (bias * self._hand.normals).sum(axis=1)
        slips = np.sqrt(np.maximum((bias**2).sum(axis=1) - lifts**2, 0.0) / 2.0)
        for part in (self._hand.digits < 0, self._hand.digits >= 0):
            shown = part & seen.any(axis=0)
            self._places[part] = [_FROM_BIAS * _spread(of[shown]) for of in (slips, lifts)]


def _spread(values: NDArray[np.float64]) -> float:
    """Standard deviation of values around zero [m], without outliers."""
    near = values[np.abs(values) < _OUTLIER]
    return float(np.sqrt(np.mean(near**2))) if len(near) else 0.0


@kernel
def _frame_equations(
    hand: HandArrays,
    targets: Float[np.ndarray, "T M 3"],
    qpos: Float[np.ndarray, "T 27"],
    precision: float,
    robust_scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
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
    # Pairs of frames form the blocks of a block tridiagonal system: eliminate forward, then substitute.
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
