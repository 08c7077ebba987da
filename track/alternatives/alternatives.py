"""Alternatives to the labels of a take: changes that hold for all of its frames.

Two markers of a hand may be exchanged, labels shifted along a digit, two digits exchanged, or a marker lost
whose points have no label. Each alternative is fitted to the same frames with free places of the markers
(`track.alternatives.placement`); the likeliest is used, and the probability of the others is the doubt.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.fit import GloveFit
from gloves.takes.points import spread_out
from gloves.takes.take import Take
from handsim.arrays import Doubles, Flags, Integers
from handsim.hand.shape import BONES, DIGITS, PALM, Side
from handsim.space.transforms import MIRROR, rigid_fit
from track.alternatives.placement import (
    NUM_COMPARED,
    Placement,
    are_complete,
    offset_cost,
    place_again,
    place_markers,
)
from track.calibration.energy import QUICK_OPTIONS
from track.calibration.hand_parameters import mirror_to_right
from track.kinematics.pose_solver import PoseSolver
from track.user import hand_like
from train.labelers.matching import assign

_FEWEST_FRAMES: Final = 4
# Share of the complete frames that are judged: those most alike in missing markers, or with most markers.
_JUDGED_SHARE: Final = 0.3
_MOST_FITTED: Final = 4  # number of fitted alternatives, those with the least rough cost first
_MOST_ROUGH_COST: Final = 12.0  # An alternative with a larger rough cost (log-odds) is not fitted.
_STRAY_COST: Final = 10.0  # log-odds against a point that moves with the hand and is no marker
_UNSEEN_COST: Final = 5.0  # log-odds against a marker that is never seen
# A marker missing in a larger share of the frames is searched among unlabeled points.
_MISSING_SHARE: Final = 0.5
_STEADY_DISTANCE: Final = 0.008  # [m] A point on a bone stays within this distance in the bone's frame.
_MOST_BONE_DISTANCE: Final = 0.12  # [m] largest distance of such a point from the bone's joint
_MIRROR_ROUNDS: Final = 5  # rounds of matching the markers of both hands
_MOST_CHANGES: Final = 3  # largest number of successive changes
_ROUGH_NOISE, _ROUGH_BOUND = 0.004, 0.02  # [m] scale and bound of residuals in rough costs
_STRAY_SHARE: Final = 0.5  # Such a point is seen in this share of the frames that lack the marker.
_TEMPERATURE: Final = 1.5  # Log-odds are divided by this, because no fit models all errors of gloves.
_REPORTED_PROBABILITY: Final = 0.2  # An alternative is reported from this probability on.
# [m] least reported distance of a marker from its place; right ones reach 13 mm
_REPORTED_OFFSET: Final = 0.014
_LIKELY: Final = 0.01  # Alternatives are kept from this probability on.
_REMEDY: Final = "`handsim glove learn CAPTURE --start FILE.toml --out NEW.toml` corrects it"


Order = tuple[int, ...]
"""The column of each marker's points: a label, M and more for unlabeled points, or -1 for none."""
ALTERNATIVES: Final = "alternatives"
"""Key of the alternatives in the settings of a take."""


class Alternative(NamedTuple):
    """A way to label a hand in all frames of a take."""

    markers: tuple[int, ...]
    """Markers whose points differ from those in the take."""
    words: str
    """The change of labels, such as "RH1 and RH6 are exchanged"; empty for the labels as they are."""
    probability: float
    """Probability that the points of the take are labeled this way, from 0 to 1."""


class JudgedHand(NamedTuple):
    """A hand of a take with the alternatives to its labels."""

    side: Side
    alternatives: tuple[Alternative, ...]
    """The likeliest first."""
    hand: GloveFit
    """The hand with the marker places of the likeliest alternative, and its side."""
    offsets: Float[np.ndarray, "M 3"]
    """Their offsets from the places of the layout, at rest in the wrist's frame of a right hand [m]."""

    @property
    def is_changed(self) -> bool:
        """Whether other labels are likelier than those of the take."""
        return bool(self.alternatives[0].words)


class Doubt(NamedTuple):
    """What may be wrong with a hand's labels in a whole take."""

    tried: tuple[Alternative, ...]
    """The likeliest alternatives."""
    distances: Float[np.ndarray, "M"]
    """Distance of each marker from its place in the layout [m]."""

    @property
    def is_wrong(self) -> bool:
        """Whether other labels are likelier than those of the take; then its poses are wrong, too."""
        return any(one.words and one.probability > 0.5 for one in self.tried)

    def faults(self, side: Side, names: Sequence[str]) -> Iterator[Fault]:
        """Yield likely other labels, and markers far from their places, as sentences with marker names."""
        for one in self.tried:
            if one.words and one.probability >= _REPORTED_PROBABILITY:
                why = f"may be labeled wrong ({100 * one.probability:.0f} %): {one.words}"
                remedy = "correct the layout, or move a marker to where no other label fits"
                yield Fault(f"the {side} hand", why, remedy)
        for marker in () if self.is_wrong else np.flatnonzero(self.distances > _REPORTED_OFFSET):
            why = f"is {1e3 * self.distances[marker]:.0f} mm from where the layout has it"
            yield Fault(f"{side}:{names[int(marker)]}", why, _REMEDY)


class Fault(NamedTuple):
    """A sentence on a fault that holds for a whole take."""

    of: str
    why: str
    remedy: str


def judge_take(take: Take) -> tuple[JudgedHand, ...]:
    """Compare the labels of each hand of a take with their alternatives.

    Hands that too few frames show are left out. The sides of two hands are exchanged for both or for neither.
    """
    found = [(side, _columns_of(take, side)) for side in take.sides]
    tried = [_TriedHand(columns, side) for side, columns in found if columns is not None]
    mirrored = [one.mirrored() for one in tried]
    gains = [fit.cost - one.least for one, fit in zip(tried, mirrored, strict=True) if fit is not None]
    both = float(sum(gains)) if len(gains) == len(tried) else np.inf
    return tuple(one.judged(fit, both) for one, fit in zip(tried, mirrored, strict=True))


def with_doubt(take: Take, judged: Sequence[JudgedHand]) -> Take:
    """The take with its alternatives in its settings, and its confidences lowered by them."""
    record = {}
    for one in judged:
        distances = np.linalg.norm(one.offsets, axis=1).round(5).tolist()
        record[one.side] = {"tried": [each._asdict() for each in one.alternatives], "distances": distances}
    take = dataclasses.replace(take, settings={**take.settings, ALTERNATIVES: record})
    points, right = take.point_list, np.append(label_probability(take), 1.0)
    confidence = points.confidence * right[np.minimum(points.labels, len(right) - 1)]
    return dataclasses.replace(take, point_list=dataclasses.replace(points, confidence=confidence))


def doubts_of(take: Take) -> dict[Side, Doubt]:
    """What may be wrong with the labels of each hand, from the take's settings or else computed."""
    if ALTERNATIVES not in take.settings:
        take = with_doubt(take, judge_take(take))
    return {
        side: Doubt(tuple(Alternative(**one) for one in record["tried"]), np.array(record["distances"]))
        for side, record in take.settings[ALTERNATIVES].items()
    }


def label_probability(take: Take) -> Float[np.ndarray, "K"]:
    """Probability that no likely alternative gives the points of a label to another marker.

    Alternatives of different markers are independent. It is 1 for takes whose settings have no alternatives.
    """
    sure = np.ones(take.hand_labels[-1].stop)
    for side, part in zip(take.sides, take.hand_labels, strict=True):
        tried = take.settings.get(ALTERNATIVES, {}).get(side, {"tried": ()})["tried"]
        others = [(frozenset(one["markers"]), one["probability"]) for one in tried if one["words"]]
        given = max(1.0 - sum(share for _, share in others), np.finfo(float).tiny)
        odds = [(markers, share / given) for markers, share in others]
        for marker in frozenset[int]().union(*(markers for markers, _ in odds)):
            kept = [one for one in odds if marker not in one[0]]
            sure[part[marker]] = _odds_of_sets(kept) / _odds_of_sets(odds)
    return sure


def _odds_of_sets(odds: Sequence[tuple[frozenset[int], float]]) -> float:
    """Sum of the odds of all sets of changes of different markers, given the odds of each change."""
    if not odds:
        return 1.0
    (markers, first), *others = odds
    return _odds_of_sets(others) + first * _odds_of_sets([one for one in others if not one[0] & markers])


class Columns(NamedTuple):
    """Points of a hand in some frames, as a right one."""

    names: tuple[str, ...]
    seen: Float[np.ndarray, "F C 3"]  # of each label, then steady unlabeled ones [m]; NaN where missing
    worn: GloveFit  # the right hand in the glove as designed

    def of(self, order: Sequence[int]) -> Float[np.ndarray, "F M 3"]:
        """Points of the markers under an alternative."""
        return np.where(np.array(order)[:, None] < 0, np.nan, self.seen[:, list(order)])

    def left_over(self, order: Sequence[int]) -> float:
        """Cost of an alternative by the points that it leaves unlabeled, and by unseen markers (log-odds)."""
        shown = np.isfinite(self.seen[..., 0]).mean(axis=0)
        left = np.delete(shown, [one for one in order if one >= 0]).sum()
        return float(_STRAY_COST * left + _UNSEEN_COST * sum(one < 0 for one in order))

    def free(self, order: Sequence[int]) -> list[int]:
        """Columns whose points an alternative leaves unlabeled."""
        shown = np.isfinite(self.seen[..., 0]).any(axis=0)
        return [one for one in range(len(shown)) if shown[one] and one not in order]

    def normal(self, order: Sequence[int]) -> Order:
        """An order with -1 for columns without points."""
        shown = np.append(np.isfinite(self.seen[..., 0]).any(axis=0), False)
        return tuple(int(column) if shown[column] else -1 for column in order)


class _TriedHand:
    """A hand of a take under the alternatives that were tried."""

    def __init__(self, columns: Columns, side: Side) -> None:
        self._columns, self._side = columns, side
        self._given = best = columns.normal(range(len(columns.names)))
        base = place_markers(columns.of(best), columns.worn)
        self._fits, self._words = {best: base}, {best: ""}
        self._costs = {best: base.cost + columns.left_over(best)}
        for _ in range(_MOST_CHANGES):
            for order, words in _candidates(columns, best, self._fits[best]):
                if order not in self._fits:
                    fit = self._fits[order] = place_again(columns.of(order), base)
                    earlier = self._words[best]
                    self._words[order] = words if earlier in ("", words) else f"{earlier}; {words}"
                    self._costs[order] = fit.cost + columns.left_over(order)
            before, best = best, min(self._costs, key=lambda order: self._costs[order])
            if best == before:
                break
        self.least = self._costs[best] - columns.left_over(self._given)
        """Cost of the likeliest alternative."""

    def mirrored(self) -> Placement | None:
        """Fit the same points as a hand of the other side; None if a rough cost excludes it."""
        columns, base = self._columns, self._fits[self._given]
        solver, rough = PoseSolver(columns.worn), list[tuple[float, Doubles]]()
        least = _rough_cost(solver, columns.of(self._given))
        for order in _mirror_orders(columns.worn.attachment.points):
            seen = columns.of([self._given[marker] for marker in order]) @ MIRROR
            rough.append((_rough_cost(solver, seen) - least, seen))
        gain, seen = min(rough, key=lambda one: one[0])
        return place_again(seen, base) if gain < _MOST_ROUGH_COST else None

    def judged(self, mirrored: Placement | None, gain: float) -> JudgedHand:
        """Rate the alternatives by probability; a hand of the other side costs `gain` more."""
        given, side = self._given, self._side
        other: Side = "left" if side == "right" else "right"
        tried = []
        for order, cost in self._costs.items():
            changed = np.flatnonzero(np.not_equal(given, order)).tolist()
            alternative = Alternative(tuple(changed), self._words[order], 0.0)
            tried.append((cost, alternative, self._fits[order], side))
        if mirrored is not None and gain < np.inf:
            every = Alternative(tuple(range(len(given))), f"it is the {other} hand", 0.0)
            tried.append((self.least + self._columns.left_over(given) + gain, every, mirrored, other))
        log_odds = np.array([-cost / _TEMPERATURE for cost, *_ in tried])
        shares = np.exp(log_odds - log_odds.max())
        shares /= shares.sum()
        ranked = np.argsort(-shares, kind="stable")
        found = [tried[n][1]._replace(probability=float(shares[n])) for n in ranked if shares[n] >= _LIKELY]
        _, _, fit, of = tried[ranked[0]]
        return JudgedHand(side, tuple(found), fit.hand.with_side(of), fit.offsets)


def _mirror_orders(points: Float[np.ndarray, "M 3"]) -> Iterator[list[int]]:
    """Yield matches of a hand's markers with the other hand's: thumb side exchanged, or back and palm."""
    for turn in (np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, -1.0])):
        order, moved = np.arange(len(points)), points @ turn
        for _ in range(_MIRROR_ROUNDS):
            off = points.mean(axis=0) - moved.mean(axis=0)
            costs = np.square(moved[:, None] + off - points).sum(axis=2)
            _, order = assign(costs, np.full(len(points), 1.0))
            rotation, translation = rigid_fit(points @ MIRROR, points[order])
            moved = points @ MIRROR @ rotation.T + translation
        yield order.tolist()


def _columns_of(take: Take, side: Side) -> Columns | None:
    """The points of a hand in frames spread over the take; None if too few frames show enough markers."""
    number, mirror = take.hand_index(side), mirror_to_right(side)
    part, worn = take.hand_labels[number], take.hands[number]
    there = np.isfinite(take.observed(part)[..., 0])
    counts = there.sum(axis=1)
    frames = np.flatnonzero(are_complete(counts))
    if len(frames) < _FEWEST_FRAMES:
        return None
    # If an unlabeled point moves with the hand, labels are wrong in the frames that lack one, perhaps most of
    # the take. Otherwise frames with many markers are more informative.
    usual = there[frames].mean(axis=0) > 0.5
    unlike = (there[frames] != usual).sum(axis=1)
    alike = spread_out(frames[unlike <= np.quantile(unlike, _JUDGED_SHARE)], NUM_COMPARED)
    seen = take.point_list.labeled(part, alike)
    strays = [one[:, None] for one in _steady_points(take, worn, alike, seen)]
    if not strays:
        full = counts[frames] >= np.quantile(counts[frames], 1.0 - _JUDGED_SHARE)
        seen = take.point_list.labeled(part, spread_out(frames[full], NUM_COMPARED))
    return Columns(worn.layout.names, np.concatenate([seen, *strays], axis=1) @ mirror, hand_like(worn))


def _steady_points(take: Take, worn: GloveFit, frames: Integers, seen: Doubles) -> Iterator[Doubles]:
    """Yield unlabeled points (F, 3) that move with the palm or a digit while that digit lacks a marker."""
    missing = np.isnan(seen[..., 0])
    if missing.mean(axis=0).max() <= _MISSING_SHARE:
        return
    bones = worn.model.forward_kinematics(PoseSolver(worn).solve(seen).qpos)
    taken = np.zeros(len(take.point_list.points), dtype=bool)
    for marker in np.flatnonzero(missing.mean(axis=0) > _MISSING_SHARE):
        best: dict[int, int] = {}
        digit = worn.attachment.digits[marker]
        for bone in [PALM, *(bone for bone in range(len(BONES)) if BONES[bone].digit == digit >= 0)]:
            found = _steadiest_point(take, bones[:, bone], frames, taken)
            found = {row: point for row, point in found.items() if missing[row, marker]}
            if len(found) > len(best):
                best = found
        if len(best) >= _STRAY_SHARE * missing[:, marker].sum():
            taken[list(best.values())] = True
            stray = np.full((len(frames), 3), np.nan)
            stray[list(best)] = take.point_list.points[list(best.values())]
            yield stray


def _steadiest_point(take: Take, T_world_bone: Doubles, frames: Integers, taken: Flags) -> dict[int, int]:
    """The steadiest unlabeled point in the frame of a bone: its index by row of `frames`."""
    rows, points, places = [], [], []
    for row, (frame, pose) in enumerate(zip(frames, T_world_bone, strict=True)):
        part = take.point_list.of(int(frame))
        free = part.start + np.flatnonzero((take.point_list.labels[part] < 0) & ~taken[part])
        local = (take.point_list.points[free] - pose[:3, 3]) @ pose[:3, :3]
        near = np.linalg.norm(local, axis=1) < _MOST_BONE_DISTANCE
        rows += [row] * int(near.sum())
        points += free[near].tolist()
        places.append(local[near])
    if not rows:
        return {}
    off = np.concatenate(places)
    near = np.linalg.norm(off[:, None] - off, axis=2) < _STEADY_DISTANCE
    best = max(near, key=lambda one: len({rows[n] for n in np.flatnonzero(one)}))
    return {rows[n]: points[n] for n in np.flatnonzero(best)}


def _candidates(columns: Columns, now: Order, fit: Placement) -> list[tuple[Order, str]]:
    """Changes of an order that a rough cost does not exclude, the likeliest first."""
    found: dict[Order, tuple[float, str]] = {}
    for raw, words, cost in (*_reassigned_orders(columns, now, fit), *_shifted_orders(columns, now)):
        order = columns.normal(raw)
        if cost < _MOST_ROUGH_COST and (order not in found or cost < found[order][0]):
            found[order] = cost, words
    ranked = sorted(found.items(), key=lambda one: one[1][0])
    return [(order, words) for order, (_, words) in ranked[:_MOST_FITTED]]


def _reassigned_orders(columns: Columns, now: Order, fit: Placement) -> Iterator[tuple[Order, str, float]]:
    """Orders in which one or two markers have other columns, with rough costs.

    A rough cost rates the mean place and the spread of points in the frames of the bones, for unchanged
    poses.
    """
    hand, names = fit.hand, columns.names
    bones = hand.model.forward_kinematics(fit.estimate.qpos)
    place = hand.attachment.centers(hand.model, bones)
    main = hand.attachment.main_bones
    rest = hand.model.rest_transforms[main][:, :3, :3]
    count, total = len(names), columns.seen.shape[1]
    cost = np.full((count, total + 1), _UNSEEN_COST)  # The last column stands for no point.
    for marker in range(count):
        turns = rest[marker] @ bones[:, main[marker], :3, :3].swapaxes(1, 2)
        off = np.einsum("fij,fcj->fci", turns, columns.seen - place[:, marker, None])
        there = np.isfinite(off[..., 0])
        mean = np.nansum(off, axis=0) / np.maximum(there.sum(axis=0), 1)[:, None]
        spread = np.nansum((off - mean) ** 2, axis=(0, 2))
        rough = offset_cost(mean + fit.offsets[marker]) + spread / (2.0 * QUICK_OPTIONS["noise"] ** 2)
        cost[marker, :total] = np.where(there.any(axis=0), rough, _UNSEEN_COST)
    own = cost[range(count), now]
    for one, other in itertools.combinations(range(count), 2):
        gain = cost[one, now[other]] + cost[other, now[one]] - own[one] - own[other]
        words = f"{names[one]} and {names[other]} are exchanged"
        yield _changed(now, {one: now[other], other: now[one]}), words, float(gain)
    for marker, stray in itertools.product(range(count), columns.free(now)):
        gain = cost[marker, stray] - own[marker]
        yield _changed(now, {marker: stray}), f"{names[marker]} is a point without a label", float(gain)
        for other in range(count):
            gain = cost[marker, now[other]] + cost[other, stray] - own[marker] - own[other]
            words = f"the points of {names[marker]} have the label {names[other]}"
            if other != marker:
                yield _changed(now, {marker: now[other], other: stray}), words, float(gain)


def _changed(order: Order, changes: Mapping[int, int]) -> Order:
    """An order with other columns for some markers."""
    return tuple(changes.get(marker, column) for marker, column in enumerate(order))


def _shifted_orders(columns: Columns, now: Order) -> Iterator[tuple[Order, str, float]]:
    """Orders with labels shifted along a digit, or exchanged between neighbors, with rough costs."""
    digits, orders = columns.worn.attachment.digits, list[tuple[Order, str]]()
    chains = [np.flatnonzero(digits == digit).tolist() for digit in range(len(DIGITS))]
    ends = [-1, *columns.free(now)]
    for name, chain in zip(DIGITS, chains, strict=True):
        own = [now[marker] for marker in chain]
        for end in ends if len(chain) > 1 else ():
            for sources in ([*own[1:], end], [end, *own[:-1]]):
                words = f"the labels of the {name} are one marker off"
                orders.append((_changed(now, dict(zip(chain, sources, strict=True))), words))
    for (one, first), (other, second) in itertools.pairwise(enumerate(chains)):
        if len(first) == len(second) > 0:
            changes = {a: now[b] for a, b in zip([*first, *second], [*second, *first], strict=True)}
            orders.append((_changed(now, changes), f"{DIGITS[one]} and {DIGITS[other]} are exchanged"))
    solver = PoseSolver(columns.worn)
    tried = [now, *(order for order, _ in orders)]
    rough = [_rough_cost(solver, columns.of(order)) + columns.left_over(order) for order in tried]
    for (order, words), cost in zip(orders, rough[1:], strict=True):
        yield order, words, cost - rough[0]


def _rough_cost(solver: PoseSolver, seen: Float[np.ndarray, "F M 3"]) -> float:
    """Rough cost of labels, by poses of the designed hand; an error that repeats counts once."""
    squares = np.minimum((solver.solve(seen).residuals ** 2).sum(axis=2), _ROUGH_BOUND**2)
    mean = np.nansum(squares, axis=0) / np.maximum(np.isfinite(squares).sum(axis=0), 1)
    return float(mean.sum() / (2.0 * _ROUGH_NOISE**2))
