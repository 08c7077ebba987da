"""One of the user's hands with nothing to it but its last pose: what simple tracking loops are made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.fit import GloveFit
from handsim.hand.topology import NUM_QPOS
from track.kinematics.pose_solver import PoseFit, PoseSolver
from track.tracked_frame import Status, TrackedHand

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

MOST_RMS: Final = 0.008
"""RMS distance [m] beyond which a pose is thrown away; Han et al. 2018, section 4.4."""
FEWEST: Final = 4
"""Named points without which no pose is solved; the paper gives no number, the solver wants this one."""


class PlainHand:
    """A hand that loops without memory follow.

    Args:
        hand: The hand and its glove.
    """

    def __init__(self, hand: GloveFit) -> None:
        self.hand = hand
        self.solver = PoseSolver(hand)
        self.num_markers = hand.attachment.layout.num_markers
        self.qpos: NDArray[np.float64] | None = None
        """The pose of the frame before; None where there is none."""

    def fit(
        self, points: Float[np.ndarray, "N 3"], proposals: Sequence[Int[np.ndarray, "N"]]
    ) -> tuple[list[Int[np.ndarray, "N"]], PoseFit | None]:
        """Solve the pose of every way to name points, from the pose before where there is one.

        Args:
            points: Points of a frame [m].
            proposals: Marker of each point, -1 for none of this hand's.

        Returns:
            The proposals with at least `FEWEST` names, and their poses in this order; None without any.
        """
        usable = [names for names in proposals if (names >= 0).sum() >= FEWEST]
        if not usable:
            return [], None
        targets = np.full((len(usable), self.num_markers, 3), np.nan)
        for row, names in enumerate(usable):
            targets[row, names[names >= 0]] = points[names >= 0]
        initial = None if self.qpos is None else np.tile(self.qpos, (len(usable), 1))
        return usable, self.solver.solve(targets, initial)

    def tracked(
        self,
        status: Status,
        points: Float[np.ndarray, "N 3"],
        names: Int[np.ndarray, "N"],
        fit: PoseFit,
        row: int = 0,
    ) -> TrackedHand:
        """What is said of this hand in a frame: one of the poses that were solved and its names."""
        there = names >= 0
        markers = self.solver.marker_positions(fit.qpos[row])
        markers[names[there]] = points[there]
        filled = np.setdiff1d(np.arange(self.num_markers), names[there])
        return TrackedHand(self.hand.side, status, fit.qpos[row], float(fit.rms[row]), markers, filled)

    def lost(self) -> TrackedHand:
        """What is said of this hand in a frame that has no pose of it."""
        nowhere = np.full((self.num_markers, 3), np.nan)
        return TrackedHand(
            self.hand.side, Status.LOST, np.full(NUM_QPOS, np.nan), np.nan, nowhere, np.arange(0)
        )
