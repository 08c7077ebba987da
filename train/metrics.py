"""Accuracy, precision and recall of labelings, as Han et al. 2018 define them.

Slot accuracy: over frames and label slots, a slot is right when it holds the right point, or rightly none
(Tables 2, 4 and 6 on synthetic data). Point accuracy: over the points of the input, ghosts among them.
Occlusion (O) and ghost (G) figures take "occluded slot" and "ghost point" as the positive class. Macro F1 is
over points too: the mean F1 of the markers and of "ghost", the null class, as SOMA (Ghorbani and Black 2021)
counts it. Calibration compares the confidence of labels with the share of them that is right.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

BINS: Final = 15
"""Equally wide bins of confidence."""
LEAST_SURE: Final = 0.02
"""Share of the points that a person might check by hand."""


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
        """Count one frame by given and true labels, -1 for a ghost; which label slots are right."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Points in equally wide bins of confidence; NaN in bins that hold none."""

    confidence: Float[np.ndarray, "15"]
    """Mean confidence."""
    right: Float[np.ndarray, "15"]
    """Share that is right."""
    count: Int[np.ndarray, "15"]


def reliability(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> Reliability:
    """Share of right labels by confidence.

    Args:
        confidence: Confidence of each label, 0 to 1; a bin includes its lower edge, the last one also 1.
    """
    index = np.floor(confidence * BINS).astype(np.int64).clip(0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    sums = [np.bincount(index, weights, minlength=BINS) for weights in (confidence, right)]
    with np.errstate(invalid="ignore"):
        return Reliability(sums[0] / count, sums[1] / count, count)


def expected_calibration_error(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> float:
    """Mean difference of a bin's confidence and its share of right labels, weighted by points; NaN if empty.

    Args:
        confidence: Confidence of each label, 0 to 1.
    """
    if not len(confidence):
        return float("nan")
    bins = reliability(confidence, right)
    return float(np.nansum(np.abs(bins.confidence - bins.right) * bins.count) / len(confidence))


def error_without(
    confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"], share: float = LEAST_SURE
) -> float:
    """Share of points labeled wrongly after a share of least confidence is left out; NaN when none is kept.

    Where only some points of one confidence are left out, the result is the mean over all choices, so that
    the order of the points does not matter.
    """
    kept = len(confidence) - round(share * len(confidence))
    if not kept:
        return float("nan")
    least = np.partition(confidence, -kept)[-kept]  # the least confidence that is kept
    above, tied = confidence > least, confidence == least
    from_tied = (kept - above.sum()) * (~right[tied]).mean()
    return float(((~right[above]).sum() + from_tied) / kept)


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


def print_figures(columns: dict[str, dict[str, float]], *, title: str) -> None:
    """Print figures as a table in percent, a column each."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    table.add_column("figure")
    for name in columns:
        table.add_column(f"{name} [%]", justify="right")
    for figure in next(iter(columns.values())):
        table.add_row(
            figure.replace("_", " "), *map(percent, (column[figure] for column in columns.values()))
        )
    Console().print(table)
