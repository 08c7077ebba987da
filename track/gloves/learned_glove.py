"""A glove learned from labeled captures: where each marker sits, on whose hands, and how well that labels.

The user need not say which column is which marker. Columns that stay near each other may be a hand. A search
finds the bone that carries each of them (`marker_search`), hands and places are fitted together (`fit`), and
the places of all hands make one layout. The last third of each capture is kept for the proof, which labels
its points with the layout.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture
from gloves.fit import Attachment, GloveFit, attach, place_marker, settle_glove
from gloves.layout import MAX_MARKERS, MIN_MARKERS, MarkerLayout, MarkerPlace, load_layout
from gloves.takes.points import spread_out
from gloves.takes.take import Take
from handsim.callbacks import OnStep, no_step
from handsim.errors import CaptureError, LayoutError
from handsim.hand.model import HandModel
from handsim.hand.shape import SIDES, Side
from handsim.space.transforms import MIRROR
from track.bodies.constellation import FEWEST
from track.captures import label_capture
from track.frames import AnyCapture, capture_of
from track.gloves.fit import FINE, FLESH, FittedPlaces, fit_places, shown_flesh
from track.gloves.marker_search import FittedHand, diverse_frames, search_places
from track.gloves.settings import LearnSettings
from track.kinematics.pose_solver import OUTLIER_DISTANCE, PoseSolver
from track.user import ATTACHMENT_ARRAYS, User

_FIT_FRAMES: Final = 60  # number of frames of each capture to which hands and places are fitted
_MOST_EXTENT: Final = 0.26  # [m] largest distance between two markers of a hand
_RIGID_CHANGE: Final = 0.004  # [m] Columns whose distances change less belong to a rigid object.
_LEARNED_SHARE: Final = 2 / 3  # share of each capture that is learned from
_ROUNDS: Final = 3  # rounds of fitting all hands to a common layout
_STARTS: Final = ("S", "L")  # sizes of the hands that a fit begins with
_MOST_RESIDUAL: Final = 0.003  # [m] largest median distance of a hand's markers from their places
_TEMPERATURE: Final = 2.0  # Differences in energy are divided by this, because errors of hands repeat.
_SAME_PLACE: Final = 0.015  # [m] A marker nearer to a place counts as there.
_SURE_PROBABILITY: Final = 0.9  # A marker's place with a smaller probability is reported as doubtful.
_EXAMINED_FRAMES: Final = 300  # number of frames in which exchanged columns are searched
# [m] In frames where a marker is farther from its place, columns may be exchanged.
_BENT_DISTANCE: Final = 0.008
_MOST_SUSPECTS: Final = 4  # number of tried markers, those with the largest distances in these frames
_MOST_RATIO: Final = 0.5  # An exchange leaves a smaller share of the squared distances.
_EXCHANGED_SHARE: Final = 0.02  # An exchange in a larger share of the frames is reported.
_MOST_NAMES: Final = 8  # largest number of names in a sentence
# A point off the skin is moved toward the middle of its bone by these shares of the way.
_INWARDS: Final = (0.0, 0.2, 0.4, 0.6)
# [m] Markers of the other hand at most this far from a place are the same marker.
_PAIR_DISTANCE: Final = 0.02


class TrialHand(NamedTuple):
    """A hand of one of the captures in the learned glove."""

    capture: int
    """Number of the capture."""
    columns: Mapping[str, int]
    """Column of each marker that the capture has."""
    hand: GloveFit
    """The hand in the whole glove, with the capture's own places for these markers."""
    residuals: Float[np.ndarray, "M"]
    """Root mean square distance of each marker of the layout from its place [m]; NaN if it has no column."""


@dataclass(frozen=True, slots=True, eq=False)
class LearnedGlove:
    """A layout learned from captures, and the hands in them."""

    layout: MarkerLayout
    hands: tuple[TrialHand, ...]
    left_out: tuple[str, ...]
    """Sentences on columns that do not belong to a hand, or not to the glove."""
    spreads: Float[np.ndarray, "M"]
    """Root mean square distance of each marker's places on the hands from its place in the layout [m]."""
    sure: Float[np.ndarray, "M"]
    """For each marker the probability of its place, against the best hand that has it elsewhere."""
    doubt: tuple[str, ...]
    """Sentences on places that are unsure, and on columns that exchange their markers."""

    def users(self) -> tuple[User, ...]:
        """A user for each capture: the hands in it, with their own places."""
        captures = sorted({one.capture for one in self.hands})
        hands = (tuple(one.hand for one in self.hands if one.capture == number) for number in captures)
        return tuple(User(some, "learned from a labeled trial") for some in hands)


class _ColumnGroup(NamedTuple):
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
    sources = captures_of(captures)
    start = None if chosen.start is None else load_layout(chosen.start)
    if start is None and chosen.radius_mm is None:
        raise LayoutError("the radius of the markers is unknown; give radius_mm, half their diameter in mm")
    radius = start.radius if start is not None else 1e-3 * (chosen.radius_mm or 0.0)
    if start is not None:
        on_step("labeling with the start")
        sources = [_labeled(source, start) for source in sources]
    return _Learning(sources, radius, chosen.hands, on_step).learned(name, start)


def captures_of(captures: AnyCapture | Sequence[AnyCapture]) -> list[Capture]:
    """Read one or several captures."""
    if isinstance(captures, str | Path | Capture | Take):
        return [capture_of(captures)]
    if not captures:
        raise CaptureError("no capture was given, expected one labeled capture or more")
    return [capture_of(one) for one in captures]


class _HandColumns(NamedTuple):
    """A hand in some columns: the number of each marker's column in its part."""

    part: _ColumnGroup
    side: Side
    columns: Mapping[str, int]


class _Learning:
    """Captures from which a glove is learned."""

    def __init__(
        self, sources: Sequence[Capture], radius: float, sides: tuple[Side, ...], on_step: OnStep
    ) -> None:
        self._sources, self._radius, self._sides, self._on_step = sources, radius, sides, on_step
        self._sure, self._doubt = dict[str, float](), list[str]()

    def learned(self, name: str, start: MarkerLayout | None) -> LearnedGlove:
        """Find the hands in all parts, and fit one layout to them."""
        layout, hands = start, list[_HandColumns]()
        parts = [part for number, source in enumerate(self._sources) for part in _groups(number, source)]
        for part in sorted(parts, key=lambda one: one.points.shape[:2][::-1], reverse=True):
            known = () if layout is None else tuple(one for one in layout.names if one in part.names)
            if layout is not None and len(known) >= MIN_MARKERS:
                columns = {one: part.names.index(one) for one in known}
                fits = {side: self._fitted(_HandColumns(part, side, columns), layout) for side in self._sides}
                hands.append(_HandColumns(part, min(fits, key=lambda side: fits[side].cost), columns))
            elif (found := self._searched(part)) is not None:
                shown = hand_layout(found.hand, found.hand.layout)
                columns = {part.names[column]: int(column) for column in found.columns}
                if layout is None:
                    layout = dataclasses.replace(shown, name=name)
                else:
                    pairs = _paired(layout, shown)
                    columns = {one: columns[other] for one, other in pairs.items()}
                if columns:
                    hands.append(_HandColumns(part, found.side, columns))
        if layout is None or not hands:
            raise CaptureError("no hand is in the captures, expected columns of 5 or more markers of one")
        return self._common(dataclasses.replace(layout, name=name), hands)

    def _searched(self, part: _ColumnGroup) -> FittedHand | None:
        """The likeliest hand in the columns of a part; None if none fits.

        Both sides are tried whatever was asked for, because a hand of the wrong side fits nearly as well.
        """
        found = search_places(part.points, part.names, self._radius, on_step=self._on_step)
        asked = [one for one in found if one.side in self._sides]
        best, likeliest = (asked or found)[0], found[0]
        if np.median(best.residuals) > _MOST_RESIDUAL or len(best.columns) < MIN_MARKERS:
            return None
        if best.side not in self._sides:
            raise CaptureError(f"the columns fit a {best.side} hand and none that is asked for; give hands")
        if likeliest.side != best.side:
            self._doubt.append(f"the columns fit a {likeliest.side} hand better than a {best.side} one")
        self._sure |= _probabilities(asked)
        return best

    def _common(self, layout: MarkerLayout, hands: Sequence[_HandColumns]) -> LearnedGlove:
        """Fit all hands to one layout, and the layout to all hands, by turns."""
        self._on_step("fitting hands and places together")
        flesh = FLESH
        for _ in range(_ROUNDS):
            fitted = [self._fitted(one, layout, flesh) for one in hands]
            flesh = shown_flesh(np.concatenate([one.residuals for one in fitted]))
            found = [{place.name: place for place in hand_layout(one.hand, layout).markers} for one in fitted]
            layout = _mean_layout(layout, found)
        wearable = settle_glove(_with_markers(layout, layout.names), HandModel.named("M")).layout
        layout = dataclasses.replace(wearable, sides=tuple(sorted({one.side for one in hands})))
        done, doubt = list[TrialHand](), list(self._doubt)
        for one, fit in zip(hands, fitted, strict=True):
            own = [name for name in layout.names if name in one.columns]
            columns = {name: int(one.part.columns[one.columns[name]]) for name in own}
            residuals = np.full(layout.num_markers, np.nan)
            residuals[[layout.names.index(name) for name in fit.hand.layout.names]] = fit.residuals
            hand = _in_whole_glove(fit.hand, layout).with_side(one.side)
            done.append(TrialHand(one.part.capture, columns, hand, residuals))
            doubt += _exchanges(one, fit.hand, self._sources[one.part.capture])
        sure = np.array([self._sure.get(name, 1.0) for name in layout.names])
        for name, marker, share in zip(layout.names, layout.markers, sure, strict=True):
            if share < _SURE_PROBABILITY:
                doubt.append(f"{name} may sit elsewhere than on {marker.bone} ({100 * (1 - share):.0f} %)")
        left_out = *_left_out(self._sources, done), *_forearm_hints(self._sources, done)
        return LearnedGlove(layout, tuple(done), left_out, _spreads(layout, done), sure, tuple(doubt))

    def _fitted(self, one: _HandColumns, layout: MarkerLayout, flesh: float = FLESH) -> FittedPlaces:
        """A hand in the markers of a layout that it has, begun from a small and from a large hand."""
        own = _with_markers(layout, one.columns)
        points = _right_points(one, own.names)
        points = points[diverse_frames(points, _FIT_FRAMES)]
        starts = [settle_glove(own, HandModel.named(size)) for size in _STARTS]
        fits = [fit_places(points, start, gain=FINE, flesh=flesh) for start in starts]
        return min(fits, key=lambda fit: fit.cost)


def _labeled(source: Capture, layout: MarkerLayout) -> Capture:
    """A capture with columns of a layout's names: as it is, or labeled with the layout if it has none."""
    if len(set(layout.names) & {_bare_name(name) for name in source.names}) >= MIN_MARKERS:
        return source
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of markers that are elsewhere, which are corrected here
        take = label_capture(source, glove=layout)
    names = tuple(f"{side}:{name}" for side in take.sides for name in layout.names)
    return Capture(names, np.concatenate([take.observed(side) for side in take.sides], axis=1), source.rate)


def _bare_name(name: str) -> str:
    """The name of a column without its subject."""
    return name.rsplit(":", 1)[-1].strip()


def _groups(number: int, source: Capture) -> Iterator[_ColumnGroup]:
    """The groups of a capture's columns that may be hands, in the frames that are learned from."""
    learned = source.positions[: _num_learned(source)]
    for columns in _hand_groups(learned):
        names = tuple(_bare_name(source.names[column]) for column in columns)
        yield _ColumnGroup(number, columns, names, learned[:, columns])


def _num_learned(source: Capture) -> int:
    """Number of a capture's first frames that are learned from."""
    return max(1, round(_LEARNED_SHARE * source.num_frames))


def held_out(source: Capture) -> Capture:
    """The frames of a capture that are not learned from."""
    first = min(_num_learned(source), source.num_frames - 1)
    return dataclasses.replace(source, positions=source.positions[first:])


def _with_markers(layout: MarkerLayout, names: Collection[str]) -> MarkerLayout:
    """The layout with some of its markers, for both hands."""
    kept = tuple(one for one in layout.markers if one.name in names)
    return dataclasses.replace(layout, markers=kept, sides=SIDES)


def _right_points(one: _HandColumns, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The markers of a hand in some order [m], as those of a right one."""
    points = one.part.points[:, [one.columns[name] for name in names]]
    return points @ MIRROR if one.side == "left" else points


def _probabilities(found: Sequence[FittedHand]) -> dict[str, float]:
    """Probability that each marker is where the best hand has it.

    The best of the hands that have the marker elsewhere is the alternative.
    """
    best, rival = found[0], np.full(len(found[0].columns), np.inf)
    for one in found:
        own = dict(zip(one.columns.tolist(), one.hand.attachment.points, strict=True))
        far = np.full(3, np.inf)
        shown = np.array([own.get(column, far) for column in best.columns.tolist()])
        off = np.linalg.norm(shown - best.hand.attachment.points, axis=1)
        elsewhere = (off > _SAME_PLACE) | (one.side != best.side)
        rival[elsewhere] = np.minimum(rival[elsewhere], one.cost - best.cost)
    shares = 1.0 / (1.0 + np.exp(-0.5 * rival / _TEMPERATURE))
    return dict(zip(best.hand.layout.names, shares.tolist(), strict=True))


def _exchanges(one: _HandColumns, hand: GloveFit, source: Capture) -> Iterator[str]:
    """Sentences on columns that hold another marker's points in a part of the capture.

    Such points bend the hand; exchanging them back makes it fit again.
    """
    names = hand.layout.names
    points = _right_points(one, names)
    seen = np.isfinite(points[..., 0]).sum(axis=1) >= MIN_MARKERS
    rows = spread_out(np.flatnonzero(seen), _EXAMINED_FRAMES)
    squares = _squares(hand, points[rows])
    bad = squares.max(axis=1) > _BENT_DISTANCE**2
    worst = sorted(np.argsort(squares[bad].sum(axis=0))[-_MOST_SUSPECTS:].tolist())
    for first, second in itertools.combinations(worst if bad.any() else (), 2):
        changed = points[rows[bad]]
        changed[:, [first, second]] = changed[:, [second, first]]
        wrong = _squares(hand, changed).sum(axis=1) < _MOST_RATIO * squares[bad].sum(axis=1)
        if wrong.sum() > _EXCHANGED_SHARE * len(rows):
            time = rows[bad][wrong.argmax()] / source.rate
            yield f"{names[first]} and {names[second]} are exchanged from {time:.1f} s on, or for a time"


def _squares(hand: GloveFit, points: Float[np.ndarray, "F M 3"]) -> Float[np.ndarray, "F M"]:
    """Squared distance of each point from its marker on the posed hand [m^2]; zero where missing."""
    poses = PoseSolver(hand, outlier_distance=OUTLIER_DISTANCE).solve(points)
    squares = ((points - hand.markers(poses.qpos)[0]) ** 2).sum(axis=2)
    return np.where(np.isfinite(squares), squares, 0.0)


def _left_out(sources: Sequence[Capture], hands: Sequence[TrialHand]) -> Iterator[str]:
    """A sentence for each capture on its columns that are no marker of the glove."""
    for number, source in enumerate(sources):
        own = {column for one in hands if one.capture == number for column in one.columns.values()}
        others = [name for column, name in enumerate(source.names) if column not in own]
        if others:
            shown = ", ".join(others[:_MOST_NAMES]) + (", ..." if len(others) > _MOST_NAMES else "")
            where = f"capture {number + 1}: " if len(sources) > 1 else ""
            count = f"{len(others)} of {len(source.names)} columns"
            yield f"{where}{count} are on no bone of the hand: {shown}"


def hand_layout(hand: GloveFit, like: MarkerLayout) -> MarkerLayout:
    """The layout with the places of a hand's markers, on the same bones as in another layout if possible."""
    known = {one.name: one for one in like.markers}
    layout = dataclasses.replace(hand.layout, markers=tuple(known[one] for one in hand.layout.names))
    for index, point in enumerate(hand.attachment.points):
        layout = _placed(layout, index, hand, point)
    return layout


def _placed(layout: MarkerLayout, index: int, hand: GloveFit, point: Float[np.ndarray, "3"]) -> MarkerLayout:
    """The layout with one marker at a point [m], or nearer to its bone's middle where no skin is there."""
    bone = int(hand.attachment.main_bones[index])
    start = hand.model.rest_transforms[bone]
    middle = start[:3, 3] + 0.5 * hand.model.skeleton.lengths[bone] * start[:3, 0]
    for share in _INWARDS:
        with contextlib.suppress(LayoutError):
            return place_marker(layout, index, hand.model, point + share * (middle - point))
    return layout


def _in_whole_glove(hand: GloveFit, layout: MarkerLayout) -> GloveFit:
    """A hand in all markers of a layout: its own stay where they are."""
    worn = settle_glove(layout, hand.model).attachment
    rows = [layout.names.index(name) for name in hand.layout.names]
    parts = {key: getattr(worn, key).copy() for key in ATTACHMENT_ARRAYS}
    for key, values in parts.items():
        values[rows] = getattr(hand.attachment, key)
    return GloveFit(hand.model, Attachment(layout, **parts))


def _hand_groups(points: Float[np.ndarray, "T N 3"]) -> Iterator[Int[np.ndarray, "N"]]:
    """Groups of columns that are never farther apart than a hand's markers, and move against each other."""
    from scipy.cluster.hierarchy import fcluster, linkage

    first, second = np.triu_indices(points.shape[1], 1)
    low, high = _distances(points, first, second)
    high = np.where(np.isfinite(high), high, 1.0)
    groups = fcluster(linkage(high, "complete"), _MOST_EXTENT, "distance")
    for group in np.unique(groups):
        columns = np.flatnonzero(groups == group)
        own = np.isin(first, columns) & np.isin(second, columns)
        is_rigid = np.nanmax(high[own] - low[own], initial=0.0) < _RIGID_CHANGE
        if MIN_MARKERS <= len(columns) <= MAX_MARKERS and not is_rigid:
            yield columns


def _distances(
    points: Float[np.ndarray, "T N 3"], first: Int[np.ndarray, "P"], second: Int[np.ndarray, "P"]
) -> Float[np.ndarray, "2 P"]:
    """Low and high distances of pairs of columns over time [m]; NaN of pairs never seen together."""
    some = spread_out(points, _EXAMINED_FRAMES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that are never seen together
        apart = np.linalg.norm(some[:, first] - some[:, second], axis=2)
        return np.nanquantile(apart, (0.02, 0.98), axis=0) if apart.size else np.empty((2, 0))


def _forearm_hints(sources: Sequence[Capture], hands: Sequence[TrialHand]) -> Iterator[str]:
    """A sentence for each hand on columns beside it that keep their distances, as on a forearm."""
    for one in hands:
        names, points = sources[one.capture].names, sources[one.capture].positions
        taken = {
            column for other in hands if other.capture == one.capture for column in other.columns.values()
        }
        own = np.array([*one.columns.values()])
        others = np.array([column for column in range(len(names)) if column not in taken], dtype=int)
        _, far = _distances(points, np.repeat(others, len(own)), np.tile(own, len(others)))
        near = others[(far.reshape(len(others), len(own)) < _MOST_EXTENT).any(axis=1)]
        while len(near):
            low, high = _distances(points, np.repeat(near, len(near)), np.tile(near, len(near)))
            moved = np.nan_to_num(high - low, nan=1.0).reshape(len(near), len(near))
            if moved.max() < _RIGID_CHANGE:
                break
            near = np.delete(near, moved.sum(axis=1).argmax())
        if len(near) >= FEWEST:
            limb, side = [names[column] for column in near.tolist()], one.hand.side
            yield (
                f"{', '.join(limb)} keep their distances beside the {side} hand; if they are on its forearm, "
                f"handsim body TRIAL --markers {' '.join(limb)} --forearm {side} --out forearm.toml makes a "
                "body of them for angles of the wrist (docs/angles.md)"
            )


def _paired(layout: MarkerLayout, other: MarkerLayout) -> dict[str, str]:
    """The markers of another layout at the places of a layout's; none if fewer than five agree."""
    from scipy.optimize import linear_sum_assignment

    points = [attach(one, "M").attachment.points for one in (layout, other)]
    apart = np.linalg.norm(points[0][:, None] - points[1], axis=2)
    rows, columns = linear_sum_assignment(apart)
    near = apart[rows, columns] < _PAIR_DISTANCE
    if near.sum() < MIN_MARKERS:
        return {}
    pairs = zip(rows[near], columns[near], strict=True)
    return {layout.names[row]: other.names[column] for row, column in pairs}


def _mean_layout(layout: MarkerLayout, places: Sequence[Mapping[str, MarkerPlace]]) -> MarkerLayout:
    """The layout with each marker at the mean of its places, on the bone that most of them are on."""
    markers = []
    for marker in layout.markers:
        shown = [one[marker.name] for one in places if marker.name in one]
        bone = Counter(one.bone for one in shown).most_common(1)[0][0] if shown else marker.bone
        same = [one for one in shown if one.bone == bone] or [marker]
        turn = np.angle(np.mean(np.exp(1j * np.array([one.around for one in same]))))
        along, across = (float(np.mean([getattr(one, key) for one in same])) for key in ("along", "across"))
        moved = dataclasses.replace(marker, bone=bone, along=along, around=float(turn), across=across)
        markers.append(moved)
    return dataclasses.replace(layout, markers=tuple(markers))


def _spreads(layout: MarkerLayout, hands: Sequence[TrialHand]) -> Float[np.ndarray, "M"]:
    """Root mean square distance of the hands' places from the layout's [m], NaN where no hand has one."""
    squares = np.empty((len(hands), layout.num_markers))
    for row, one in zip(squares, hands, strict=True):
        worn = settle_glove(layout, one.hand.with_side("right").model).attachment.points
        off = worn - one.hand.with_side("right").attachment.points
        row[:] = np.where(np.isfinite(one.residuals), (off**2).sum(axis=1), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a marker without a column
        return np.asarray(np.sqrt(np.nanmean(squares, axis=0)))
