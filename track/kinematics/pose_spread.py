"""Uncertainty of poses: covariances of joint angles, predicted markers and keypoints.

- Before its markers are used, a hand has a prior: a joint normal distribution of all 20 joint angles. They
  follow an Ornstein-Uhlenbeck process whose stationary distribution is that of people's gestures: an unseen
  joint returns to it, in mean and covariance. Neighboring fingers bend together, so the covariance carries
  information from visible digits to hidden ones.
- The neighbors of a missing marker may determine its position well, or leave it free along the arc of one
  joint. Its covariance follows from the normal matrix of the fit and the prior of the joint angles.
- Standard deviations of joint angles and keypoints come from a linear normal model around the pose. Each
  marker is seen with noise, and tells less the longer it is hidden. The hand model differs from the user's
  hand in the same way in every frame, so that averaging does not help: in its size, marker places, origins
  and directions of digits, and bone lengths. Flesh moves markers slowly, so that averaging over successive
  frames does not help, either.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.shape import ADULTS, DIGITS, NUM_JOINTS, NUM_KEYPOINTS, PALM
from handsim.kernels import kernel, write_quaternion_matrix
from poses.shapes import LIBRARIES, gestures_of
from track.config import HandOrigin
from track.kinematics.marker_kinematics import (
    MARKER_NOISE,
    NUM_UNKNOWNS,
    HandArrays,
    Workspace,
    accumulate_normal_equations,
    compute_markers,
    eliminate,
    hand_arrays,
    invert_positive,
    marker_residuals,
    solve_positive,
    workspace,
)
from track.kinematics.pose_solver import FEWEST_ON_PART

# Short, so that a digit with one marker recovers from a wrong, unusual pose.
_JOINT_MEMORY: Final = 0.3  # [s] time constant of the process of joint angles
_JOINT_SPREAD: Final = float(np.deg2rad(0.5))  # [rad] least standard deviation of a predicted angle
_GESTURE_MARGIN: Final = float(np.deg2rad(6.0))  # [rad] added to that of the gestures, for other poses
_ARC: Final = 0.04  # [m] usual radius of the arcs of markers: the length of a finger's bones
_LEAST_INFORMATION: Final = 1e-9  # share of a marker's precision, added for an inverse
_DRIFT: Final = 0.014  # [m/sqrt(s)] random walk of a hidden marker
_ANYWHERE: Final = 0.01  # [1/m^2, 1/rad^2] prior precision of the wrist
_LEAST_NOISE: Final = 0.0001  # [m] lower bound of a marker's noise
_NOISE_STEP: Final = 1e-5  # [m] rounding of the noise
# Standard deviations of a calibrated hand, chosen as `_MEASURED` is; they grow with the markers' noise.
_FEW: Final = 1.4  # uncertainty factor of a digit with fewer than three markers
_CALIBRATED_SIZE: Final = 3.0  # [1/m] of relative size, times the noise
_CALIBRATED_PLACE: Final = 0.15  # of marker places, times the noise
_CALIBRATED_PALM: Final = 0.45  # of the palm's marker places, times the noise
_CALIBRATED_KNUCKLE: Final = 0.15  # of knuckles, times the noise
_CALIBRATED_TURNS: Final = (0.5, 0.8, 1.5)  # [deg] directions; abduction hardly shows a digit's
_CALIBRATED_THUMB: Final = 1.6  # factor of the thumb's directions over the fingers'
_CALIBRATED_BONES: Final = (3.5, 3.0)  # [1/m] of log lengths, times the noise
_CALIBRATED_WRIST: Final = 0.0007  # [m] wrist in the palm
_CALIBRATED_JOINTS: Final = (0.00016, 0.00045)  # [m] joints, tips
_SINGLE: Final = (7.0, 3.0)  # factors of these for a digit with one marker
_LEAST_FREEDOM: Final = 3  # least number of marker coordinates beyond those that a pose needs
SOURCES: Final = ("noise and gaps", "gluing", "flesh", "person")
"""Sources of an angle's uncertainty: noisy or unseen markers, their glued places, their motion over the
bones, and what stays of a person: sizes and directions of bones, gestures unlike other people's."""
CHANGING: Final = 1.0, 0.5, 1.2, 0.32
"""Factors by which these parts of an uncalibrated hand's error change between sessions of a person. The rest
comes from its wrong shape, which stays, and from people's usual gestures, towards which a hand is drawn
nearly alike. Flesh counts more than once, as residuals do not show all of it. Found for two sessions of each
of 107, 67 and 40 simulated people in dense19, sparse13 and starter10 (benchmarks/sessions.py)."""
DETECTABLE: Final = 1.96 * float(np.sqrt(2.0))
"""Ratio of the minimal detectable difference of two sessions to the standard error of measurement."""
_OWN: Final = 10  # unknown numbers of a digit: knuckle, direction, bones (3 each), all its bones
_NUMBERS: Final = 5 * _OWN + 1  # unknown numbers of a hand: those of its digits, and its size
NOT_SMOOTHED: Final = np.empty((0, NUM_UNKNOWNS, NUM_UNKNOWNS))
"""No covariances: the poses were fitted frame by frame."""
# Unknowns by which a digit's keypoints respond to each number: its own joint angles, and the wrist.
_OWN_UNKNOWNS: Final = np.ones((NUM_UNKNOWNS, _NUMBERS))
_OWN_UNKNOWNS[:NUM_JOINTS, :-1] = np.kron(np.eye(5), np.ones((4, _OWN)))


class JointPrior(NamedTuple):
    """Normal distribution of the joint angles."""

    angles: Float[np.ndarray, "20"]  # mean [rad]
    covariance: Float[np.ndarray, "20 20"]  # covariance [rad^2]
    precision: Float[np.ndarray, "20 20"]  # inverse of the covariance [1/rad^2]

    @property
    def spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each joint angle [rad]."""
        return np.sqrt(np.diag(self.covariance))


class MarkerPrediction(NamedTuple):
    """Markers and joint angles of a fitted pose, with covariances."""

    qpos: Float[np.ndarray, "27"]  # the pose; digits with missing markers at the optimum of markers and prior
    positions: Float[np.ndarray, "M 3"]  # markers in the world [m]
    covariances: Float[np.ndarray, "M 3 3"]  # of each marker in the world [m^2]: from the pose, and its own
    rotations: Float[np.ndarray, "M 3 3"]  # rotation in the world of each marker's main bone
    joint_covariance: Float[np.ndarray, "20 20"]  # covariance of the joint angles [rad^2]
    information_matrix: Float[np.ndarray, "20 20"]  # of the markers alone on angles, palm fixed [1/rad^2]
    information_vector: Float[np.ndarray, "20"]  # the matrix times the angles by the markers alone [1/rad]


class HandDoubt(NamedTuple):
    """Standard deviations of the difference between a hand model and its user's hand."""

    noise: float  # marker around its place, independent in each frame [m]
    size: float  # log size of the whole hand
    places: Float[np.ndarray, "M 2"]  # of each marker on its bone: along the skin (each way), off it [m]
    knuckles: Float[np.ndarray, "5"]  # origin of each digit on the palm, in each direction [m]
    directions: Float[np.ndarray, "5 3"]  # direction of each digit, about the axes of the palm [rad]
    bones: Float[np.ndarray, "5 2"]  # log lengths of each bone of a digit, and of all of them together
    wrist: float  # place of the wrist in the palm, which no marker shows, in each direction [m]
    joints: Float[np.ndarray, "5 2"]  # joints and tip of a digit, beyond what markers show, each way [m]
    flesh: float = 0.0  # marker around its place, alike in successive frames [m]


class _Proportions(NamedTuple):
    """Standard deviations of the difference between an uncalibrated hand model and its user's hand."""

    size: float  # log size
    place: tuple[float, float]  # marker place along the skin, off it [m]
    knuckle: float  # knuckle position [m]
    turn: float  # direction of a finger [deg]
    thumb: float  # factor for the thumb's direction
    bones: tuple[float, float]  # log lengths: each bone, all of a digit


# Chosen on simulated people that benchmarks.doubt does not use. Smaller than differences between people, as
# the fit of proportions makes up for part of them.
_MEASURED: Final = _Proportions(0.001, (0.0014, 0.0005), 0.0003, 1.8, 4.0, (0.01, 0.02))
# Nearest of five sizes: differences between people, and half a step between sizes. Marker places include
# slips, and shifts by wrong girths and bone lengths.
_NAMED: Final = _Proportions(
    0.02,
    (0.003, 0.003),
    ADULTS.knuckle_spread,
    ADULTS.angle_spread,
    3.0,
    (ADULTS.bone_spread, ADULTS.digit_spread),
)


@cache
def resting_prior() -> JointPrior:
    """Prior of a hand without any history: mean and covariance over all gestures."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    covariance = np.cov(gestures.T) + _GESTURE_MARGIN**2 * np.eye(NUM_JOINTS)
    return JointPrior(gestures.mean(axis=0), covariance, np.linalg.inv(covariance))


def predict_joints(
    angles: Float[np.ndarray, "20"], covariance: Float[np.ndarray, "20 20"], span: float
) -> JointPrior:
    """Prior of the joint angles `span` seconds after an estimate, around predicted angles [rad]."""
    kept = float(np.exp(-max(span, 0.0) / _JOINT_MEMORY))
    return _relax(angles, covariance, resting_prior(), kept)


@kernel
def _relax(
    angles: Float[np.ndarray, "20"], covariance: Float[np.ndarray, "20 20"], resting: JointPrior, kept: float
) -> JointPrior:
    """Mix joint angles with the resting prior, keeping the share `kept` of their deviation from it."""
    count, share = len(angles), kept**2
    mean, spread, precision = np.empty(count), np.empty((count, count)), np.empty((count, count))
    for row in range(count):
        mean[row] = angles[row] + (1.0 - kept) * (resting.angles[row] - angles[row])
        for column in range(count):
            spread[row, column] = share * covariance[row, column]
            spread[row, column] += (1.0 - share) * resting.covariance[row, column]
        spread[row, row] += _JOINT_SPREAD**2
        precision[row] = spread[row]
    invert_positive(precision)
    return JointPrior(mean, spread, precision)


@kernel
def digit_prior(
    prior: JointPrior,
    seen: MarkerPrediction,
    digit: int,
    angles: Float[np.ndarray, "4"],
    precision: Float[np.ndarray, "4 4"],
) -> None:
    """Write mean and precision of one digit's joint angles, given the information of the other digits."""
    count = len(prior.angles)
    order, system, right_side = np.empty(count, dtype=np.int64), np.empty((count, count)), np.zeros(count)
    index = 0
    for hinge in range(count):  # The digit's own joints come last, so that the others are eliminated.
        own = hinge // 4 == digit
        order[count - 4 + hinge % 4 if own else index] = hinge
        index += not own
    for row in range(count):
        one = order[row]
        for column in range(count):
            system[row, column] = prior.precision[one, order[column]]
        if row < count - 4:
            right_side[row] = seen.information_vector[one]
            for column in range(count):
                right_side[row] -= seen.information_matrix[one, order[column]] * prior.angles[order[column]]
            for column in range(count - 4):
                system[row, column] += seen.information_matrix[one, order[column]]
    eliminate(system, right_side, 0, count - 4)
    precision[:] = system[count - 4 :, count - 4 :]
    solve_positive(system[count - 4 :, count - 4 :], right_side[count - 4 :])
    for row in range(4):
        angles[row] = prior.angles[4 * digit + row] + right_side[count - 4 + row]


@kernel
def predict_markers(
    hand: HandArrays,
    on_part: Int[np.ndarray, "6"],
    pose: Float[np.ndarray, "27"],
    target: Float[np.ndarray, "M 3"],
    joint_prior: JointPrior,
    wrist_spread: tuple[float, float],
    variance: Float[np.ndarray, "M"],
    noise: float,
) -> MarkerPrediction:
    """Positions and covariances of a fitted pose's markers."""
    count = len(target)
    work, wrist, weights = workspace(count), np.empty((3, 3)), np.zeros(count)
    out = MarkerPrediction(
        pose.copy(),
        np.empty((count, 3)),
        np.empty((count, 3, 3)),
        np.empty((count, 3, 3)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty((NUM_JOINTS, NUM_JOINTS)),
        np.empty(NUM_JOINTS),
    )
    write_quaternion_matrix(wrist, pose[3], pose[4], pose[5], pose[6])
    marker_residuals(hand, target, pose, work)
    seen = np.zeros(len(on_part), dtype=np.int64)
    for marker in range(count):
        if not np.isnan(work.residuals[marker, 0]):
            weights[marker] = 1.0 / noise**2
            seen[hand.digits[marker]] += 1
    accumulate_normal_equations(hand, weights, work)
    if _complete_digits(hand, seen, on_part, joint_prior, work, out.qpos):
        marker_residuals(hand, target, out.qpos, work)
        accumulate_normal_equations(hand, weights, work)
    posterior = work.factor
    for row in range(NUM_UNKNOWNS):
        for column in range(row + 1):
            posterior[row, column] = work.normal[column, row]
        posterior[row, row] += _LEAST_INFORMATION / noise**2
        if row >= NUM_JOINTS:
            posterior[row, row] += wrist_spread[(row - NUM_JOINTS) // 3] ** -2.0
    for row in range(NUM_JOINTS):
        out.information_vector[row] = -work.gradient[row]
        for column in range(NUM_JOINTS):
            out.information_matrix[row, column] = posterior[max(row, column), min(row, column)]
            out.information_vector[row] += out.information_matrix[row, column] * out.qpos[7 + column]
    posterior[:NUM_JOINTS, :NUM_JOINTS] += joint_prior.precision
    invert_positive(posterior)
    out.joint_covariance[:] = posterior[:NUM_JOINTS, :NUM_JOINTS]
    for marker in range(count):
        _marker_covariance(hand, marker, posterior, wrist, variance[marker], work, out.covariances[marker])
        bone = work.rotations[hand.bones[marker, 0]]
        for i in range(3):
            out.positions[marker, i] = pose[i]
            for j in range(3):
                out.positions[marker, i] += wrist[i, j] * work.markers[marker, j]
                out.rotations[marker, i, j] = 0.0
                for k in range(3):
                    out.rotations[marker, i, j] += wrist[i, k] * bone[k, j]
    return out


@kernel
def _marker_covariance(
    hand: HandArrays,
    marker: int,
    posterior: Float[np.ndarray, "26 26"],
    wrist: Float[np.ndarray, "3 3"],
    variance: float,
    work: Workspace,
    covariance: Float[np.ndarray, "3 3"],
) -> None:
    """Write the covariance of a marker in the world [m^2], from that of the unknowns and its own variance."""
    first, last = hand.hinge_span[marker, 0], hand.hinge_span[marker, 1]
    count = last - first + 6
    jacobian, in_world = work.jacobian[marker], np.zeros((3, count))
    unknowns = np.empty(count, dtype=np.int64)
    for number in range(count):
        unknowns[number] = first + number if number < last - first else NUM_JOINTS + number - (last - first)
        for i in range(3):
            for j in range(3):
                in_world[i, number] += wrist[i, j] * jacobian[j, unknowns[number]]
    covariance[:] = 0.0
    for one in range(count):
        x, y, z = 0.0, 0.0, 0.0
        for other in range(count):
            share = posterior[unknowns[one], unknowns[other]]
            x += share * in_world[0, other]
            y += share * in_world[1, other]
            z += share * in_world[2, other]
        for i in range(3):
            covariance[i, 0] += in_world[i, one] * x
            covariance[i, 1] += in_world[i, one] * y
            covariance[i, 2] += in_world[i, one] * z
    # A marker moves on an arc, not on its tangent: motion along the tangent implies a deviation across
    # it, the square over twice the radius.
    bend = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / (2.0 * _ARC)
    for i in range(3):
        covariance[i, i] += variance + bend**2


@kernel
def _complete_digits(
    hand: HandArrays,
    seen: Int[np.ndarray, "6"],
    on_part: Int[np.ndarray, "6"],
    joint_prior: JointPrior,
    work: Workspace,
    qpos: Float[np.ndarray, "27"],
) -> bool:
    """Move joints of digits with missing markers to the optimum of prior and markers, others fixed."""
    weak = np.zeros(NUM_JOINTS, dtype=np.int64)
    count = 0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        if seen[digit] < max(on_part[digit], FEWEST_ON_PART):
            weak[count] = hinge
            count += 1
    if count == 0:
        return False
    matrix, change = np.empty((count, count)), np.empty(count)
    for row in range(count):
        one = weak[row]
        change[row] = -work.gradient[one]
        for hinge in range(NUM_JOINTS):
            change[row] -= joint_prior.precision[one, hinge] * (qpos[7 + hinge] - joint_prior.angles[hinge])
        for column in range(count):
            other = weak[column]
            information = work.normal[min(one, other), max(one, other)]
            matrix[row, column] = information + joint_prior.precision[one, other]
    solve_positive(matrix, change)
    for row in range(count):
        hinge = weak[row]
        low, high = hand.ranges[hinge, 0], hand.ranges[hinge, 1]
        qpos[7 + hinge] = min(max(qpos[7 + hinge] + change[row], low), high)
    return True


def known_hand(digits: Int[np.ndarray, "M"], noise: float) -> HandDoubt:
    """`HandDoubt` of a perfectly known hand whose markers have some noise [m]."""
    count = len(DIGITS)
    pairs, turns = np.zeros((count, 2)), np.zeros((count, 3))
    return HandDoubt(noise, 0.0, np.zeros((len(digits), 2)), np.zeros(count), turns, pairs, 0.0, pairs)


def hand_doubt(digits: Int[np.ndarray, "M"], origin: HandOrigin, noise: float) -> HandDoubt:
    """`HandDoubt` of a user's hand by its origin, for people and gloves like the simulated ones."""
    # A calibrated hand is as accurate as the noise of its markers [m] allows; a digit with one marker remains
    # half as uncertain as on a measured hand.
    known, count = _NAMED if origin == "named" else _MEASURED, len(DIGITS)
    turns = np.full((count, 3), np.deg2rad(known.turn))
    turns[0] *= known.thumb
    before = HandDoubt(
        MARKER_NOISE,
        known.size,
        np.tile(known.place, (len(digits), 1)),
        np.full(count, known.knuckle),
        turns,
        np.tile(known.bones, (count, 1)),
        0.0,
        np.zeros((count, 2)),
    )
    if origin != "calibrated":
        return before
    counts = np.bincount(digits[digits >= 0], minlength=count)
    single, few = counts < 2, np.where(counts < FEWEST_ON_PART, _FEW, 1.0)
    places = np.where(single[:, None], 0.6 * np.array(known.place), _CALIBRATED_PLACE * noise * few[:, None])
    lengths, turns = np.outer(few, _CALIBRATED_BONES) * noise, np.outer(few, np.deg2rad(_CALIBRATED_TURNS))
    turns[0] *= _CALIBRATED_THUMB * few[0]  # Few markers determine a thumb's direction even less.
    return HandDoubt(
        noise,
        _CALIBRATED_SIZE * noise,
        np.where(digits[:, None] < 0, _CALIBRATED_PALM * noise, places[np.maximum(digits, 0)]),
        np.where(single, 0.5 * before.knuckles, _CALIBRATED_KNUCKLE * noise * few),
        np.where(single[:, None], 0.5 * before.directions, turns),
        np.where(single[:, None], 0.5 * before.bones, lengths),
        _CALIBRATED_WRIST,
        np.where(single[:, None], _SINGLE, few[:, None]) * _CALIBRATED_JOINTS,
    )


class SpreadModel:
    """Standard deviations of the poses of one hand, which depend on the hand's origin.

    `angle_errors` are those that remain after a calibration, see `energy.angle_errors`.
    """

    def __init__(
        self, fit: GloveFit, origin: HandOrigin, angle_errors: Float[np.ndarray, "20 2"] | None = None
    ) -> None:
        self._hand, self._digits, self._origin = with_keypoints(fit), hand_arrays(fit).digits, origin
        self._angle_errors = angle_errors
        self._doubts: dict[int, HandDoubt] = {}  # by the noise [10 um], which hardly changes in a take

    def of_pose(
        self, qpos: Float[np.ndarray, "27"], unseen: Float[np.ndarray, "M"], rms: float
    ) -> tuple[Float[np.ndarray, "20"], Float[np.ndarray, "21"]]:
        """Standard deviations of one pose; see `spreads`."""
        angles, keypoints = self.spreads(qpos[None], unseen[None], rms)
        return angles[0], keypoints[0]

    def spreads(
        self, qpos: Float[np.ndarray, "T 27"], unseen: Float[np.ndarray, "T M"], rms: float
    ) -> tuple[Float[np.ndarray, "T 20"], Float[np.ndarray, "T 21"]]:
        """Standard deviations of angles [rad] and keypoints [m]; `unseen` is in [s], infinite for never."""
        digits = self._digits
        noise = max(rms * freedom_factor(len(digits)), _LEAST_NOISE) if rms > 0.0 else MARKER_NOISE
        variances, keypoints = self.variances(qpos, unseen, noise)
        return np.sqrt(variances.sum(axis=-1)), keypoints

    def variances(
        self,
        qpos: Float[np.ndarray, "T 27"],
        unseen: Float[np.ndarray, "T M"],
        noise: float,
        flesh: float = 0.0,
        places: Float[np.ndarray, "M 2"] | float = 0.0,
        smoothed: Float[np.ndarray, "S 26 26"] = NOT_SMOOTHED,
        share: float = 1.0,
    ) -> tuple[Float[np.ndarray, "T 20 4"], Float[np.ndarray, "T 21"]]:
        """Variances of angles by `SOURCES` [rad^2], and standard deviations of keypoints [m].

        For smoothed poses are given: flesh motion and RMS errors of marker places, along the skin and off it
        [m], the covariances of the unknowns from noise and gaps, and the weight of the prior in one frame.
        """
        steps = round(noise / _NOISE_STEP)
        if steps not in self._doubts:
            self._doubts[steps] = hand_doubt(self._digits, self._origin, steps * _NOISE_STEP)
        doubt = self._doubts[steps]
        doubt = doubt._replace(flesh=flesh, places=np.maximum(doubt.places, places))
        prior = share * resting_prior().precision
        variances, keypoints = pose_spreads(self._hand, prior, doubt, qpos, unseen, smoothed)
        if self._angle_errors is not None:
            unsure, errors = variances[..., [1, 3]], self._angle_errors**2
            # Errors of the hand move its keypoints as they move its angles.
            keypoints *= max(1.0, np.sqrt(errors.sum() / unsure.mean(axis=0).sum()))
            variances[..., [1, 3]] = np.maximum(unsure, errors)
        return variances, keypoints


def measurement_error(budget: Float[np.ndarray, "*J 4"], origin: HandOrigin) -> Float[np.ndarray, "*J"]:
    """Standard error of measurement between sessions of a person, in the unit of deviations by `SOURCES`.

    The glove is put on anew for each session. Then a calibrated hand is calibrated anew, too, and all parts
    of its error change.
    """
    changing = 1.0 if origin == "calibrated" else np.array(CHANGING)
    return np.asarray(np.linalg.norm(changing * budget, axis=-1))


def freedom_factor(num_markers: int) -> float:
    """Ratio of the noise of marker coordinates to the RMS distance from a fitted pose."""
    return float(np.sqrt(num_markers / max(3 * num_markers - NUM_UNKNOWNS, _LEAST_FREEDOM)))


def with_keypoints(fit: GloveFit) -> HandArrays:
    """Arrays of a hand with its keypoints as further markers, each on the bone that ends there."""
    hand, count = hand_arrays(fit), NUM_KEYPOINTS
    digits = np.repeat(np.arange(len(DIGITS)), 4)
    ends = 1 + 3 * digits + np.tile([0, 0, 1, 2], len(DIGITS))  # A knuckle is where the first bone begins.
    bones, weights, positions = np.full((count, 4), -1), np.zeros((count, 4)), np.zeros((count, 4, 3))
    bones[0, 0], bones[1:, 0], weights[:, 0] = PALM, ends, 1.0
    positions[1:, 0, 0] = fit.model.skeleton.lengths[ends] * np.tile([0.0, 1.0, 1.0, 1.0], len(DIGITS))
    spans = np.zeros((count, 2), dtype=np.int64)
    spans[1:] = 4 * digits[:, None] + [0, 4]
    return hand._replace(
        bones=np.concatenate([hand.bones, bones]),
        bone_weights=np.concatenate([hand.bone_weights, weights]),
        positions=np.concatenate([hand.positions, positions]),
        digits=np.concatenate([hand.digits, [-1], digits]),
        hinge_span=np.concatenate([hand.hinge_span, spans]),
    )


@kernel
def pose_spreads(
    hand: HandArrays,
    prior: Float[np.ndarray, "20 20"],
    doubt: HandDoubt,
    qpos: Float[np.ndarray, "T 27"],
    unseen: Float[np.ndarray, "T M"],
    smoothed: Float[np.ndarray, "S 26 26"],
) -> tuple[Float[np.ndarray, "T 20 4"], Float[np.ndarray, "T 21"]]:
    """Variances of joint angles by `SOURCES` [rad^2] and standard deviations of keypoints [m].

    `hand` is from `with_keypoints`. A marker off its place moves the fit as noise does. The hand's unknown
    numbers move markers, through them the fit, and keypoints also directly.
    """
    angles, keypoints = np.empty((len(qpos), NUM_JOINTS, 4)), np.empty((len(qpos), NUM_KEYPOINTS))
    count, work, weights = unseen.shape[1], workspace(len(hand.digits)), np.zeros(len(hand.digits))
    moved, posterior = np.zeros((len(weights), 3, _NUMBERS)), np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS))
    weighted = np.empty((3 * count, NUM_UNKNOWNS))
    jacobian, numbers = work.jacobian.reshape(-1, NUM_UNKNOWNS), moved.reshape(-1, _NUMBERS)
    work.residuals[:] = 0.0
    for frame in range(len(qpos)):
        for marker in range(count):
            weights[marker] = 1.0 / (doubt.noise**2 + _DRIFT**2 * unseen[frame, marker])
        compute_markers(hand, qpos[frame, 7:], work)
        accumulate_normal_equations(hand, weights, work)
        for row in range(NUM_UNKNOWNS):
            for column in range(row + 1):
                posterior[row, column] = work.normal[column, row]
            posterior[row, row] += _ANYWHERE if row >= NUM_JOINTS else 0.0
        posterior[:NUM_JOINTS, :NUM_JOINTS] += prior
        invert_positive(posterior)
        _move_points(hand, doubt, work, moved)
        for row in range(3 * count):
            for unknown in range(NUM_UNKNOWNS):
                weighted[row, unknown] = weights[row // 3] * jacobian[row, unknown]
        forces = weighted.T @ numbers[: 3 * count]
        off, answers = weighted @ posterior, posterior @ forces
        covariance, noise = answers @ answers.T, smoothed[frame] if len(smoothed) > 0 else posterior
        _write_variances(hand, doubt, work, noise, covariance, off, angles[frame])
        covariance += noise + off.T @ off
        spread = jacobian[3 * count :] @ covariance
        response = jacobian[3 * count :] @ (posterior @ (_OWN_UNKNOWNS * forces))
        for keypoint in range(NUM_KEYPOINTS):
            digit, total = (keypoint - 1) // 4, 0.0
            for row in range(3 * keypoint, 3 * keypoint + 3):
                for unknown in range(NUM_UNKNOWNS):
                    total += spread[row, unknown] * jacobian[3 * count + row, unknown]
                for number in range(_NUMBERS):
                    own = numbers[3 * count + row, number]
                    total += own * (own - 2.0 * response[row, number])
            beyond = doubt.joints[digit, (keypoint - 1) % 4 // 3] if keypoint > 0 else doubt.wrist
            keypoints[frame, keypoint] = np.sqrt(max(total, 0.0) / 3.0 + beyond**2)
    return angles, keypoints


@kernel
def _write_variances(
    hand: HandArrays,
    doubt: HandDoubt,
    work: Workspace,
    noise: Float[np.ndarray, "26 26"],
    bones: Float[np.ndarray, "26 26"],
    off: Float[np.ndarray, "R 26"],
    variances: Float[np.ndarray, "20 4"],
) -> None:
    """Write the variances of angles [rad^2]; scales `off` from derivatives [rad/m] to deviations [rad]."""
    # A slipped marker keeps its height over the bone, and the height tells most of the bone's flexion.
    variances[:] = 0.0
    for hinge in range(NUM_JOINTS):
        variances[hinge, 0], variances[hinge, 3] = noise[hinge, hinge], bones[hinge, hinge]
    flesh = doubt.flesh**2
    for marker in range(len(off) // 3):
        normal = work.rotations[hand.bones[marker, 0]] @ hand.normals[marker]
        along, above = doubt.places[marker, 0] ** 2, doubt.places[marker, 1] ** 2
        rows, wide, high = off[3 * marker : 3 * marker + 3], np.sqrt(along + flesh), np.sqrt(above + flesh)
        for unknown in range(NUM_UNKNOWNS):
            square, lift = 0.0, 0.0
            for i in range(3):
                square += rows[i, unknown] ** 2
                lift += normal[i] * rows[i, unknown]
            if unknown < NUM_JOINTS:
                variances[unknown, 1] += along * (square - lift**2) + above * lift**2
                variances[unknown, 2] += flesh * square
            for i in range(3):
                rows[i, unknown] = wide * rows[i, unknown] + (high - wide) * lift * normal[i]


@kernel
def _move_points(
    hand: HandArrays, doubt: HandDoubt, work: Workspace, moved: Float[np.ndarray, "P 3 51"]
) -> None:
    """Write the motion of points by one standard deviation of each unknown number of the hand [m]."""
    # Ten numbers per digit: origin, turns about three axes, lengths of bones and of all; then the size.
    lever = np.empty(3)
    for point in range(len(moved)):
        for i in range(3):
            moved[point, i, _NUMBERS - 1] = doubt.size * work.markers[point, i]
        for digit in range(hand.hinge_span[point, 0] // 4, hand.hinge_span[point, 1] // 4):
            shift, share = moved[point, :, _OWN * digit : _OWN * (digit + 1)], 0.0
            shift[:], lever[:] = 0.0, 0.0
            for link in range(2, -1, -1):
                bone = 1 + 3 * digit + link
                reach = share * hand.offsets[bone + 1, 0] if link < 2 else 0.0  # distance along the bone [m]
                for slot in range(4):
                    if hand.bones[point, slot] == bone:
                        share += hand.bone_weights[point, slot]
                        reach += hand.positions[point, slot, 0]
                        for i in range(3):
                            lever[i] += work.bone_terms[point, slot, i]
                for i in range(3):
                    shift[i, 6 + link] = doubt.bones[digit, 0] * reach * work.rotations[bone, i, 0]
                    shift[i, 9] += doubt.bones[digit, 1] * reach * work.rotations[bone, i, 0]
            for i in range(3):
                lever[i] -= share * work.origins[1 + 3 * digit, i]
                shift[i, i] = share * doubt.knuckles[digit]
            turns = doubt.directions[digit]
            shift[1, 3], shift[2, 3] = -turns[0] * lever[2], turns[0] * lever[1]
            shift[0, 4], shift[2, 4] = turns[1] * lever[2], -turns[1] * lever[0]
            shift[0, 5], shift[1, 5] = -turns[2] * lever[1], turns[2] * lever[0]
