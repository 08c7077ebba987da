"""The pictures of a training set's page: joint angles, occlusion, ghosts, neighbors and gaps."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float, Int

from handsim.hand.shape import DIGITS, JOINTS
from train.reports.plot_style import BAND, BLUE, CARD, INK, LINE, PALE, SOFT, WARM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PUBLISHED_MEDIAN: Final = (3, 4)
"""Median gap of real finger markers [frames], lowest and highest of the published takes."""
PUBLISHED_P90: Final = (24, 43)
"""The same, 90th percentile."""


def draw_angles(
    figure: Figure,
    shares: Float[np.ndarray, "20 N"],
    edges: Float[np.ndarray, "20 N+1"],
    middle: Float[np.ndarray, "20 2"],
) -> None:
    """Small multiples: one column per digit, one row per joint angle from the knuckle outwards.

    Args:
        shares: Share of frames in each bin of a joint angle's range.
        edges: The bins' edges [deg].
        middle: Angles between which 98 % of the frames lie [deg].
    """
    panels = figure.subplots(4, 5)
    for number, joint in enumerate(JOINTS):
        digit, row = divmod(number, 4)
        panel: Axes = panels[row, digit]
        if digit > 1:  # the thumb has axes of its own; linked before anything is drawn, so that all fits
            panel.sharex(panels[row, 1])
            panel.sharey(panels[row, 1])
        density = 100.0 * shares[number] / np.diff(edges[number])
        panel.axvspan(joint.low, joint.high, color=BAND, linewidth=0)
        panel.stairs(density, edges[number], fill=True, color=BLUE)
        panel.set_title(joint.name.split("_", 1)[1].replace("_", " "), loc="left", color=SOFT, fontsize=8.5)
        panel.margins(x=0.03, y=0.08)
        panel.axhline(0.0, color=LINE, linewidth=0.8)
        low, high = middle[number]
        panel.plot([low, high], [0.0, 0.0], color=WARM, linewidth=2.6, solid_capstyle="butt", clip_on=False)
        panel.xaxis.set_major_formatter("{x:.0f}°")
        panel.locator_params(axis="x", nbins=5)
        panel.locator_params(axis="y", nbins=3)
        panel.tick_params(labelsize=8.0, length=2.5)
        panel.spines["left"].set_visible(digit < 2)
        panel.tick_params(axis="y", left=digit < 2, labelleft=digit < 2)
    for digit, name in enumerate(DIGITS):
        panels[0, digit].annotate(
            name, (0.0, 1.0), (0.0, 20.0), "axes fraction", "offset points", weight="bold", fontsize=10.5
        )
    figure.supylabel("share of frames [% per degree]", fontsize=9.0, color=SOFT)


def draw_visibility(
    figure: Figure, names: tuple[str, ...], lost: Float[np.ndarray, "M"], seen_by: Float[np.ndarray, "M C+1"],
    min_cameras: int,
) -> None:  # fmt: skip
    """Bars of the share of frames without each marker; beside them how many cameras see it."""
    rows = np.arange(len(names))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.5))
    left.barh(rows, 100.0 * lost, color=BLUE, height=0.62)
    for row, share in enumerate(lost):
        left.annotate(f"{100 * share:.1f}", (100 * share, row), (4, 0), textcoords="offset points",
                      va="center", color=SOFT, fontsize=8.0)  # fmt: skip
    left.set_yticks(rows, names, color=INK, parse_math=False)
    left.set_ylim(len(names) - 0.4, -0.6)
    left.set_xlim(0.0, max(0.1, 115.0 * float(lost.max(initial=0.0))))
    left.set_xlabel(f"frames in which fewer than {min_cameras} cameras see it [%]")
    left.tick_params(axis="y", length=0)
    most = int(np.flatnonzero(seen_by.sum(axis=0))[-1]) if seen_by.any() else 0
    shades = right.pcolormesh(
        np.arange(most + 2) - 0.5, np.arange(len(names) + 1) - 0.5, 100.0 * seen_by[:, : most + 1],
        cmap="Blues", vmin=0.0, edgecolors=CARD, linewidth=1.2,
    )  # fmt: skip
    means = seen_by @ np.arange(seen_by.shape[1])
    right.plot(means, rows, "o", color=CARD, markeredgecolor=INK, markersize=4.5, markeredgewidth=0.9)
    right.annotate("mean", (means[0], 0.0), (0, 13), textcoords="offset points", ha="center", fontsize=8.0)
    right.axvline(min_cameras - 0.5, color=WARM, linewidth=1.4)
    right.annotate(f"at least {min_cameras}", (min_cameras - 0.5, -0.5), (3, 3), textcoords="offset points",
                   color=WARM, fontsize=8.0)  # fmt: skip
    right.set_xlabel("cameras that see it")
    right.locator_params(axis="x", integer=True)
    right.tick_params(axis="y", length=0)
    right.spines["left"].set_visible(False)
    bar = figure.colorbar(shades, ax=right, pad=0.02, aspect=35)
    bar.set_label("share of frames [%]")
    bar.outline.set_visible(False)


def draw_ghosts(figure: Figure, counts: Int[np.ndarray, "G+1"], distances: Float[np.ndarray, "N"]) -> None:
    """Ghosts per frame, and how far [m] each lies from the nearest marker."""
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    shares = 100.0 * counts / max(1, counts.sum())
    left.bar(np.arange(len(counts)), shares, color=BLUE, width=0.62)
    for count, share in enumerate(shares):
        left.annotate(f"{share:.1f}", (count, share), (0, 3), textcoords="offset points", ha="center",
                      color=SOFT, fontsize=8.0)  # fmt: skip
    left.set_xlabel("ghosts in a frame")
    left.set_ylabel("share of frames [%]")
    left.locator_params(axis="x", integer=True)
    _millimeters(right, distances, BLUE, "ghosts")
    right.set_xlabel("from a ghost to the nearest marker [mm]")
    if len(distances):
        _mark(right, 1e3 * float(np.median(distances)), "median {:.0f} mm", INK)
    else:
        right.annotate("no ghosts", (0.5, 0.5), xycoords="axes fraction", ha="center", color=SOFT)


def draw_neighbors(figure: Figure, distances: Float[np.ndarray, "T M"], diameter: float) -> None:
    """How near each marker's nearest neighbor is, and the nearest pair of each frame [m]."""
    panel = figure.subplots()
    nearest = distances.min(axis=1)
    _millimeters(panel, distances.ravel(), PALE, "")
    bins = _millimeter_bins(distances)
    panel.stairs(*_shares(nearest, bins), color=BLUE, linewidth=1.6)
    panel.set_ylabel("share [% per mm]")
    panel.set_xlabel("distance to the nearest other marker, center to center [mm]")
    for values, name, color in (
        (nearest, "nearest pair\nof each frame", BLUE),
        (distances, "every marker", SOFT),
    ):
        shares, _ = _shares(values.ravel(), bins)
        peak = int(shares.argmax())
        panel.annotate(name, (bins[peak], shares[peak]), (10, 4), textcoords="offset points", color=color,
                       annotation_clip=False)  # fmt: skip
    panel.set_xlim(left=0.0)
    _mark(panel, 1e3 * diameter, "marker diameter\n{:.1f} mm", WARM)


def draw_gaps(figure: Figure, lengths: Int[np.ndarray, "G"], rate: float) -> None:
    """Share of gaps [frames] that are no longer than a length, beside the published median and p90."""
    panel = figure.subplots()
    ordered = np.sort(lengths)
    longest = int(max(ordered[-1], 1.3 * PUBLISHED_P90[1]))
    steps = np.arange(1, longest + 2)
    shares = 100.0 * np.searchsorted(ordered, steps, side="right") / len(ordered)
    panel.step(steps, shares, where="post", color=BLUE, linewidth=1.8)
    panel.set_xscale("log")
    panel.set_xlim(0.9, 1.15 * longest)
    panel.set_ylim(0.0, 103.0)
    panel.xaxis.set_major_formatter("{x:.0f}")
    panel.set_xlabel("length of a gap [frames]")
    panel.set_ylabel("gaps no longer than that [%]")
    milliseconds = panel.secondary_xaxis(
        "top", functions=(partial(np.multiply, 1e3 / rate), partial(np.multiply, rate / 1e3))
    )
    milliseconds.xaxis.set_major_formatter("{x:.0f}")
    milliseconds.set_xlabel(f"[ms at {rate:g} Hz]")
    for height, name, published in ((50.0, "median", PUBLISHED_MEDIAN), (90.0, "p90", PUBLISHED_P90)):
        mine = int(np.percentile(ordered, height, method="inverted_cdf"))
        panel.axhline(height, color=BAND, linewidth=1.0, zorder=0)
        panel.plot(published, (height, height), color=WARM, linewidth=5.0, solid_capstyle="butt", alpha=0.85)
        panel.annotate(f"real finger markers: {name} {published[0]} to {published[1]}",
                       (published[1], height), (8, -11), textcoords="offset points", color=WARM)  # fmt: skip
        panel.plot(mine, height, "o", color=BLUE, markersize=6.0, markeredgecolor=CARD)
        panel.annotate(f"{name} {mine}", (mine, height), (-8, 5), textcoords="offset points",
                       color=BLUE, ha="right", weight="bold")  # fmt: skip


def _millimeter_bins(distances: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "B"]:
    """Edges [mm] of at most 80 whole-millimeter bins from 0 to the 99.9th percentile."""
    longest = 1e3 * float(np.percentile(distances, 99.9)) if distances.size else 1.0
    width = max(1.0, np.ceil(longest / 80.0))
    return np.arange(0.0, longest + width, width)


def _shares(
    distances: Float[np.ndarray, "N"], bins: Float[np.ndarray, "B"]
) -> tuple[Float[np.ndarray, "B-1"], Float[np.ndarray, "B"]]:
    """Percent per millimeter, and the bins."""
    counts, _ = np.histogram(1e3 * distances, bins)
    return 100.0 * counts / (max(1, len(distances)) * np.diff(bins)), bins


def _millimeters(panel: Axes, distances: Float[np.ndarray, "N"], color: str, noun: str) -> None:
    """A filled histogram of distances [m]."""
    panel.stairs(*_shares(distances, _millimeter_bins(distances)), fill=True, color=color)
    panel.set_ylabel(f"share of {noun} [% per mm]")
    panel.set_xlim(left=0.0)
    panel.margins(y=0.12)
    if not distances.size:
        panel.set_ylim(0.0, 1.0)


def _mark(panel: Axes, value: float, text: str, color: str) -> None:
    """An upright line with its meaning beside its top."""
    panel.axvline(value, color=color, linewidth=1.4)
    panel.annotate(text.format(value), (value, 1.0), (5, -2), ("data", "axes fraction"), "offset points",
                   va="top", color=color)  # fmt: skip
