"""Names for the points that have none: the palms' first, then those of all digits in reach, together.

Every naming of a digit's candidates is tried on the digit (`track.digit_search`); where digits reach for the
same points, of one hand or of two that touch, the best of all their namings together is taken
(`track.combining`). Names that are still young stand for re-election.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.topology import DIGITS
from track.combining import combine
from track.digit_search import NEVER, DigitNamings, digit_namings, search_digit
from track.hand_memory import Coming, Estimate, HandMemory
from track.hinge_belief import believe_digit
from track.matching import gains, match, worth_of
from track.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

_REACH_WHOLE, _REACH_MISSING = 0.012, 0.05  # [m] around a marker seen or not: points that may be its
_MOST_CANDIDATES: Final = 7  # points that are tried on a digit
YOUNG: Final = 4.0
"""Credit below which a name stands for re-election."""


class Following(NamedTuple):
    """A hand whose pose is known so far."""

    number: int
    memory: HandMemory
    coming: Coming
    estimate: Estimate


class _Digit(NamedTuple):
    """A digit and the points that are named its markers."""

    hand: Following
    digit: int
    markers: NDArray[np.int64]
    own: NDArray[np.int64]
    missing: NDArray[np.int64]


class _Search(NamedTuple):
    """A digit, the points it may have, and what they are worth to it."""

    number: int
    markers: NDArray[np.int64]
    candidates: NDArray[np.int64]
    namings: DigitNamings


def name_new(
    hands: Sequence[Following],
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "H N"],
    credit: Float[np.ndarray, "N"],
    born: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N"]:
    """Name points that nobody has named.

    Args:
        hands: The hands that have a pose.
        points: The frame's points [m].
        names: Names of every hand, overwritten.
        credit: What the name of each point is worth for the sake of its ID.
        born: When each point appeared [s].

    Returns:
        How sure each name is that has changed; NaN for those that have not.
    """
    sure = np.full(len(points), np.nan)
    for hand in hands:
        _name_palm(hand, points, names, born, sure)
    young = (names >= 0).any(axis=0) & (credit < YOUNG)
    free = np.asarray((names < 0).all(axis=0), dtype=bool)
    everywhere = [hand.estimate.places for hand in hands]
    if not young.any() and not any(
        _near(points[free], places, _REACH_MISSING).any() for places in everywhere
    ):
        return sure
    digits = [_digit(hand, digit, names) for hand in hands for digit in range(len(DIGITS))]
    contested = np.zeros(len(points), dtype=bool)
    for one in digits:
        rivals = one.own[young[one.own]]
        for other in digits:
            if other is not one and len(rivals) and len(other.missing):
                places = other.hand.estimate.places[other.missing]
                contested[rivals[_near(points[rivals], places, _REACH_MISSING)]] = True
    searches = [
        search
        for one in digits
        if (search := _search(one, points, names, free, contested, credit, born)) is not None
    ]
    for group in _groups(searches):
        _elect(group, names, sure)
    return sure


def _name_palm(
    hand: Following,
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    born: NDArray[np.float64],
    sure: NDArray[np.float64],
) -> None:
    mine = names[hand.number]
    missing = np.ones(hand.memory.num_markers, dtype=bool)
    missing[mine[mine >= 0]] = False
    palm = np.flatnonzero(missing & (hand.memory.digits < 0))
    free = np.flatnonzero((names < 0).all(axis=0))
    if len(palm) == 0 or len(free) == 0:
        return
    odds = gains(points[free], hand.estimate.places[palm], hand.estimate.covariances[palm])
    found, how_sure = match(odds + hand.memory.chances(born[free])[:, palm])
    chosen = free[found >= 0]
    mine[chosen], sure[chosen] = palm[found[found >= 0]], how_sure[found >= 0]


def _digit(hand: Following, digit: int, names: NDArray[np.int64]) -> _Digit:
    markers = np.flatnonzero(hand.memory.digits == digit)
    mine = names[hand.number]
    own = np.flatnonzero((mine >= 0) & (hand.memory.digits[mine] == digit))
    there = set(mine[own].tolist())
    missing = np.array([marker for marker in markers.tolist() if marker not in there], dtype=np.int64)
    return _Digit(hand, digit, markers, own, missing)


def _search(
    one: _Digit,
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    free: NDArray[np.bool_],
    contested: NDArray[np.bool_],
    credit: NDArray[np.float64],
    born: NDArray[np.float64],
) -> _Search | None:
    """Everything a digit may take, if there is anything to decide."""
    hand, digit, markers, own, missing = one
    memory, estimate, places = hand.memory, hand.estimate, hand.estimate.places
    near = free & _near(points, places[markers], _REACH_WHOLE)
    near |= (free | contested) & _near(points, places[missing], _REACH_MISSING)
    near[own] = False
    rivals = np.flatnonzero(near)
    if not (len(rivals) or contested[own].any() or (len(missing) and (credit[own] < YOUNG).any())):
        return None
    apart = np.linalg.norm(points[rivals, None] - places[markers], axis=-1).min(axis=1)
    rivals = rivals[np.argsort(apart)[: _MOST_CANDIDATES - len(own)]]
    candidates = np.concatenate([own, rivals])
    kept = memory.chances(born[candidates])[:, markers]
    kept[np.arange(len(own)), np.searchsorted(markers, names[hand.number, own])] = credit[own]
    turn = np.empty((3, 3))
    write_rotation(estimate.qpos[3:7], turn)
    believed, trust = np.empty(4), np.empty((4, 4))
    believe_digit(hand.coming.hinges, estimate.expected.told, estimate.expected.pull, digit, believed, trust)
    namings = digit_namings(len(candidates), len(markers))
    search_digit(
        memory.adapted,
        memory.ranges,
        digit,
        markers,
        np.ascontiguousarray((points[candidates] - estimate.qpos[:3]) @ turn),
        kept,
        memory.variance,
        worth_of(memory.variance),
        memory.slack,
        estimate.qpos[7:].copy(),
        believed,
        trust,
        namings,
    )
    return _Search(hand.number, markers, candidates, namings)


def _near(points: NDArray[np.float64], places: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = (np.linalg.norm(points[:, None] - places, axis=-1) < reach).any(axis=1)
    return near


def _groups(searches: list[_Search]) -> list[list[_Search]]:
    """Searches that reach for the same points, directly or through others."""
    groups: list[list[_Search]] = []
    for search in searches:
        apart, joined = [], [search]
        for group in groups:
            if any(np.isin(other.candidates, search.candidates).any() for other in group):
                joined += group
            else:
                apart.append(group)
        groups = [*apart, joined]
    return groups


def _elect(group: list[_Search], names: NDArray[np.int64], sure: NDArray[np.float64]) -> None:
    """Take the best of a group's namings together; a digit is as sure as its next best is worse."""
    everyone = np.unique(np.concatenate([search.candidates for search in group]))
    rows = [np.flatnonzero(search.namings.scores > -NEVER) for search in group]
    rows = [row[np.argsort(-search.namings.scores[row])] for row, search in zip(rows, group, strict=True)]
    counts = np.array([len(row) for row in rows])
    scores, sets = np.full((len(group), counts.max()), -NEVER), np.zeros((len(group), counts.max()), np.int64)
    for place, (row, search) in enumerate(zip(rows, group, strict=True)):
        scores[place, : len(row)] = search.namings.scores[row]
        bits = 1 << np.searchsorted(everyone, search.candidates)
        sets[place, : len(row)] = ((row[:, None] >> np.arange(len(bits))) & 1) @ bits
    best, other = np.zeros((2, len(group)), dtype=np.int64)
    banned = np.full(len(group), -1)
    total = combine(scores, sets, counts, banned, best)
    before = names[:, everyone].max(axis=0), names[:, everyone].argmax(axis=0)
    names[:, everyone] = -1
    margins = np.full(len(everyone), np.inf)
    for place, search in enumerate(group):
        row = rows[place][best[place]]
        chosen = search.namings.names[row]
        names[search.number, search.candidates[chosen[chosen >= 0]]] = search.markers[chosen >= 0]
        banned[place] = best[place]
        rival = combine(scores, sets, counts, banned, other)
        banned[place] = -1
        rival = max(rival, total - scores[place, best[place]] + search.namings.runners_up[row])
        touched = np.searchsorted(everyone, search.candidates)
        margins[touched] = np.minimum(margins[touched], total - rival)
    after = names[:, everyone].max(axis=0), names[:, everyone].argmax(axis=0)
    changed = (before[0] != after[0]) | ((after[0] >= 0) & (before[1] != after[1]))
    sure[everyone[changed]] = 1.0 / (1.0 + np.exp(-np.clip(margins[changed], 0.0, 30.0)))
