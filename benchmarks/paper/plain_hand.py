"""What the rivals share: a hand whose only state is its last pose, and labels by proximity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves import GloveFit, Status
from handsim.hand.shape import NUM_QPOS
from track import PoseFit, TrackedHand
from track.kinematics.pose_solver import PoseSolver

MOST_RMS: Final = 0.008
"""RMS distance [m] above which a pose is rejected; Han et al. 2018, section 4.4."""
FEWEST: Final = 4
"""Labeled points that a pose needs; the paper gives no number, our solver needs this one."""


def labels_by_id(ids: Sequence[int], labels: Int[np.ndarray, "N"]) -> dict[int, int]:
    """Label of each ID; points without an ID or a label are left out."""
    pairs = zip(ids, labels.tolist(), strict=True)
    return {point: label for point, label in pairs if min(point, label) >= 0}


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
