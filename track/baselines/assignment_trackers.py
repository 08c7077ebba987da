"""Two ways to label that are older than the paper's, to be compared with.

Both are given the true labels of the first frame, as from somebody who holds a pose that the system knows (a
T-pose) until all is labeled: neither can begin by itself, and neither finds a hand that it lost but by luck.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from gloves.fit import GloveFit
from handsim.errors import ArgumentError
from track.baselines.plain_hand import MOST_RMS, PlainHand
from track.baselines.proposals import name_by_proximity
from track.kinematics.integration import move, velocity_of
from track.tracked_frame import Status, TrackedFrame, TrackedHand

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

NEAR: Final = 0.01
"""Distance [m] of a new point from where a lost marker was coming to, less than this."""
GATE: Final = 0.02
"""Distance [m] of a point from the marker it is assigned to, less than this."""
_LONGEST_GLIDE: Final = 0.05  # [s] that a motion is carried on for


class GivenFirst:
    """What both have in common: hands, and a first frame whose labels are known.

    Args:
        hands: The user's hands, each side at most once.
        first_labels: True labels of the first frame's points, counted through the hands; -1 for none.

    Raises:
        ArgumentError: A label is none of the hands', or the first frame has another number of points.
    """

    def __init__(self, hands: Sequence[GloveFit], first_labels: Int[np.ndarray, "N"]) -> None:
        self._hands = [PlainHand(hand) for hand in hands]
        self._first = np.cumsum([0, *(hand.num_markers for hand in self._hands)])
        self._first_labels: NDArray[np.int64] | None = np.asarray(first_labels, dtype=np.int64)
        if self._first_labels.max(initial=-1) >= self._first[-1]:
            raise ArgumentError(
                f"first_labels go up to {self._first_labels.max()}, expected less than {self._first[-1]}"
            )
        self._begin()

    def _begin(self) -> None:
        """Make ready what one of them alone remembers."""

    def _given(self, points: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """The labels of the first frame, when this is it."""
        labels, self._first_labels = self._first_labels, None
        if labels is not None and len(labels) != len(points):
            raise ArgumentError(
                f"first_labels name {len(labels)} points, but the first frame has {len(points)}"
            )
        return labels

    def _pose(self, points: NDArray[np.float64], labels: NDArray[np.int64]) -> list[TrackedHand]:
        """Solve every hand's pose from its labels; a hand keeps its pose where none is good enough."""
        tracked = []
        for number, hand in enumerate(self._hands):
            mine = (labels >= self._first[number]) & (labels < self._first[number + 1])
            names = np.where(mine, labels - self._first[number], -1)
            _, fit = hand.fit(points, [names])
            if fit is None or not fit.rms[0] <= MOST_RMS:
                tracked.append(hand.lost())
                continue
            hand.qpos = fit.qpos[0]
            tracked.append(hand.tracked(Status.TRACKED, points, names, fit))
        return tracked

    def _places(self, poses: Sequence[NDArray[np.float64] | None]) -> NDArray[np.float64]:
        """Where all hands' markers are [m]; nowhere without a pose."""
        places = np.full((self._first[-1], 3), np.inf)
        for number, (hand, pose) in enumerate(zip(self._hands, poses, strict=True)):
            if pose is not None:
                places[self._first[number] : self._first[number + 1]] = hand.solver.marker_positions(pose)
        return places


class NearestNeighborTracker(GivenFirst):
    """Names that go on by themselves, without a hand in the loop.

    A point keeps its name with its ID. A point whose ID is new takes the name of the lost marker that it is
    nearest to: to where that was coming, in a straight line for 50 ms, and less than 10 mm off; nearest
    pairs first. Poses are solved from the labels afterwards and change nothing; a pose of more than 8 mm RMS
    is not given out. Markers that the first frame lacks begin where a pose fitted to it has them.
    """

    def _begin(self) -> None:
        self._labels: dict[int, int] = {}
        self._before: set[int] = set()
        self._last = np.full((self._first[-1], 3), np.inf)
        self._speed, self._when = np.zeros_like(self._last), np.zeros(self._first[-1])

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame, see `PaperTracker.step`."""
        known, given = ids.tolist(), self._given(points)
        if given is None:
            labels = np.array([self._labels.get(point, -1) for point in known], dtype=np.int64)
            self._name_new(points, labels, [point not in self._before for point in known], time)
        else:
            labels = given
        hands = self._pose(points, labels)
        if given is not None:
            self._last[:] = self._places([hand.qpos for hand in self._hands])
            self._when[:] = time
        self._remember(points, labels, time)
        self._labels = {
            point: label
            for point, label in zip(known, labels.tolist(), strict=True)
            if min(point, label) >= 0
        }
        self._before = set(known) - {-1}
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))

    def _name_new(
        self, points: NDArray[np.float64], labels: NDArray[np.int64], new: list[bool], time: float
    ) -> None:
        chosen = np.flatnonzero(np.array(new, dtype=bool) & (labels < 0))
        span = np.minimum(time - self._when, _LONGEST_GLIDE)
        coming = self._last + span[:, None] * self._speed
        coming[labels[labels >= 0]] = np.inf
        labels[chosen] = name_by_proximity(points[chosen], coming, NEAR)

    def _remember(self, points: NDArray[np.float64], labels: NDArray[np.int64], time: float) -> None:
        mine = labels[labels >= 0]
        span = time - self._when[mine]
        moved = points[labels >= 0] - self._last[mine]
        self._speed[mine] = np.where(span[:, None] > 0.0, moved / np.maximum(span, 1e-9)[:, None], 0.0)
        self._last[mine], self._when[mine] = points[labels >= 0], time


class HungarianTracker(GivenFirst):
    """An optimal assignment in every frame (Maycock et al. 2015); IDs count for nothing.

    Every hand's pose goes on at its last speed; the model's markers there and all points are assigned to each
    other at the least sum of distances, every pair less than 20 mm apart, and the pose is solved anew. Where
    it fails (fewer than four points, or more than 8 mm RMS) a hand waits where it was, without a pose.
    """

    def _begin(self) -> None:
        self._speeds = np.zeros((len(self._hands), 26))
        self._time = 0.0

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame, see `PaperTracker.step`."""
        labels = self._given(points)
        span = time - self._time
        before = [hand.qpos for hand in self._hands]
        if labels is None:
            coming = [
                None if pose is None else move(pose[None], min(span, _LONGEST_GLIDE) * speed[None])[0]
                for pose, speed in zip(before, self._speeds, strict=True)
            ]
            labels = _assign(points, self._places(coming))
        hands = self._pose(points, labels)
        for number, (hand, tracked, last) in enumerate(zip(self._hands, hands, before, strict=True)):
            steady = last is not None and hand.qpos is not None and tracked.has_pose and span > 0.0
            self._speeds[number] = velocity_of(last, hand.qpos, span) if steady else 0.0  # type: ignore[arg-type]
        self._time = time
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))


def _assign(points: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Label of each point at the least sum of distances, a pair at the gate being as good as none."""
    apart = np.minimum(np.linalg.norm(points[:, None] - places, axis=-1), GATE)
    rows, columns = linear_sum_assignment(apart)
    labels = np.full(len(points), -1)
    close = apart[rows, columns] < GATE
    labels[rows[close]] = columns[close]
    return labels
