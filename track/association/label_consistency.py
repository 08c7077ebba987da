"""Tests of the labels that IDs carry over: exchange of IDs, gate around the prediction, fit, and review."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from handsim.arrays import Doubles, Flags, Integers
from handsim.hand.shape import DIGITS
from handsim.kernels import kernel, point_distance, squared_distance
from track.association.frame_state import FrameState, peak_log_odds, targets_of
from track.association.hand_state import (
    MOST_AGE_LOG_ODDS,
    SEEN_ELSEWHERE,
    STRAY_LIFETIME,
    HandEstimate,
    HandState,
    HandTrack,
    Prediction,
)
from track.association.initialization import CLOUD_RADIUS, MOST_POINTS
from track.config import TrackerConfig
from track.kinematics.pose_spread import MEDIAN_SQUARE
from train.labelers.protocol import Labeler

# gate of a fitted point, as squared Mahalanobis distance: four standard deviations
_GATE_SQUARE: Final = 16.0
_PREDICTION_SPREAD: Final = 0.004  # [m] least standard deviation of a prediction
_PREDICTION_FACTOR: Final = 2.0  # standard deviation of a prediction over that of the other markers
_MOST_GATED_SHARE: Final = 0.3  # With a larger share outside the gate the prediction is wrong.
ID_EXCHANGE_DISTANCE: Final = 0.04  # [m] IDs of points closer than this may be exchanged.
_EXCHANGE_MARGIN: Final = 8.0  # least log-odds for an exchange, as systems rarely exchange IDs
_EXCHANGE_SPREAD: Final = 0.002  # [m] least standard deviation of the offset between two predicted markers
_EXCHANGE_CONFIDENCE: Final = 0.5
_FIT_SPREAD: Final = 0.0015  # [m] standard deviation of a fitted marker, added to its own
_RESTART_RMS: Final = 0.004  # [m] A worse fit is tried again from general poses instead of the prediction.
_RESTART_STEPS: Final = 8  # steps from each of these poses; the best result is fitted further
# [m] `CLOUD_RADIUS` for missing markers of a digit without labels, which may be bent or straight
_DIGIT_CLOUD_RADIUS: Final = 0.13
_FIRST_REVIEW_WAIT: Final = 0.01  # [s] from a review with changes to the next one
_REVIEW_WAIT_FACTOR: Final = 1.6  # factor of the wait after each review without changes
_DOUBTED_PRESENCE: Final = -2.0  # log probability of a marker that the track saw elsewhere at the same time
_REVIEW_MARGIN: Final = 8.0  # log-odds by which the labeler's labels must be better than those of the track
# A bias is doubted if a point's distance without it is less than this share of that with it.
_DOUBTED_BIAS_SHARE: Final = 0.85
_MOVED_LABEL_LOG_ODDS: Final = 2.0  # log-odds that a point keeps its label
_REPEATED_REVIEW_LOG_ODDS: Final = 1.0  # log-odds gained by each earlier review with the same result
_MOST_ANSWER_LOG_ODDS: Final = 7.0  # bound of the log-odds from the labeler's confidence


def exchange_labels(frame: FrameState, positions: Float[np.ndarray, "K 3"]) -> FrameState:
    """Exchange the labels of two points if that explains both much better, as if IDs were exchanged."""
    # An error of the prediction moves both points alike, so it cancels in the comparison.
    labels = frame.labels.copy()
    points = _exchange_in_place(frame.points, labels, positions)
    if len(points) == 0:
        return frame
    changed = np.zeros(len(labels), dtype=bool)
    changed[points] = True
    confidence = np.full(len(points), _EXCHANGE_CONFIDENCE)
    return frame._replace(labels=labels).with_confidence(changed, confidence)


@kernel
def _exchange_in_place(points: Doubles, labels: Integers, positions: Doubles) -> Integers:
    """Kernel of `exchange_labels`: changes labels in place, returns the points with changed labels."""
    # The gain of exchanging the labels of points p_i and p_j with predicted markers m_i and m_j,
    # (|p_i-m_i|^2 + |p_j-m_j|^2 - |p_i-m_j|^2 - |p_j-m_i|^2) / (2 s^2), is -(p_i-p_j).(m_i-m_j) / s^2.
    # Exchange the pair with the largest gain first, and each point only once.
    labeled = np.flatnonzero(labels >= 0)
    changed = np.empty(len(labeled), dtype=np.int64)
    count = 0
    if len(labeled) < 2:
        return changed[:0]
    seen, markers = points[labeled], positions[labels[labeled]]
    offsets = seen - markers
    middle = np.array([np.median(offsets[:, 0]), np.median(offsets[:, 1]), np.median(offsets[:, 2])])
    squares = ((offsets - middle) ** 2).sum(axis=1)
    variance = max(_EXCHANGE_SPREAD**2, _PREDICTION_FACTOR**2 * np.median(squares) / MEDIAN_SQUARE)
    free = np.ones(len(labeled), dtype=np.bool_)
    while True:
        most, one, other = _EXCHANGE_MARGIN, -1, -1
        for i in range(len(labeled)):
            for j in range(i):
                gain, square = 0.0, 0.0
                for k in range(3):
                    apart = seen[i, k] - seen[j, k]
                    gain -= apart * (markers[i, k] - markers[j, k]) / variance
                    square += apart * apart
                if gain > most and square <= ID_EXCHANGE_DISTANCE**2 and free[i] and free[j]:
                    most, one, other = gain, i, j
        if one < 0:
            return changed[:count]
        free[one] = free[other] = False
        first, second = labeled[one], labeled[other]
        labels[first], labels[second] = labels[second], labels[first]
        changed[count], changed[count + 1] = first, second
        count += 2


def gate_labels(frame: FrameState, hand: int, state: HandState, prediction: Prediction) -> FrameState:
    """Drop labels of points outside a gate as wide as the innovations of the hand's markers."""
    # If too many labels are outside, the prediction is wrong, and all labels stay.
    markers = frame.markers(hand)
    _gate_in_place(frame.points, markers, prediction.positions, state.variance)
    return frame.with_markers(hand, markers)


@kernel
def _gate_in_place(points: Doubles, markers: Integers, positions: Doubles, variance: Doubles) -> None:
    """Kernel of `gate_labels` for one hand; changes `markers` (P,) in place."""
    labeled = np.flatnonzero(markers >= 0)
    if len(labeled) == 0:
        return
    squares = np.empty(len(labeled))
    for row, point in enumerate(labeled):
        squares[row] = ((points[point] - positions[markers[point]]) ** 2).sum()
    shown = max(_PREDICTION_SPREAD**2, _PREDICTION_FACTOR**2 * np.median(squares) / MEDIAN_SQUARE)
    outside = squares > _GATE_SQUARE * (variance[markers[labeled]] + shown)
    if outside.sum() <= _MOST_GATED_SHARE * len(labeled):
        markers[labeled[outside]] = -1


def fit_labels(
    frame: FrameState, hand: int, state: HandState, prediction: Prediction, *, is_sure: bool = False
) -> tuple[FrameState, HandEstimate]:
    """Fit the pose to the labeled points, and drop inconsistent labels, the worst first.

    If the prediction is sure, no other start is tried; if most labels are far from it, the RMS is NaN.
    """
    points, markers = frame.points, frame.markers(hand)
    start, restarted, dropped = prediction.qpos, False, False
    while True:
        targets = targets_of(points, markers, state.num_markers)
        estimate = state.fit(targets, start, prediction)
        worst = _worst_label(points, markers, estimate.positions, state.variance)
        if worst < 0:
            break
        if estimate.rms > _RESTART_RMS and not restarted:
            restarted = True
            if is_sure:
                if np.nanmedian((estimate.residuals**2).sum(axis=1)) > _RESTART_RMS**2:
                    estimate = estimate._replace(rms=np.nan)
                    break
            else:
                restart = state.solver.solve(targets[None], iterations=_RESTART_STEPS)
                if restart.rms[0] < 0.5 * estimate.rms:
                    start = restart.qpos[0]
                    continue
        markers[worst] = -1
        dropped = True
    return frame.with_markers(hand, markers) if dropped else frame, estimate


@kernel
def _worst_label(
    points: Float[np.ndarray, "P 3"],
    markers: Int[np.ndarray, "P"],
    positions: Float[np.ndarray, "M 3"],
    variance: Float[np.ndarray, "M"],
) -> int:
    """The labeled point farthest from its fitted marker, if it is outside the gate; otherwise -1."""
    worst, most = -1, -1.0
    for point in range(len(markers)):
        marker = markers[point]
        if marker < 0:
            continue
        square = squared_distance(points[point], positions[marker])
        square /= variance[marker] + _FIT_SPREAD**2
        if square > most:
            worst, most = point, square
    return worst if most >= _GATE_SQUARE else -1


def refit_labels(before: FrameState, frame: FrameState, track: HandTrack) -> tuple[FrameState, HandTrack]:
    """Fit the pose of a hand again if its labels changed."""
    if (before.markers(track.hand) == frame.markers(track.hand)).all():
        return frame, track
    frame, estimate = fit_labels(frame, track.hand, track.state, track.prediction)
    return frame, track._replace(estimate=estimate)


class _Proposal(NamedTuple):
    """The labeler's labels of a hand's points, and the pose fitted to them."""

    frame: FrameState  # the frame with these labels
    confidence: Float[np.ndarray, "P"]
    """The labeler's confidence in each label; NaN for points that it did not get."""
    estimate: HandEstimate  # the pose fitted to them


class LabelerReview:
    """Decides when a hand's labels are reviewed by the labeler, and reviews them."""

    def __init__(self, labeler: Labeler, num_hands: int, config: TrackerConfig) -> None:
        self._labeler = labeler
        self._config = config
        self._wait = np.full(num_hands, _FIRST_REVIEW_WAIT)  # [s] between a hand's reviews
        self._last = np.full(num_hands, -np.inf)  # [s] of each hand's last review
        # Per hand and change: number of successive reviews in which it was better, but not by enough.
        self._earlier: list[dict[tuple[int, int], int]] = [{} for _ in range(num_hands)]
        self._open: list[frozenset[int]] = [frozenset()] * num_hands  # IDs near missing markers

    def restart(self, index: int, time: float) -> None:
        """Note that a hand was initialized at a time [s], so that its labels are reviewed soon."""
        self._wait[index], self._last[index] = _FIRST_REVIEW_WAIT, time

    def review(self, frame: FrameState, track: HandTrack) -> tuple[FrameState, HandTrack]:
        """If a review is due, compare a hand's labels with the labeler's, and adopt the likelier ones."""
        markers = frame.markers(track.hand)
        digits, positions = track.state.digits, track.estimate.positions
        near = _near_missing(frame.points, frame.labels, markers, digits, positions)
        if not self._is_due(track.hand, frame, near):
            return frame, track
        cloud = np.flatnonzero((markers >= 0) | near)
        if len(cloud) > MOST_POINTS:
            return frame, track
        named, confidence = np.full(len(near), -1), np.full(len(near), np.nan)
        labeling = self._labeler.label_frames([frame.points[cloud]])[0]
        named[cloud], confidence[cloud] = labeling.labels, labeling.confidence
        if (named == markers).all():
            return frame, track
        proposal = self._compare(frame, track, named, confidence)
        if proposal is None:
            doubted = _doubted_biases(frame, track, named)
            if len(doubted):
                biases = track.state.biases
                track.state.forget(doubted)
                proposal = self._compare(frame, track, named, confidence)
                if proposal is None:
                    track.state.recall(biases)
        if proposal is None:
            return frame, track
        self._wait[track.hand] = _FIRST_REVIEW_WAIT
        proposed = proposal.frame.markers(track.hand)
        changed = (proposed != markers) & (proposed >= 0)
        reviewed = proposal.frame.with_confidence(changed, proposal.confidence[changed])
        return reviewed, track._replace(estimate=proposal.estimate)

    def _compare(
        self, frame: FrameState, track: HandTrack, named: Integers, confidence: Doubles
    ) -> _Proposal | None:
        """Fit the labeler's labels; None if the current ones are likelier or equal."""
        labeled, is_sure = frame.with_markers(track.hand, named), track.estimate.rms < _RESTART_RMS
        proposed, estimate = fit_labels(labeled, track.hand, track.state, track.prediction, is_sure=is_sure)
        before, after = frame.markers(track.hand), proposed.markers(track.hand)
        if (after == before).all() or np.isnan(estimate.rms):
            return None
        proposal = _Proposal(proposed, confidence, estimate)
        gain = self._gain(frame, track, proposal)
        new = np.flatnonzero((after != before) & (after >= 0))
        changes = {(int(frame.ids[row]), int(after[row])) for row in new}
        earlier = self._earlier[track.hand]
        times = min((earlier.get(change, 0) for change in changes), default=0)
        if gain + _REPEATED_REVIEW_LOG_ODDS * times >= _REVIEW_MARGIN:
            return proposal
        if gain > 0.0:
            self._earlier[track.hand] = {change: earlier.get(change, 0) + 1 for change in changes}
        return None

    def _is_due(self, index: int, frame: FrameState, near: Flags) -> bool:
        """Whether a review is due; if so, the next one is scheduled."""
        points = frozenset(frame.ids[near].tolist())
        new = bool(points - self._open[index])
        if not new and frame.time < self._last[index] + self._wait[index]:
            return False
        self._open[index], self._last[index] = points, frame.time
        longer = min(_REVIEW_WAIT_FACTOR * self._wait[index], self._config.longest_review_wait)
        self._wait[index] = _FIRST_REVIEW_WAIT if new else longer
        return True

    def _gain(self, frame: FrameState, track: HandTrack, proposal: _Proposal) -> float:
        """Log-odds gained by the proposed labels over the current ones."""
        before, proposed = frame.markers(track.hand), proposal.frame.markers(track.hand)
        gain = self._log_odds(frame, track, proposed, proposal.estimate)
        gain -= self._log_odds(frame, track, before, track.estimate)
        named = np.flatnonzero((proposed != before) & (proposed >= 0))
        sure = np.clip(proposal.confidence[named], 0.5, 1.0 - 1e-6)
        gain += np.minimum(np.log(sure / (1.0 - sure)), _MOST_ANSWER_LOG_ODDS).sum()
        fresh = named[before[named] < 0]
        gain -= _MOVED_LABEL_LOG_ODDS * (len(named) - len(fresh))
        presence = track.state.presence_log_odds(frame.first_seen, frame.free_since, before)
        presence = presence[fresh, proposed[fresh]]
        # The review questions whether the marker was rightly seen elsewhere, so that penalty becomes a
        # smaller one, unless the point was beside the marker for long.
        doubted = (presence >= SEEN_ELSEWHERE) & (presence <= SEEN_ELSEWHERE + MOST_AGE_LOG_ODDS)
        return float(gain + presence[~doubted].sum() + _DOUBTED_PRESENCE * doubted.sum())

    def _log_odds(self, frame: FrameState, track: HandTrack, markers: Integers, fit: HandEstimate) -> float:
        """Log-odds of labeled points being markers of the fitted hand and not strays."""
        labeled = np.flatnonzero(markers >= 0)
        variance = track.state.variance[markers[labeled]]
        peak = peak_log_odds(variance, self._config.stray_density)
        squares = ((frame.points[labeled] - fit.positions[markers[labeled]]) ** 2).sum(axis=1)
        return float((peak - 0.5 * squares / variance).sum())


@kernel
def _near_missing(
    points: Float[np.ndarray, "P 3"],
    labels: Int[np.ndarray, "P"],
    markers: Int[np.ndarray, "P"],
    digits: Int[np.ndarray, "M"],
    positions: Float[np.ndarray, "M 3"],
) -> Bool[np.ndarray, "P"]:
    """Which unlabeled points may be missing markers of a hand, by their distances from the positions [m]."""
    near, missing = np.zeros(len(points), dtype=np.bool_), np.ones(len(digits), dtype=np.bool_)
    seen = np.zeros(len(DIGITS) + 1, dtype=np.bool_)
    for point in range(len(points)):
        if markers[point] >= 0:
            missing[markers[point]] = False
            seen[digits[markers[point]]] = True
    for point in range(len(points)):
        for marker in range(len(digits)):
            if labels[point] < 0 and missing[marker]:
                radius = CLOUD_RADIUS if seen[digits[marker]] else _DIGIT_CLOUD_RADIUS
                near[point] |= point_distance(points[point], positions[marker]) < radius
    return near


def _doubted_biases(frame: FrameState, track: HandTrack, named: Integers) -> Int[np.ndarray, "K"]:
    """Missing markers with a probably wrong bias: the labeler assigns them points that have persisted."""
    # Such a bias was learned from other points if the point is much closer without it.
    old = frame.time - frame.first_seen >= STRAY_LIFETIME
    rows = np.flatnonzero(old & frame.unlabeled & (named >= 0))
    if not len(rows):
        return rows
    points, markers = frame.points[rows], named[rows]
    without = np.linalg.norm(points - track.state.unbiased_positions(track.estimate)[markers], axis=1)
    with_bias = np.linalg.norm(points - track.estimate.positions[markers], axis=1)
    doubted = markers[without < _DOUBTED_BIAS_SHARE * with_bias]
    return np.setdiff1d(doubted, frame.markers(track.hand))
