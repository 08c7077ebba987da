"""Uncertainty of poses: covariances of joint angles, predicted markers and keypoints.

- Before its markers are used, a hand has a prior: a joint normal distribution of all 20 joint angles. They
  follow an Ornstein-Uhlenbeck process whose stationary distribution is that of people's gestures: an unseen
  joint returns to it, in mean and covariance. Neighboring fingers bend together, so the covariance carries
  information from visible digits to hidden ones.
- The neighbors of a missing marker may determine its position well, or leave it free along the arc of one
  joint. Its covariance follows from the normal matrix of the fit and the prior of the joint angles.
- Standard deviations of joint angles and keypoints come from a linear normal model around the pose. Each
  marker is seen with noise, and tells less the longer it is hidden. The hand model differs from the user's
  hand in the same error in every frame, so that averaging does not help: in its size, marker places, origins
  and directions of digits, and bone lengths. Flesh moves markers slowly, so that averaging over successive
  frames does not help, either. Nor does the palm follow the model, which takes the flexion of the metacarpals
  of ring and little finger for that of their MCP joints.
"""

from __future__ import annotations

from functools import cache
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

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

# The time constant is short, so that a digit with one marker recovers from a wrong, unusual pose.
_JOINT_MEMORY: Final = 0.3  # [s] time constant of the process of joint angles
_JOINT_SPREAD: Final = float(np.deg2rad(0.5))  # [rad] least standard deviation of a predicted angle
_GESTURE_MARGIN: Final = float(np.deg2rad(6.0))  # [rad] standard deviation of other poses from the gestures
_STILL_RATIO: Final = 0.25  # A still joint varies by less than this share of its usual standard deviation.
# [rad] standard deviation of a still joint's angle among people
_STILL_ANGLE_SPREAD: Final = float(np.deg2rad(40.0))
_STILL_SHARE: Final = 0.5  # A joint counts as still above this share of `_STILL_ANGLE_SPREAD`.
_ARC_RADIUS: Final = 0.04  # [m] usual radius of the arcs of markers: the length of a finger's bones
_LEAST_INFORMATION: Final = 1e-9  # share of a marker's precision, added for an inverse
_DRIFT: Final = 0.014  # [m/sqrt(s)] random walk of a hidden marker
_WRIST_PRECISION: Final = 0.01  # [1/m^2, 1/rad^2] prior precision of the wrist
_LEAST_NOISE: Final = 0.0001  # [m] lower bound of a marker's noise
_LEAST_FREEDOM: Final = 3  # least number of marker coordinates beyond those that a pose needs
SOURCES: Final = ("noise and gaps", "gluing", "flesh", "person", "palm")
"""Sources of an angle's uncertainty: noisy or unseen markers, where markers are glued, how flesh moves them
over the bones, the person (sizes and directions of bones, gestures unlike other people's), and the arch of
the palm, which a model knows in part at most."""
Measure = Literal["frame", "mean", "peak", "range"]
"""Figure of an angle that sessions compare: its value in a frame, its mean in a take, its peak (5th or 95th
percentile), or its range of motion between these percentiles."""
_ARCH_RATIOS: Final = {"ring": 0.13, "little": 0.32}
"""Flexion of the metacarpal over that of its finger, from the flat hand: root mean square of nine recorded
grasps of four people (benchmarks/palm.py). Both are large in the same people."""
# [rad] largest flexion in these grasps; the arch stops growing there
_MOST_FLEXION: Final = float(np.deg2rad(50.0))
_METACARPAL_LENGTH: Final = 0.054  # [m] from the metacarpal's hinge to the knuckle, as in benchmarks/palm.py
CHANGING: Final[dict[Measure, tuple[float, ...]]] = {
    "frame": (0.0, 0.0, 1.39, 0.25, 0.3),
    "mean": (0.0, 0.0, 0.73, 0.22, 0.25),
    "peak": (0.0, 0.0, 1.56, 0.27, 0.5),
    "range": (0.0, 0.0, 2.01, 0.31, 0.5),
}
"""Factors of the `SOURCES` of an uncalibrated hand's error that change between sessions of a person. The rest
of the error repeats: it comes from the wrong shape, and from people's usual gestures, towards which the prior
pulls each session alike. The factor of flesh includes glued places, most of whose effect a fit absorbs. The
factors were fitted to two sessions of each of 64 simulated people, half in dense19 and half in sparse13
(benchmarks/sessions.py). Those of the palm are the standard deviation between a person's grasps over
`_ARCH_RATIOS` (0.3), times the ratio of the measure to the RMS of usual flexion (0.83, 1.7, 1.7)."""
DETECTABLE: Final = 1.96 * float(np.sqrt(2.0))
"""Ratio of the minimal detectable difference of two sessions to the standard error of measurement."""
# numbers per digit: position of its knuckle, its direction, lengths of its bones (3 each)
_DIGIT_NUMBERS: Final = 9
SKELETON_NUMBERS: Final = len(DIGITS) * _DIGIT_NUMBERS + 1
"""How many numbers describe a skeleton: those of its digits, and its size."""
NOT_SMOOTHED: Final = np.empty((0, NUM_UNKNOWNS, NUM_UNKNOWNS))
"""No covariances, for poses that were fitted frame by frame."""
MEDIAN_SQUARE: Final = 2.366
"""Median of the squared length of a standard normal vector in space."""


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
    covariances: Float[np.ndarray, "M 3 3"]  # covariance of each marker in the world [m^2], its own included
    rotations: Float[np.ndarray, "M 3 3"]  # rotation in the world of each marker's main bone
    joint_covariance: Float[np.ndarray, "20 20"]  # covariance of the joint angles [rad^2]
    information_matrix: Float[np.ndarray, "20 20"]  # of the markers alone on angles, palm fixed [1/rad^2]
    information_vector: Float[np.ndarray, "20"]  # the matrix times the angles by the markers alone [1/rad]


class HandErrors(NamedTuple):
    """C independent errors of a hand model against its user's hand, each of one standard deviation."""

    numbers: Float[np.ndarray, "46 C"]
    """By digit: its knuckle [m], its rotation about the palm's axes [rad], log lengths of its bones; log
    size."""
    markers: Float[np.ndarray, "M 3 C"]
    """Shift of each marker in the frame of its main bone [m], beyond its motion with the bones."""


class HandDoubt(NamedTuple):
    """Standard deviations of the difference between a hand model and its user's hand."""

    noise: float  # of a marker around its place, independent in each frame [m]
    errors: HandErrors  # equal in all frames
    places: Float[np.ndarray, "M 2"]  # of each marker on its bone: along the skin (each way), off it [m]
    arch: Float[np.ndarray, "46 1"]  # arch of the palm as an error of the numbers, per flexion of each finger
    flesh: float = 0.0  # of a marker around its place, equal in successive frames [m]


class _Proportions(NamedTuple):
    """Standard deviations of the difference between an uncalibrated hand model and its user's hand."""

    size: float  # log size
    place: tuple[float, float]  # marker place along the skin, off it [m]
    knuckle: float  # knuckle position [m]
    direction_deg: float  # direction of a finger [deg]
    thumb: float  # factor for the thumb's direction
    bones: tuple[float, float]  # log lengths: each bone, all of a digit


# These were chosen on simulated people other than those of docs/tracking.md. They are smaller than the
# differences between people, because the fit of proportions absorbs a part.
_MEASURED_PROPORTIONS: Final = _Proportions(0.001, (0.0014, 0.0005), 0.0003, 1.8, 4.0, (0.01, 0.02))
# For the nearest of five sizes they are the differences between people, and half a step between sizes. Marker
# places include slips, and shifts by wrong girths and bone lengths.
_NAMED_PROPORTIONS: Final = _Proportions(
    0.02, (0.003, 0.003), ADULTS.knuckle_spread, ADULTS.angle_spread, 3.0,
    (ADULTS.bone_spread, ADULTS.digit_spread),
)  # fmt: skip


@cache
def resting_prior() -> JointPrior:
    """Prior of a hand without any history: mean and covariance over all gestures."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    covariance = np.cov(gestures.T) + _GESTURE_MARGIN**2 * np.eye(NUM_JOINTS)
    return JointPrior(gestures.mean(axis=0), covariance, np.linalg.inv(covariance))


def usual_angle_variances(angles: Float[np.ndarray, "F 20"]) -> Float[np.ndarray, "20"]:
    """Variances of a person's usual angles around people's [rad^2], given the angles of a capture.

    A joint that does not move in the capture may never move. Its one angle may then be far from the gestures
    of other people, however many frames repeat it.
    """
    moved = angles.std(axis=0) / (_STILL_RATIO * resting_prior().spread)
    return np.asarray((_STILL_ANGLE_SPREAD / (1.0 + moved**4)) ** 2)


def are_still(angles: Float[np.ndarray, "F 20"]) -> Bool[np.ndarray, "20"]:
    """Whether each joint hardly moves in a capture, so that the prior knows nothing of its usual angle."""
    return np.asarray(usual_angle_variances(angles) > (_STILL_SHARE * _STILL_ANGLE_SPREAD) ** 2)


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
    for hinge in range(count):  # The digit's joints come last, so that the others can be eliminated first.
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
    positions, covariances, rotations = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3, 3))
    joints, matrix = np.empty((NUM_JOINTS, NUM_JOINTS)), np.empty((NUM_JOINTS, NUM_JOINTS))
    vector = np.empty(NUM_JOINTS)
    out = MarkerPrediction(pose.copy(), positions, covariances, rotations, joints, matrix, vector)
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
    """Write the covariance of a marker in the world [m^2]: that of the pose, and its own variance."""
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
    # A marker moves on an arc. Motion along the tangent deviates across it by its square over twice the
    # radius.
    bend = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / (2.0 * _ARC_RADIUS)
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
    """Move the joints of digits with missing markers to the optimum of prior and markers; fix all others."""
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
    numbers, places = np.zeros((SKELETON_NUMBERS, 1)), np.zeros((len(digits), 2))
    return HandDoubt(noise, _with_fixed_markers(digits, numbers), places, numbers)


def hand_doubt(digits: Int[np.ndarray, "M"], origin: HandOrigin) -> HandDoubt:
    """`HandDoubt` of an uncalibrated hand, for people and gloves like the simulated ones."""
    known, count = _NAMED_PROPORTIONS if origin == "named" else _MEASURED_PROPORTIONS, len(DIGITS)
    turns = np.deg2rad(known.direction_deg) * np.repeat([known.thumb, 1.0], [1, count - 1])
    each, all_bones = known.bones
    own = [np.repeat([known.knuckle, turn, each], 3) for turn in turns]
    numbers = np.zeros((SKELETON_NUMBERS, SKELETON_NUMBERS + count))
    np.fill_diagonal(numbers, [*np.ravel(own), known.size])
    numbers[:-1, SKELETON_NUMBERS:] = np.kron(np.eye(count), np.repeat([[0.0], [all_bones]], [6, 3], axis=0))
    return known_hand(digits, MARKER_NOISE)._replace(
        errors=_with_fixed_markers(digits, numbers), places=np.tile(known.place, (len(digits), 1))
    )


def _usual_arch() -> Float[np.ndarray, "46 1"]:
    """The `HandDoubt.arch` of people: metacarpals that rotate about the palm's y axis, each at its hinge.

    Hands whose shape has an arch get it, too. With half of it 81 % of the little finger's errors in the
    grasps were within two standard deviations, instead of 94 %.
    """
    numbers = np.zeros((SKELETON_NUMBERS, 1))
    for digit, share in _ARCH_RATIOS.items():
        first = _DIGIT_NUMBERS * DIGITS.index(digit)
        numbers[[first + 2, first + 4], 0] = -_METACARPAL_LENGTH * share, share
    return numbers


def errors_of_motions(
    fit: GloveFit, numbers: Float[np.ndarray, "46 C"], motions: Float[np.ndarray, "M 3 C"]
) -> HandErrors:
    """Errors of a hand that move the markers of the flat hand by `motions` in the wrist's frame [m]."""
    hand, work = hand_arrays(fit), workspace(len(motions))
    compute_markers(hand, np.zeros(NUM_JOINTS), work)
    moved = np.empty((3 * len(motions), numbers.shape[1]))
    _write_point_motions(hand, numbers, work, moved)
    turns = work.rotations[hand.bones[:, 0]].swapaxes(1, 2)
    return HandErrors(numbers, np.ascontiguousarray(turns @ (motions - moved.reshape(motions.shape))))


def _with_fixed_markers(digits: Int[np.ndarray, "M"], numbers: Float[np.ndarray, "46 C"]) -> HandErrors:
    """Errors of a skeleton whose markers keep their places on the bones."""
    return HandErrors(numbers, np.zeros((len(digits), 3, numbers.shape[1])))


class SpreadModel:
    """Standard deviations of the poses of one hand.

    They follow from the errors that its calibration left; if these are unknown, from the hand's origin.
    """

    def __init__(self, fit: GloveFit, origin: HandOrigin, errors: HandErrors | None = None) -> None:
        self._hand, self.is_calibrated = with_keypoints(fit), errors is not None
        digits = hand_arrays(fit).digits
        self._doubt = hand_doubt(digits, origin)
        if errors is not None:
            self._doubt = known_hand(digits, MARKER_NOISE)._replace(errors=errors)
        self._doubt = self._doubt._replace(arch=_usual_arch())

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
        factor = freedom_factor(unseen.shape[1])
        noise = max(rms * factor, _LEAST_NOISE) if rms > 0.0 else MARKER_NOISE
        variances, keypoints = self.variances(qpos, unseen, noise)
        return np.sqrt(variances[:, :NUM_JOINTS].sum(axis=-1)), keypoints

    def variances(
        self,
        qpos: Float[np.ndarray, "T 27"],
        unseen: Float[np.ndarray, "T M"],
        noise: float,
        flesh: float = 0.0,
        places: Float[np.ndarray, "M 2"] | float = 0.0,
        smoothed: Float[np.ndarray, "S 26 26"] = NOT_SMOOTHED,
        prior: Float[np.ndarray, "20 20"] | None = None,
    ) -> tuple[Float[np.ndarray, "T 26 5"], Float[np.ndarray, "T 21"]]:
        """Variances of all unknowns by `SOURCES` [rad^2, m^2], and standard deviations of keypoints [m].

        Callers with smoothed poses pass the motion of flesh and the RMS errors of marker places, along the
        skin and off it [m], the covariances of the unknowns from noise and gaps, and the prior's precision in
        a frame.
        """
        doubt = self._doubt._replace(flesh=flesh, places=np.maximum(self._doubt.places, places))
        if self.is_calibrated:
            doubt = doubt._replace(noise=noise)
        prior = resting_prior().precision if prior is None else prior
        return pose_spreads(self._hand, prior, doubt, qpos, unseen, smoothed)


def measurement_error(
    budget: Float[np.ndarray, "*J 5"], origin: HandOrigin, measure: Measure = "frame"
) -> Float[np.ndarray, "*J"]:
    """Standard error of measurement between sessions of a person, in the unit of deviations by `SOURCES`.

    The glove is put on again for each session, and a calibrated hand is calibrated again, so that all parts
    of its error except the palm's change. The other measures keep their ratio to that of a frame.
    """
    fitted, palm = budget[..., :-1], CHANGING[measure][-1] * budget[..., -1]
    changing = np.linalg.norm(np.array(CHANGING[measure][:-1]) * fitted, axis=-1)
    if origin == "calibrated":
        frame = np.linalg.norm(np.array(CHANGING["frame"][:-1]) * fitted, axis=-1)
        changing *= np.linalg.norm(fitted, axis=-1) / frame
    return np.asarray(np.hypot(changing, palm))


def freedom_factor(num_markers: int) -> float:
    """Ratio of the noise of marker coordinates to the RMS distance from a fitted pose."""
    return float(np.sqrt(num_markers / max(3 * num_markers - NUM_UNKNOWNS, _LEAST_FREEDOM)))


def with_keypoints(fit: GloveFit) -> HandArrays:
    """Arrays of a hand with its keypoints as additional markers, each on the bone that ends there."""
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
) -> tuple[Float[np.ndarray, "T 26 5"], Float[np.ndarray, "T 21"]]:
    """Variance of each unknown by `SOURCES` ([rad^2] or [m^2]), and standard deviation of each keypoint [m].

    The unknowns are the joint angles, then position and rotation of the wrist along its own axes. `hand`
    comes from `with_keypoints`. A misplaced marker moves the fit as noise does. Errors of the hand and the
    arch of its palm move the markers, hence the fit, and they also move the keypoints directly.
    """
    found, keypoints = np.empty((len(qpos), NUM_UNKNOWNS, 5)), np.empty((len(qpos), NUM_KEYPOINTS))
    count, work, weights = unseen.shape[1], workspace(len(hand.digits)), np.zeros(len(hand.digits))
    num_errors, posterior = doubt.errors.numbers.shape[1], np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS))
    moved, shifted = np.empty((3 * len(weights), num_errors)), np.empty((3 * count, num_errors))
    arched, arch = np.empty((3 * len(weights), 1)), np.zeros_like(doubt.arch)
    weighted, jacobian = np.empty((3 * count, NUM_UNKNOWNS)), work.jacobian.reshape(-1, NUM_UNKNOWNS)
    work.residuals[:] = 0.0
    for frame in range(len(qpos)):
        for marker in range(count):
            weights[marker] = 1.0 / (doubt.noise**2 + _DRIFT**2 * unseen[frame, marker])
        compute_markers(hand, qpos[frame, 7:], work)
        accumulate_normal_equations(hand, weights, work)
        for row in range(NUM_UNKNOWNS):
            for column in range(row + 1):
                posterior[row, column] = work.normal[column, row]
            posterior[row, row] += _WRIST_PRECISION if row >= NUM_JOINTS else 0.0
        posterior[:NUM_JOINTS, :NUM_JOINTS] += prior
        invert_positive(posterior)
        _write_point_motions(hand, doubt.errors.numbers, work, moved)
        _write_marker_shifts(hand, doubt.errors.markers, work, shifted)
        for number in range(SKELETON_NUMBERS - 1):
            flexion = qpos[frame, 8 + 4 * (number // _DIGIT_NUMBERS)]
            flexion = min(max(flexion, -_MOST_FLEXION), _MOST_FLEXION)
            arch[number] = doubt.arch[number] * flexion
        _write_point_motions(hand, arch, work, arched)
        for row in range(3 * count):
            for unknown in range(NUM_UNKNOWNS):
                weighted[row, unknown] = weights[row // 3] * jacobian[row, unknown]
        off = weighted @ posterior
        by_bones, by_places = off.T @ moved[: 3 * count], off.T @ shifted
        by_arch = off.T @ arched[: 3 * count]
        noise, answers = smoothed[frame] if len(smoothed) > 0 else posterior, by_bones + by_places
        _write_variances(hand, doubt, work, noise, by_bones, by_places, off, found[frame])
        spread = jacobian[3 * count :] @ (noise + off.T @ off)
        for unknown in range(NUM_UNKNOWNS):
            # Only arched digits have this error: others move half as far in simulated arches, and not at all
            # in recorded grasps.
            arches = unknown < NUM_JOINTS and doubt.arch[_DIGIT_NUMBERS * (unknown // 4) + 4, 0] != 0.0
            found[frame, unknown, 4] = by_arch[unknown, 0] ** 2 if arches else 0.0
        left = moved[3 * count :] - jacobian[3 * count :] @ answers
        bent = arched[3 * count :] - jacobian[3 * count :] @ by_arch
        for keypoint in range(NUM_KEYPOINTS):
            total = 0.0
            for row in range(3 * keypoint, 3 * keypoint + 3):
                for unknown in range(NUM_UNKNOWNS):
                    total += spread[row, unknown] * jacobian[3 * count + row, unknown]
                for error in range(num_errors):
                    total += left[row, error] ** 2
                total += bent[row, 0] ** 2
            keypoints[frame, keypoint] = np.sqrt(max(total, 0.0) / 3.0)
    return found, keypoints


@kernel
def _write_variances(
    hand: HandArrays,
    doubt: HandDoubt,
    work: Workspace,
    noise: Float[np.ndarray, "26 26"],
    by_bones: Float[np.ndarray, "26 C"],
    by_places: Float[np.ndarray, "26 C"],
    off: Float[np.ndarray, "R 26"],
    variances: Float[np.ndarray, "26 5"],
) -> None:
    """Write the variances of unknowns [rad^2, m^2]; scale `off` from derivatives to standard deviations."""
    # A slipped marker keeps its height over the bone, and that height determines most of the bone's flexion.
    # Errors of bones and places are correlated, so their variance is divided in proportion to the separate
    # ones.
    variances[:] = 0.0
    for unknown in range(NUM_UNKNOWNS):
        bones, places, both = 0.0, 0.0, 0.0
        for error in range(by_bones.shape[1]):
            bone, place = by_bones[unknown, error], by_places[unknown, error]
            bones, places, both = bones + bone**2, places + place**2, both + (bone + place) ** 2
        both /= max(bones + places, 1e-30)
        variances[unknown, 0] = noise[unknown, unknown]
        variances[unknown, 1], variances[unknown, 3] = both * places, both * bones
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
            variances[unknown, 1] += along * (square - lift**2) + above * lift**2
            variances[unknown, 2] += flesh * square
            for i in range(3):
                rows[i, unknown] = wide * rows[i, unknown] + (high - wide) * lift * normal[i]


@kernel
def _write_marker_shifts(
    hand: HandArrays, shifts: Float[np.ndarray, "M 3 C"], work: Workspace, shifted: Float[np.ndarray, "R C"]
) -> None:
    """Write the shifts of markers in the wrist's frame [m]."""
    shifted[:] = 0.0
    for marker in range(len(shifts)):
        bone = work.rotations[hand.bones[marker, 0]]
        _add_product(bone, shifts[marker], shifted[3 * marker : 3 * marker + 3])


@kernel
def _write_point_motions(
    hand: HandArrays, numbers: Float[np.ndarray, "46 C"], work: Workspace, moved: Float[np.ndarray, "R C"]
) -> None:
    """Write the motion of points with the bones by each error of a skeleton's numbers [m]."""
    num_errors, lever, own = numbers.shape[1], np.empty(3), np.empty((3, _DIGIT_NUMBERS))
    for point in range(len(moved) // 3):
        for i in range(3):
            for error in range(num_errors):
                moved[3 * point + i, error] = work.markers[point, i] * numbers[SKELETON_NUMBERS - 1, error]
        for digit in range(hand.hinge_span[point, 0] // 4, hand.hinge_span[point, 1] // 4):
            share, lever[:], own[:] = 0.0, 0.0, 0.0
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
                    own[i, 6 + link] = reach * work.rotations[bone, i, 0]
            for i in range(3):
                lever[i] -= share * work.origins[1 + 3 * digit, i]
                own[i, i] = share
            own[1, 3], own[2, 3] = -lever[2], lever[1]
            own[0, 4], own[2, 4] = lever[2], -lever[0]
            own[0, 5], own[1, 5] = -lever[1], lever[0]
            first = _DIGIT_NUMBERS * digit
            _add_product(own, numbers[first : first + _DIGIT_NUMBERS], moved[3 * point : 3 * point + 3])


@kernel
def _add_product(
    left: Float[np.ndarray, "3 N"], right: Float[np.ndarray, "N C"], total: Float[np.ndarray, "3 C"]
) -> None:
    """Add the product of two matrices, of which the left is mostly zero."""
    for row in range(3):
        for number in range(len(right)):
            if left[row, number] != 0.0:
                for error in range(right.shape[1]):
                    total[row, error] += left[row, number] * right[number, error]
