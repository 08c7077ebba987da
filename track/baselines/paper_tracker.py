"""The tracking loop of Han et al. 2018, section 4, as it is written: what ours is compared with.

Where the paper is silent:

- Its numbers are for 19 markers: clusters of at most 22 points, of which 14 to 21 are a hand. Another glove
  has its number of markers plus 3, minus 5 and plus 2.
- More clusters than hands, or fewer: hands and clusters are paired at random, the rest go without. A cluster
  is looked for among the points that no tracked hand has.
- Markers are named anew in a frame in which a hand lacks a marker and a point without a name is there whose
  ID was not there in the frame before.
- The expected location of a missing marker is where the pose of the frame before has it, without any speed.
  Pairs closer than 15 mm are made nearest first, over all hands at once.
- The labeler is asked about the hand's points and the points without a name within 200 mm of their center,
  the nearest first, 22 in all: the bounds of the clusters.
- Of proposals with as many labeled markers the one with the least RMS distance wins.
- A hand whose proposals all fail has no pose in this frame, its names are forgotten, and it is looked for
  from the next frame on. Four named points make a pose.
- The pose solver and the labeler are ours. The solver draws hinges that markers leave open weakly to rest,
  and without a pose to start from tries several; the labeler does not tell left from right, so that only the
  RMS distance does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.fit import GloveFit
from track.baselines.clustering import REACH, cluster_points
from track.baselines.plain_hand import MOST_RMS, PlainHand
from track.baselines.proposals import cloud_of, name_by_proximity
from track.tracked_frame import Status, TrackedFrame, TrackedHand
from train.labelers.protocol import Labeler

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

GATE: Final = 0.015
"""Distance [m] of a point from where a missing marker is expected, less than this."""
_LACKING, _EXTRA, _TOO_MANY = 5, 2, 3  # markers less or more than a glove has: 14, 21 and 22 for 19


class PaperTracker:
    """Follows the user's hands as the paper does.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Knows the markers of the hands' glove.
        rng: Decides which hand a cluster is taken for.
    """

    def __init__(self, hands: Sequence[GloveFit], labeler: Labeler, *, rng: np.random.Generator) -> None:
        self._hands = [PlainHand(hand) for hand in hands]
        self._first = np.cumsum([0, *(hand.num_markers for hand in self._hands)])
        self._labeler, self._rng = labeler, rng
        markers = len(labeler.marker_names)
        self._fewest, self._most = markers - _LACKING, markers + _EXTRA
        self._cap = markers + _TOO_MANY
        self._labels: dict[int, int] = {}
        self._before: set[int] = set()

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame.

        Args:
            points: Points [m], none of them missing.
            ids: The system's IDs: a point keeps its own for as long as it is seen; -1 where there is none.
            time: Time of the frame [s].

        Returns:
            Labels are as sure as their hand's pose: the loop has no other measure.
        """
        known = ids.tolist()
        labels = np.array([self._labels.get(point, -1) for point in known], dtype=np.int64)
        new = np.array([point not in self._before for point in known], dtype=bool)
        lost = [number for number, hand in enumerate(self._hands) if hand.qpos is None]
        hands = [hand.lost() for hand in self._hands]
        nearby = self._nearby(points, labels) if (new & (labels < 0)).any() else None
        for number, hand in enumerate(self._hands):
            if hand.qpos is not None:
                hands[number] = self._follow(number, points, labels, nearby)
        self._begin(lost, points, labels, hands)
        self._labels = {
            point: label
            for point, label in zip(known, labels.tolist(), strict=True)
            if min(point, label) >= 0
        }
        self._before = set(known) - {-1}
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))

    def _names(self, number: int, labels: NDArray[np.int64]) -> NDArray[np.int64]:
        """A hand's part of the labels, counted from its first marker."""
        first, last = self._first[number : number + 2]
        return np.where((labels >= first) & (labels < last), labels - first, -1)

    def _nearby(self, points: NDArray[np.float64], labels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Labels of points without one that lie where a tracked hand lacks a marker; -1 for all others."""
        free = np.flatnonzero(labels < 0)
        places = np.full((self._first[-1], 3), np.inf)
        for number, hand in enumerate(self._hands):
            if hand.qpos is not None:
                places[self._first[number] : self._first[number + 1]] = hand.solver.marker_positions(
                    hand.qpos
                )
        places[labels[labels >= 0]] = np.inf
        found = np.full(len(points), -1)
        found[free] = name_by_proximity(points[free], places, GATE)
        return found

    def _follow(
        self,
        number: int,
        points: NDArray[np.float64],
        labels: NDArray[np.int64],
        nearby: NDArray[np.int64] | None,
    ) -> TrackedHand:
        """Choose among the proposals for a hand that was there before; its labels are overwritten."""
        hand, own = self._hands[number], self._names(number, labels)
        proposals = [own]
        if nearby is not None and (own >= 0).any() and (own >= 0).sum() < hand.num_markers:
            free = labels < 0
            proposals.append(np.where(free, self._names(number, nearby), own))
            proposals.append(self._ask(points, own, free))
        proposals, fit = hand.fit(points, proposals)
        labels[own >= 0] = -1
        counts = np.array([(names >= 0).sum() for names in proposals])
        passed = np.zeros(0, dtype=int) if fit is None else np.flatnonzero(fit.rms <= MOST_RMS)
        if fit is None or not len(passed):
            hand.qpos = None
            return hand.lost()
        best = passed[np.lexsort((fit.rms[passed], -counts[passed]))[0]]
        names = proposals[best]
        labels[names >= 0] = names[names >= 0] + self._first[number]
        hand.qpos = fit.qpos[best]
        return hand.tracked(Status.TRACKED, points, names, fit, int(best))

    def _ask(
        self, points: NDArray[np.float64], own: NDArray[np.int64], free: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        """What the labeler makes of a hand's points and the free ones around it."""
        cloud = cloud_of(points, own >= 0, free, most=self._cap, reach=REACH)
        names = np.full(len(points), -1)
        names[cloud] = self._labeler.label_frames([points[cloud]])[0].labels
        return names

    def _begin(
        self,
        lost: list[int],
        points: NDArray[np.float64],
        labels: NDArray[np.int64],
        hands: list[TrackedHand],
    ) -> None:
        """Take clusters for hands that had no pose, at random, and keep what fits."""
        free = np.flatnonzero(labels < 0)
        if not lost or len(free) < self._fewest:
            return
        clusters = [free[group] for group in cluster_points(points[free], most=self._cap)]
        clusters = [group for group in clusters if self._fewest <= len(group) <= self._most]
        chosen = [clusters[place] for place in self._rng.permutation(len(clusters))]
        pairs = list(zip(self._rng.permutation(lost), chosen, strict=False))
        labelings = self._labeler.label_frames([points[group] for _, group in pairs])
        for (number, group), labeling in zip(pairs, labelings, strict=True):
            hand, names = self._hands[number], np.full(len(points), -1)
            names[group] = labeling.labels
            if (names >= 0).sum() < self._fewest:
                continue
            _, fit = hand.fit(points, [names])
            if fit is not None and fit.rms[0] <= MOST_RMS:
                labels[names >= 0] = names[names >= 0] + self._first[number]
                hand.qpos = fit.qpos[0]
                hands[number] = hand.tracked(Status.FOUND, points, names, fit)
