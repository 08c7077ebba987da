"""Names for the points that have none: the palms' first, then those of all digits in reach, together.

Every naming of a digit's candidates is tried on the digit (`track.association.digit_hypotheses`); where
digits reach for the
same points, of one hand or of two that touch, the best of all their namings together is taken
(`track.association.joint_assignment`). Names that are still young stand for re-election.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handsim.hand.topology import DIGITS
from track.association.candidates import MOST_CANDIDATES, Crowd, Reach, find_reach
from track.association.digit_hypotheses import DigitNamings, digit_namings, search_digit
from track.association.hand_state import Coming, Estimate, HandMemory
from track.association.joint_assignment import elect
from track.association.point_matching import gains, match

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray


class Following(NamedTuple):
    """A hand whose pose is known so far."""

    number: int
    memory: HandMemory
    coming: Coming
    estimate: Estimate


def name_new(
    hands: Sequence[Following],
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "H N"],
    credit: Float[np.ndarray, "N"],
    born: Float[np.ndarray, "N"],
    advice: Mapping[int, Float[np.ndarray, "N M"]],
) -> Float[np.ndarray, "N"]:
    """Name points that nobody has named.

    Args:
        hands: The hands that have a pose.
        points: The frame's points [m].
        names: Names of every hand, overwritten.
        credit: What the name of each point is worth for the sake of its ID.
        born: When each point appeared [s].
        advice: Log odds of names by what others say, for some hands.

    Returns:
        How sure each name is that has changed; NaN for those that have not.
    """
    sure = np.full(len(points), np.nan)
    if not hands:
        return sure
    for hand in hands:
        _name_palm(hand, points, names, born, advice, sure)
    crowd = _crowd(hands, names)
    reach = find_reach(points, credit, crowd, len(hands) * len(DIGITS))
    if not reach.counts.any():
        return sure
    markers = _markers_of_digits(crowd.parts, len(reach.counts))
    namings = digit_namings(len(reach.counts), MOST_CANDIDATES, markers.shape[1])
    first = 0
    for place, hand in enumerate(hands):
        digits = slice(place * len(DIGITS), (place + 1) * len(DIGITS))
        part = Reach(*(values[digits] for values in reach))
        rows = DigitNamings(*(values[digits] for values in namings))
        _search(hand, points, names[hand.number], part, markers[digits] - first, credit, born, advice, rows)
        first += hand.memory.num_markers
    before, margins = crowd.owners.copy(), np.full(len(points), np.nan)
    elect(reach, namings, markers, crowd.owners, margins)
    changed = before != crowd.owners
    sure[changed] = 1.0 / (1.0 + np.exp(-np.clip(margins[changed], 0.0, 30.0)))
    _write_names(hands, crowd.owners, names)
    return sure


def _name_palm(
    hand: Following,
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    born: NDArray[np.float64],
    advice: Mapping[int, NDArray[np.float64]],
    sure: NDArray[np.float64],
) -> None:
    mine = names[hand.number]
    missing = hand.memory.digits < 0
    missing[mine[mine >= 0]] = False
    if not missing.any():
        return
    palm, free = np.flatnonzero(missing), np.flatnonzero((names < 0).all(axis=0))
    if len(free) == 0:
        return
    odds = gains(points[free], hand.estimate.places[palm], hand.estimate.covariances[palm])
    odds += hand.memory.chances(born[free])[:, palm]
    if hand.number in advice:
        odds += advice[hand.number][free[:, None], palm]
    found, how_sure = match(odds)
    chosen = free[found >= 0]
    mine[chosen], sure[chosen] = palm[found[found >= 0]], how_sure[found >= 0]


def _crowd(hands: Sequence[Following], names: NDArray[np.int64]) -> Crowd:
    owners, parts, first = np.full(names.shape[1], -1), [], 0
    for place, hand in enumerate(hands):
        mine, digits = names[hand.number], hand.memory.digits
        owners[mine >= 0] = first + mine[mine >= 0]
        parts.append(np.where(digits >= 0, place * len(DIGITS) + digits, -1))
        first += hand.memory.num_markers
    places = np.concatenate([hand.estimate.places for hand in hands])
    return Crowd(places, np.concatenate(parts), owners)


def _markers_of_digits(parts: NDArray[np.int64], num_digits: int) -> NDArray[np.int64]:
    """Markers of each digit (D, K), -1 where there are fewer."""
    found = [np.flatnonzero(parts == digit) for digit in range(num_digits)]
    markers = np.full((num_digits, max(map(len, found))), -1)
    for row, mine in zip(markers, found, strict=True):
        row[: len(mine)] = mine
    return markers


def _search(
    hand: Following,
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    reach: Reach,
    markers: NDArray[np.int64],
    credit: NDArray[np.float64],
    born: NDArray[np.float64],
    advice: Mapping[int, NDArray[np.float64]],
    namings: DigitNamings,
) -> None:
    """Try the points that one hand's digits may take."""
    if not reach.counts.any():
        return
    memory, estimate = hand.memory, hand.estimate
    odds, named = memory.chances(born), np.flatnonzero(names >= 0)
    odds[named, names[named]] = credit[named]
    if hand.number in advice:
        odds += advice[hand.number]
    firm, doubtful = memory.trust(hand.coming, estimate)
    for digit in np.flatnonzero(reach.counts):
        search_digit(
            memory.adapted,
            firm if memory.proven[digit] else doubtful,
            digit,
            markers[digit, markers[digit] >= 0],
            points,
            reach.candidates[digit, : reach.counts[digit]],
            odds,
            *(values[digit] for values in namings),
        )


def _write_names(hands: Sequence[Following], owners: NDArray[np.int64], names: NDArray[np.int64]) -> None:
    first = 0
    for hand in hands:
        last = first + hand.memory.num_markers
        names[hand.number] = np.where((owners >= first) & (owners < last), owners - first, -1)
        first = last
