"""Pictures of a glove on the resting hand: markers colored by accuracy, arrows between confused markers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit, attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, PALM
from handsim.pages import Paint, color_bar, color_scale, distinct_colors, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HAND_SIZE: Final = (10.8, 9.6)
"""Size of the picture [inch]."""
HAND_CAPTION: Final = (
    "A right hand of size M at rest, from the back; rings are markers that look to the palm's side. "
)
MAX_LETTERS: Final = 20
"""Longest marker name drawn in full."""
_SLIPS_SIZE: Final = (10.8, 6.6)  # size of the picture of slips [inch]
_MARGIN: Final = 34.0  # margin around the hand [points]
_BEND: Final = 0.22  # curvature of the arrows, so that two between a pair of markers lie side by side
_BAR: Final = (0.90, 0.2, 0.016, 0.6)  # position of the color bar, as shares of the picture
_FONT_SIZE: Final = 7.5  # font size of names [points]
_DOT_RADIUS: Final = 4.2  # radius of a marker's dot [points]
_DISTANCES: Final = (7.0, 11.0, 16.0, 23.0, 32.0, 43.0, 56.0, 72.0, 92.0)  # from dot to name [points]


class FlatHand(NamedTuple):
    """A right hand of size M at rest, seen from the back, in the plane [m]: thumb left, fingers up."""

    outlines: list[Float[np.ndarray, "N 2"]]
    bones: Float[np.ndarray, "L 2 2"]
    markers: Float[np.ndarray, "M 2"]
    below: NDArray[np.bool_]
    """Which markers face the palm's side (M,)."""

    def draw(
        self, panel: Axes, *, scale: float = 1.0, shift: Any = 0.0, bone_width: float, **bones: Any
    ) -> None:
        """Draw outline and bones, scaled and then shifted."""
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        outlines = [Path(scale * loop + shift, closed=True) for loop in self.outlines]
        outline = Path.make_compound_path(*outlines)
        panel.add_patch(PathPatch(outline, facecolor=Paint.BAND, edgecolor=Paint.LINE, linewidth=1.0))
        for bone in scale * self.bones + shift:
            panel.plot(*bone.T, color=Paint.LINE, linewidth=bone_width, solid_capstyle="round", **bones)


def flat_hand(layout: MarkerLayout) -> FlatHand:
    """Drawing of a glove on the hand of size M at rest."""
    model = HandModel.named("M")
    attachment = attach_markers(layout, model)
    starts = model.rest_transforms[:, :3, 3]
    ends = starts + model.skeleton.lengths[:, None] * model.rest_transforms[:, :3, 0]
    bones = [(starts[number], ends[number]) for number in range(1, len(BONES))]
    bones += [(starts[PALM], starts[number]) for number, bone in enumerate(BONES) if bone.parent == PALM]
    surface = model.surface
    return FlatHand(
        _outlines(_projected(surface.vertices), surface.faces),
        _projected(np.array(bones)),
        _projected(attachment.points),
        attachment.normals[:, 2] < 0.0,
    )


def _projected(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project positions (..., 3) in the wrist's frame to the view of a right hand's back (..., 2) [m]."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _outlines(
    vertices: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"]
) -> list[Float[np.ndarray, "N 2"]]:
    """Outlines of the faces turned to the viewer; those of holes have the opposite direction."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    one, other = second - first, third - first
    seen = faces[one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0.0]
    ways = np.concatenate([seen[:, [0, 1]], seen[:, [1, 2]], seen[:, [2, 0]]]).tolist()
    back = {(end, start) for start, end in ways}
    follow: dict[int, list[int]] = {}
    for start, end in ways:
        if (start, end) not in back:
            follow.setdefault(start, []).append(end)
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while loop[-1] in follow:
            here = loop[-1]
            loop.append(follow[here].pop())
            if not follow[here]:
                del follow[here]
        loops.append(vertices[loop])
    return loops


class Mistake(NamedTuple):
    """Points of the marker `truth` that were labeled as the marker `called`."""

    truth: int
    called: int
    points: int
    share: float
    """Share of the marker's points."""


def mistakes(confusion: Int[np.ndarray, "M+1 M+1"], most: int = 12) -> list[Mistake]:
    """The most frequently confused pairs of markers, the most frequent first."""
    between = confusion[:-1, :-1] * ~np.eye(len(confusion) - 1, dtype=np.bool_)
    order = np.argsort(-between, axis=None, kind="stable")[:most]
    truths, called = np.unravel_index(order, between.shape)
    return [
        Mistake(int(one), int(other), int(between[one, other]), between[one, other] / confusion[one].sum())
        for one, other in zip(truths, called, strict=True)
        if between[one, other]
    ]


def hand_picture(layout: MarkerLayout, accuracy: Float[np.ndarray, "M"], arrows: list[Mistake]) -> str:
    """Picture of the hand with each marker's slot accuracy, and arrows for mistakes."""
    percent = 100.0 * accuracy
    scale = (min(99.0, float(np.floor(percent.min()))), 100.0, "slots right [%]")
    return picture(HAND_SIZE, _draw_hand, flat_hand(layout), layout.names, percent, scale, arrows)


def residual_picture(layout: MarkerLayout, residuals: Float[np.ndarray, "M"]) -> str:
    """Picture of the hand with each marker's distance from its place in a fit [m], 0 to 10 mm."""
    scale = (10.0, 0.0, "distance from its place [mm]")
    return picture(HAND_SIZE, _draw_hand, flat_hand(layout), layout.names, 1e3 * residuals, scale, [])


def _draw_hand(
    figure: Figure,
    hand: FlatHand,
    names: tuple[str, ...],
    values: Float[np.ndarray, "M"],
    scale_of: tuple[float, float, str],
    arrows: list[Mistake],
) -> None:
    """Draw hand, markers, arrows, names and a color bar, with `scale_of` its ends and its title."""
    panel, (width, height), middle, scale = _canvas(figure, hand, hand.markers, 0.86)
    shift = np.array([0.46 * width, 0.5 * height]) - scale * middle
    hand.draw(panel, scale=scale, shift=shift, bone_width=3.0)
    dots = scale * hand.markers + shift
    _draw_arrows(panel, dots, arrows)
    worst, best, title = scale_of
    colors = color_scale(worst, best)
    for dot, color, ring in zip(dots, colors.to_rgba(values), hand.below, strict=True):
        edge, face, width = (color, Paint.CARD, 2.2) if ring else (Paint.INK, color, 0.7)
        panel.plot(*dot, "o", markersize=2.0 * _DOT_RADIUS, zorder=5, markeredgecolor=edge,
                   markerfacecolor=face, markeredgewidth=width)  # fmt: skip
    labels = [short(name) for name in names]
    curves = [arrow_curve(dots[arrow.truth], dots[arrow.called]) for arrow in arrows]
    centers = place_names(labels, dots, curves, (width, height))
    for name, dot, center in zip(labels, dots, centers, strict=True):
        _draw_name(panel, name, dot, center)
    color_bar(figure, colors, title, cax=figure.add_axes(_BAR))


def _canvas(
    figure: Figure, hand: FlatHand, dots: Float[np.ndarray, "K 2"], share: float
) -> tuple[Axes, tuple[float, float], Float[np.ndarray, "2"], float]:
    """A panel, its size [points], the middle of hand and dots [m], and the scale that fits a share of it."""
    # Constrained layout would move things after the names are placed.
    figure.set_layout_engine("none")
    panel: Axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    width, height = 72.0 * figure.get_figwidth(), 72.0 * figure.get_figheight()
    panel.set(xlim=(0.0, width), ylim=(0.0, height))
    panel.set_axis_off()
    everything = np.concatenate([*hand.outlines, dots])
    low, size = everything.min(axis=0), np.ptp(everything, axis=0)
    scale = float(((np.array([share * width, height]) - 2.0 * _MARGIN) / size).min())
    return panel, (width, height), low + size / 2.0, scale


def slips_picture(layout: MarkerLayout, slips: Sequence[GloveFit]) -> str:
    """Picture of the hand of size M from the back and the palm's side, with markers of many gloves."""
    points = np.stack([fit.attachment.points for fit in slips])
    below = np.stack([fit.attachment.normals[:, 2] < 0.0 for fit in slips])
    return picture(_SLIPS_SIZE, _draw_slips, flat_hand(layout), layout.names, _projected(points), below)


def _draw_slips(
    figure: Figure,
    hand: FlatHand,
    names: tuple[str, ...],
    dots: Float[np.ndarray, "P M 2"],
    below: NDArray[np.bool_],
) -> None:
    """Draw the markers of many gloves [m], one color per marker; those `below` (P, M) on the right."""
    panel, (width, height), middle, scale = _canvas(figure, hand, dots.reshape(-1, 2), 0.5)
    colors, middles, shown = distinct_colors(len(names)), [], []
    for center, flip, there in ((0.25, 1.0, ~below), (0.75, -1.0, below)):
        turn = np.array([flip, 1.0])
        shift = np.array([center * width, 0.5 * height]) - scale * turn * middle
        seen = hand._replace(outlines=[turn * loop for loop in hand.outlines], bones=turn * hand.bones)
        seen.draw(panel, scale=scale, shift=shift, bone_width=2.0)
        for marker, color in enumerate(colors):
            mine = scale * turn * dots[there[:, marker], marker] + shift
            panel.plot(*mine.T, "o", color=color, markersize=2.2, markeredgewidth=0, alpha=0.6)
            if len(mine) > len(dots) / 2:
                middles.append(mine.mean(axis=0))
                shown.append(marker)
    labels = [short(names[marker]) for marker in shown]
    centers = place_names(labels, np.array(middles), [], (width, height))
    for name, middle, center in zip(labels, middles, centers, strict=True):
        _draw_name(panel, name, middle, center)


def short(name: str) -> str:
    """Shorten a marker's name to the available room."""
    return name if len(name) <= MAX_LETTERS else name[: MAX_LETTERS - 1] + "…"


def _draw_name(panel: Axes, name: str, dot: NDArray[np.float64], center: NDArray[np.float64]) -> None:
    """Draw a name, with a line to its dot unless that is close."""
    panel.annotate(
        name, (center[0], center[1]), fontsize=_FONT_SIZE, color=Paint.INK, ha="center", va="center_baseline",
        zorder=6, parse_math=False,
    )  # fmt: skip
    half = np.array(name_extent(name)) / 2.0
    end = np.clip(dot, center - half, center + half)
    if np.linalg.norm(end - dot) > _DISTANCES[1] + 1.0:
        panel.plot(*np.stack([dot, end]).T, color=Paint.SOFT, linewidth=0.5, zorder=4)


def _draw_arrows(panel: Axes, dots: NDArray[np.float64], arrows: list[Mistake]) -> None:
    """Draw arrows from true to given labels, wider for more points."""
    from matplotlib.patches import FancyArrowPatch

    for arrow in arrows:
        wide = 0.8 + 3.4 * (arrow.points / arrows[0].points) ** 0.5
        panel.add_patch(
            FancyArrowPatch(
                dots[arrow.truth], dots[arrow.called], connectionstyle=f"arc3,rad={_BEND}",
                arrowstyle=f"-|>,head_length={2.2 + wide},head_width={1.2 + 0.7 * wide}", mutation_scale=1.0,
                shrinkA=_DOT_RADIUS + 1.0, shrinkB=_DOT_RADIUS + 1.5, color=Paint.WARM, linewidth=wide,
                alpha=0.75, zorder=3,
            )
        )  # fmt: skip


def arrow_curve(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (15, 2) along an arrow curved like matplotlib's arc3 [points]."""
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
    """Centers of the names, placed one by one where they overlap least with the rest [points]."""
    extents = np.array([name_extent(name) for name in names])
    taken = np.concatenate([dots, *curves])
    half_sizes = np.concatenate(
        [np.full((len(dots), 2), _DOT_RADIUS + 1.0), np.full((len(taken) - len(dots), 2), 1.5)]
    )
    angles = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    centers = np.zeros_like(dots)
    crowd = np.linalg.norm(dots[:, None] - dots, axis=-1)
    # The names of the most crowded dots are placed first.
    for number in np.argsort(np.sort(crowd, axis=1)[:, : min(4, len(dots))].sum(axis=1), kind="stable"):
        half = extents[number] / 2.0
        offsets = np.concatenate([around * (distance + half) for distance in _DISTANCES])
        cost = np.repeat(np.array(_DISTANCES), len(around)) - 2.0 * np.tile(around[:, 0], len(_DISTANCES))
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
    """Width and height of a drawn name [points]."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    font = FontProperties(size=_FONT_SIZE)
    width, _, _ = TextToPath().get_text_width_height_descent(name, font, ismath=False)
    return float(width), 1.15 * _FONT_SIZE
