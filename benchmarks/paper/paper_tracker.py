"""The tracking loop of Han et al. 2018, section 4, as it is written: the baseline for our tracker.

Where the paper gives no details:

- Its numbers are for 19 markers: clusters of at most 22 points, of which 14 to 21 are a hand. For another
  glove these are its number of markers plus 3, minus 5 and plus 2.
- If there are more clusters than hands, or fewer, hands and clusters are paired at random and the rest stay
  without. Clusters are formed of the points that no tracked hand has.
- Labels are assigned again in a frame in which a hand lacks a marker and an unlabeled point has an ID that
  was not there in the previous frame.
- The expected position of a missing marker is that of the previous pose, without velocity. Pairs closer than
  15 mm are made nearest first, over all hands at once.
- The labeler is queried with the hand's points and the unlabeled points within 200 mm of their center, the
  nearest first, 22 in all: the bounds of the clusters.
- Of proposals with the same number of labeled markers, the one with the least RMS distance wins.
- A hand whose proposals all fail has no pose in this frame, its labels are dropped, and it is initialized
  again from the next frame on. Four labeled points determine a pose.
- The pose solver and the labeler are ours. The solver draws joint angles that markers leave open weakly to
  rest and, without a pose to start from, tries several; the labeler does not tell left from right, so only
  the RMS distance does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from benchmarks.paper.take_evaluation import MOST_RMS
from gloves import GloveFit, Status
from handsim.hand.shape import NUM_QPOS
from track import PoseFit, TrackedFrame, TrackedHand
from track.kinematics.pose_solver import PoseSolver
from train import Labeler

RADIUS: Final = 0.2
"""Largest distance between the centers of two clusters that are joined [m]."""
GATE: Final = 0.015
"""Largest distance [m] of a point from the expected position of a missing marker."""
FEWEST: Final = 4
"""Labeled points that a pose needs; the paper gives no number, our solver needs this one."""
_LACKING, _EXTRA, _TOO_MANY = 5, 2, 3  # points less or more than a glove has markers: 14, 21 and 22 for 19


class PlainHand:
    """A hand tracked without any state but its last pose.

    Args:
        hand: The hand and its glove.
    """

    def __init__(self, hand: GloveFit) -> None:
        self.hand = hand
        self.solver = PoseSolver(hand)
        self.num_markers = hand.attachment.layout.num_markers
        self.qpos: NDArray[np.float64] | None = None
        """The pose of the previous frame; None if there is none."""

    def fit(
        self, points: Float[np.ndarray, "N 3"], proposals: Sequence[Int[np.ndarray, "N"]]
    ) -> tuple[list[Int[np.ndarray, "N"]], PoseFit | None]:
        """Solve the pose of every proposal, starting from the previous pose if there is one.

        Args:
            points: Points of a frame [m].
            proposals: Labels of the points: index of the marker, -1 for points that are not of this hand.

        Returns:
            The proposals with at least `FEWEST` labeled points, and their poses in this order; None without
            any.
        """
        usable = [labels for labels in proposals if (labels >= 0).sum() >= FEWEST]
        if not usable:
            return [], None
        targets = np.full((len(usable), self.num_markers, 3), np.nan)
        for row, labels in enumerate(usable):
            targets[row, labels[labels >= 0]] = points[labels >= 0]
        initial = None if self.qpos is None else np.tile(self.qpos, (len(usable), 1))
        return usable, self.solver.solve(targets, initial)

    def tracked(
        self,
        status: Status,
        points: Float[np.ndarray, "N 3"],
        labels: Int[np.ndarray, "N"],
        fit: PoseFit,
        row: int = 0,
    ) -> TrackedHand:
        """The hand in a tracked frame, by one of the solved poses.

        Args:
            status: Its status.
            points: Points of the frame [m].
            labels: Marker of each point, -1 for none.
            fit: Solved poses.
            row: Which of them.
        """
        present = labels >= 0
        markers = self.solver.marker_positions(fit.qpos[row])
        markers[labels[present]] = points[present]
        filled = np.setdiff1d(np.arange(self.num_markers), labels[present])
        return TrackedHand(self.hand.side, status, fit.qpos[row], float(fit.rms[row]), markers, filled)

    def lost(self) -> TrackedHand:
        """The hand in a frame without a pose of it."""
        missing = np.full((self.num_markers, 3), np.nan)
        return TrackedHand(
            self.hand.side, Status.LOST, np.full(NUM_QPOS, np.nan), np.nan, missing, np.arange(0)
        )


class PaperTracker:
    """Tracks the user's hands as the paper does.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Labeler of the hands' glove.
        rng: Pairs hands with clusters.
    """

    def __init__(self, hands: Sequence[GloveFit], labeler: Labeler, *, rng: np.random.Generator) -> None:
        self._hands = [PlainHand(hand) for hand in hands]
        self._first_label = np.cumsum([0, *(hand.num_markers for hand in self._hands)])
        self._labeler, self._rng = labeler, rng
        markers = len(labeler.marker_names)
        self._fewest_points, self._most = markers - _LACKING, markers + _EXTRA
        self._most_points = markers + _TOO_MANY
        self._labels: dict[int, int] = {}
        self._last_ids: set[int] = set()

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame.

        Args:
            points: Points [m], all finite.
            ids: The system's IDs: a point keeps its ID for as long as it is seen; -1 where it has none.
            time: Time of the frame [s].

        Returns:
            The tracked frame; every label has confidence 1, as the loop has no measure of it.
        """
        known = ids.tolist()
        labels = np.array([self._labels.get(point, -1) for point in known], dtype=np.int64)
        new = np.array([point not in self._last_ids for point in known], dtype=bool)
        lost = [number for number, hand in enumerate(self._hands) if hand.qpos is None]
        hands = [hand.lost() for hand in self._hands]
        by_proximity = self._proximity_labels(points, labels) if (new & (labels < 0)).any() else None
        for number, hand in enumerate(self._hands):
            if hand.qpos is not None:
                hands[number] = self._track(number, points, labels, by_proximity)
        self._initialize(lost, points, labels, hands)
        self._labels = labels_by_id(known, labels)
        self._last_ids = set(known) - {-1}
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))

    def _labels_of(self, number: int, labels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Labels of one hand's points, counted from its first marker; -1 for all others."""
        first, last = self._first_label[number : number + 2]
        return np.where((labels >= first) & (labels < last), labels - first, -1)

    def _proximity_labels(self, points: NDArray[np.float64], labels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Labels (N,) of unlabeled points near an expected missing marker; -1 for all others."""
        free = np.flatnonzero(labels < 0)
        positions = np.full((self._first_label[-1], 3), np.inf)
        for number, hand in enumerate(self._hands):
            if hand.qpos is not None:
                positions[self._first_label[number] : self._first_label[number + 1]] = (
                    hand.solver.marker_positions(hand.qpos)
                )
        positions[labels[labels >= 0]] = np.inf
        proposed = np.full(len(points), -1)
        proposed[free] = label_by_proximity(points[free], positions, GATE)
        return proposed

    def _track(
        self,
        number: int,
        points: NDArray[np.float64],
        labels: NDArray[np.int64],
        by_proximity: NDArray[np.int64] | None,
    ) -> TrackedHand:
        """Choose among the label proposals for a tracked hand; its `labels` are overwritten."""
        hand, own = self._hands[number], self._labels_of(number, labels)
        proposals = [own]
        if by_proximity is not None and (own >= 0).any() and (own >= 0).sum() < hand.num_markers:
            free = labels < 0
            proposals.append(np.where(free, self._labels_of(number, by_proximity), own))
            proposals.append(self._query_labeler(points, own, free))
        proposals, fit = hand.fit(points, proposals)
        labels[own >= 0] = -1
        counts = np.array([(own_labels >= 0).sum() for own_labels in proposals])
        passed = np.zeros(0, dtype=int) if fit is None else np.flatnonzero(fit.rms <= MOST_RMS)
        if fit is None or not len(passed):
            hand.qpos = None
            return hand.lost()
        best = passed[np.lexsort((fit.rms[passed], -counts[passed]))[0]]
        own_labels = proposals[best]
        labels[own_labels >= 0] = own_labels[own_labels >= 0] + self._first_label[number]
        hand.qpos = fit.qpos[best]
        return hand.tracked(Status.TRACKED, points, own_labels, fit, int(best))

    def _query_labeler(
        self, points: NDArray[np.float64], own: NDArray[np.int64], free: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        """Labels (N,) by the labeler of a hand's points and the free ones around it."""
        cloud = labeler_cloud(points, own >= 0, free, most=self._most_points, radius=RADIUS)
        own_labels = np.full(len(points), -1)
        own_labels[cloud] = self._labeler.label_frames([points[cloud]])[0].labels
        return own_labels

    def _initialize(
        self,
        lost: list[int],
        points: NDArray[np.float64],
        labels: NDArray[np.int64],
        hands: list[TrackedHand],
    ) -> None:
        """Pair hands without a pose with clusters at random, and keep poses that fit."""
        free = np.flatnonzero(labels < 0)
        if not lost or len(free) < self._fewest_points:
            return
        clusters = [free[group] for group in cluster_points(points[free], most=self._most_points)]
        clusters = [group for group in clusters if self._fewest_points <= len(group) <= self._most]
        chosen = [clusters[index] for index in self._rng.permutation(len(clusters))]
        pairs = list(zip(self._rng.permutation(lost), chosen, strict=False))
        labelings = self._labeler.label_frames([points[group] for _, group in pairs])
        for (number, group), labeling in zip(pairs, labelings, strict=True):
            hand, own_labels = self._hands[number], np.full(len(points), -1)
            own_labels[group] = labeling.labels
            if (own_labels >= 0).sum() < self._fewest_points:
                continue
            _, fit = hand.fit(points, [own_labels])
            if fit is not None and fit.rms[0] <= MOST_RMS:
                labels[own_labels >= 0] = own_labels[own_labels >= 0] + self._first_label[number]
                hand.qpos = fit.qpos[0]
                hands[number] = hand.tracked(Status.INITIALIZED, points, own_labels, fit)


def cluster_points(
    points: Float[np.ndarray, "N 3"], *, most: int, radius: float = RADIUS
) -> list[Int[np.ndarray, "K"]]:
    """Agglomerative clustering: join the two clusters with the nearest centers, starting from single points.

    Args:
        points: Points of a frame [m].
        most: Largest number of points in a cluster; 22 in the paper.
        radius: Largest distance of centers that are joined [m].

    Returns:
        Indices of each cluster's points, in order of the first of them.
    """
    centers, members = points.copy(), [np.array([index]) for index in range(len(points))]
    sizes = np.ones(len(points))
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    while len(points) > 1:
        allowed = np.where(sizes[:, None] + sizes <= most, distances, np.inf)
        one, other = np.sort(np.unravel_index(allowed.argmin(), allowed.shape))
        if not allowed[one, other] <= radius:
            break
        members[one] = np.concatenate([members[one], members[other]])
        members[other] = members[other][:0]
        centers[one] = points[members[one]].mean(axis=0)
        sizes[one], sizes[other] = len(members[one]), np.inf
        distances[one] = distances[:, one] = np.linalg.norm(centers - centers[one], axis=-1)
        distances[one, one] = distances[other] = distances[:, other] = np.inf
    return [np.sort(group) for group in members if len(group)]


def labeler_cloud(
    points: Float[np.ndarray, "N 3"],
    labeled: Bool[np.ndarray, "N"],
    free: Bool[np.ndarray, "N"],
    *,
    most: int,
    radius: float,
) -> Int[np.ndarray, "K"]:
    """Indices of the points for a labeler query: those of a hand and the free ones around it.

    Args:
        points: Points of a frame [m].
        labeled: Points with a label of this hand; at least one.
        free: Points without a label.
        most: Largest number of points; of the free ones those nearest to the hand's center are taken.
        radius: Largest distance of a free point from that center [m].
    """
    own, others = np.flatnonzero(labeled), np.flatnonzero(free)
    away = np.linalg.norm(points[others] - points[own].mean(axis=0), axis=-1)
    near = others[away <= radius][np.argsort(away[away <= radius], kind="stable")]
    return np.concatenate([own, near[: max(0, most - len(own))]])


def label_by_proximity(
    points: Float[np.ndarray, "P 3"], positions: Float[np.ndarray, "K 3"], radius: float
) -> Int[np.ndarray, "P"]:
    """Assign points to expected positions one to one, the nearest pair first.

    Args:
        points: Points without a label [m].
        positions: Expected positions of markers [m].
        radius: Upper bound of the distance of a pair [m].

    Returns:
        Index of each point's position, -1 for none.
    """
    labels, apart = np.full(len(points), -1), np.linalg.norm(points[:, None] - positions, axis=-1)
    while apart.size:
        point, position = np.unravel_index(apart.argmin(), apart.shape)
        if not apart[point, position] < radius:
            break
        labels[point] = position
        apart[point], apart[:, position] = np.inf, np.inf
    return labels


def labels_by_id(ids: Sequence[int], labels: Int[np.ndarray, "N"]) -> dict[int, int]:
    """Label of each ID; points without an ID or a label are left out."""
    pairs = zip(ids, labels.tolist(), strict=True)
    return {point: label for point, label in pairs if min(point, label) >= 0}
