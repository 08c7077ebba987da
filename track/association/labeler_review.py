"""Review of a hand's labels: the labeler labels its points too, and the likelier of both labelings holds.

Labels that go along with IDs can hold a hand in a wrong pose that excludes a marker which is clearly visible.
The labeler sees the same points without that history. Both labelings are fitted and compared by the
likelihood of the points: as markers of the fitted hand, or as strays where they have no label.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from track.association.assignment import peak_log_odds
from track.association.frame_state import FrameState
from track.association.hand_state import (
    MOST_AGE_LOG_ODDS,
    SEEN_ELSEWHERE,
    STRAY_LIFETIME,
    HandEstimate,
    HandTrack,
)
from track.association.initialization import MOST_POINTS
from track.association.label_consistency import fit_labels
from track.config import TrackerConfig
from train.labelers.protocol import Labeler

_RADIUS: Final = 0.06  # [m] from a missing marker, within which the labeler is shown points without a label
_DIGIT_RADIUS: Final = 0.13  # [m] the same of a marker whose digit has no label: it may be bent or straight
_FIRST_WAIT: Final = 0.01  # [s] from a review that changed something to the next one
_WAIT_FACTOR: Final = 1.6  # of that time after each review that changed nothing
_SEEN_ELSEWHERE: Final = -2.0  # log probability of a marker that the track saw elsewhere at the same time
_MARGIN: Final = 8.0  # log-odds by which the labeler's labels must be likelier than those of the track
_MUCH_NEARER: Final = 0.85  # share of a point's distance that is left without a bias, to doubt the bias
_MOVED_LABEL: Final = 2.0  # log-odds that a point keeps the label that it has
_PERSISTENCE: Final = 1.0  # log-odds added by each earlier review with the same labels
_MOST_ANSWER_LOG_ODDS: Final = 7.0  # that the labeler's confidence in a label contributes


class _Proposal(NamedTuple):
    """Labels of a hand's points by the labeler, and the pose that fits them."""

    frame: FrameState
    """The frame with these labels."""
    confidence: Float[np.ndarray, "P"]
    """The labeler's confidence in each label; NaN for points that it was not shown."""
    estimate: HandEstimate
    """The pose fitted to them."""


class LabelerReview:
    """Decides when a hand's labels are reviewed, and reviews them.

    Args:
        labeler: Labels the points of a cloud of one hand.
        config: Density of strays, and the longest time between reviews.
    """

    def __init__(self, labeler: Labeler, num_hands: int, config: TrackerConfig) -> None:
        self._labeler = labeler
        self._config = config
        self._wait = np.full(num_hands, _FIRST_WAIT)  # [s] from a hand's last review to its next
        self._last = np.full(num_hands, -np.inf)  # [s] of each hand's last review
        self._earlier: list[dict[tuple[int, int], int]] = [{} for _ in range(num_hands)]
        # How many reviews in turn found other labels of points likelier, but not by enough.
        self._open: list[frozenset[int]] = [frozenset()] * num_hands  # IDs that it was about

    def restart(self, index: int, time: float) -> None:
        """Note that a hand was initialized at a time [s]: its labels are reviewed soon."""
        self._wait[index], self._last[index] = _FIRST_WAIT, time

    def review(self, frame: FrameState, track: HandTrack) -> tuple[FrameState, HandTrack]:
        """Compare a hand's labels with the labeler's if that is due, and take over the likelier ones."""
        markers = frame.markers(track.hand)
        near = self._near(frame, track, markers)
        if not self._is_due(track.hand, frame, near):
            return frame, track
        cloud = np.flatnonzero((markers >= 0) | near)
        if len(cloud) > MOST_POINTS:
            return frame, track
        named, confidence = np.full(len(near), -1), np.full(len(near), np.nan)
        labeling = self._labeler.label_frames([frame.points[cloud]])[0]
        named[cloud], confidence[cloud] = labeling.labels, labeling.confidence
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
        self._wait[track.hand] = _FIRST_WAIT
        proposed = proposal.frame.markers(track.hand)
        changed = (proposed != markers) & (proposed >= 0)
        reviewed = proposal.frame.with_confidence(changed, proposal.confidence[changed])
        return reviewed, track._replace(estimate=proposal.estimate)

    def _compare(
        self,
        frame: FrameState,
        track: HandTrack,
        named: NDArray[np.int64],
        confidence: NDArray[np.float64],
    ) -> _Proposal | None:
        """Fit the labeler's labels; None if those of the frame are likelier or the same."""
        proposed, estimate = fit_labels(
            frame.with_markers(track.hand, named), track.hand, track.state, track.prediction
        )
        before, after = frame.markers(track.hand), proposed.markers(track.hand)
        if (after == before).all() or np.isnan(estimate.rms):
            return None
        proposal = _Proposal(proposed, confidence, estimate)
        gain = self._gain(frame, track, proposal)
        changes = {
            (int(frame.ids[row]), int(after[row])) for row in np.flatnonzero((after != before) & (after >= 0))
        }
        earlier = self._earlier[track.hand]
        times = min((earlier.get(change, 0) for change in changes), default=0)
        if gain + _PERSISTENCE * times >= _MARGIN:
            return proposal
        if gain > 0.0:
            self._earlier[track.hand] = {change: earlier.get(change, 0) + 1 for change in changes}
        return None

    def _near(self, frame: FrameState, track: HandTrack, markers: NDArray[np.int64]) -> Bool[np.ndarray, "P"]:
        """Which points without a label may be markers that the hand lacks."""
        near = frame.unlabeled
        if near.any():
            missing = np.ones(track.state.num_markers, dtype=bool)
            missing[markers[markers >= 0]] = False
            digits = track.state.digits
            radius = np.where(np.isin(digits, digits[~missing]), _RADIUS, _DIGIT_RADIUS)
            offsets = frame.points[near, None] - track.estimate.positions[missing]
            near[near] = (np.linalg.norm(offsets, axis=-1) < radius[missing]).any(axis=1)
        return near

    def _is_due(self, index: int, frame: FrameState, near: NDArray[np.bool_]) -> bool:
        """Whether a review is due; the next one is planned then."""
        points = frozenset(frame.ids[near].tolist())
        new = bool(points - self._open[index])
        if not new and frame.time < self._last[index] + self._wait[index]:
            return False
        self._open[index], self._last[index] = points, frame.time
        longer = min(_WAIT_FACTOR * self._wait[index], self._config.longest_review_wait)
        self._wait[index] = _FIRST_WAIT if new else longer
        return True

    def _gain(self, frame: FrameState, track: HandTrack, proposal: _Proposal) -> float:
        """Log-odds by which proposed labels are likelier than those of the frame."""
        before, proposed = frame.markers(track.hand), proposal.frame.markers(track.hand)
        gain = self._log_odds(frame, track, proposed, proposal.estimate)
        gain -= self._log_odds(frame, track, before, track.estimate)
        named = np.flatnonzero((proposed != before) & (proposed >= 0))
        sure = np.clip(proposal.confidence[named], 0.5, 1.0 - 1e-6)
        gain += np.minimum(np.log(sure / (1.0 - sure)), _MOST_ANSWER_LOG_ODDS).sum()
        fresh = named[before[named] < 0]
        gain -= _MOVED_LABEL * (len(named) - len(fresh))
        presence = track.state.presence_log_odds(frame.first_seen[fresh])[
            np.arange(len(fresh)), proposed[fresh]
        ]
        # That the marker was seen elsewhere is what the review doubts.
        doubted = presence <= SEEN_ELSEWHERE + MOST_AGE_LOG_ODDS
        return float(gain + presence[~doubted].sum() + _SEEN_ELSEWHERE * doubted.sum())

    def _log_odds(
        self, frame: FrameState, track: HandTrack, markers: NDArray[np.int64], estimate: HandEstimate
    ) -> float:
        """Log-odds of labeled points being the markers of a fitted hand against their being strays."""
        labeled = np.flatnonzero(markers >= 0)
        variance = track.state.variance[markers[labeled]]
        peak = peak_log_odds(variance, self._config.stray_density)
        squares = ((frame.points[labeled] - estimate.positions[markers[labeled]]) ** 2).sum(axis=1)
        return float((peak - 0.5 * squares / variance).sum())


def _doubted_biases(frame: FrameState, track: HandTrack, named: NDArray[np.int64]) -> Int[np.ndarray, "K"]:
    """Markers that the hand lacks, and for which the labeler names points that have lasted.

    Their biases may have been learned from other points if the markers would be much nearer without them.
    """
    old = frame.time - frame.first_seen >= STRAY_LIFETIME
    rows = np.flatnonzero(old & frame.unlabeled & (named >= 0))
    if not len(rows):
        return rows
    points, markers = frame.points[rows], named[rows]
    without = np.linalg.norm(points - track.state.unbiased_positions(track.estimate)[markers], axis=1)
    with_bias = np.linalg.norm(points - track.estimate.positions[markers], axis=1)
    doubted = markers[without < _MUCH_NEARER * with_bias]
    return np.setdiff1d(doubted, frame.markers(track.hand))
