"""Digits that reach for the same points: the best namings of all of them together, compiled."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from track.digit_search import NEVER


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
