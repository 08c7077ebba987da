"""Two labeling methods older than the paper's, as baselines: nearest neighbor and Hungarian assignment.

Both get the true labels of the first frame, as if the user held a known pose (a T-pose) until all points are
labeled. Neither can initialize a hand, and neither recovers a lost hand other than by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.paper.plain_hand import MOST_RMS, PlainHand, label_by_proximity, labels_by_id
from gloves import GloveFit, Status
from handsim.errors import ArgumentError
from handsim.kernels import move, velocity_of
from track import TrackedFrame, TrackedHand

NEAR: Final = 0.01
"""Upper bound of the distance of a new point from the predicted position of a lost marker [m]."""
GATE: Final = 0.02
"""Upper bound of the distance of a point from the marker it is assigned to [m]."""
_LONGEST_PREDICTION: Final = 0.05  # [s] of motion at constant velocity


class InitializedTracker:
    """Base of both: hands, and a first frame whose labels are known.

    Args:
        hands: The user's hands, each side at most once.
        first_labels: True labels of the first frame's points, counted through the hands; -1 for none.

    Raises:
        ArgumentError: A label is too large, or the first frame has another number of points.
    """

    def __init__(self, hands: Sequence[GloveFit], first_labels: Int[np.ndarray, "N"]) -> None:
        self._hands = [PlainHand(hand) for hand in hands]
        self._first_label = np.cumsum([0, *(hand.num_markers for hand in self._hands)])
        self._first_labels: NDArray[np.int64] | None = np.asarray(first_labels, dtype=np.int64)
        if self._first_labels.max(initial=-1) >= self._first_label[-1]:
            highest, most = self._first_labels.max(), self._first_label[-1]
            raise ArgumentError(f"first_labels go up to {highest}, expected less than {most}")
        self._reset()

    def _reset(self) -> None:
        """Initialize the state of a subclass."""

    def _take_first_labels(self, points: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """The labels of the first frame (N,); None in all later frames."""
        labels, self._first_labels = self._first_labels, None
        if labels is not None and len(labels) != len(points):
            raise ArgumentError(
                f"first_labels are of {len(labels)} points, but the first frame has {len(points)}"
            )
        return labels

    def _solve_poses(self, points: NDArray[np.float64], labels: NDArray[np.int64]) -> list[TrackedHand]:
        """Solve every hand's pose from its labels; a hand keeps its pose if the solved one is rejected."""
        tracked = []
        for number, hand in enumerate(self._hands):
            mine = (labels >= self._first_label[number]) & (labels < self._first_label[number + 1])
            hand_labels = np.where(mine, labels - self._first_label[number], -1)
            _, fit = hand.fit(points, [hand_labels])
            if fit is None or not fit.rms[0] <= MOST_RMS:
                tracked.append(hand.lost())
                continue
            hand.qpos = fit.qpos[0]
            tracked.append(hand.tracked(Status.TRACKED, points, hand_labels, fit))
        return tracked

    def _marker_positions(self, poses: Sequence[NDArray[np.float64] | None]) -> NDArray[np.float64]:
        """Markers of all hands at these poses [m]; infinite for a hand without a pose."""
        positions = np.full((self._first_label[-1], 3), np.inf)
        for number, (hand, pose) in enumerate(zip(self._hands, poses, strict=True)):
            if pose is not None:
                positions[self._first_label[number] : self._first_label[number + 1]] = (
                    hand.solver.marker_positions(pose)
                )
        return positions


class NearestNeighborTracker(InitializedTracker):
    """Labels by ID and by the nearest predicted marker; poses are not used for labeling.

    A point keeps its label with its ID. A point with a new ID takes the label of the lost marker with the
    nearest predicted position (constant velocity for 50 ms), less than 10 mm away; nearest pairs first.
    Poses are solved from the labels afterwards and do not change them; a pose of more than 8 mm RMS is
    rejected. Markers that the first frame lacks start at their positions by the pose fitted to it.
    """

    def _reset(self) -> None:
        self._labels: dict[int, int] = {}
        self._last_ids: set[int] = set()
        self._last_positions = np.full((self._first_label[-1], 3), np.inf)
        self._velocity, self._last_time = np.zeros_like(self._last_positions), np.zeros(self._first_label[-1])

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame, see `PaperTracker.step`."""
        known, first_labels = ids.tolist(), self._take_first_labels(points)
        if first_labels is None:
            labels = np.array([self._labels.get(point, -1) for point in known], dtype=np.int64)
            self._label_new_points(points, labels, [point not in self._last_ids for point in known], time)
        else:
            labels = first_labels
        hands = self._solve_poses(points, labels)
        if first_labels is not None:
            self._last_positions[:] = self._marker_positions([hand.qpos for hand in self._hands])
            self._last_time[:] = time
        self._remember(points, labels, time)
        self._labels = labels_by_id(known, labels)
        self._last_ids = set(known) - {-1}
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))

    def _label_new_points(
        self, points: NDArray[np.float64], labels: NDArray[np.int64], new: list[bool], time: float
    ) -> None:
        chosen = np.flatnonzero(np.array(new, dtype=bool) & (labels < 0))
        span = np.minimum(time - self._last_time, _LONGEST_PREDICTION)
        predicted = self._last_positions + span[:, None] * self._velocity
        predicted[labels[labels >= 0]] = np.inf
        labels[chosen] = label_by_proximity(points[chosen], predicted, NEAR)

    def _remember(self, points: NDArray[np.float64], labels: NDArray[np.int64], time: float) -> None:
        mine = labels[labels >= 0]
        span = time - self._last_time[mine]
        moved = points[labels >= 0] - self._last_positions[mine]
        self._velocity[mine] = np.where(span[:, None] > 0.0, moved / np.maximum(span, 1e-9)[:, None], 0.0)
        self._last_positions[mine], self._last_time[mine] = points[labels >= 0], time


class HungarianTracker(InitializedTracker):
    """An optimal assignment in every frame (Maycock et al. 2015); IDs are not used.

    Every hand's pose is predicted at constant velocity. The model's markers at that pose and all points are
    assigned to each other with the least sum of distances, each less than 20 mm, and the pose is solved
    again. If that fails (fewer than four points, or more than 8 mm RMS), the hand has no pose in this frame
    and keeps its last one for the next prediction.
    """

    def _reset(self) -> None:
        self._velocities = np.zeros((len(self._hands), 26))
        self._time = 0.0

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame, see `PaperTracker.step`."""
        labels = self._take_first_labels(points)
        span = time - self._time
        before = [hand.qpos for hand in self._hands]
        if labels is None:
            predicted = [
                None if pose is None else move(pose[None], min(span, _LONGEST_PREDICTION) * velocity[None])[0]
                for pose, velocity in zip(before, self._velocities, strict=True)
            ]
            labels = _assign(points, self._marker_positions(predicted))
        hands = self._solve_poses(points, labels)
        for number, (hand, tracked, last) in enumerate(zip(self._hands, hands, before, strict=True)):
            self._velocities[number] = 0.0
            if last is not None and hand.qpos is not None and tracked.has_pose and span > 0.0:
                self._velocities[number] = velocity_of(last, hand.qpos, span)
        self._time = time
        return TrackedFrame(time, tuple(hands), labels, np.ones(len(points)))


def _assign(points: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Label of each point (N,) by the assignment of least total distance; pairs at the gate are dropped."""
    distances = np.minimum(np.linalg.norm(points[:, None] - positions, axis=-1), GATE)
    rows, columns = linear_sum_assignment(distances)
    labels = np.full(len(points), -1)
    close = distances[rows, columns] < GATE
    labels[rows[close]] = columns[close]
    return labels
