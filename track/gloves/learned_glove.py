"""A glove that labeled captures show: where each marker sits, on whose hands, and how well that labels.

Nobody has to say which column is which marker. Columns that stay near each other may be a hand; a search
finds the bone that carries each of them (`marker_search`), hands and places are fitted together (`fit`), and
the places of all hands make one layout. The last third of each capture is kept for the proof: it is labeled
with the layout, from points without names.
"""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.fit import GloveFit, attach, place_marker, settle_glove
from gloves.layout import FEWEST_MARKERS, MOST_MARKERS, AnyLayout, MarkerLayout, MarkerPlace, load_layout
from handsim.callbacks import OnStep, no_step
from handsim.errors import CaptureError, HandSimWarning, LayoutError
from handsim.hand.model import HandModel
from handsim.hand.shape import SIDES, Side
from handsim.settings import Limits, Settings
from handsim.space.transforms import MIRROR
from track.frames import AnyCapture, capture_of
from track.gloves.fit import PLACE_SPREAD, FittedPlaces, fit_places
from track.gloves.marker_search import FittedHand, diverse_frames, search_places
from track.user import User

_FRAMES: Final = 60  # of each capture, in which hands and places are fitted
_HAND: Final = 0.26  # [m] Two markers of a hand are never farther apart.
_LEARNED: Final = 2 / 3  # share of each capture that is learned from
_COMMON_SPREAD: Final = 0.004  # [m] standard deviation of a marker's place between people
_ROUNDS: Final = 2  # of a common layout and fits of all hands to it
_FITS: Final = 0.003  # [m] A hand whose markers are farther from their places in the median is none.
_MARKER_FITS: Final = 0.006  # [m] the same of a single column
_PAIRED: Final = 0.02  # [m] Markers of the other hand at most this far from a place are the same marker.


@dataclass(frozen=True, slots=True)
class LearnSettings(Settings):
    """How a glove is learned from captures: options of `handsim glove learn`, arguments of `learn_glove`."""

    radius_mm: Annotated[float | None, Limits(0.5, 15.0)] = None
    """Radius of the markers [mm]; needed unless there is a start."""
    start: AnyLayout | None = None
    """A guess of the layout, the path of a .toml file: its places are corrected. The captures then need no
    labels."""
    hands: tuple[Side, ...] = SIDES
    """Which hands may be in the captures."""


class TrialHand(NamedTuple):
    """A hand of one of the captures in the learned glove."""

    capture: int
    """Number of the capture."""
    columns: Mapping[str, int]
    """Column of each marker that the capture has."""
    hand: GloveFit
    """The hand with the capture's own places."""
    residuals: Float[np.ndarray, "M"]
    """Root mean square distance of each of these markers from its place [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class LearnedGlove:
    """A layout that captures show, and the hands in them."""

    layout: MarkerLayout
    hands: tuple[TrialHand, ...]
    left_out: tuple[str, ...]
    """Sentences on columns that do not belong to a hand, or not to the glove."""
    spreads: Float[np.ndarray, "M"]
    """How far each marker's place differs between the hands and the layout, root mean square [m]."""

    def users(self) -> tuple[User, ...]:
        """A user for each capture: the hands in it, with their own places."""
        captures = sorted({one.capture for one in self.hands})
        return tuple(
            User(tuple(one.hand for one in self.hands if one.capture == number), "learned from a labeled trial")
            for number in captures
        )


class _Part(NamedTuple):
    """Columns of a capture that stay together like a hand."""

    capture: int
    columns: Int[np.ndarray, "N"]
    names: tuple[str, ...]
    points: Float[np.ndarray, "T N 3"]


def learn_glove(
    captures: AnyCapture | Sequence[AnyCapture],
    settings: LearnSettings | None = None,
    *,
    name: str = "learned",
    on_step: OnStep = no_step,
    **options: Any,
) -> LearnedGlove:
    """Learn a marker layout from labeled captures of one or more people, as `handsim glove learn` does.

    Args:
        captures: Captures or paths of marker files. Each column is one marker in all captures that have it,
            whatever it is called; columns of arms and objects may be among them.
        settings: What is known already.
        name: Name of the layout.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name: `radius_mm=3.2` [mm].

    Returns:
        The layout, and the hands of the captures with their own places [m].

    Raises:
        ArgumentError: A setting has another type or is out of range.
        CaptureError: A capture cannot be read, or no hand is in it.
        LayoutError: The start is unknown, or there is neither a start nor a radius.
    """
    chosen = LearnSettings.of(settings, options)
    listed = captures if isinstance(captures, Sequence) and not isinstance(captures, str) else [captures]
    sources = [capture_of(one) for one in listed]
    start = None if chosen.start is None else load_layout(chosen.start)
    if start is None and chosen.radius_mm is None:
        raise LayoutError("the radius of the markers is unknown; give radius_mm, half their diameter in mm")
    radius = start.radius if start is not None else 1e-3 * (chosen.radius_mm or 0.0)
    return _Learning(sources, radius, chosen.hands, on_step).learned(name, start)


class _Learning:
    """Captures from which a glove is learned."""

    def __init__(
        self, sources: Sequence[Capture], radius: float, sides: tuple[Side, ...], on_step: OnStep
    ) -> None:
        self._radius, self._sides, self._on_step = radius, sides, on_step
        self._parts = [
            _Part(number, columns, tuple(_bare(source.names[column]) for column in columns), learned[:, columns])
            for number, source in enumerate(sources)
            for learned in [source.positions[: max(1, round(_LEARNED * source.num_frames))]]
            for columns in _together(learned)
        ]
        self._sources = sources
        self._left_out = list[str]()

    def learned(self, name: str, start: MarkerLayout | None) -> LearnedGlove:
        """Find the markers of all parts, and fit one layout."""
        layout, hands = start, list[tuple[_Part, Side, dict[str, int]]]()
        parts = sorted(self._parts, key=lambda one: (len(one.columns), len(one.points)), reverse=True)
        for part in parts:
            known = () if layout is None else [one for one in layout.names if one in part.names]
            if len(known) >= FEWEST_MARKERS:
                columns = {one: part.names.index(one) for one in known}
                hands.append((part, self._likelier_side(part, layout, columns), columns))
                continue
            found = search_places(
                part.points, part.names, self._radius, sides=self._sides, on_step=self._on_step
            )[0]
            own = {part.names[column]: int(column) for column in found.columns}
            shown = layout_of(found.hand, found.hand.layout)
            if layout is None:
                layout = dataclasses.replace(shown, name=name)
                hands.append((part, found.side, own))
            elif (pairs := _paired(layout, shown)) is not None:
                hands.append((part, found.side, {one: own[other] for one, other in pairs.items()}))
        if layout is None or not hands:
            raise CaptureError("no hand is in the captures, expected columns of 5 or more markers of one")
        return self._common(dataclasses.replace(layout, name=name), hands)

    def _common(
        self, layout: MarkerLayout, hands: list[tuple[_Part, Side, dict[str, int]]]
    ) -> LearnedGlove:
        """Fit all hands to one layout, and the layout to all hands, by turns."""
        self._on_step("fitting hands and places together")
        for number in range(_ROUNDS + 1):
            spread = PLACE_SPREAD if number == 0 else _COMMON_SPREAD
            fitted = [self._fitted(part, side, columns, layout, spread) for part, side, columns in hands]
            places = [{place.name: place for place in layout_of(one.hand, layout).markers} for one in fitted]
            layout = _mean_layout(layout, places)
        sides = tuple(sorted({side for _, side, _ in hands}))
        layout = dataclasses.replace(layout, sides=sides)
        done = tuple(
            TrialHand(part.capture, {one: int(part.columns[at]) for one, at in columns.items()}, one.hand.with_side(side), one.residuals)
            for (part, side, columns), one in zip(hands, fitted, strict=True)
        )
        return LearnedGlove(layout, done, tuple(self._left_out), _spreads(layout, fitted))

    def _fitted(
        self, part: _Part, side: Side, columns: Mapping[str, int], layout: MarkerLayout, spread: float
    ) -> FittedPlaces:
        own = dataclasses.replace(
            layout, markers=tuple(one for one in layout.markers if one.name in columns), sides=SIDES
        )
        points = part.points[:, [columns[one] for one in own.names]] @ (MIRROR if side == "left" else np.eye(3))
        points = points[diverse_frames(points, _FRAMES)]
        tried = [fit_places(points, settle_glove(own, HandModel.named(size)), spread, 3e-3) for size in ("S", "L")]
        return min(tried, key=lambda one: one.cost)

    def _likelier_side(self, part: _Part, layout: MarkerLayout, columns: Mapping[str, int]) -> Side:
        """The side whose hand fits the known markers better."""
        costs = {side: self._fitted(part, side, columns, layout, PLACE_SPREAD).cost for side in self._sides}
        return min(self._sides, key=lambda side: costs[side])


def layout_of(hand: GloveFit, like: MarkerLayout) -> MarkerLayout:
    """The layout with the places of a hand's markers, which stay on the bones of a layout where they can."""
    known = {one.name: one for one in like.markers}
    layout = dataclasses.replace(hand.layout, markers=tuple(known[one] for one in hand.layout.names))
    for index, point in enumerate(hand.attachment.points):
        layout = place_marker(layout, index, hand.model, point)
    return layout


def _together(points: Float[np.ndarray, "T N 3"]) -> Iterator[Int[np.ndarray, "N"]]:
    """Groups of columns that are never farther from each other than markers of a hand."""
    from scipy.cluster.hierarchy import fcluster, linkage

    some = points[np.linspace(0, len(points) - 1, min(len(points), 300)).astype(int)]
    first, second = np.triu_indices(points.shape[1], 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that are never seen together
        apart = np.nanquantile(np.linalg.norm(some[:, first] - some[:, second], axis=2), 0.98, axis=0)
    apart = np.where(np.isfinite(apart), apart, 1.0)
    groups = fcluster(linkage(apart, "complete"), _HAND, "distance")
    for group in np.unique(groups):
        columns = np.flatnonzero(groups == group)
        if FEWEST_MARKERS <= len(columns) <= MOST_MARKERS:
            yield columns


def _bare(name: str) -> str:
    return name.rsplit(":", 1)[-1].strip()


def _paired(layout: MarkerLayout, other: MarkerLayout) -> dict[str, str] | None:
    """The markers of another layout at the places of a layout's; None where these are not the same."""
    from scipy.optimize import linear_sum_assignment

    points = [attach(one, "M").attachment.points for one in (layout, other)]
    apart = np.linalg.norm(points[0][:, None] - points[1], axis=2)
    rows, columns = linear_sum_assignment(apart)
    near = apart[rows, columns] < _PAIRED
    if near.sum() < FEWEST_MARKERS:
        return None
    return {layout.names[row]: other.names[column] for row, column in zip(rows[near], columns[near], strict=True)}


def _mean_layout(layout: MarkerLayout, places: Sequence[Mapping[str, MarkerPlace]]) -> MarkerLayout:
    """The layout with each marker at the mean of its places, on the bone that most of them are on."""
    markers = []
    for marker in layout.markers:
        shown = [one[marker.name] for one in places if marker.name in one]
        bone = Counter(one.bone for one in shown).most_common(1)[0][0] if shown else marker.bone
        same = [one for one in shown if one.bone == bone] or [marker]
        turn = np.angle(np.mean(np.exp(1j * np.array([one.around for one in same]))))
        means = {key: float(np.mean([getattr(one, key) for one in same])) for key in ("along", "across")}
        markers.append(dataclasses.replace(marker, bone=bone, around=float(turn), **means))
    return dataclasses.replace(layout, markers=tuple(markers))


def _spreads(layout: MarkerLayout, fitted: Sequence[FittedPlaces]) -> Float[np.ndarray, "M"]:
    """Root mean square distance of the hands' places from the layout's [m]."""
    off: dict[str, list[float]] = {name: [] for name in layout.names}
    for one in fitted:
        own = tuple(marker for marker in layout.markers if marker.name in one.hand.layout.names)
        worn = settle_glove(dataclasses.replace(layout, markers=own, sides=SIDES), one.hand.model)
        for name, distance in zip(
            worn.layout.names, np.linalg.norm(worn.attachment.points - one.hand.attachment.points, axis=1), strict=True
        ):
            off[name].append(float(distance))
    return np.array([np.sqrt(np.mean(np.square(values))) if values else np.nan for values in off.values()])
