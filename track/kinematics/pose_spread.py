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
  places of its markers, in where its digits begin and point, in the lengths of its bones.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.shape import ADULTS, DIGITS, NUM_JOINTS, NUM_KEYPOINTS, bones_of
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
_OWN: Final = 10  # numbers of a digit that are not known: knuckle, direction, bones (3 each), all its bones
_CHAIN: Final = 10  # unknowns that move a digit: its four hinges and the wrist


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

    qpos: Float[np.ndarray, "27"]
    """The pose; hinges of digits that lack markers are moved to the optimum of markers and prior."""
    positions: Float[np.ndarray, "M 3"]
    """Markers in the world [m]."""
    covariances: Float[np.ndarray, "M 3 3"]
    """Covariance of each marker in the world [m^2]: that of the pose, and the marker's own variance."""
    rotations: Float[np.ndarray, "M 3 3"]
    """Rotation in the world of the bone with the largest weight of each marker."""
    joint_covariance: Float[np.ndarray, "20 20"]
    """Covariance of the hinges [rad^2]."""
    information_matrix: Float[np.ndarray, "20 20"]
    """Information of the markers alone on the hinges, the palm being held [1/rad^2]."""
    information_vector: Float[np.ndarray, "20"]
    """The matrix times the angles that the markers alone would give [1/rad]."""


class HandDoubt(NamedTuple):
    """How far a hand in its glove may be from its user's: standard deviations."""

    noise: float
    """Of a marker around its place on the hand, from frame to frame [m]."""
    size: float
    """Of the size of the whole hand, its logarithm."""
    places: Float[np.ndarray, "M"]
    """Of each marker's place on its bone, in each direction [m]."""
    knuckles: Float[np.ndarray, "5"]
    """Of where each digit begins on the palm, in each direction [m]."""
    directions: Float[np.ndarray, "5 3"]
    """Of the way each digit points, about the axes of the palm [rad]."""
    bones: Float[np.ndarray, "5 2"]
    """Of the length of each bone of a digit, and of all of them together, logarithms."""
    wrist: float
    """Of where the wrist is in the palm, which no marker shows, in each direction [m]."""
    joints: Float[np.ndarray, "5 2"]
    """Of where a digit's joints and its tip are, as far as no marker shows it, in each direction [m]."""


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
    """Prior of the hinges `span` seconds after they were estimated.

    The angles [rad] are predicted by velocity alone; they return to those of a resting hand.
    """
    kept, resting = np.exp(-max(span, 0.0) / _JOINT_MEMORY), resting_prior()
    mean = angles + (1.0 - kept) * (resting.angles - angles)
    prior = JointPrior(mean, np.empty_like(covariance), np.empty_like(covariance))
    _predict_covariance(covariance, resting.covariance, kept**2, prior)
    return prior


@kernel
def _predict_covariance(
    known: Float[np.ndarray, "20 20"], resting: Float[np.ndarray, "20 20"], kept: float, prior: JointPrior
) -> None:
    """Fill covariance and precision of a prior: a share of what is known, the rest of a resting hand."""
    for row in range(len(known)):
        for column in range(len(known)):
            prior.covariance[row, column] = kept * known[row, column] + (1.0 - kept) * resting[row, column]
        prior.covariance[row, row] += _JOINT_SPREAD**2
    prior.precision[:] = prior.covariance
    invert_positive(prior.precision)


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
    for number in range(count):
        unknown = first + number if number < last - first else NUM_JOINTS + number - (last - first)
        for i in range(3):
            for j in range(3):
                in_world[i, number] += wrist[i, j] * jacobian[j, unknown]
    covariance[:] = 0.0
    for one in range(count):
        row = first + one if one < last - first else NUM_JOINTS + one - (last - first)
        for other in range(count):
            column = first + other if other < last - first else NUM_JOINTS + other - (last - first)
            share = posterior[row, column]
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += in_world[i, one] * share * in_world[j, other]
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
    """Move hinges of digits that lack markers to the optimum of prior and markers; False without such digits.

    The hinges of the other digits are held, and inform those of their neighbors through the prior's
    covariance.
    """
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
    """Doubt of a user's hand by where it is from.

    People and gloves differ as simulated ones do. A calibrated hand is as near to its user's as the noise of
    its markers [m] lets it be; a digit with a single marker remains half as doubtful as on a measured hand.
    """
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
    """Standard deviations of the poses of one hand, which depend on where the hand is from."""

    def __init__(self, fit: GloveFit, origin: HandOrigin) -> None:
        self._hand, self._tips, self._origin = hand_arrays(fit), tip_lengths(fit), origin
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
        """Standard deviations of joint angles [rad] and of keypoints in each direction [m].

        Times since markers were seen are in [s], infinite where never; the RMS distance [m] may be NaN.
        """
        digits = self._hand.digits
        freedom = max(3 * len(digits) - NUM_UNKNOWNS, _LEAST_FREEDOM)
        noise = max(rms * np.sqrt(len(digits) / freedom), _LEAST_NOISE) if rms > 0.0 else MARKER_NOISE
        steps = round(noise / _NOISE_STEP)
        if steps not in self._doubts:
            self._doubts[steps] = hand_doubt(digits, self._origin, steps * _NOISE_STEP)
        return pose_spreads(
            self._hand, self._tips, resting_prior().precision, self._doubts[steps], qpos, unseen
        )


def tip_lengths(fit: GloveFit) -> Float[np.ndarray, "5"]:
    """Lengths of the last bones [m]."""
    return np.array([fit.model.skeleton.lengths[bones_of(digit)[-1]] for digit in DIGITS])


class _PoseErrors(NamedTuple):
    """Covariances of the unknowns of one pose, and how its fit answers to what is not known of the hand."""

    posterior: Float[np.ndarray, "26 26"]
    """By noise alone."""
    covariance: Float[np.ndarray, "26 26"]
    """With the doubt of the hand; lower triangle."""
    own: Float[np.ndarray, "5 10 26"]
    """Change of the fit's gradient by each digit's own numbers, in their standard deviations."""
    whole: Float[np.ndarray, "26"]
    """The same by the size of the whole hand."""


@kernel
def pose_spreads(
    hand: HandArrays,
    tips: Float[np.ndarray, "5"],
    prior: Float[np.ndarray, "20 20"],
    doubt: HandDoubt,
    qpos: Float[np.ndarray, "T 27"],
    unseen: Float[np.ndarray, "T M"],
) -> tuple[Float[np.ndarray, "T 20"], Float[np.ndarray, "T 21"]]:
    """Standard deviations of each joint angle [rad] and of each keypoint in each direction [m]."""
    angles, keypoints = np.empty((len(qpos), NUM_JOINTS)), np.empty((len(qpos), NUM_KEYPOINTS))
    count = unseen.shape[1]
    work, weights, square = workspace(count), np.empty(count), (NUM_UNKNOWNS, NUM_UNKNOWNS)
    own, whole = np.empty((len(tips), _OWN, NUM_UNKNOWNS)), np.empty(NUM_UNKNOWNS)
    errors = _PoseErrors(np.empty(square), np.empty(square), own, whole)
    work.residuals[:] = 0.0
    for frame in range(len(qpos)):
        for marker in range(count):
            weights[marker] = 1.0 / (doubt.noise**2 + _DRIFT**2 * unseen[frame, marker])
        compute_markers(hand, qpos[frame, 7:], work)
        accumulate_normal_equations(hand, weights, work)
        for row in range(NUM_UNKNOWNS):
            for column in range(row + 1):
                errors.posterior[row, column] = work.normal[column, row]
                if row < NUM_JOINTS:
                    errors.posterior[row, column] += prior[row, column]
            if row >= NUM_JOINTS:
                errors.posterior[row, row] += _ANYWHERE
        invert_positive(errors.posterior)
        _add_systematic(hand, doubt, weights, work, errors)
        for hinge in range(NUM_JOINTS):
            angles[frame, hinge] = np.sqrt(errors.covariance[hinge, hinge])
        _spread_keypoints(hand, tips, doubt, errors, work, keypoints[frame])
    return angles, keypoints


@kernel
def _add_systematic(
    hand: HandArrays, doubt: HandDoubt, weights: Float[np.ndarray, "M"], work: Workspace, errors: _PoseErrors
) -> None:
    """Fill what the doubt of the hand adds to a posterior."""
    forces, own, whole = work.factor, errors.own, errors.whole
    forces[:], own[:], whole[:] = 0.0, 0.0, 0.0
    shift, unknowns = np.empty((_OWN, 3)), np.empty(NUM_UNKNOWNS, dtype=np.int64)
    for marker in range(len(weights)):
        weight, jacobian, place = weights[marker], work.jacobian[marker], work.markers[marker]
        first, last = hand.hinge_span[marker, 0], hand.hinge_span[marker, 1]
        count = last - first + 6
        for one in range(count):
            unknowns[one] = first + one if one < last - first else NUM_JOINTS + one - (last - first)
        square, size = (weight * doubt.places[marker]) ** 2, weight * doubt.size
        for one in range(count):
            row = unknowns[one]
            a, b, c = jacobian[0, row], jacobian[1, row], jacobian[2, row]
            whole[row] += size * (a * place[0] + b * place[1] + c * place[2])
            a, b, c = square * a, square * b, square * c
            for other in range(one + 1):
                column = unknowns[other]
                forces[row, column] += (
                    a * jacobian[0, column] + b * jacobian[1, column] + c * jacobian[2, column]
                )
        for digit in range(first // 4, last // 4):
            _shift_marker(hand, doubt, marker, digit, work, shift)
            for one in range(count):
                row = unknowns[one]
                a, b, c = weight * jacobian[0, row], weight * jacobian[1, row], weight * jacobian[2, row]
                for number in range(_OWN):
                    own[digit, number, row] += (
                        a * shift[number, 0] + b * shift[number, 1] + c * shift[number, 2]
                    )
    _add_columns(own, whole, forces)
    _propagate(forces, errors.posterior, errors.covariance)


@kernel
def _add_columns(
    own: Float[np.ndarray, "5 10 26"], whole: Float[np.ndarray, "26"], forces: Float[np.ndarray, "26 26"]
) -> None:
    """Add the squares of columns to a matrix of which the lower triangle is given, and complete it."""
    for row in range(NUM_UNKNOWNS):
        for column in range(row + 1):
            forces[row, column] += whole[row] * whole[column]
        for digit in range(len(own)):
            for number in range(_OWN):
                share = own[digit, number, row]
                if share != 0.0:
                    for column in range(row + 1):
                        forces[row, column] += share * own[digit, number, column]
    for row in range(NUM_UNKNOWNS):
        for column in range(row):
            forces[column, row] = forces[row, column]


@kernel
def _propagate(
    forces: Float[np.ndarray, "26 26"],
    posterior: Float[np.ndarray, "26 26"],
    covariance: Float[np.ndarray, "26 26"],
) -> None:
    """Fill the lower triangle of the posterior plus posterior times forces times posterior."""
    product = np.zeros((NUM_UNKNOWNS, NUM_UNKNOWNS))
    for row in range(NUM_UNKNOWNS):
        for inner in range(NUM_UNKNOWNS):
            share = forces[row, inner]
            if share != 0.0:
                for column in range(NUM_UNKNOWNS):
                    product[row, column] += share * posterior[inner, column]
    for row in range(NUM_UNKNOWNS):
        for column in range(row + 1):
            covariance[row, column] = posterior[row, column]
        for inner in range(NUM_UNKNOWNS):
            share = posterior[row, inner]
            for column in range(row + 1):
                covariance[row, column] += share * product[inner, column]


@kernel
def _shift_marker(
    hand: HandArrays,
    doubt: HandDoubt,
    marker: int,
    digit: int,
    work: Workspace,
    shift: Float[np.ndarray, "10 3"],
) -> None:
    """Fill how a marker moves by each of a digit's own numbers, in their standard deviations [m]."""
    root, point, share = work.origins[1 + 3 * digit], np.zeros(3), 0.0
    shift[_OWN - 1] = 0.0
    for link in range(2, -1, -1):
        bone = 1 + 3 * digit + link
        reach = share * hand.offsets[bone + 1, 0] if link < 2 else 0.0  # along the bone [m]
        for slot in range(4):
            if hand.bones[marker, slot] == bone:
                share += hand.bone_weights[marker, slot]
                reach += hand.positions[marker, slot, 0]
                for i in range(3):
                    point[i] += work.bone_terms[marker, slot, i]
        for i in range(3):
            shift[6 + link, i] = doubt.bones[digit, 0] * reach * work.rotations[bone, i, 0]
            shift[_OWN - 1, i] += doubt.bones[digit, 1] * reach * work.rotations[bone, i, 0]
    for i in range(3):
        point[i] -= share * root[i]
    _shift_digit(doubt, digit, point, share, shift)


@kernel
def _shift_digit(
    doubt: HandDoubt,
    digit: int,
    point: Float[np.ndarray, "3"],
    share: float,
    shift: Float[np.ndarray, "10 3"],
) -> None:
    """Fill how a point of a digit, times its share, moves with knuckle and direction, in their spreads."""
    turns = doubt.directions[digit]
    shift[:6] = 0.0
    for i in range(3):
        shift[i, i] = share * doubt.knuckles[digit]
    shift[3, 1], shift[3, 2] = -turns[0] * point[2], turns[0] * point[1]
    shift[4, 0], shift[4, 2] = turns[1] * point[2], -turns[1] * point[0]
    shift[5, 0], shift[5, 1] = -turns[2] * point[1], turns[2] * point[0]


@kernel
def _spread_keypoints(
    hand: HandArrays,
    tips: Float[np.ndarray, "5"],
    doubt: HandDoubt,
    errors: _PoseErrors,
    work: Workspace,
    spread: Float[np.ndarray, "21"],
) -> None:
    """Fill the standard deviation of each keypoint in each direction [m].

    A keypoint is off by the pose's error and by the hand's own, which the fit partly makes up for.
    """
    total = 0.0
    for i in range(3):
        total += errors.covariance[NUM_JOINTS + i, NUM_JOINTS + i]
    spread[0] = np.sqrt(total / 3.0 + doubt.wrist**2)
    unknowns, answers = np.empty(_CHAIN, dtype=np.int64), np.empty((_OWN + 1, _CHAIN))
    jacobian, shift = np.zeros((_CHAIN, 3)), np.zeros((_OWN + 1, 3))
    point, offset = np.empty(3), np.empty(3)
    for number in range(6):
        unknowns[4 + number] = NUM_JOINTS + number
    for i in range(3):
        jacobian[4 + i, i] = 1.0
    for digit in range(len(tips)):
        base = 1 + 3 * digit
        for number in range(4):
            unknowns[number] = 4 * digit + number
        _answer(errors, digit, unknowns, answers)
        jacobian[:4], shift[:] = 0.0, 0.0
        for part in range(4):
            bone = base + part - 1  # that ends here
            length = (tips[digit] if part == 3 else hand.offsets[bone + 1, 0]) if part > 0 else 0.0
            for i in range(3):
                point[i] = work.origins[base, i]
                if part > 0:
                    along = length * work.rotations[bone, i, 0]
                    point[i] = work.origins[bone, i] + along
                    shift[5 + part, i] = doubt.bones[digit, 0] * along
                    shift[_OWN - 1, i] += doubt.bones[digit, 1] * along
                shift[_OWN, i] = doubt.size * point[i]
                offset[i] = point[i] - work.origins[base, i]
            _shift_digit(doubt, digit, offset, 1.0, shift)
            _move_keypoint(digit, part, point, work, jacobian)
            total = _keypoint_square(jacobian, unknowns, errors.covariance, answers, shift)
            beyond = doubt.joints[digit, part // 3]
            spread[1 + 4 * digit + part] = np.sqrt(max(total, 0.0) / 3.0 + beyond**2)


@kernel
def _keypoint_square(
    jacobian: Float[np.ndarray, "10 3"],
    unknowns: Int[np.ndarray, "10"],
    covariance: Float[np.ndarray, "26 26"],
    answers: Float[np.ndarray, "11 10"],
    shift: Float[np.ndarray, "11 3"],
) -> float:
    """Mean square of a keypoint's error, over all directions together [m^2].

    `unknowns` move it, `covariance` is of all unknowns, and `shift` how the hand's keypoint moves by each of
    its numbers [m].
    """
    total, cross = 0.0, np.empty(3)
    for one in range(_CHAIN):
        cross[:] = 0.0
        for number in range(_OWN + 1):
            for i in range(3):
                cross[i] -= 2.0 * answers[number, one] * shift[number, i]
        for other in range(one + 1):
            share = (1.0 if one == other else 2.0) * covariance[unknowns[one], unknowns[other]]
            for i in range(3):
                cross[i] += share * jacobian[other, i]
        for i in range(3):
            total += jacobian[one, i] * cross[i]
    for number in range(_OWN + 1):
        for i in range(3):
            total += shift[number, i] ** 2
    return total


@kernel
def _answer(
    errors: _PoseErrors, digit: int, unknowns: Int[np.ndarray, "10"], answers: Float[np.ndarray, "11 10"]
) -> None:
    """Fill how the fit of some unknowns answers to a digit's own numbers, and to the size (last)."""
    answers[:] = 0.0
    for one in range(_CHAIN):
        for inner in range(_CHAIN):
            column = unknowns[inner]
            share = errors.posterior[unknowns[one], column]
            for number in range(_OWN):
                answers[number, one] += share * errors.own[digit, number, column]
        for column in range(NUM_UNKNOWNS):
            answers[_OWN, one] += errors.posterior[unknowns[one], column] * errors.whole[column]


@kernel
def _move_keypoint(
    digit: int, part: int, point: Float[np.ndarray, "3"], work: Workspace, jacobian: Float[np.ndarray, "10 3"]
) -> None:
    """Fill the derivatives of a digit's keypoint by its hinges and by the wrist's rotation and translation.

    Parts are its joints, 0 to 2, and its tip, 3, in ascending order, since further hinges are left as they
    are.
    """
    for hinge in range(part + 1 if part > 0 else 0):
        origin, axis = work.origins[1 + 3 * digit + max(0, hinge - 1)], work.axes[4 * digit + hinge]
        p, q, r = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
        jacobian[hinge, 0] = axis[1] * r - axis[2] * q
        jacobian[hinge, 1] = axis[2] * p - axis[0] * r
        jacobian[hinge, 2] = axis[0] * q - axis[1] * p
    jacobian[7, 1], jacobian[7, 2] = -point[2], point[1]
    jacobian[8, 0], jacobian[8, 2] = point[2], -point[0]
    jacobian[9, 0], jacobian[9, 1] = -point[1], point[0]
