"""What markers and priors leave open of a pose: covariances of hinges, predicted markers and keypoints.

- Before its markers are used, a hand has a prior: a normal distribution of all 20 hinges together. They
  follow an Ornstein-Uhlenbeck process whose resting distribution is that of the gestures people make: a hinge
  that no marker shows for a while returns to it, in its mean and in its spread. Neighboring fingers bend
  together, so the covariance carries information from visible digits to hidden ones.
- The neighbors of a missing marker may determine its position nearly, or leave it free along the arc of one
  hinge. The normal matrix of the fit together with the prior of the hinges gives its covariance.
- Standard deviations of joint angles and keypoints come from a model that is linear and normal around the
  pose. Each marker is seen with noise, and tells less the longer it is hidden. The hand differs from its
  user's in the same way in every frame, so that no number of frames averages it out: in its size, in the
  places of its markers, in where its digits begin and point, in the lengths of its bones. Flesh moves markers
  slowly, so that frames beside each other do not average it out either.
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

# So short that a digit with one marker that was bent as few digits are finds its way back.
_JOINT_MEMORY: Final = 0.3  # [s] time constant of the process of the hinges
_JOINT_SPREAD: Final = float(np.deg2rad(0.5))  # least standard deviation of a predicted hinge
_GESTURE_MARGIN: Final = float(np.deg2rad(6.0))  # added to the gestures' spread, for poses that none shows
_ARC: Final = 0.04  # [m] usual radius of the arcs that markers move on: the length of a finger's bones
_LEAST_INFORMATION: Final = 1e-9  # share of a marker's precision on the diagonal, so that it has an inverse
_DRIFT: Final = 0.014  # [m/sqrt(s)] of a hidden marker
_ANYWHERE: Final = 0.01  # [1/m^2, 1/rad^2] precision of the wrist before any marker is seen
_LEAST_NOISE: Final = 0.0001  # [m] of a marker that many cameras see
_NOISE_STEP: Final = 1e-5  # [m] to which noise is rounded
# A calibrated hand, chosen on the same people; what markers tell is better the less noise they have.
_FEW: Final = 1.4  # uncertainty factor of a digit with fewer than three markers
_CALIBRATED_SIZE: Final = 3.0  # [1/m] times the noise
_CALIBRATED_PLACE: Final = 0.15  # times the noise
_CALIBRATED_PALM: Final = 0.45  # times the noise
_CALIBRATED_KNUCKLE: Final = 0.15  # times the noise
_CALIBRATED_TURNS: Final = (0.5, 0.8, 1.5)  # [deg]; abduction hardly tells where a digit points
_CALIBRATED_THUMB: Final = 1.6  # times the fingers' directions
_CALIBRATED_BONES: Final = (3.5, 3.0)  # [1/m] times the noise
_CALIBRATED_WRIST: Final = 0.0007  # [m]
_CALIBRATED_JOINTS: Final = (0.00016, 0.00045)  # [m], tips last
_SINGLE: Final = (7.0, 3.0)  # times these, of a digit with one marker
_LEAST_FREEDOM: Final = 3  # coordinates of markers beyond those that a pose needs
SOURCES: Final = ("noise and gaps", "gluing", "flesh", "bones")
"""What makes an angle uncertain: markers that are noisy or not seen, the places where they were glued on,
their motion over the bones, and the sizes and directions of these."""
_OWN: Final = 10  # numbers of a digit that are not known: knuckle, direction, bones (3 each), all its bones
_NUMBERS: Final = 5 * _OWN + 1  # numbers of a hand that are not known: those of its digits, and its size
NOT_SMOOTHED: Final = np.empty((0, NUM_UNKNOWNS, NUM_UNKNOWNS))
"""Covariances of poses that were fitted frame by frame."""
# Unknowns by which a digit's keypoints respond to each number: its own hinges, and the wrist.
_OWN_UNKNOWNS: Final = np.ones((NUM_UNKNOWNS, _NUMBERS))
_OWN_UNKNOWNS[:NUM_JOINTS, :-1] = np.kron(np.eye(5), np.ones((4, _OWN)))


class JointPrior(NamedTuple):
    """A normal distribution of the hinges."""

    angles: Float[np.ndarray, "20"]  # mean [rad]
    covariance: Float[np.ndarray, "20 20"]  # covariance [rad^2]
    precision: Float[np.ndarray, "20 20"]  # inverse of the covariance [1/rad^2]

    @property
    def spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each hinge [rad]."""
        return np.sqrt(np.diag(self.covariance))


class MarkerPrediction(NamedTuple):
    """Positions of the markers and angles of the hinges at a fitted pose, with their covariances."""

    qpos: Float[np.ndarray, "27"]  # the pose; digits that lack markers at the optimum of markers and prior
    positions: Float[np.ndarray, "M 3"]  # markers in the world [m]
    covariances: Float[np.ndarray, "M 3 3"]  # of each marker in the world [m^2]: the pose's and its own
    rotations: Float[np.ndarray, "M 3 3"]  # in the world, of each marker's bone with the largest weight
    joint_covariance: Float[np.ndarray, "20 20"]  # covariance of the hinges [rad^2]
    information_matrix: Float[np.ndarray, "20 20"]  # of the markers alone on hinges, the palm held [1/rad^2]
    information_vector: Float[np.ndarray, "20"]  # the matrix times the angles by the markers alone [1/rad]


class HandDoubt(NamedTuple):
    """How far a hand in its glove may be from its user's: standard deviations."""

    noise: float  # of a marker around its place on the hand, from frame to frame [m]
    size: float  # of the size of the whole hand, its logarithm
    places: Float[np.ndarray, "M"]  # of each marker's place on its bone, in each direction [m]
    knuckles: Float[np.ndarray, "5"]  # of where each digit begins on the palm, in each direction [m]
    directions: Float[np.ndarray, "5 3"]  # of the way each digit points, about the axes of the palm [rad]
    bones: Float[np.ndarray, "5 2"]  # of the length of each bone of a digit, and of all together, logarithms
    wrist: float  # of where the wrist is in the palm, which no marker shows, in each direction [m]
    joints: Float[np.ndarray, "5 2"]  # of a digit's joints and tip, beyond what markers show, each way [m]
    flesh: float = 0.0  # of a marker around its place, alike in frames that follow each other [m]


class _Proportions(NamedTuple):
    """How far a hand that is not calibrated is from its user's: standard deviations."""

    size: float  # logarithm
    place: float  # of a marker [m]
    knuckle: float  # [m]
    turn: float  # of a finger's direction [deg]
    thumb: float  # times the fingers' directions
    bones: tuple[float, float]  # logarithms, of each bone and of all of a digit


# Chosen on simulated people that benchmarks.doubt does not try. What the fit of the proportions makes up for
# is not here: less than people differ by.
_MEASURED: Final = _Proportions(0.001, 0.0014, 0.0003, 1.8, 4.0, (0.01, 0.02))
# Of the nearest of five sizes: what people differ by, and half a step between sizes. Places are off by what
# slips, and by what girths of digits and lengths of bones that are not the user's move.
_NAMED: Final = _Proportions(
    0.02, 0.003, ADULTS.knuckle_spread, ADULTS.angle_spread, 3.0, (ADULTS.bone_spread, ADULTS.digit_spread)
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
    """Prior of the hinges `span` seconds after they were estimated, near these predicted angles [rad]."""
    kept = float(np.exp(-max(span, 0.0) / _JOINT_MEMORY))
    return _relax(angles, covariance, resting_prior(), kept)


@kernel
def _relax(
    angles: Float[np.ndarray, "20"], covariance: Float[np.ndarray, "20 20"], resting: JointPrior, kept: float
) -> JointPrior:
    """The prior of hinges of which this share is kept, and the rest is that of resting hands."""
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
    """Fill mean and precision of one digit's hinges, given the information of the others' markers."""
    count = len(prior.angles)
    order, system, right_side = np.empty(count, dtype=np.int64), np.empty((count, count)), np.zeros(count)
    index = 0
    for hinge in range(count):  # the digit's own hinges last, so that the others are eliminated from them
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
    """Fill the covariance of a marker in the world [m^2]: that of the unknowns, and its own variance."""
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
    # A marker moves on an arc, not on its tangent: a variance along the tangent means a deviation
    # across it, by the square over twice the radius.
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
    """Move hinges of digits that lack markers to the optimum of prior and markers, the others held."""
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
    """Doubt of a hand of which everything is known, whose markers are seen with a noise [m]."""
    count = len(DIGITS)
    pairs, turns = np.zeros((count, 2)), np.zeros((count, 3))
    return HandDoubt(noise, 0.0, np.zeros(len(digits)), np.zeros(count), turns, pairs, 0.0, pairs)


def hand_doubt(digits: Int[np.ndarray, "M"], origin: HandOrigin, noise: float) -> HandDoubt:
    """Doubt of a user's hand by where it is from: people and gloves differ as simulated ones do."""
    # A calibrated hand is as near to its user's as the noise of its markers [m] lets it be; a digit with a
    # single marker remains half as doubtful as on a measured hand.
    known, count = _NAMED if origin == "named" else _MEASURED, len(DIGITS)
    turns = np.full((count, 3), np.deg2rad(known.turn))
    turns[0] *= known.thumb
    before = HandDoubt(
        MARKER_NOISE,
        known.size,
        np.full(len(digits), known.place),
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
    places = np.where(single, 0.6 * known.place, _CALIBRATED_PLACE * noise * few)
    lengths, turns = np.outer(few, _CALIBRATED_BONES) * noise, np.outer(few, np.deg2rad(_CALIBRATED_TURNS))
    turns[0] *= _CALIBRATED_THUMB * few[0]  # few markers tell even less of where a thumb points
    return HandDoubt(
        noise,
        _CALIBRATED_SIZE * noise,
        np.where(digits < 0, _CALIBRATED_PALM * noise, places[np.maximum(digits, 0)]),
        np.where(single, 0.5 * before.knuckles, _CALIBRATED_KNUCKLE * noise * few),
        np.where(single[:, None], 0.5 * before.directions, turns),
        np.where(single[:, None], 0.5 * before.bones, lengths),
        _CALIBRATED_WRIST,
        np.where(single[:, None], _SINGLE, few[:, None]) * _CALIBRATED_JOINTS,
    )


class SpreadModel:
    """Standard deviations of the poses of one hand, which depend on where the hand is from.

    `angle_errors` are what the solution of the hand leaves open of each angle, see `energy.angle_errors`.
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
        """Standard deviations of angles [rad] and keypoints [m]; markers are unseen for [s] or for ever."""
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
        place: float = 0.0,
        smoothed: Float[np.ndarray, "S 26 26"] = NOT_SMOOTHED,
        share: float = 1.0,
    ) -> tuple[Float[np.ndarray, "T 20 4"], Float[np.ndarray, "T 21"]]:
        """Variances of angles by `SOURCES` [rad^2], and standard deviations of keypoints [m].

        Of a smoothed hand are given: flesh, how far its markers are from their places in all frames [m], the
        covariances of its unknowns by noise and gaps, and how often the prior counts in a frame.
        """
        steps = round(noise / _NOISE_STEP)
        if steps not in self._doubts:
            self._doubts[steps] = hand_doubt(self._digits, self._origin, steps * _NOISE_STEP)
        doubt = self._doubts[steps]
        doubt = doubt._replace(flesh=flesh, places=np.maximum(doubt.places, place))
        prior = share * resting_prior().precision
        variances, keypoints = pose_spreads(self._hand, prior, doubt, qpos, unseen, smoothed)
        if self._angle_errors is not None:
            unsure, errors = variances[..., [1, 3]], self._angle_errors**2
            # What is open of a hand moves its keypoints as it moves its angles.
            keypoints *= max(1.0, np.sqrt(errors.sum() / unsure.mean(axis=0).sum()))
            variances[..., [1, 3]] = np.maximum(unsure, errors)
        return variances, keypoints


def freedom_factor(num_markers: int) -> float:
    """Ratio of the noise of markers to the RMS distance from a pose that was fitted to them."""
    return float(np.sqrt(num_markers / max(3 * num_markers - NUM_UNKNOWNS, _LEAST_FREEDOM)))


def with_keypoints(fit: GloveFit) -> HandArrays:
    """The arrays of a hand whose keypoints follow its markers, each on the bone that ends there."""
    hand, count = hand_arrays(fit), NUM_KEYPOINTS
    digits = np.repeat(np.arange(len(DIGITS)), 4)
    ends = 1 + 3 * digits + np.tile([0, 0, 1, 2], len(DIGITS))  # a knuckle is where the first bone begins
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
    """Variances of joint angles by `SOURCES` [rad^2], standard deviations of keypoints [m] `with_keypoints`.

    A marker off its place moves the fit as noise does. The hand's numbers move markers, through them the fit,
    and the keypoints also by themselves.
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
        _write_variances(doubt, noise, covariance, off, angles[frame])
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
    doubt: HandDoubt,
    noise: Float[np.ndarray, "26 26"],
    bones: Float[np.ndarray, "26 26"],
    off: Float[np.ndarray, "R 26"],
    variances: Float[np.ndarray, "20 4"],
) -> None:
    """Fill the variances of angles [rad^2]; `off` is what a meter moves, then what the doubt does."""
    variances[:] = 0.0
    for hinge in range(NUM_JOINTS):
        variances[hinge, 0], variances[hinge, 3] = noise[hinge, hinge], bones[hinge, hinge]
    for row in range(len(off)):
        place, flesh = doubt.places[row // 3] ** 2, doubt.flesh**2
        for hinge in range(NUM_JOINTS):
            square = off[row, hinge] ** 2
            variances[hinge, 1] += place * square
            variances[hinge, 2] += flesh * square
        off[row] *= np.sqrt(place + flesh)


@kernel
def _move_points(
    hand: HandArrays, doubt: HandDoubt, work: Workspace, moved: Float[np.ndarray, "P 3 51"]
) -> None:
    """Fill how points move by a hand's numbers, in their standard deviations [m]."""
    # Ten of each digit: where it begins, turns about three axes, lengths of bones and of all; then the size.
    lever = np.empty(3)
    for point in range(len(moved)):
        for i in range(3):
            moved[point, i, _NUMBERS - 1] = doubt.size * work.markers[point, i]
        for digit in range(hand.hinge_span[point, 0] // 4, hand.hinge_span[point, 1] // 4):
            shift, share = moved[point, :, _OWN * digit : _OWN * (digit + 1)], 0.0
            shift[:], lever[:] = 0.0, 0.0
            for link in range(2, -1, -1):
                bone = 1 + 3 * digit + link
                reach = share * hand.offsets[bone + 1, 0] if link < 2 else 0.0  # along the bone [m]
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
