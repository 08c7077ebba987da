"""Hypotheses of a digit: every assignment of a few candidate points to its markers, fitted and scored.

With the palm known, a digit has four joint angles, and three markers on it leave five of nine coordinates as
a test. So the points near a digit can be labeled by trying all assignments. The score of a hypothesis is its
log-odds against all points being strays. It sums up the distances of the points from the fitted markers, the
prior of the joint angles, the Laplace approximation of their uncertainty, and the evidence of IDs and of
the labeler's reviews.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.model import join_qpos
from handsim.kernels import kernel, point_distance, write_quaternion_matrix
from track.kinematics.marker_kinematics import (
    LIMIT_PRECISION,
    HandArrays,
    Workspace,
    compute_digit,
    compute_marker,
    compute_markers,
    eliminate,
    marker_jacobian,
    solve_positive,
    workspace,
)
from track.kinematics.pose_spread import JointPrior, MarkerPrediction, digit_prior

EXCLUDED_SCORE: Final = -1e9  # score of an excluded hypothesis
_ANGLES_PER_HINGE: Final = 5  # grid of each joint angle for the ranges of distances
_LENGTH_TOLERANCE: Final = 0.003  # [m] tolerance of distances between two markers of a digit
_PRUNING_MARGIN: Final = 7.0  # A hypothesis with an upper bound this far behind another is not fitted.
_START_DISTANCE: Final = float(np.deg2rad(5.0))  # Two starts closer than this in every angle are one.
_MOST_FIT_STEPS: Final = 10  # most Levenberg-Marquardt steps; a digit needs about four
_SMALL_GAIN: Final = 0.01  # least gain of a step (half squared standard deviations)
_ROBUST_SQUARE: Final = 20.0  # scale of the prior's robust loss, in squared standard deviations


class DigitRanges(NamedTuple):
    """Range of the distance between two markers of a digit over all poses."""

    nearest: Float[np.ndarray, "M M"]  # least distance [m]
    farthest: Float[np.ndarray, "M M"]  # largest distance [m]


class DigitModel(NamedTuple):
    """Model of a hand, against which a digit's candidates are tested."""

    joint_prior: JointPrior  # prior of the hand's joint angles before this frame
    predicted: MarkerPrediction  # the hand fitted to the labels so far
    variance: Float[np.ndarray, "M"]  # variance of each marker around its position [m^2]
    peak_log_odds: Float[np.ndarray, "M"]  # log-odds of a point exactly at the predicted marker
    slack: Float[np.ndarray, "M"]  # possible offset of each marker from its design, beyond `ranges` [m]
    ranges: DigitRanges  # distances between markers of a digit over all poses


class DigitHypotheses(NamedTuple):
    """The best assignment of every subset of a digit's candidates, one row per subset (bits)."""

    scores: Float[np.ndarray, "*D S"]  # log-odds against strays alone; `EXCLUDED_SCORE` if excluded
    runners_up: Float[np.ndarray, "*D S"]  # score of the second best assignment
    assignments: Int[np.ndarray, "*D S K"]  # candidate of each of the digit's markers, -1 for none


class DigitPoints(NamedTuple):
    """A digit, its candidate points and its prior."""

    hand: HandArrays  # the hand, its markers shifted by their biases
    digit: int  # index of the digit
    markers: Int[np.ndarray, "K"]  # markers of the digit
    points: Float[np.ndarray, "C 3"]  # the candidates in the wrist's frame [m]
    variance: Float[np.ndarray, "M"]  # variance of each marker of the hand [m^2]
    mean: Float[np.ndarray, "4"]  # mean of the digit's prior [rad]
    precision: Float[np.ndarray, "4 4"]  # its precision [1/rad^2]


def digit_ranges(hand: GloveFit) -> DigitRanges:
    """Ranges of the distances between a hand's markers over a grid of joint angles, equal for all digits."""
    shares = np.indices((_ANGLES_PER_HINGE,) * 4).reshape(4, -1).T / (_ANGLES_PER_HINGE - 1)
    low, high = hand.model.skeleton.ranges.T
    markers, _ = hand.markers(join_qpos(low + np.tile(shares, 5) * (high - low)))
    x, y, z = np.ascontiguousarray(markers.T)  # Poses last is six times as fast.
    squares = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 + (z[:, None] - z) ** 2
    return DigitRanges(np.sqrt(squares.min(axis=-1)), np.sqrt(squares.max(axis=-1)))


def empty_hypotheses(num_digits: int, num_candidates: int, num_markers: int) -> DigitHypotheses:
    """Buffers of `DigitHypotheses`, for at most this number of candidates and markers per digit."""
    sets = num_digits, 1 << num_candidates
    return DigitHypotheses(
        np.full(sets, EXCLUDED_SCORE), np.full(sets, EXCLUDED_SCORE), np.full((*sets, num_markers), -1)
    )


@kernel
def evaluate_digit(
    hand: HandArrays,
    model: DigitModel,
    digit: int,
    markers: Int[np.ndarray, "K"],
    points: Float[np.ndarray, "N 3"],
    candidates: Int[np.ndarray, "C"],
    log_odds: Float[np.ndarray, "N M"],
    found: DigitHypotheses,
) -> None:
    """Evaluate all assignments of points to a digit's markers; `log_odds` are those apart from the fit."""
    pose, wrist = model.predicted.qpos, np.empty((3, 3))
    write_quaternion_matrix(wrist, pose[3], pose[4], pose[5], pose[6])
    local, label_log_odds = np.zeros((len(candidates), 3)), np.empty((len(candidates), len(markers)))
    for number, point in enumerate(candidates):
        for i in range(3):
            for j in range(3):
                local[number, i] += (points[point, j] - pose[j]) * wrist[j, i]
        for slot, marker in enumerate(markers):
            label_log_odds[number, slot] = log_odds[point, marker]
    mean, precision = np.empty(4), np.empty((4, 4))
    digit_prior(model.joint_prior, model.predicted, digit, mean, precision)
    own = DigitPoints(hand, digit, markers, local, model.variance, mean, precision)
    _fit_hypotheses(own, model, label_log_odds, found)


@kernel
def _fit_hypotheses(
    own: DigitPoints, model: DigitModel, label_log_odds: Float[np.ndarray, "C K"], found: DigitHypotheses
) -> None:
    """Fit the hypotheses that may be the best for their points, those with the fewest labels first."""
    scores, runners_up, assignments = found
    count, choices, angles_before = len(own.markers), len(own.points) + 1, model.predicted.qpos[7:]
    work = workspace(len(own.hand.digits))
    compute_markers(own.hand, angles_before, work)
    hypothesis, angles = np.full(count, -1), np.empty(4)
    current = angles_before[4 * own.digit : 4 * own.digit + 4]
    starts = 2 if np.abs(own.mean - current).max() > _START_DISTANCE else 1
    total = choices**count
    costs, poses = np.zeros(total), np.empty((total, 4))
    subset_scores = np.full(len(scores), EXCLUDED_SCORE)
    poses[0] = own.mean
    for number in range(total):
        points_used = _decode(number, choices, hypothesis)
        subset = _costliest_subset(number, choices, hypothesis, costs)
        costs[number], poses[number] = costs[subset], poses[subset]
        if number > 0 and costs[subset] >= -EXCLUDED_SCORE:
            continue
        bound = _upper_bound(own, model, label_log_odds, hypothesis)
        if bound <= EXCLUDED_SCORE:
            costs[number] = -EXCLUDED_SCORE
            continue
        subset_score = _best_subset_score(points_used, scores, subset_scores)
        least = max(scores[points_used], subset_score) - _PRUNING_MARGIN
        cutoff = bound - max(runners_up[points_used], least)
        if costs[subset] >= cutoff:
            continue
        score = EXCLUDED_SCORE
        for start in range(starts):
            angles[:] = poses[subset] if start == 0 else current
            cost, complexity = fit_hypothesis(own, hypothesis, cutoff, angles, work)
            if bound - cost - complexity > score:
                score = bound - cost - complexity
                costs[number], poses[number] = cost, angles
        if score > scores[points_used]:
            runners_up[points_used], scores[points_used] = scores[points_used], score
            assignments[points_used, :count] = hypothesis
        elif score > runners_up[points_used]:
            runners_up[points_used] = score


@kernel
def _decode(number: int, choices: int, hypothesis: Int[np.ndarray, "K"]) -> int:
    """Write the hypothesis of a number; return the points that it uses as bits."""
    points_used = 0
    for slot in range(len(hypothesis)):
        hypothesis[slot] = number % choices - 1
        number //= choices
        if hypothesis[slot] >= 0:
            points_used |= 1 << hypothesis[slot]
    return points_used


@kernel
def _costliest_subset(
    number: int, choices: int, hypothesis: Int[np.ndarray, "K"], costs: Float[np.ndarray, "H"]
) -> int:
    """Number of the costliest hypothesis with one label less, whose cost is a lower bound of this one's."""
    costliest, radix = 0, 1
    for slot in range(len(hypothesis)):
        part = number - (hypothesis[slot] + 1) * radix
        radix *= choices
        if hypothesis[slot] >= 0 and costs[part] >= costs[costliest]:
            costliest = part
    return costliest


@kernel
def _best_subset_score(
    points_used: int, scores: Float[np.ndarray, "S"], subset_scores: Float[np.ndarray, "S"]
) -> float:
    """Best score so far of a proper subset of some points, stored in `subset_scores` for larger sets."""
    bit = 1
    while bit <= points_used:
        if points_used & bit:
            part = points_used ^ bit
            subset_scores[points_used] = max(subset_scores[points_used], scores[part], subset_scores[part])
        bit <<= 1
    return subset_scores[points_used]  # type: ignore[no-any-return]


@kernel
def _upper_bound(
    own: DigitPoints,
    model: DigitModel,
    label_log_odds: Float[np.ndarray, "C K"],
    hypothesis: Int[np.ndarray, "K"],
) -> float:
    """Score of a hypothesis with every point at its marker; `EXCLUDED_SCORE` if the distances exclude it."""
    ranges, slack, total = model.ranges, model.slack, 0.0
    for slot in range(len(own.markers)):
        point, one = hypothesis[slot], own.markers[slot]
        if point < 0:
            continue
        total += model.peak_log_odds[one] + label_log_odds[point, slot]
        for other in range(slot):
            if hypothesis[other] < 0:
                continue
            if hypothesis[other] == point:
                return EXCLUDED_SCORE
            distance = point_distance(own.points[point], own.points[hypothesis[other]])
            two = own.markers[other]
            tolerance = _LENGTH_TOLERANCE + slack[one] + slack[two]
            low, high = ranges.nearest[one, two] - tolerance, ranges.farthest[one, two] + tolerance
            if distance < low or distance > high:
                return EXCLUDED_SCORE
    return total


@kernel
def fit_hypothesis(
    own: DigitPoints,
    hypothesis: Int[np.ndarray, "K"],
    cutoff: float,
    angles: Float[np.ndarray, "4"],
    work: Workspace,
) -> tuple[float, float]:
    """Fit the four joint angles of a digit [rad] to a hypothesis; return cost and complexity.

    Complexity is half the log ratio of the angles' precision after and before (Laplace's approximation): a
    hypothesis that any pose fits is weak evidence. A cost beyond `cutoff` ends the fit early.
    """
    trial, factor, step = angles.copy(), np.empty((4, 4)), np.empty(4)
    normal, gradient = np.empty((4, 4)), np.empty(4)
    new_normal, new_gradient = np.empty((4, 4)), np.empty(4)
    cost = _accumulate_digit(own, hypothesis, angles, work, normal, gradient)
    damping = 1e-3
    for _ in range(_MOST_FIT_STEPS):
        for row in range(4):
            step[row] = -gradient[row]
            for column in range(4):
                factor[row, column] = normal[row, column]
            factor[row, row] *= 1.0 + damping
        solve_positive(factor, step)
        gain = 0.0
        for row in range(4):
            gain -= gradient[row] * step[row]
            trial[row] = angles[row] + step[row]
        if gain < _SMALL_GAIN:
            break
        if cost - 2.0 * gain > cutoff:
            cost -= 2.0 * gain
            break
        tried = _accumulate_digit(own, hypothesis, trial, work, new_normal, new_gradient)
        if tried < cost:
            small = cost - tried < _SMALL_GAIN
            cost = tried
            angles[:] = trial
            normal[:] = new_normal
            gradient[:] = new_gradient
            damping = max(damping * 0.1, 1e-9)
            if small:
                break
        else:
            damping *= 30.0
            if damping > 1e5:
                break
    return cost, 0.5 * (_log_determinant(normal) - _log_determinant(own.precision))


@kernel
def _accumulate_digit(
    own: DigitPoints,
    hypothesis: Int[np.ndarray, "K"],
    angles: Float[np.ndarray, "4"],
    work: Workspace,
    normal: Float[np.ndarray, "4 4"],
    gradient: Float[np.ndarray, "4"],
) -> float:
    """Cost of a hypothesis at some angles [rad]; writes the normal matrix and half the gradient."""
    normal[:] = 0.0
    gradient[:] = 0.0
    hand, mean, precision, cost, first = own.hand, own.mean, own.precision, 0.0, 4 * own.digit
    compute_digit(hand, own.digit, angles, work)
    for slot in range(len(own.markers)):
        if hypothesis[slot] < 0:
            continue
        marker, point = own.markers[slot], own.points[hypothesis[slot]]
        compute_marker(hand, marker, work)
        marker_jacobian(hand, marker, work)
        weight, jacobian, position = 1.0 / own.variance[marker], work.jacobian[marker], work.markers[marker]
        x, y, z = position[0] - point[0], position[1] - point[1], position[2] - point[2]
        cost += 0.5 * weight * (x * x + y * y + z * z)
        for row in range(4):
            a, b, c = jacobian[0, first + row], jacobian[1, first + row], jacobian[2, first + row]
            a, b, c = weight * a, weight * b, weight * c
            gradient[row] += a * x + b * y + c * z
            for column in range(row + 1):
                other = first + column
                normal[row, column] += (
                    a * jacobian[0, other] + b * jacobian[1, other] + c * jacobian[2, other]
                )
    for row in range(4):
        for column in range(row):
            normal[column, row] = normal[row, column]
    square = 0.0
    for row in range(4):
        for column in range(4):
            square += (angles[row] - mean[row]) * precision[row, column] * (angles[column] - mean[column])
    weight_of_prior = 1.0 / (1.0 + square / _ROBUST_SQUARE)
    cost += 0.5 * _ROBUST_SQUARE * np.log(1.0 + square / _ROBUST_SQUARE)
    for row in range(4):
        for column in range(4):
            gradient[row] += weight_of_prior * precision[row, column] * (angles[column] - mean[column])
            normal[row, column] += weight_of_prior * precision[row, column]
        low, high = hand.ranges[first + row, 0], hand.ranges[first + row, 1]
        beyond = max(angles[row] - high, 0.0) + min(angles[row] - low, 0.0)
        if beyond != 0.0:
            cost += 0.5 * LIMIT_PRECISION * beyond * beyond
            gradient[row] += LIMIT_PRECISION * beyond
            normal[row, row] += LIMIT_PRECISION
    return cost  # type: ignore[no-any-return]


@kernel
def _log_determinant(matrix: Float[np.ndarray, "4 4"]) -> float:
    """Log determinant of a positive-definite matrix, by elimination."""
    factor, total = matrix.copy(), 0.0
    eliminate(factor, np.zeros(4), 0, 4)
    for row in range(4):
        total += np.log(factor[row, row])
    return total
