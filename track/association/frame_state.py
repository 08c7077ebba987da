"""The state of one frame while hands are tracked in it: points, labels, evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(slots=True, eq=False)
class FrameState:
    """P points of a frame and what is known of each so far; H hands, M markers of each.

    The tracker makes one from the labels that the IDs carry over from the frame before, and hands it from
    step to step. These write it:

    - `labels`: `gate_labels` and `fit_labels` drop labels, `label_new_points` adds and reassigns them, the
      tracker writes those of a hand that was initialized and drops those of a hand that is lost.
    - `evidence`: the tracker, where a label changes and after each fit.
    - `confidence`: the tracker, where a label changes.
    - `points`, `ids`, `first_seen` and `time` stay as they are.
    """

    points: Float[np.ndarray, "P 3"]
    """Points in the world [m]."""
    ids: Int[np.ndarray, "P"]
    """The optical system's IDs; -1 where there is none."""
    labels: Int[np.ndarray, "H P"]
    """Marker of each hand that each point is, in the layout's order; -1 where it is none of them."""
    evidence: Float[np.ndarray, "P"]
    """Evidence for the label of each point that its ID has collected over the frames (log-odds)."""
    confidence: Float[np.ndarray, "P"]
    """Confidence in each label, 0 to 1."""
    first_seen: Float[np.ndarray, "P"]
    """Time of the first frame with the point's ID [s]; this frame's for points without an ID."""
    time: float
    """Time of the frame [s]."""

    @property
    def unlabeled(self) -> Bool[np.ndarray, "P"]:
        """Which points have no label of any hand."""
        unlabeled: np.ndarray = np.all(self.labels < 0, axis=0)
        return unlabeled

    def unlabeled_by_others(self, hands: int | list[int]) -> Int[np.ndarray, "F"]:
        """Indices (F,) of the points that carry no label of any hand except the given ones."""
        return np.flatnonzero((np.delete(self.labels, hands, axis=0) < 0).all(axis=0))
