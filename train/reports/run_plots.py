"""The pictures of a training run's page, but for the hand's: curves, confusion, reliability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Int

from train.evaluation import BINS, History, Reliability
from train.reports.plot_style import BAND, BLUE, INK, LINE, PALE, SOFT, WARM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST_NAME: Final = 20  # letters of a marker's name that are drawn
_LEAST_SHARE: Final = 0.01  # lowest end of the confusions' scale [%]
_MOST_WRITTEN: Final = 30  # classes up to which a cell has room for a number


def short(name: str) -> str:
    """A marker's name as there is room for it."""
    return name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"


def confusion_size(num_classes: int) -> tuple[float, float]:
    """Width and height [inch] of a confusion matrix in which every name can be read."""
    side = 1.6 + num_classes * float(np.clip(8.4 / num_classes, 0.15, 0.36))
    return side + 0.9, side


def draw_curves(figure: Figure, history: History) -> None:
    """Loss, held-out accuracy where there is any, and learning rate, over the samples seen."""
    from matplotlib.ticker import LogFormatter

    done, losses, rates = np.array(history.losses, dtype=np.float64).reshape(-1, 3).T
    heights = (2.6, 1.5, 0.9)
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=heights)
    upper.plot(done, losses, color=BLUE, linewidth=1.6, marker="o" if len(done) == 1 else None)
    upper.set_yscale("log")
    for axis in (upper.yaxis.set_major_formatter, upper.yaxis.set_minor_formatter):
        axis(LogFormatter(minor_thresholds=(2.0, 0.5)))
    upper.set_ylabel("loss")
    if history.accuracies:
        seen, _, accuracy = np.array(history.accuracies, dtype=np.float64).T
        middle.plot(seen, 100.0 * accuracy, "o-", color=WARM, linewidth=1.6, markersize=4.5)
        middle.annotate(f"{100.0 * accuracy[-1]:.2f}", (seen[-1], 100.0 * accuracy[-1]), (0, -12),
                        textcoords="offset points", ha="right", color=WARM, weight="bold")  # fmt: skip
    middle.set_ylabel("held-out slots\nright [%]")
    middle.margins(y=0.2)
    lower.plot(done, rates, color=SOFT, linewidth=1.4, marker="o" if len(done) == 1 else None)
    lower.set_ylabel("learning\nrate")
    lower.set_ylim(bottom=0.0)
    lower.set_xlim(left=0.0)
    lower.xaxis.set_major_formatter("{x:,.0f}")
    lower.set_xlabel("samples")
    for panel in (upper, middle, lower):
        panel.grid(axis="y", which="major", color=BAND, linewidth=0.8)
    figure.align_ylabels()


def draw_confusion(figure: Figure, names: Sequence[str], confusion: Int[np.ndarray, "M+1 M+1"]) -> None:
    """Share of each row's points by what they were called: mistakes in color, the diagonal in figures.

    Args:
        figure: Where to draw, of `confusion_size`.
        names: Markers in label order.
        confusion: Counts, rows the truth, last the ghosts.
    """
    from matplotlib.colors import LogNorm

    classes = [*map(short, names), "ghost"]
    places = np.arange(len(classes))
    shares = row_percent(confusion)
    wrong = np.where(np.eye(len(classes), dtype=np.bool_) | (shares == 0.0), np.nan, shares)
    # From the decade below the rarest mistake to the most frequent one.
    rarest, most = np.nanmin(wrong, initial=1.0), np.nanmax(wrong, initial=10.0)
    norm = LogNorm(max(_LEAST_SHARE, 10.0 ** np.ceil(np.log10(rarest) - 1.0)), most, clip=True)
    panel: Axes = figure.subplots()
    for place, right in enumerate(shares.diagonal()):
        panel.fill([place - 0.5, place + 0.5, place + 0.5, place - 0.5],
                   [place - 0.5, place - 0.5, place + 0.5, place + 0.5], color=BAND, linewidth=0)  # fmt: skip
        if len(classes) <= _MOST_WRITTEN and np.isfinite(right):
            panel.annotate(f"{right:.1f}" if right < 99.95 else "100", (place, place), ha="center",
                           va="center", fontsize=6.0, color=SOFT)  # fmt: skip
    edges = np.arange(len(classes) + 1) - 0.5
    shades = panel.pcolormesh(edges, edges, np.ma.masked_invalid(wrong), cmap="Oranges", norm=norm)
    panel.hlines(edges, edges[0], edges[-1], color=BAND, linewidth=0.5)
    panel.vlines(edges, edges[0], edges[-1], color=BAND, linewidth=0.5)
    small = 8.0 if len(classes) <= _MOST_WRITTEN else 6.5
    panel.set_xticks(places, classes, rotation=90, fontsize=small, color=INK, parse_math=False)
    panel.set_yticks(places, classes, fontsize=small, color=INK, parse_math=False)
    panel.set_xlim(edges[0], edges[-1])
    panel.set_ylim(edges[-1], edges[0])
    panel.set_aspect("equal")
    panel.tick_params(length=0)
    panel.spines[:].set_visible(False)
    panel.set_xlabel("called")
    panel.set_ylabel("is")
    bar = figure.colorbar(shades, ax=panel, pad=0.02, aspect=40, shrink=0.8)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.set_label("share of the row's points [%]")
    bar.outline.set_visible(False)


def row_percent(confusion: Int[np.ndarray, "K K"]) -> np.ndarray:
    """Each row's counts in percent of their sum, NaN in rows without any."""
    with np.errstate(invalid="ignore"):
        shares: np.ndarray = 100.0 * confusion / confusion.sum(axis=1, keepdims=True)
    return shares


def draw_reliability(figure: Figure, bins: Reliability, error: float) -> None:
    """Share right by confidence, and below it how many points have that confidence."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.0, 1.0))
    there = bins.count > 0
    upper.plot([0.0, 100.0], [0.0, 100.0], color=LINE, linewidth=1.4, zorder=1)
    confidence, right = 100.0 * bins.confidence[there], 100.0 * bins.right[there]
    upper.vlines(confidence, confidence, right, color=WARM, linewidth=2.0, zorder=2)
    upper.plot(confidence, right, "o-", color=BLUE, markersize=5.0, linewidth=1.4, zorder=3)
    upper.set_ylim(-3.0, 103.0)
    upper.set_ylabel("points right [%]")
    upper.set_title(f"expected calibration error {100.0 * error:.2f} %", loc="left", color=WARM)
    edges = np.linspace(0.0, 100.0, BINS + 1)
    lower.stairs(np.maximum(bins.count, 0.5), edges, fill=True, color=PALE, baseline=0.5)
    lower.set_yscale("log")
    lower.set_ylim(0.5, 2.0 * max(1, int(bins.count.max())))
    lower.set_ylabel("points")
    lower.set_xlabel("confidence [%]")
    lower.set_xlim(0.0, 100.5)
    figure.align_ylabels()
