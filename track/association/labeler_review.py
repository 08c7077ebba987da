"""Review of a hand's labels: the labeler labels its points too, and the likelier of both labelings holds.

Labels that go along with IDs can hold a hand in a wrong pose that excludes a marker which is clearly visible.
The labeler sees the same points without that history. Both labelings are fitted and compared by the
likelihood of the points: as markers of the fitted hand, or as strays where they have no label.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from track.association.frame_state import FrameState
from track.association.hand_state import Estimate
from track.association.label_consistency import fit_labels
from track.association.label_new_points import HandTrack
from track.association.point_matching import peak_log_odds
from track.config import TrackerConfig
from train.labelers.protocol import Labeler


class Proposal(NamedTuple):
    """Labels of a hand's points by the labeler, and the pose that fits them."""

    labels: Int[np.ndarray, "P"]
    """Marker of each point, -1 where it is none of the hand's."""
    confidence: Float[np.ndarray, "P"]
    """The labeler's confidence in each label; NaN for points that it was not shown."""
    estimate: Estimate
    """The pose fitted to them."""


class LabelerReview:
    """Decides when a hand's labels are reviewed, and reviews them.

    Args:
        labeler: Labels the points of a cloud of one hand.
        num_hands: Number of hands.
        config: When labels are reviewed, and by how much others must be likelier.
    """

    def __init__(self, labeler: Labeler, num_hands: int, config: TrackerConfig) -> None:
        self._labeler = labeler
        self._config = config
        self._wait = np.full(num_hands, config.review.first_wait)  # [s] from a hand's last review to its next
        self._last = np.full(num_hands, -np.inf)  # [s] of each hand's last review
        self._earlier: list[dict[tuple[int, int], int]] = [{} for _ in range(num_hands)]
        # How many reviews in turn found other labels of points likelier, but not by enough.
        self._open: list[frozenset[int]] = [frozenset()] * num_hands  # IDs that it was about

    def restart(self, index: int, time: float) -> None:
        """Note that a hand was initialized at a time [s]: its labels are reviewed soon."""
        self._wait[index], self._last[index] = self._config.review.first_wait, time

    def review(self, hand: HandTrack, estimate: Estimate, frame: FrameState) -> Proposal | None:
        """Compare a hand's labels with the labeler's if that is due.

        Args:
            hand: The hand.
            estimate: Its pose fitted to the frame's labels.
            frame: The frame; stays as it is.

        Returns:
            Likelier labels, if there are any.
        """
        near = self._near(hand, estimate, frame)
        if not self._is_due(hand.index, frame, near):
            return None
        cloud = np.flatnonzero((frame.labels[hand.index] >= 0) | near)
        if len(cloud) > self._config.initialization.most_points:
            return None
        labels, confidence = np.full(len(near), -1), np.full(len(near), np.nan)
        labeling = self._labeler.label_frames([frame.points[cloud]])[0]
        labels[cloud], confidence[cloud] = labeling.labels, labeling.confidence
        proposal = self._compare(hand, estimate, frame, labels, confidence)
        if proposal is None:
            doubted = self._doubted_biases(hand, estimate, frame, labels)
            if len(doubted):
                recall = hand.state.forget(doubted)
                proposal = self._compare(hand, estimate, frame, labels, confidence)
                if proposal is None:
                    recall()
        if proposal is not None:
            self._wait[hand.index] = self._config.review.first_wait
        return proposal

    def _compare(
        self,
        hand: HandTrack,
        estimate: Estimate,
        frame: FrameState,
        named: NDArray[np.int64],
        confidence: NDArray[np.float64],
    ) -> Proposal | None:
        """Fit the labeler's labels; None if those of the frame are likelier or the same."""
        labels = named.copy()
        fitted = fit_labels(hand.state, frame.points, labels, hand.prediction, self._config.gating)
        if (labels == frame.labels[hand.index]).all() or np.isnan(fitted.rms):
            return None
        proposal = Proposal(labels, confidence, fitted)
        gain = self._gain(hand, estimate, frame, proposal)
        changes = {
            (int(frame.ids[row]), int(labels[row]))
            for row in np.flatnonzero((labels != frame.labels[hand.index]) & (labels >= 0))
        }
        earlier = self._earlier[hand.index]
        times = min((earlier.get(change, 0) for change in changes), default=0)
        if gain + self._config.review.persistence * times >= self._config.review.margin:
            return proposal
        if gain > 0.0:
            self._earlier[hand.index] = {change: earlier.get(change, 0) + 1 for change in changes}
        return None

    def _doubted_biases(
        self, hand: HandTrack, estimate: Estimate, frame: FrameState, named: NDArray[np.int64]
    ) -> Int[np.ndarray, "K"]:
        """Markers that the hand lacks, and for which the labeler names points that have lasted.

        Their biases may have been learned from other points if the markers would be much nearer without them.
        """
        old = frame.time - frame.first_seen >= self._config.presence.stray_lifetime
        rows = np.flatnonzero(old & frame.unlabeled & (named >= 0))
        points, markers = frame.points[rows], named[rows]
        without = np.linalg.norm(points - hand.state.unbiased_positions(estimate)[markers], axis=1)
        with_bias = np.linalg.norm(points - estimate.positions[markers], axis=1)
        doubted = markers[without < self._config.review.much_nearer * with_bias]
        return np.setdiff1d(doubted, frame.labels[hand.index])

    def _near(self, hand: HandTrack, estimate: Estimate, frame: FrameState) -> Bool[np.ndarray, "P"]:
        """Which points without a label may be markers that the hand lacks."""
        labels, near = frame.labels[hand.index], frame.unlabeled.copy()
        missing = np.ones(hand.state.num_markers, dtype=bool)
        missing[labels[labels >= 0]] = False
        if near.any():
            offsets = frame.points[near, None] - estimate.positions[missing]
            near[near] = (np.linalg.norm(offsets, axis=-1) < self._config.review.radius).any(axis=1)
        return near

    def _is_due(self, index: int, frame: FrameState, near: NDArray[np.bool_]) -> bool:
        """Whether a review is due; the next one is planned then."""
        review, points = self._config.review, frozenset(frame.ids[near].tolist())
        new = bool(points - self._open[index])
        if not new and frame.time < self._last[index] + self._wait[index]:
            return False
        self._open[index], self._last[index] = points, frame.time
        longer = min(review.wait_factor * self._wait[index], review.longest_wait)
        self._wait[index] = review.first_wait if new else longer
        return True

    def _gain(self, hand: HandTrack, estimate: Estimate, frame: FrameState, proposal: Proposal) -> float:
        """Log-odds by which proposed labels are likelier than those of the frame."""
        labels, (proposed, confidence, fitted) = frame.labels[hand.index], proposal
        gain = self._log_odds(hand, frame, proposed, fitted) - self._log_odds(hand, frame, labels, estimate)
        named = np.flatnonzero((proposed != labels) & (proposed >= 0))
        sure = np.clip(confidence[named], 0.5, 1.0 - 1e-6)
        gain += np.minimum(np.log(sure / (1.0 - sure)), self._config.review.most_answer_log_odds).sum()
        fresh = named[labels[named] < 0]
        gain -= self._config.review.moved_label * (len(named) - len(fresh))
        presence = hand.state.presence_log_odds(frame.first_seen[fresh])[
            np.arange(len(fresh)), proposed[fresh]
        ]
        # That the marker was seen elsewhere is what the review doubts.
        doubted = presence <= self._config.presence.seen_elsewhere + self._config.presence.most_age_log_odds
        return float(gain + presence[~doubted].sum() + self._config.review.seen_elsewhere * doubted.sum())

    def _log_odds(
        self, hand: HandTrack, frame: FrameState, labels: NDArray[np.int64], estimate: Estimate
    ) -> float:
        """Log-odds of labeled points being the markers of a fitted hand against their being strays."""
        labeled = np.flatnonzero(labels >= 0)
        variance = hand.state.variance[labels[labeled]]
        peak = peak_log_odds(variance, self._config.association.stray_density)
        squares = ((frame.points[labeled] - estimate.positions[labels[labeled]]) ** 2).sum(axis=1)
        return float((peak - 0.5 * squares / variance).sum())
