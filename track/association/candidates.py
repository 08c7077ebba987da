"""Which points each digit may take: those within reach of its markers, compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

YOUNG: Final = 4.0
"""Credit below which a name stands for re-election."""
MOST_CANDIDATES: Final = 7
"""Points that are tried on a digit."""
_REACH_WHOLE, _REACH_MISSING = 0.012, 0.05  # [m] around a marker seen or not: points that may be its


class Crowd(NamedTuple):
    """All hands' markers in a row, and which points have their names."""

    places: Float[np.ndarray, "K 3"]
    """Where the markers are expected [m]."""
    parts: Int[np.ndarray, "K"]
    """Digit of each marker, counted through the hands; -1 on a palm."""
    owners: Int[np.ndarray, "N"]
    """Marker of each point, -1 for none."""


class Reach(NamedTuple):
    """Points that digits may take, and those they have."""

    candidates: Int[np.ndarray, "D 7"]
    """Points of each digit: first those named its markers, then others, the nearest first."""
    counts: Int[np.ndarray, "D"]
    """How many; none where there is nothing to decide."""
    own: Int[np.ndarray, "D"]
    """How many of them are named its markers."""


def find_reach(
    points: Float[np.ndarray, "N 3"], credit: Float[np.ndarray, "N"], crowd: Crowd, num_digits: int
) -> Reach:
    """What each digit may take.

    Args:
        points: The frame's points [m].
        credit: What the name of each point is worth.
        crowd: The hands.
        num_digits: Of all hands.
    """
    reach = Reach(
        np.full((num_digits, MOST_CANDIDATES), -1),
        np.zeros(num_digits, dtype=np.int64),
        np.zeros(num_digits, dtype=np.int64),
    )
    _find_reach(points, credit, crowd, reach)
    return reach


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _find_reach(points: Any, credit: Any, crowd: Any, reach: Any) -> None:
    places, parts, owners = crowd
    missing = np.ones(len(places), dtype=np.bool_)
    for owner in owners:
        if owner >= 0:
            missing[owner] = False
    contested = _find_contested(points, credit, crowd, missing)
    apart = np.full((len(reach.counts), len(points)), np.inf)
    for digit in range(len(reach.counts)):
        lacks, doubtful = False, False
        rivals = np.zeros(len(points), dtype=np.bool_)
        for marker in range(len(places)):
            if parts[marker] != digit:
                continue
            lacks = lacks or missing[marker]
            for point in range(len(points)):
                off = _distance(points[point], places[marker])
                apart[digit, point] = min(apart[digit, point], off)
                if owners[point] < 0:
                    rivals[point] |= off < (_REACH_MISSING if missing[marker] else _REACH_WHOLE)
                elif contested[point] and missing[marker]:
                    rivals[point] |= off < _REACH_MISSING
        count = 0
        for point in range(len(points)):
            if owners[point] >= 0 and parts[owners[point]] == digit:
                rivals[point] = False
                doubtful = doubtful or contested[point] or (lacks and credit[point] < YOUNG)
                reach.candidates[digit, count] = point
                count += 1
        if not (doubtful or rivals.any()):
            continue
        reach.own[digit] = count
        reach.counts[digit] = _add_nearest(apart[digit], rivals, reach.candidates[digit], count)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _find_contested(points: Any, credit: Any, crowd: Any, missing: Any) -> Any:
    """Points of a digit whose names are young, with a missing marker of another digit in reach."""
    contested = np.zeros(len(points), dtype=np.bool_)
    for point in range(len(points)):
        owner = crowd.owners[point]
        if owner < 0 or crowd.parts[owner] < 0 or credit[point] >= YOUNG:
            continue
        for marker in range(len(missing)):
            other = missing[marker] and crowd.parts[marker] not in (-1, crowd.parts[owner])
            if other and _distance(points[point], crowd.places[marker]) < _REACH_MISSING:
                contested[point] = True
    return contested


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_nearest(apart: Any, rivals: Any, candidates: Any, count: Any) -> Any:
    """Add the nearest rivals to a digit's candidates while there is room; how many there are then."""
    while count < len(candidates):
        nearest = -1
        for point in range(len(rivals)):
            if rivals[point] and (nearest < 0 or apart[point] < apart[nearest]):
                nearest = point
        if nearest < 0:
            break
        rivals[nearest] = False
        candidates[count] = nearest
        count += 1
    return count


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _distance(one: Any, other: Any) -> Any:
    return np.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)
