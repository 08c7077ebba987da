"""The picture of a glove on the hand: markers colored by accuracy, arrows between confused ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from train.reports.flat_hand import FlatHand
from train.reports.plot_style import BAND, BLUE, CARD, INK, LINE, PALE, SOFT, WARM
from train.reports.run_plots import short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


HAND_SIZE: Final = (10.8, 9.6)
"""Of the picture [inch]."""
MOST_ARROWS: Final = 12
_MARGIN: Final = 34.0  # around the hand [points]
_BEND: Final = 0.22  # of the arrows, so that two that lead to and fro lie side by side
_BAR: Final = (0.90, 0.2, 0.016, 0.6)  # the colors' scale, in shares of the picture
FONT_SIZE: Final = 7.5
"""Of names [points]."""
DOT_RADIUS: Final = 4.2
"""Of a marker's dot [points]."""
DISTANCES: Final = (7.0, 11.0, 16.0, 23.0, 32.0, 43.0, 56.0, 72.0, 92.0)
"""Tried from a dot to its name [points]."""


class Mistake(NamedTuple):
    """Points of one marker that were taken for another's."""

    truth: int
    called: int
    points: int
    share: float
    """Of the marker's points."""


def mistakes(confusion: Int[np.ndarray, "M+1 M+1"], most: int = MOST_ARROWS) -> list[Mistake]:
    """The pairs of markers that are confused most often, most often first; ghosts do not count."""
    between = confusion[:-1, :-1] * ~np.eye(len(confusion) - 1, dtype=np.bool_)
    order = np.argsort(-between, axis=None, kind="stable")[:most]
    truths, called = np.unravel_index(order, between.shape)
    return [
        Mistake(
            int(truth), int(other), int(between[truth, other]), between[truth, other] / confusion[truth].sum()
        )
        for truth, other in zip(truths, called, strict=True)
        if between[truth, other]
    ]


def draw_hand(
    figure: Figure,
    hand: FlatHand,
    names: tuple[str, ...],
    accuracy: Float[np.ndarray, "M"],
    arrows: list[Mistake],
) -> None:
    """The hand's picture.

    Args:
        figure: Where to draw, of `HAND_SIZE`.
        names: Markers in label order.
        accuracy: Slot accuracy of each, 0 to 1.
        arrows: From what points are to what they were called, the most frequent first.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    # Constrained layout would move things after the names are placed.
    figure.set_layout_engine("none")
    panel: Axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    width, height = 72.0 * figure.get_figwidth(), 72.0 * figure.get_figheight()  # one unit is one point
    panel.set(xlim=(0.0, width), ylim=(0.0, height))
    panel.set_axis_off()
    everything = np.concatenate([*hand.outlines, hand.markers])
    low, size = everything.min(axis=0), np.ptp(everything, axis=0)
    scale = float(((np.array([0.86 * width, height]) - 2.0 * _MARGIN) / size).min())
    shift = np.array([0.46 * width, 0.5 * height]) - scale * (low + size / 2.0)
    outlines = [Path(scale * loop + shift, closed=True) for loop in hand.outlines]
    panel.add_patch(
        PathPatch(Path.make_compound_path(*outlines), facecolor=BAND, edgecolor=LINE, linewidth=1.0)
    )
    for bone in scale * hand.bones + shift:
        panel.plot(*bone.T, color=LINE, linewidth=3.0, solid_capstyle="round")
    dots = scale * hand.markers + shift
    _draw_arrows(panel, dots, arrows)
    colors = LinearSegmentedColormap.from_list("right", [WARM, "#d9a441", PALE, BLUE])
    norm = Normalize(min(99.0, float(np.floor(100.0 * accuracy.min()))), 100.0)
    _draw_dots(panel, dots, colors(norm(100.0 * accuracy)), hand.below)
    labels = [short(name) for name in names]
    curves = [arrow_curve(dots[arrow.truth], dots[arrow.called]) for arrow in arrows]
    centers = place_names(labels, dots, curves, (width, height))
    for name, dot, center in zip(labels, dots, centers, strict=True):
        _draw_name(panel, name, dot, center)
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=figure.add_axes(_BAR))
    bar.set_label("slots right [%]")
    bar.outline.set_visible(False)


def _draw_dots(
    panel: Axes, dots: NDArray[np.float64], colors: NDArray[np.float64], below: NDArray[np.bool_]
) -> None:
    """Markers of the back as dots, those of the palm's side as rings."""
    for dot, color, ring in zip(dots, colors, below, strict=True):
        panel.plot(*dot, "o", markersize=2.0 * DOT_RADIUS, zorder=5, markeredgecolor=color if ring else INK,
                   markerfacecolor=CARD if ring else color, markeredgewidth=2.2 if ring else 0.7)  # fmt: skip


def _draw_name(panel: Axes, name: str, dot: NDArray[np.float64], center: NDArray[np.float64]) -> None:
    """A name, with a line to its dot where it is not beside it."""
    panel.annotate(
        name, (center[0], center[1]), fontsize=FONT_SIZE, color=INK, ha="center", va="center_baseline",
        zorder=6, parse_math=False,
    )  # fmt: skip
    half = np.array(name_extent(name)) / 2.0
    end = np.clip(dot, center - half, center + half)
    if np.linalg.norm(end - dot) > DISTANCES[1] + 1.0:
        panel.plot(*np.stack([dot, end]).T, color=SOFT, linewidth=0.5, zorder=4)


def _draw_arrows(panel: Axes, dots: NDArray[np.float64], arrows: list[Mistake]) -> None:
    from matplotlib.patches import FancyArrowPatch

    for arrow in arrows:
        wide = 0.8 + 3.4 * (arrow.points / arrows[0].points) ** 0.5
        panel.add_patch(
            FancyArrowPatch(
                dots[arrow.truth], dots[arrow.called], connectionstyle=f"arc3,rad={_BEND}",
                arrowstyle=f"-|>,head_length={2.2 + wide},head_width={1.2 + 0.7 * wide}", mutation_scale=1.0,
                shrinkA=DOT_RADIUS + 1.0, shrinkB=DOT_RADIUS + 1.5, color=WARM, linewidth=wide,
                alpha=0.75, zorder=3,
            )
        )  # fmt: skip


def arrow_curve(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (15, 2) along an arrow [points], which is bent as matplotlib's arc3 is."""
    aside = _BEND * (second - first)[::-1] * (1.0, -1.0)
    middle = (first + second) / 2.0 + aside
    along = np.linspace(0.1, 0.9, 15)[:, None]
    return (1 - along) ** 2 * first + 2 * along * (1 - along) * middle + along**2 * second


def place_names(
    names: list[str],
    dots: Float[np.ndarray, "M 2"],
    curves: Sequence[Float[np.ndarray, "K 2"]],
    size: tuple[float, float],
) -> Float[np.ndarray, "M 2"]:
    """Centers of the names [points], each placed in turn where it overlaps least with what is there.

    Args:
        dots: Markers [points].
        curves: Points along the arrows [points].
        size: Width and height of the picture [points].
    """
    extents = np.array([name_extent(name) for name in names])
    taken = np.concatenate([dots, *curves])
    half_sizes = np.concatenate(
        [np.full((len(dots), 2), DOT_RADIUS + 1.0), np.full((len(taken) - len(dots), 2), 1.5)]
    )
    angles = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    centers = np.zeros_like(dots)
    crowd = np.linalg.norm(dots[:, None] - dots, axis=-1)
    # The most crowded dots come first.
    for number in np.argsort(np.sort(crowd, axis=1)[:, : min(4, len(dots))].sum(axis=1), kind="stable"):
        half = extents[number] / 2.0
        offsets = np.concatenate([around * (distance + half) for distance in DISTANCES])
        cost = np.repeat(np.array(DISTANCES), len(around)) - 2.0 * np.tile(around[:, 0], len(DISTANCES))
        candidates = dots[number] + offsets
        overlap = (half + half_sizes - np.abs(candidates[:, None] - taken)).clip(0.0, None).prod(axis=-1)
        others = np.arange(len(taken)) != number
        cost = cost + 4.0 * overlap[:, others].sum(axis=1) + 60.0 * (overlap[:, others] > 0.0).sum(axis=1)
        cost += 1e4 * ((candidates - half < 2.0) | (candidates + half > size)).any(axis=1)
        centers[number] = candidates[cost.argmin()]
        taken = np.concatenate([taken, centers[number, None]])
        half_sizes = np.concatenate([half_sizes, half[None] + 1.0])
    return centers


def name_extent(name: str) -> tuple[float, float]:
    """Width and height of a name as it is drawn [points]."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    width, _, _ = TextToPath().get_text_width_height_descent(
        name, FontProperties(size=FONT_SIZE), ismath=False
    )
    return float(width), 1.15 * FONT_SIZE
