"""The filter state of one hand: pose, velocity, covariances, and the learned bias of each marker.

Where the model differs from the user's hand, each marker is off by the same few millimeters in every frame,
in the frame of its bone. Once this bias is known, a marker is predicted from the pose and the bias: nearly as
accurately for an uncalibrated hand as for a calibrated one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.fit import GloveFit
from handsim.arrays import Doubles
from handsim.hand.shape import DIGITS, NUM_JOINTS
from handsim.kernels import kernel, move, velocity_of
from track.association.digit_hypotheses import DigitModel, digit_ranges
from track.association.frame_state import peak_log_odds
from track.config import HandOrigin, TrackerConfig
from track.frames import Spreads
from track.kinematics.pose_solver import FEWEST_MARKERS, FramePriors, PoseSolver, priors_of_frame
from track.kinematics.pose_spread import (
    HandErrors,
    JointPrior,
    MarkerPrediction,
    SpreadModel,
    predict_joints,
    predict_markers,
    resting_prior,
)

# Process model.
_LONGEST_EXTRAPOLATION: Final = 0.05  # [s] longest extrapolated motion; then the hand stands still
_VELOCITY_SMOOTHING: Final = 0.6  # weight of the newest velocity in the smoothed one
_HIDDEN_DIGIT_DAMPING: Final = 0.7  # factor per frame of the velocity of a digit with missing markers
_WRIST_SPREAD: Final = 0.001  # [m] standard deviation of the wrist's predicted position in the same frame
_WRIST_ACCELERATION: Final = 10.0  # [m/s^2] process noise
_WRIST_ROTATION_SPREAD: Final = float(np.deg2rad(1.5))  # [rad] as `_WRIST_SPREAD`, of rotation
_WRIST_ANGULAR_ACCELERATION: Final = 100.0  # [rad/s^2] process noise
# Measurement model: standard deviations and biases of markers.
_INITIAL_SPREAD: Final = 1.2  # initial standard deviation of markers over the RMS of the first fit
_INITIAL_SPREAD_LEAST, _INITIAL_SPREAD_MOST = 0.0015, 0.006  # [m] bounds of it
_LEAST_MARKER_SPREAD: Final = 0.0005  # [m] lower bound of a marker's noise, as few cameras may see it
_BIAS_VARIATION: Final = 0.3  # variation of a bias with the pose, as share of the hand's typical bias
_BIAS_DOUBT_TIME: Final = 0.5  # [s] unseen, after which a marker's bias is unknown again
_LEFT_OUT_SPREAD: Final = 0.004  # [m] doubt of a marker that the first fit left out, as it may have slipped
_LEFT_OUT_GROWTH: Final = 0.2  # [s] This doubt grows to its full size in this time; wrong starts end earlier.
_AVERAGING_FRAMES: Final = 120.0  # averaging window of a bias; one second at 120 Hz
_FORGETTING_FRAMES: Final = 2400.0  # time constant in which an unconfirmed bias decays
_DECAY_PER_FRAME: Final = 1.7e-7  # [m] additional decay of a bias per frame: 0.02 mm in a second at 120 Hz
_LEARNING_FRAMES: Final = 30.0  # number of frames after which the spread of a hand's markers is known
_BIAS_REUSE_RMS: Final = 0.002  # [m] A hand initialized again with a smaller RMS keeps its biases.
_FEWEST_ON_DIGIT, _FEWEST_ON_PALM = 2, 3  # markers needed for a variance estimate
_BIAS_SLACK: Final = 2.5  # standard deviations allowed between a marker and its design
# Reappearance of markers, and lifetime of strays.
_RETURN_SCALE: Final = 0.01  # [s] over the hidden time: probability that a marker returns in a frame
_RETURN_LEAST, _RETURN_MOST = 0.01, 0.65  # bounds of the probability that a marker returns in a frame
SEEN_ELSEWHERE: Final = -7.0
"""Log probability that a point is a marker that was seen as another point at the same time."""
# A point that stays unlabeled while a marker is seen elsewhere is probably not that marker: it loses one
# log-odds per `_BESIDE_TIME` [s], at most `_MOST_BESIDE`, which outweighs the labeler. The loss fades while
# the marker is hidden.
_BESIDE_TIME, _MOST_BESIDE = 0.01, 18.0
STRAY_LIFETIME: Final = 0.1  # [s] mean lifetime of strays
MOST_AGE_LOG_ODDS: Final = 3.0  # largest log-odds from a point's age


class Prediction(NamedTuple):
    """A hand's pose before the markers of a frame are used."""

    qpos: Float[np.ndarray, "27"]  # the predicted pose
    positions: Float[np.ndarray, "M 3"]  # its markers in the world [m]
    joint_prior: JointPrior  # prior of the joint angles
    wrist_spread: tuple[float, float]  # standard deviations of the wrist's position [m] and orientation [rad]
    priors: FramePriors  # the same as priors of the solver


class HandEstimate(NamedTuple):
    """A hand's pose fitted to the markers of a frame."""

    qpos: Float[np.ndarray, "27"]  # the fitted pose
    rms: float  # RMS distance of the present markers [m]
    residuals: Float[np.ndarray, "M 3"]  # model minus marker [m], NaN where a marker is missing
    predicted: MarkerPrediction  # markers and joint angles of that pose, with covariances

    @property
    def positions(self) -> Float[np.ndarray, "M 3"]:
        """Positions of the fitted pose's markers in the world [m]."""
        return self.predicted.positions


class Biases(NamedTuple):
    """Learned biases of a hand's markers."""

    bias: Float[np.ndarray, "M 3"]  # in the frames of the bones [m]
    frames: Float[np.ndarray, "M"]  # number of frames in each average
    learned_variance: Float[np.ndarray, "M"]  # variance of each marker with a certain bias [m^2]
    variance: Float[np.ndarray, "M"]  # variance of each marker at the last prediction [m^2]


class HandState:
    """Filter state of one of the user's hands, calibrated or not."""

    def __init__(
        self,
        hand: GloveFit,
        config: TrackerConfig = TrackerConfig(),  # noqa: B008 (frozen)
        *,
        origin: HandOrigin = "calibrated",
        errors: HandErrors | None = None,
    ) -> None:
        self.hand = hand
        self.config = config
        self.solver = PoseSolver(hand)
        """Solver of its poses, whose markers are shifted by their biases."""
        self.qpos: Doubles | None = None
        """Pose of the last frame with one; None if the hand is lost."""
        self.time = 0.0
        """Time of that pose [s]."""
        self.rms = np.nan
        """RMS distance of that pose's markers, biases removed [m]."""
        count = self.num_markers = hand.attachment.layout.num_markers
        self.digits = hand.attachment.digits
        """Digit of each marker (M,), -1 for the palm."""
        self.variance = np.full(count, _INITIAL_SPREAD_MOST**2)
        """Variance (M,) of each marker around its position on the hand [m^2], at the last prediction."""
        self.positions = np.full((count, 3), np.nan)
        """Positions (M, 3) of the pose's markers [m]."""
        self.confirmed = np.zeros(len(DIGITS), dtype=bool)
        """Digits with a settled label since the hand was initialized."""
        self.velocity = np.zeros(6 + NUM_JOINTS)
        """Velocity in MuJoCo's order, smoothed [m/s, rad/s]."""
        self._joint_covariance = resting_prior().covariance  # [rad^2] of the last estimate
        self._bias = np.zeros((count, 3))  # [m] in the frames of the bones
        self._bias_frames = np.zeros(count)  # number of frames in each average
        self._learned_variance = self.variance.copy()  # [m^2] with certain biases
        self._typical_bias = 0.0  # [m] RMS over the markers
        self._last_seen = np.full(count, -np.inf)  # [s] of each marker since the hand was initialized
        self._started = 0.0  # [s] when the hand was initialized
        self._left_out = np.zeros(count, dtype=bool)  # markers without a point in the first fit
        self._spread_model = SpreadModel(hand, origin, errors)
        self._usual_square = np.nan  # [m^2] mean squared RMS distance, biases included
        self._designed = self.solver.hand.positions[:, 0].copy()  # [m] without biases
        self._ranges = digit_ranges(hand)
        self._now = 0.0  # [s] of the last prediction

    def predict(self, time: float) -> Prediction:
        """Predict the pose at a time [s] with constant velocity, for a hand that has a pose."""
        assert self.qpos is not None
        self._now = time
        span = time - self.time
        doubt = self._typical_bias * np.minimum((time - self._last_seen) / _BIAS_DOUBT_TIME, 1.0)
        # The RMS does not bound the error of a marker that the first fit left out, which may have slipped.
        slip = _LEFT_OUT_SPREAD * min((time - self._started) / _LEFT_OUT_GROWTH, 1.0)
        doubt[self._left_out & (self._bias_frames == 0.0)] = max(self._typical_bias, slip)
        self.variance = self._learned_variance + doubt**2
        moved: Doubles = move(self.qpos[None], min(span, _LONGEST_EXTRAPOLATION) * self.velocity[None])[0]
        position = _WRIST_SPREAD + 0.5 * _WRIST_ACCELERATION * span**2
        rotation = _WRIST_ROTATION_SPREAD + 0.5 * _WRIST_ANGULAR_ACCELERATION * span**2
        joints = predict_joints(moved[7:], self._joint_covariance, span)
        return self._prediction(moved, joints, (position, rotation))

    def _prediction(self, qpos: Doubles, prior: JointPrior, wrist_spread: tuple[float, float]) -> Prediction:
        """Make a prediction from a pose with these uncertainties."""
        priors = priors_of_frame(prior.angles, prior.spread, qpos[:7], wrist_spread)
        return Prediction(qpos, self.solver.marker_positions(qpos), prior, wrist_spread, priors)

    def fit(
        self, targets: Float[np.ndarray, "M 3"], start: Float[np.ndarray, "27"], prediction: Prediction
    ) -> HandEstimate:
        """Fit the pose to at least four labeled markers; with fewer it stays the prediction."""
        if np.count_nonzero(np.isfinite(targets[:, 0])) >= FEWEST_MARKERS:
            fit = self.solver.solve_frame(targets, start, prediction.priors)
            qpos, rms, residuals = fit.qpos[0], float(fit.rms[0]), fit.residuals[0]
        else:
            qpos, rms, residuals = prediction.qpos, np.nan, np.full_like(targets, np.nan)
        hand, on_part, noise = self.solver.hand, self.solver.on_part, self.config.marker_noise
        prior = prediction.joint_prior, prediction.wrist_spread
        predicted = predict_markers(hand, on_part, qpos, targets, *prior, self.variance, noise)
        return HandEstimate(predicted.qpos, rms, residuals, predicted)

    def digit_models(self, prediction: Prediction, estimate: HandEstimate) -> tuple[DigitModel, DigitModel]:
        """Models for new points of a digit: one for digits with settled labels, one for others."""
        # The second uses the resting prior, so that a pose bent by a wrong label cannot confirm it.
        slack = _BIAS_SLACK * np.sqrt(self.variance) + np.sqrt((self._bias**2).sum(axis=1))
        peaks = peak_log_odds(self.variance, self.config.stray_density)
        markers = self.variance, peaks, slack, self._ranges
        confirmed = DigitModel(prediction.joint_prior, estimate.predicted, *markers)
        return confirmed, confirmed._replace(joint_prior=resting_prior())

    def pose_spread(self, time: float) -> Callable[[], Spreads]:
        """A function that computes the standard deviations of this pose at a time [s], valid later, too."""
        assert self.qpos is not None
        unseen = np.maximum(time - self._last_seen, 0.0)
        return partial(self._spread_model.of_pose, self.qpos.copy(), unseen, np.sqrt(self._usual_square))

    @property
    def spread(self) -> float | None:
        """Standard deviation of the markers in each direction [m]; None if not yet known."""
        if np.median(self._bias_frames) < _LEARNING_FRAMES:
            return None
        return max(float(np.sqrt(np.median(self._learned_variance))), self.config.marker_noise)

    def presence_log_odds(
        self,
        first_seen: Float[np.ndarray, "P"],
        free_since: Float[np.ndarray, "P"],
        markers: Int[np.ndarray, "P"],
    ) -> Float[np.ndarray, "P M"]:
        """Log-odds that a point is a marker, which returned when the point appeared, and not a stray.

        A point that had no label while the marker was seen is probably foreign. This counts only for markers
        that currently have no point.
        """
        return np.asarray(_presence_log_odds(first_seen, free_since, markers, self._last_seen, self._now))

    def initialize(
        self, qpos: Float[np.ndarray, "27"], targets: Float[np.ndarray, "M 3"], time: float
    ) -> HandEstimate:
        """Start from a pose without history; biases are kept if they still fit."""
        self.velocity[:] = 0.0
        self._last_seen[:] = -np.inf  # A marker may be any of the present points.
        self.confirmed[:] = False
        unknown = self._prediction(qpos, resting_prior(), (1.0, 1.0))
        estimate = self.fit(targets, qpos, unknown)
        if not (self._bias_frames.any() and estimate.rms < _BIAS_REUSE_RMS):
            self._bias[:], self._bias_frames[:], self._learned_variance[:] = 0.0, 0.0, 0.0
            self._apply_biases()
            estimate = self.fit(targets, qpos, unknown)
            spread = _INITIAL_SPREAD * estimate.rms
            self._learned_variance[:] = np.clip(spread, _INITIAL_SPREAD_LEAST, _INITIAL_SPREAD_MOST) ** 2
            self._left_out = np.isnan(targets[:, 0])
        self._started = time
        self._store(estimate, time)
        return estimate

    def unbiased_positions(self, estimate: HandEstimate) -> Float[np.ndarray, "M 3"]:
        """Positions of a pose's markers in the world without any bias [m]."""
        offsets: Doubles = np.einsum("mij,mj->mi", estimate.predicted.rotations, self._bias)
        return estimate.positions + offsets

    @property
    def biases(self) -> Biases:
        """A copy of the learned biases, for `recall`."""
        known = (self._bias, self._bias_frames, self._learned_variance, self.variance)
        return Biases(*(values.copy() for values in known))

    def forget(self, markers: Int[np.ndarray, "K"]) -> None:
        """Reset the biases of some markers, with the initial uncertainty."""
        self._bias[markers], self._bias_frames[markers] = 0.0, 0.0
        self._learned_variance[markers] = self.variance[markers] = _INITIAL_SPREAD_MOST**2
        self._apply_biases()

    def recall(self, biases: Biases) -> None:
        """Restore biases that were copied before."""
        self._bias[:], self._bias_frames[:], self._learned_variance[:], self.variance[:] = biases
        self._apply_biases()

    def resize(self, hand: GloveFit, origin: HandOrigin, errors: HandErrors | None, keep: float) -> None:
        """Continue with the same hand of another size, and a share of the biases."""
        self.hand, self.solver, self._spread_model = hand, PoseSolver(hand), SpreadModel(hand, origin, errors)
        self.digits = hand.attachment.digits
        self._designed = self.solver.hand.positions[:, 0].copy()
        if not keep:
            self._ranges = digit_ranges(hand)
        self._bias *= keep
        self._bias_frames[:] = self._bias_frames if keep else 0.0
        np.maximum(self._learned_variance, _INITIAL_SPREAD_LEAST**2, out=self._learned_variance)
        self._apply_biases()

    def rms_from_design(self, estimate: HandEstimate) -> float:
        """RMS distance of the markers from the hand's own marker positions, biases included [m]."""
        return float(_rms_from_design(estimate.residuals, estimate.predicted.rotations, self._bias))

    def update(self, estimate: HandEstimate, settled: Bool[np.ndarray, "M"], time: float) -> None:
        """Accept the pose of the next frame, and learn biases of markers with settled labels."""
        assert self.qpos is not None
        qpos, span = estimate.qpos, time - self.time
        if span > 0.0:
            change = velocity_of(self.qpos, qpos, span) - self.velocity
            self.velocity += _VELOCITY_SMOOTHING * change
        self._store(estimate, time)
        rotations, learned = (
            estimate.predicted.rotations,
            (self._bias_frames, self._bias, self._learned_variance),
        )
        _learn_bias(estimate.residuals, rotations, settled, self.digits, self.confirmed, *learned)
        self._apply_biases()

    def _store(self, estimate: HandEstimate, time: float) -> None:
        """Store an estimate as the state at a time [s]."""
        self.qpos, self.time, self.positions = estimate.qpos, time, estimate.positions
        self.rms = estimate.rms
        self._joint_covariance = estimate.predicted.joint_covariance
        _note_markers(estimate.residuals, self.digits, time, self._last_seen, self.velocity)
        square = self.rms_from_design(estimate) ** 2
        if np.isnan(self._usual_square):
            self._usual_square = square
        elif np.isfinite(square):
            self._usual_square += (square - self._usual_square) / _AVERAGING_FRAMES

    def _apply_biases(self) -> None:
        """Shift the hand's markers by their learned biases, and update the typical bias and the variances."""
        state = self._bias_frames, self._left_out, self._bias, self._designed, self._learned_variance
        self._typical_bias = _apply_biases(*state, self.solver.hand.positions)


class HandTrack(NamedTuple):
    """A hand with a pose in the current frame."""

    hand: int  # index of the hand
    state: HandState  # its filter state
    prediction: Prediction  # pose before the frame's markers were used
    estimate: HandEstimate  # pose fitted to its labels so far


@kernel
def _presence_log_odds(
    first_seen: Float[np.ndarray, "P"],
    free_since: Float[np.ndarray, "P"],
    markers: Int[np.ndarray, "P"],
    last_seen: Float[np.ndarray, "M"],
    now: float,
) -> Float[np.ndarray, "P M"]:
    """Kernel of `HandState.presence_log_odds` at a time [s]; `last_seen` is the time of each marker [s]."""
    log_odds = np.empty((len(first_seen), len(last_seen)))
    missing = np.ones(len(last_seen), dtype=np.bool_)
    for marker in markers:
        if marker >= 0:
            missing[marker] = False
    for point in range(len(first_seen)):
        age = min(max(now - first_seen[point], 0.0) / STRAY_LIFETIME, MOST_AGE_LOG_ODDS)
        for marker in range(len(last_seen)):
            gap, beside = first_seen[point] - last_seen[marker], 0.0
            share = min(max(_RETURN_SCALE / max(gap, 1e-3), _RETURN_LEAST), _RETURN_MOST)
            if missing[marker] and last_seen[marker] > free_since[point]:
                beside = min((last_seen[marker] - free_since[point]) / _BESIDE_TIME, _MOST_BESIDE)
                beside -= (now - last_seen[marker]) / STRAY_LIFETIME
            log_odds[point, marker] = SEEN_ELSEWHERE if gap < 0.0 else np.log(share)
            log_odds[point, marker] += age - max(beside, 0.0)
    return log_odds


@kernel
def _note_markers(
    residuals: Float[np.ndarray, "M 3"],
    digits: Int[np.ndarray, "M"],
    time: float,
    last_seen: Float[np.ndarray, "M"],
    velocity: Float[np.ndarray, "26"],
) -> None:
    """Store the time [s] of the seen markers, and slow down the joints of digits that lack one."""
    lacks = np.zeros(len(DIGITS) + 1, dtype=np.bool_)
    for marker in range(len(residuals)):
        if np.isfinite(residuals[marker, 0]):
            last_seen[marker] = time
        else:
            lacks[digits[marker]] = True
    for hinge in range(NUM_JOINTS):
        velocity[6 + hinge] *= _HIDDEN_DIGIT_DAMPING if lacks[hinge // 4] else 1.0


@kernel
def _learn_bias(
    residuals: Float[np.ndarray, "M 3"],
    rotations: Float[np.ndarray, "M 3 3"],
    settled: Bool[np.ndarray, "M"],
    digits: Int[np.ndarray, "M"],
    confirmed: Bool[np.ndarray, "5"],
    bias_frames: Float[np.ndarray, "M"],
    bias: Float[np.ndarray, "M 3"],
    variance: Float[np.ndarray, "M"],
) -> None:
    """Update biases and variances [m, m^2] of settled markers with their residuals, in the bones' frames."""
    # A pose fits any marker that is alone on its part: such a marker's variance does not change.
    on_part = np.zeros(len(DIGITS) + 1, dtype=np.int64)
    for marker in range(len(residuals)):
        on_part[digits[marker]] += np.isfinite(residuals[marker, 0])
        if settled[marker] and digits[marker] >= 0:
            confirmed[digits[marker]] = True
    residual = np.empty(3)
    for marker in range(len(residuals)):
        if not settled[marker] or np.isnan(residuals[marker, 0]):
            continue
        bias_frames[marker] = min(bias_frames[marker] + 1.0, _AVERAGING_FRAMES)
        # The pose also absorbs what all biases have in common; only the decay corrects that.
        length = np.sqrt(bias[marker, 0] ** 2 + bias[marker, 1] ** 2 + bias[marker, 2] ** 2)
        kept = max(1.0 - 1.0 / _FORGETTING_FRAMES - _DECAY_PER_FRAME / length, 0.0)
        square = 0.0
        for i in range(3):
            residual[i] = 0.0
            for j in range(3):
                residual[i] += rotations[marker, j, i] * residuals[marker, j]
            bias[marker, i] = kept * bias[marker, i] + residual[i] / bias_frames[marker]
            square += residual[i] ** 2
        if on_part[digits[marker]] >= (_FEWEST_ON_DIGIT if digits[marker] >= 0 else _FEWEST_ON_PALM):
            variance[marker] += (square - variance[marker]) / bias_frames[marker]


@kernel
def _apply_biases(
    bias_frames: Float[np.ndarray, "M"],
    left_out: Bool[np.ndarray, "M"],
    bias: Float[np.ndarray, "M 3"],
    designed: Float[np.ndarray, "M 3"],
    variance: Float[np.ndarray, "M"],
    positions: Float[np.ndarray, "M 4 3"],
) -> float:
    """Shift markers by their biases, raise low variances, and return the typical bias [m], an RMS."""
    square, count = 0.0, 0
    for marker in range(len(bias_frames)):
        is_known = bias_frames[marker] > 0.0 and not left_out[marker]  # Slips are not typical.
        for i in range(3):
            positions[marker, 0, i] = designed[marker, i] - bias[marker, i]
            square += bias[marker, i] ** 2 if is_known else 0.0
        count += is_known
    square /= max(count, 1)
    for marker in range(len(bias_frames)):
        variance[marker] = max(variance[marker], _LEAST_MARKER_SPREAD**2 + _BIAS_VARIATION**2 * square)
    return np.sqrt(square)  # type: ignore[no-any-return]


@kernel
def _rms_from_design(
    residuals: Float[np.ndarray, "M 3"], rotations: Float[np.ndarray, "M 3 3"], bias: Float[np.ndarray, "M 3"]
) -> float:
    """RMS of the residuals with the biases added back [m]; for the arguments see `_learn_bias`."""
    square, count = 0.0, 0
    for marker in range(len(residuals)):
        if np.isnan(residuals[marker, 0]):
            continue
        count += 1
        for i in range(3):
            residual = residuals[marker, i]
            for j in range(3):
                residual += rotations[marker, i, j] * bias[marker, j]
            square += residual * residual
    return np.sqrt(square / count)  # type: ignore[no-any-return]
