"""A glove's markers on the resting hand, colored by how often they are right, with arrows where confused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from gloves.attachment import attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel
from handsim.hand.topology import BONES, PALM
from train.reports.dataset_plots import BAND, BLUE, CARD, INK, LINE, PALE, SOFT, WARM
from train.reports.run_plots import short

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

HAND_SIZE: Final = (10.8, 9.6)
"""Of the picture [inch]."""
MOST_ARROWS: Final = 12
_MARGIN: Final = 34.0  # around the hand [points]
_FONT: Final = 7.5
_DOT: Final = 4.2  # radius [points]
_BEND: Final = 0.22  # of the arrows, so that two that lead to and fro lie side by side
_BAR: Final = (0.90, 0.2, 0.016, 0.6)  # the colors' scale, in shares of the picture
_REACHES: Final = (7.0, 11.0, 16.0, 23.0, 32.0, 43.0, 56.0, 72.0, 92.0)  # from a dot to its name [points]


class Flat(NamedTuple):
    """A right hand of middle size at rest, seen from the back, on paper [m]: thumb left, fingers up."""

    outlines: list[Float[np.ndarray, "N 2"]]
    bones: Float[np.ndarray, "L 2 2"]
    markers: Float[np.ndarray, "M 2"]
    below: NDArray[np.bool_]
    """Which markers look away, to the palm's side."""


class Mistake(NamedTuple):
    """Points of one marker that were taken for another's."""

    truth: int
    called: int
    points: int
    share: float
    """Of the marker's points."""


def flat_hand(layout: MarkerLayout) -> Flat:
    """The hand and the glove on it, laid flat.

    Raises:
        LayoutError: A marker meets no skin.
    """
    model = HandModel.named("M")
    worn = attach_markers(layout, model)
    starts = model.rest_transforms[:, :3, 3]
    ends = starts + model.skeleton.lengths[:, None] * model.rest_transforms[:, :3, 0]
    bones = [(starts[number], ends[number]) for number in range(1, len(BONES))]
    bones += [(starts[PALM], starts[number]) for number, bone in enumerate(BONES) if bone.parent == PALM]
    surface = model.surface
    return Flat(
        _outlines(_on_paper(surface.vertices), surface.faces),
        _on_paper(np.array(bones)),
        _on_paper(worn.points),
        worn.normals[:, 2] < 0.0,
    )


def mistakes(confusion: Int[np.ndarray, "M+1 M+1"], most: int = MOST_ARROWS) -> list[Mistake]:
    """The pairs of markers that are confused most often, most often first; ghosts are no markers."""
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
    hand: Flat,
    names: tuple[str, ...],
    accuracy: Float[np.ndarray, "M"],
    arrows: list[Mistake],
) -> None:
    """The hand's picture.

    Args:
        figure: Where to draw, of `HAND_SIZE`.
        hand: Hand and markers.
        names: Markers in label order.
        accuracy: Slot accuracy of each, 0 to 1.
        arrows: From what points are to what they were called, the most frequent first.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    # Constrained layout would move things after the names have found their places.
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
    for name, dot, place in zip(
        labels, dots, place_names(labels, dots, arrows, (width, height)), strict=True
    ):
        _draw_name(panel, name, dot, place)
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=figure.add_axes(_BAR))
    bar.set_label("slots right [%]")
    bar.outline.set_visible(False)


def place_names(
    names: list[str], dots: Float[np.ndarray, "M 2"], arrows: list[Mistake], size: tuple[float, float]
) -> Float[np.ndarray, "M 2"]:
    """Centers of the names [points], each in turn where it is least in the way of dots, arrows and others.

    Args:
        names: What to write.
        dots: Markers [points].
        arrows: What is drawn between them.
        size: Of the paper [points].
    """
    extents = np.array([_extent(name) for name in names])
    taken = np.concatenate([dots, *(_bend(dots[arrow.truth], dots[arrow.called]) for arrow in arrows)])
    reach = np.concatenate([np.full((len(dots), 2), _DOT + 1.0), np.full((len(taken) - len(dots), 2), 1.5)])
    angles = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.zeros_like(dots)
    crowd = np.linalg.norm(dots[:, None] - dots, axis=-1)
    # The most crowded ones choose first.
    for number in np.argsort(np.sort(crowd, axis=1)[:, : min(4, len(dots))].sum(axis=1), kind="stable"):
        half = extents[number] / 2.0
        offsets = np.concatenate([around * (far + half) for far in _REACHES])
        cost = np.repeat(np.array(_REACHES), len(around)) - 2.0 * np.tile(around[:, 0], len(_REACHES))
        candidates = dots[number] + offsets
        overlap = (half + reach - np.abs(candidates[:, None] - taken)).clip(0.0, None).prod(axis=-1)
        others = np.arange(len(taken)) != number
        cost = cost + 4.0 * overlap[:, others].sum(axis=1) + 60.0 * (overlap[:, others] > 0.0).sum(axis=1)
        cost += 1e4 * ((candidates - half < 2.0) | (candidates + half > size)).any(axis=1)
        places[number] = candidates[cost.argmin()]
        taken = np.concatenate([taken, places[number, None]])
        reach = np.concatenate([reach, half[None] + 1.0])
    return places


def _extent(name: str) -> tuple[float, float]:
    """Width and height of a name as it is drawn [points]."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    width, _, _ = TextToPath().get_text_width_height_descent(name, FontProperties(size=_FONT), ismath=False)
    return float(width), 1.15 * _FONT


def _draw_dots(
    panel: Axes, dots: NDArray[np.float64], colors: NDArray[np.float64], below: NDArray[np.bool_]
) -> None:
    """Markers of the back as dots, those of the palm's side as rings."""
    for place, color, ring in zip(dots, colors, below, strict=True):
        panel.plot(*place, "o", markersize=2.0 * _DOT, zorder=5, markeredgecolor=color if ring else INK,
                   markerfacecolor=CARD if ring else color, markeredgewidth=2.2 if ring else 0.7)  # fmt: skip


def _draw_name(panel: Axes, name: str, dot: NDArray[np.float64], place: NDArray[np.float64]) -> None:
    """A name, with a line to its dot where it is not beside it."""
    panel.annotate(
        name, (place[0], place[1]), fontsize=_FONT, color=INK, ha="center", va="center_baseline", zorder=6,
        parse_math=False,
    )  # fmt: skip
    half = np.array(_extent(name)) / 2.0
    end = np.clip(dot, place - half, place + half)
    if np.linalg.norm(end - dot) > _REACHES[1] + 1.0:
        panel.plot(*np.stack([dot, end]).T, color=SOFT, linewidth=0.5, zorder=4)


def _draw_arrows(panel: Axes, dots: NDArray[np.float64], arrows: list[Mistake]) -> None:
    from matplotlib.patches import FancyArrowPatch

    for arrow in arrows:
        wide = 0.8 + 3.4 * (arrow.points / arrows[0].points) ** 0.5
        panel.add_patch(
            FancyArrowPatch(
                dots[arrow.truth], dots[arrow.called], connectionstyle=f"arc3,rad={_BEND}",
                arrowstyle=f"-|>,head_length={2.2 + wide},head_width={1.2 + 0.7 * wide}", mutation_scale=1.0,
                shrinkA=_DOT + 1.0, shrinkB=_DOT + 1.5, color=WARM, linewidth=wide, alpha=0.75, zorder=3,
            )
        )  # fmt: skip


def _bend(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places along an arrow, which is bent as matplotlib's arc3 is."""
    aside = _BEND * (second - first)[::-1] * (1.0, -1.0)
    middle = (first + second) / 2.0 + aside
    along = np.linspace(0.1, 0.9, 15)[:, None]
    curve: NDArray[np.float64] = (
        (1 - along) ** 2 * first + 2 * along * (1 - along) * middle + along**2 * second
    )
    return curve


def _on_paper(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places in the wrist's frame as they look from the back of a right hand."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _outlines(
    vertices: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"]
) -> list[Float[np.ndarray, "N 2"]]:
    """Loops around the faces that are seen, each the other way round than the holes in them."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    one, other = second - first, third - first
    seen = faces[one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0.0]
    ways = np.concatenate([seen[:, [0, 1]], seen[:, [1, 2]], seen[:, [2, 0]]])
    back = {(int(end), int(start)) for start, end in ways}
    edges = [(int(start), int(end)) for start, end in ways if (int(start), int(end)) not in back]
    follow: dict[int, list[int]] = {}
    for start, end in edges:
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
