"""Digits that reach for the same points: the best namings of all of them together, compiled."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from track.association.digit_hypotheses import NEVER


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def elect(reach: Any, namings: Any, markers: Any, owners: Any, margins: Any) -> None:
    """Give points to digits: of all digits that reach for the same points, directly or not, the best choice.

    Args:
        reach: The points that each digit may take (`track.association.candidates.Reach`).
        namings: The best naming of every set of them (`track.association.digit_hypotheses.DigitNamings`),
            digit by digit.
        markers: The markers of each digit (D, K), counted through the hands; -1 where there are fewer.
        owners: Marker of each point (N,), -1 for none; overwritten.
        margins: By how much the next best choice in which a point has another name is worse (N,), log odds;
            written for points that some digit may take.
    """
    left = reach.counts > 0
    group = np.empty(len(left), dtype=np.int64)
    for first in range(len(left)):
        if not left[first]:
            continue
        group[0], size, place = first, 1, 0
        left[first] = False
        while place < size:
            for other in range(len(left)):
                if left[other] and _share_points(reach, group[place], other):
                    left[other] = False
                    group[size] = other
                    size += 1
            place += 1
        _elect_group(group[:size], reach, namings, markers, owners, margins)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _share_points(reach: Any, one: Any, other: Any) -> Any:
    for place in range(reach.counts[one]):
        for another in range(reach.counts[other]):
            if reach.candidates[one, place] == reach.candidates[other, another]:
                return True
    return False


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _elect_group(group: Any, reach: Any, namings: Any, markers: Any, owners: Any, margins: Any) -> None:
    most = namings.scores.shape[1]
    rows, counts = np.zeros((len(group), most), dtype=np.int64), np.zeros(len(group), dtype=np.int64)
    scores, sets = np.full((len(group), most), -NEVER), np.zeros((len(group), most), dtype=np.int64)
    bits = np.full(len(owners), -1)
    num_bits = 0  # 61 at most for ten digits with seven candidates, as each shares one with another
    for place, digit in enumerate(group):
        for point in reach.candidates[digit, : reach.counts[digit]]:
            owners[point], margins[point] = -1, np.inf
            if bits[point] < 0:
                bits[point] = num_bits
                num_bits += 1
        counts[place] = _sort_rows(namings.scores[digit], rows[place])
        for rank in range(counts[place]):
            row = rows[place, rank]
            scores[place, rank] = namings.scores[digit, row]
            for number in range(reach.counts[digit]):
                if row >> number & 1:
                    sets[place, rank] |= 1 << bits[reach.candidates[digit, number]]
    banned, other = np.full(len(group), -1), np.zeros(len(group), dtype=np.int64)
    best = np.zeros(len(group), dtype=np.int64)
    total = combine(scores, sets, counts, banned, best)
    for place, digit in enumerate(group):
        row = rows[place, best[place]]
        for number in range(markers.shape[1]):
            if namings.names[digit, row, number] >= 0:
                owners[reach.candidates[digit, namings.names[digit, row, number]]] = markers[digit, number]
        banned[place] = best[place]
        rival = combine(scores, sets, counts, banned, other)
        banned[place] = -1
        rival = max(rival, total - scores[place, best[place]] + namings.runners_up[digit, row])
        for point in reach.candidates[digit, : reach.counts[digit]]:
            margins[point] = min(margins[point], total - rival)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _sort_rows(scores: Any, rows: Any) -> Any:
    """Rows that can be, the best first; returns how many."""
    count = 0
    for row in range(len(scores)):
        if scores[row] <= -NEVER:
            continue
        place = count
        while place > 0 and scores[rows[place - 1]] < scores[row]:
            rows[place] = rows[place - 1]
            place -= 1
        rows[place] = row
        count += 1
    return count


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def combine(scores: Any, sets: Any, counts: Any, banned: Any, best: Any) -> Any:
    """The best choice of one row a digit such that no point is used twice.

    Args:
        scores: Scores (D, S) of each digit's rows, the best first.
        sets: Points (D, S) that each row uses, a bit a point.
        counts: Rows (D,) that each digit has; the last must use no point.
        banned: A row of each digit (D,) that is not to be chosen; -1 for none.
        best: The chosen rows (D,), overwritten.

    Returns:
        Their total; far below zero if there is no choice.
    """
    digits = len(scores)
    bound = np.zeros(digits + 1)
    for digit in range(digits - 1, -1, -1):
        bound[digit] = bound[digit + 1] + scores[digit, 0]
    row, total, used = np.full(digits, -1), np.zeros(digits + 1), np.zeros(digits + 1, dtype=np.int64)
    most, digit = -NEVER, 0
    while digit >= 0:
        row[digit] += 1
        now = row[digit]
        if now >= counts[digit] or total[digit] + scores[digit, now] + bound[digit + 1] <= most:
            row[digit] = -1
            digit -= 1
            continue
        if now == banned[digit] or used[digit] & sets[digit, now]:
            continue
        total[digit + 1] = total[digit] + scores[digit, now]
        used[digit + 1] = used[digit] | sets[digit, now]
        if digit + 1 < digits:
            digit += 1
        elif total[digits] > most:
            most = total[digits]
            best[:] = row
    return most
