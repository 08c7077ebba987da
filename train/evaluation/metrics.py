"""Accuracy, precision and recall of labelings, as Han et al. 2018 define them.

Slot accuracy: over frames and label slots, a slot is right when it holds the right point, or rightly none
(Tables 2, 4 and 6 on synthetic data). Point accuracy: over the points of the input, ghosts among them.
Occlusion (O) and ghost (G) figures take "occluded slot" and "ghost point" as the positive class. Macro F1 is
over points too: the mean F1 of the markers and of "ghost", the null class, as SOMA (Ghorbani and Black 2021)
counts it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int


@dataclass(slots=True)
class LabelCounts:
    """Running counts; every figure is a share in [0, 1], NaN where there was nothing to count.

    Precision is NaN also where nothing was hidden, or no point a ghost: whatever was said is wrong then, and
    its number says more than its share, zero.
    """

    frames: int = 0
    frames_right: int = 0
    slots: int = 0
    slots_right: int = 0
    points: int = 0
    points_right: int = 0
    occluded: int = 0
    occluded_given: int = 0
    occluded_right: int = 0
    ghosts: int = 0
    ghosts_given: int = 0
    ghosts_right: int = 0
    confusion: Int[np.ndarray, "M+1 M+1"] = field(
        default_factory=lambda: np.zeros((0, 0), dtype=np.int64), compare=False
    )
    """Points by true label (rows) and given label (columns): markers in label order, then ghost.
    Empty before the first frame."""

    def add(
        self, labels: Int[np.ndarray, "N"], truth: Int[np.ndarray, "N"], num_labels: int
    ) -> Bool[np.ndarray, "M"]:
        """Count one frame.

        Args:
            labels: Given label of each point, -1 for a ghost.
            truth: True label of each point, -1 for a ghost.
            num_labels: Number of markers M.

        Returns:
            Which label slots are right.
        """
        given, true = _slots(labels, num_labels), _slots(truth, num_labels)
        right: np.ndarray = given == true
        slots_right, points_right = int(right.sum()), int((labels == truth).sum())
        self.frames += 1
        self.frames_right += slots_right == num_labels and points_right == len(truth)
        self.slots += num_labels
        self.slots_right += slots_right
        self.points += len(truth)
        self.points_right += points_right
        self.occluded += int((true < 0).sum())
        self.occluded_given += int((given < 0).sum())
        self.occluded_right += int(((given < 0) & (true < 0)).sum())
        self.ghosts += int((truth < 0).sum())
        self.ghosts_given += int((labels < 0).sum())
        self.ghosts_right += int(((labels < 0) & (truth < 0)).sum())
        if not self.confusion.size:
            self.confusion = np.zeros((num_labels + 1, num_labels + 1), dtype=np.int64)
        np.add.at(self.confusion, (truth, labels), 1)  # -1, a ghost, is the last row and column
        return right

    def figures(self) -> dict[str, float]:
        """All figures by name."""
        return {
            "slot_accuracy": _share(self.slots_right, self.slots),
            "point_accuracy": _share(self.points_right, self.points),
            "frame_accuracy": _share(self.frames_right, self.frames),
            "occlusion_ratio": _share(self.occluded, self.slots),
            "occlusion_precision": _precision(self.occluded_right, self.occluded_given, self.occluded),
            "occlusion_recall": _share(self.occluded_right, self.occluded),
            "ghost_ratio": _share(self.ghosts, self.slots),
            "ghost_precision": _precision(self.ghosts_right, self.ghosts_given, self.ghosts),
            "ghost_recall": _share(self.ghosts_right, self.ghosts),
            "macro_f1": macro_f1(self.confusion),
        }

    def numbers(self) -> dict[str, int]:
        """What the shares of occlusions and ghosts come from."""
        names = ("occluded", "occluded_given", "occluded_right", "ghosts", "ghosts_given", "ghosts_right")
        return {name: getattr(self, name) for name in ("slots", "points", *names)}


def macro_f1(confusion: Int[np.ndarray, "K K"]) -> float:
    """Mean F1 of the classes that occur, as true or given labels; NaN where none does.

    Args:
        confusion: Counts, rows the truth.
    """
    occurs = confusion.sum(axis=0) + confusion.sum(axis=1)
    there = occurs > 0
    if not there.any():
        return float("nan")
    return float((2.0 * confusion.diagonal()[there] / occurs[there]).mean())


def percent(share: float) -> str:
    """A share in percent with two decimals, a dash for NaN."""
    return "-" if np.isnan(share) else f"{100 * share:.2f}"


def _slots(labels: Int[np.ndarray, "N"], num_labels: int) -> Int[np.ndarray, "M"]:
    """Which point each label slot holds, -1 for none."""
    slots = np.full(num_labels, -1)
    labeled = np.flatnonzero(labels >= 0)
    slots[labels[labeled]] = labeled
    return slots


def _precision(right: int, given: int, there: int) -> float:
    return _share(right, given) if there else float("nan")


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
