"""Labels of a frame's points, and the state that the tracker's steps pass on.

A label is one number: it counts the markers of each hand in the order of its layout, hand after hand, then
those of each rigid body. Only `Numbering` knows where a hand begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from handsim.arrays import Doubles, Flags, Integers
from handsim.kernels import kernel
from handsim.space.transforms import rigid_fit
from train.labelers.matching import assign

_LASTING_SHARE: Final = 0.5  # Use the stream's IDs only if this share of the last frame's IDs persists.
# [m] Gates of distances from the prediction: before hands are aligned, and after each alignment.
_LINK_GATES: Final = (0.04, 0.025, 0.015)
_FEWEST_ALIGNED: Final = 5  # A hand is aligned with at least this many points.
# [m] Distances between markers closer than this hardly change between frames.
_NEIGHBOR_DISTANCE: Final = 0.06
_FEWEST_NEIGHBORS: Final = 3  # Two frames are compared if they share this many pairs of neighbors.
_MOST_FREE_MOTION: Final = 0.01  # [m] An unlabeled point that moves farther in a frame may be another point.
_BESIDE_DISTANCE: Final = 0.06  # [m] An unlabeled point this close to a hand's points moves with the hand.


class Numbering:
    """The numbering of all markers: those of the hands, then those of the bodies."""

    def __init__(self, counts: Sequence[int]) -> None:
        self._first = np.cumsum([0, *counts]).tolist()
        self.owners: Int[np.ndarray, "K"] = np.repeat(np.arange(len(counts)), counts)
        """Owner of each label."""

    def part(self, owner: int) -> slice:
        """Range of the labels of an owner."""
        return slice(self._first[owner], self._first[owner + 1])

    def markers(self, owner: int, labels: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
        """Index of each point's marker in an owner's layout; -1 for points that are none of its markers."""
        return _markers(labels, self._first[owner], self._first[owner + 1])

    def with_markers(
        self, owner: int, markers: Int[np.ndarray, "N"], labels: Int[np.ndarray, "N"]
    ) -> Int[np.ndarray, "N"]:
        """Replace an owner's labels: `markers` holds the new marker of each point, -1 for none."""
        return _with_markers(labels, self._first[owner], self._first[owner + 1], markers)


class FrameState(NamedTuple):
    """P points of a frame and what is known of each so far; its arrays are never overwritten."""

    points: Float[np.ndarray, "P 3"]  # points in the world [m]
    ids: Int[np.ndarray, "P"]  # persistent numbers of the points
    labels: Int[np.ndarray, "P"]  # label of each point by `numbering`, -1 for none
    evidence: Float[np.ndarray, "P"]
    """Evidence (log-odds) for each point's label, accumulated over the frames of its number."""
    confidence: Float[np.ndarray, "P"]  # confidence in each label, 0 to 1
    first_seen: Float[np.ndarray, "P"]  # time of the first frame with the point's number [s]
    free_since: Float[np.ndarray, "P"]  # since when it has no label; now if it has one [s]
    time: float  # time of the frame [s]
    numbering: Numbering  # what labels mean

    @property
    def unlabeled(self) -> Bool[np.ndarray, "P"]:
        """Which points have no label."""
        return self.labels < 0

    def markers(self, hand: int) -> Int[np.ndarray, "P"]:
        """Index of each point's marker on a hand; -1 for points that are none of its markers."""
        return self.numbering.markers(hand, self.labels)

    def with_markers(self, hand: int, markers: Int[np.ndarray, "P"]) -> FrameState:
        """Replace a hand's labels."""
        return self._replace(labels=self.numbering.with_markers(hand, markers, self.labels))

    def with_confidence(self, changed: Flags | Integers, confidence: Doubles) -> FrameState:
        """Give C changed labels no evidence, and a confidence from 0 to 1."""
        evidence, all_confidence = self.evidence.copy(), self.confidence.copy()
        evidence[changed], all_confidence[changed] = 0.0, confidence
        return self._replace(evidence=evidence, confidence=all_confidence)

    def free_for(self, hands: Sequence[int]) -> Int[np.ndarray, "F"]:
        """Indices of the points without a label or with a label of these hands."""
        free = self.unlabeled
        for hand in hands:
            free |= self.markers(hand) >= 0
        return np.flatnonzero(free)


@kernel
def targets_of(
    points: Float[np.ndarray, "N 3"], markers: Int[np.ndarray, "N"], count: int
) -> Float[np.ndarray, "M 3"]:
    """Labeled points in the order of a layout [m], NaN where a marker has no point."""
    targets = np.full((count, 3), np.nan)
    for point in range(len(markers)):
        if markers[point] >= 0:
            targets[markers[point]] = points[point]
    return targets


@kernel
def _markers(labels: Int[np.ndarray, "N"], first: int, last: int) -> Int[np.ndarray, "N"]:
    """`Numbering.markers`, for labels from `first` to before `last`."""
    markers = np.full(len(labels), -1)
    for point in range(len(labels)):
        if first <= labels[point] < last:
            markers[point] = labels[point] - first
    return markers


@kernel
def _with_markers(
    labels: Int[np.ndarray, "N"], first: int, last: int, markers: Int[np.ndarray, "N"]
) -> Int[np.ndarray, "N"]:
    """`Numbering.with_markers`, for labels from `first` to before `last`."""
    changed = labels.copy()
    for point in range(len(labels)):
        if markers[point] >= 0:
            changed[point] = first + markers[point]
        elif first <= labels[point] < last:
            changed[point] = -1
    return changed


class PointHistory:
    """History of a stream's points by their numbers: label, evidence and age."""

    # Labels are dropped after `silence` seconds without a frame, as IDs may have changed.

    def __init__(self, numbering: Numbering, silence: float) -> None:
        self._numbering = numbering
        self._silence = silence
        self._linker = PointLinker(numbering.owners)
        self._labels: dict[int, int] = {}  # by point number
        self._evidence: dict[int, float] = {}  # log-odds of these labels
        self._first_seen: dict[int, float] = {}  # [s] by point number
        # Points without a label, by number: the time since which each has none [s], and its place [m].
        self._free: dict[int, tuple[float, Doubles]] = {}
        self._last_time = -np.inf  # [s] of the last frame

    def carry(
        self,
        points: Float[np.ndarray, "P 3"],
        ids: Int[np.ndarray, "P"],
        time: float,
        expected: Float[np.ndarray, "K 3"],
    ) -> FrameState:
        """The next frame, with labels and evidence carried over by its points."""
        if time - self._last_time > self._silence:
            self._labels = {}
        self._last_time = time
        numbers = self._linker.number(points, ids, self._labels, expected)
        known = numbers.tolist()
        self._first_seen = {number: self._first_seen.get(number, time) for number in known}
        labels = np.array([self._labels.get(number, -1) for number in known], dtype=np.int64)
        evidence = np.array([self._evidence[n] if n in self._labels else 0.0 for n in known])
        confidence = 1.0 / (1.0 + np.exp(-evidence - 1.0))
        first_seen = np.array(list(self._first_seen.values()))
        free_since = np.full(len(known), time)
        rows = [row for row, number in enumerate(known) if number in self._free]
        if rows:  # IDs may have been exchanged.
            since, places = zip(*(self._free[known[row]] for row in rows), strict=True)
            near = ((points[rows] - np.array(places)) ** 2).sum(axis=1) < _MOST_FREE_MOTION**2
            free_since[rows] = np.where(near, since, time)
        return FrameState(
            points, numbers, labels, evidence, confidence, first_seen, free_since, time, self._numbering
        )

    def keep(self, frame: FrameState) -> None:
        """Store what the next frame needs of this one."""
        rows = np.flatnonzero(frame.labels >= 0)
        numbers = frame.ids[rows].tolist()
        self._labels = dict(zip(numbers, frame.labels[rows].tolist(), strict=True))
        self._evidence = dict(zip(numbers, frame.evidence[rows].tolist(), strict=True))
        free = frame.unlabeled
        known = zip(frame.free_since[free].tolist(), frame.points[free], strict=True)
        self._free = dict(zip(frame.ids[free].tolist(), known, strict=True))


class PointLinker:
    """Gives the points of a stream persistent numbers."""

    def __init__(self, owners: Int[np.ndarray, "K"]) -> None:
        self._owners = owners
        self._numbers: dict[int, int] = {}  # from the stream's IDs in the last frame
        self._last = np.zeros(0, dtype=np.int64)  # numbers (Q,) of the last frame's points
        self._points = np.zeros((0, 3))  # those points [m]
        self._next = 0

    def number(
        self,
        points: Float[np.ndarray, "P 3"],
        ids: Int[np.ndarray, "P"],
        labels: Mapping[int, int],
        expected: Float[np.ndarray, "K 3"],
    ) -> Int[np.ndarray, "P"]:
        """Number the points of the next frame, by the stream's IDs if most of these persist."""
        # If there were labels, only IDs of labeled points are counted, as ghosts are short-lived. In a stream
        # with IDs a point without one gets a new number.
        again = [self._numbers.get(number, -1) for number in ids.tolist()]
        known = np.array(again, dtype=np.int64)
        before = labels.keys() if labels else set(self._last.tolist())
        if len(before & set(again)) < _LASTING_SHARE * min(len(before), len(ids)):
            known = self._link(points, labels, expected)
        new = np.flatnonzero(known < 0)
        known[new] = self._next + np.arange(len(new))
        self._next += len(new)
        self._numbers = {one: n for one, n in zip(ids.tolist(), known.tolist(), strict=True) if one >= 0}
        self._last, self._points = known, points
        return known

    def _link(self, points: Doubles, labels: Mapping[int, int], expected: Doubles) -> Integers:
        """Match points with those of the last frame by position; their numbers, -1 for new points."""
        predicted, hands = self._points.copy(), np.full(len(self._last), -1)
        for row, number in enumerate(self._last.tolist()):
            label = labels.get(number, -1)
            if label >= 0 and np.isfinite(expected[label, 0]):
                hands[row], predicted[row] = self._owners[label], expected[label]
        beside = self._beside(hands)
        moved, found = predicted.copy(), np.full(len(points), -1)
        for distance in _LINK_GATES:
            rows, columns = _assign(points, moved, distance)
            for hand in np.unique(hands[hands >= 0]):
                own = hands[columns] == hand
                if own.sum() >= _FEWEST_ALIGNED:
                    rotation, shift = rigid_fit(predicted[columns[own]], points[rows[own]])
                    moved[hands == hand] = predicted[hands == hand] @ rotation.T + shift
                    rotation, shift = rigid_fit(self._points[columns[own]], points[rows[own]])
                    moved[beside == hand] = self._points[beside == hand] @ rotation.T + shift
        found[rows] = self._last[columns]
        return found

    def _beside(self, hands: Integers) -> Int[np.ndarray, "Q"]:
        """The hand that each unlabeled point of the last frame is near and moves with; -1 for none."""
        beside, loose, held = np.full(len(hands), -1), np.flatnonzero(hands < 0), np.flatnonzero(hands >= 0)
        if len(loose) and len(held):
            distances = np.linalg.norm(self._points[loose, None] - self._points[held], axis=-1)
            near = distances.min(axis=1) < _BESIDE_DISTANCE
            beside[loose[near]] = hands[held[distances.argmin(axis=1)[near]]]
        return beside


def _assign(points: Doubles, predicted: Doubles, distance: float) -> tuple[Integers, Integers]:
    """Match points with predicted points within a distance [m]; indices of both."""
    squares = ((points[:, None] - predicted) ** 2).sum(axis=-1)
    _, labels = assign(squares, np.full(len(points), distance**2))
    near = np.flatnonzero(labels >= 0)
    return near, labels[near]


def change_of_distances(before: Float[np.ndarray, "O 3"], points: Float[np.ndarray, "P 3"]) -> float:
    """Median change of the distances between neighbors [m]; infinite if too few points can be matched."""
    # About 2 mm between successive frames, even of fast hands; 8 mm and more between unrelated poses.
    rows, columns = _assign(points, before, _LINK_GATES[0])
    first, second = np.triu_indices(len(rows), 1)
    was = np.linalg.norm(before[columns[first]] - before[columns[second]], axis=-1)
    now = np.linalg.norm(points[rows[first]] - points[rows[second]], axis=-1)
    near = was < _NEIGHBOR_DISTANCE
    return float(np.median(np.abs(now - was)[near])) if near.sum() >= _FEWEST_NEIGHBORS else np.inf


def match_log_odds(
    points: Float[np.ndarray, "P 3"],
    positions: Float[np.ndarray, "K 3"],
    covariances: Float[np.ndarray, "K 3 3"],
    stray_density: float,
) -> Float[np.ndarray, "P K"]:
    """Log-odds that each point is each marker and not a stray, for strays of some density [1/m^3]."""
    innovation = points[:, None] - positions
    precision = np.linalg.inv(covariances)
    square = np.einsum("pki,kij,pkj->pk", innovation, precision, innovation)
    log_odds: Doubles = 0.5 * np.log(np.linalg.det(precision)) - 0.5 * square
    return log_odds - _stray_log_density(stray_density)


def peak_log_odds(variances: Float[np.ndarray, "K"], stray_density: float) -> Float[np.ndarray, "K"]:
    """Log-odds of a point exactly at the predicted position of a marker, by the marker's variance [m^2]."""
    return np.asarray(-1.5 * np.log(variances) - _stray_log_density(stray_density))


def match_points(log_odds: Float[np.ndarray, "P K"]) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The likeliest one-to-one assignment of points to markers, -1 for none, and its confidence (0 to 1)."""
    _, labels = assign(-log_odds, np.zeros(len(log_odds)))
    if 0 in log_odds.shape:
        return labels, np.ones(len(log_odds))
    weights = np.exp(np.minimum(log_odds, 50.0))
    alternatives = 1.0 + weights.sum(axis=1, keepdims=True) + weights.sum(axis=0) - weights
    share = weights / alternatives
    confidence = 1.0 - (weights / (1.0 + weights.sum(axis=1, keepdims=True))).sum(axis=1)
    matched = np.flatnonzero(labels >= 0)
    confidence[matched] = share[matched, labels[matched]]
    return labels, confidence


def _stray_log_density(stray_density: float) -> float:
    """Log density of strays, relative to the constant factor of a normal density."""
    return float(np.log(stray_density * (2.0 * np.pi) ** 1.5))
