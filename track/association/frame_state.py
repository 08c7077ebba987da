"""The labels of a frame's points, and the state that the steps of the tracker hand from one to the next.

A label is one number: the markers of each hand in their layout's order, hand after hand, then those of each
rigid body. Only `Numbering` knows where a hand begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from handsim.kernels.kernel import kernel


class Numbering:
    """The one numbering of the markers of all owners: hands, then bodies.

    Args:
        counts: Markers of each owner.
    """

    def __init__(self, counts: Sequence[int]) -> None:
        self._first = np.cumsum([0, *counts]).tolist()
        self.owners: Int[np.ndarray, "K"] = np.repeat(np.arange(len(counts)), counts)
        """Owner of each label."""

    def part(self, owner: int) -> slice:
        """The labels of an owner."""
        return slice(self._first[owner], self._first[owner + 1])

    def markers(self, owner: int, labels: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
        """Marker of an owner that each point is, in the layout's order; -1 where it is none of them."""
        return _markers(labels, self._first[owner], self._first[owner + 1])

    def with_markers(
        self, owner: int, markers: Int[np.ndarray, "N"], labels: Int[np.ndarray, "N"]
    ) -> Int[np.ndarray, "N"]:
        """Labels in which exactly these points are an owner's markers.

        Args:
            markers: Its marker that each point is; -1 where it is none of them.
            labels: Labels before; those of other owners stay, but where `markers` has a marker.
        """
        return _with_markers(labels, self._first[owner], self._first[owner + 1], markers)


class FrameState(NamedTuple):
    """P points of a frame and what is known of each so far.

    Every step of the tracker takes one and gives the next; no array of it is ever overwritten.
    """

    points: Float[np.ndarray, "P 3"]
    """Points in the world [m]."""
    ids: Int[np.ndarray, "P"]
    """Numbers of the points that last from frame to frame."""
    labels: Int[np.ndarray, "P"]
    """Label of each point by `numbering`, -1 for none."""
    evidence: Float[np.ndarray, "P"]
    """Evidence for the label of each point that its number has collected over the frames (log-odds)."""
    confidence: Float[np.ndarray, "P"]
    """Confidence in each label, 0 to 1."""
    first_seen: Float[np.ndarray, "P"]
    """Time of the first frame with the point's number [s]."""
    time: float
    """Time of the frame [s]."""
    numbering: Numbering
    """What labels mean."""

    @property
    def unlabeled(self) -> Bool[np.ndarray, "P"]:
        """Which points have no label."""
        return self.labels < 0

    def markers(self, hand: int) -> Int[np.ndarray, "P"]:
        """Marker of a hand that each point is, -1 where it is none of them."""
        return self.numbering.markers(hand, self.labels)

    def with_markers(self, hand: int, markers: Int[np.ndarray, "P"]) -> FrameState:
        """The state in which exactly these points are a hand's markers."""
        return self._replace(labels=self.numbering.with_markers(hand, markers, self.labels))

    def with_confidence(
        self, changed: Bool[np.ndarray, "P"], confidence: Float[np.ndarray, "C"]
    ) -> FrameState:
        """The state in which C labels are new: without evidence so far, and with this confidence.

        Args:
            changed: Points whose label is new.
            confidence: Confidence in each of these labels, 0 to 1.
        """
        evidence, all_confidence = self.evidence.copy(), self.confidence.copy()
        evidence[changed], all_confidence[changed] = 0.0, confidence
        return self._replace(evidence=evidence, confidence=all_confidence)

    def free_for(self, hands: Sequence[int]) -> Int[np.ndarray, "F"]:
        """Indices of the points that have no label, or one of these hands."""
        free = self.unlabeled
        for hand in hands:
            free |= self.markers(hand) >= 0
        return np.flatnonzero(free)


@kernel
def targets_of(
    points: Float[np.ndarray, "N 3"], markers: Int[np.ndarray, "N"], count: int
) -> Float[np.ndarray, "M 3"]:
    """Labeled points in the layout's order [m], NaN where a marker has no point.

    Args:
        markers: Marker of each point, -1 for none.
        count: Markers of the layout.
    """
    targets = np.full((count, 3), np.nan)
    for point in range(len(markers)):
        if markers[point] >= 0:
            targets[markers[point]] = points[point]
    return targets


@kernel
def _markers(labels: Int[np.ndarray, "N"], first: int, last: int) -> Int[np.ndarray, "N"]:
    """`Numbering.markers` of the owner of the labels from `first` to before `last`."""
    markers = np.full(len(labels), -1)
    for point in range(len(labels)):
        if first <= labels[point] < last:
            markers[point] = labels[point] - first
    return markers


@kernel
def _with_markers(
    labels: Int[np.ndarray, "N"], first: int, last: int, markers: Int[np.ndarray, "N"]
) -> Int[np.ndarray, "N"]:
    """`Numbering.with_markers` of the owner of the labels from `first` to before `last`."""
    changed = labels.copy()
    for point in range(len(labels)):
        if markers[point] >= 0:
            changed[point] = first + markers[point]
        elif first <= labels[point] < last:
            changed[point] = -1
    return changed
