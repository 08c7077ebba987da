"""Marker IDs as an optical system assigns them: kept while a point is seen, new after every gap."""

from __future__ import annotations

import heapq

import numpy as np
from jaxtyping import Bool, Int


def number_runs(present: Bool[np.ndarray, "T S"]) -> Int[np.ndarray, "T S"]:
    """IDs from 0 in order of appearance, one per unbroken run of a source; -1 where there is no point."""
    begins = present.copy()
    begins[1:] &= ~present[:-1]
    numbers = np.cumsum(begins.ravel()).reshape(begins.shape) - 1
    running = np.maximum.accumulate(np.where(begins, numbers, -1), axis=0)
    return np.where(present, running, -1)


def pack_columns(
    present: Bool[np.ndarray, "T S"], *, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "T S"], int]:
    """Pack many runs into few columns: an unbroken stretch of a column is one run, then a frame is empty.

    Args:
        present: Which source has a point in which frame.
        rng: Decides the order of runs that begin together, so that columns do not reveal sources.

    Returns:
        The column of every point, -1 where there is none, and the number of columns.
    """
    ids = number_runs(present)
    first, source = np.nonzero(present & np.vstack([np.ones_like(present[:1]), ~present[:-1]]))
    order = np.lexsort((rng.random(len(first)), first))
    lengths = np.bincount(ids[present], minlength=len(first)) if len(first) else np.zeros(0, dtype=np.int64)
    free: list[int] = []
    busy: list[tuple[int, int]] = []  # (frame in which the column may be used again, column)
    columns = np.full(present.shape, -1)
    count = 0
    for run in order:
        begin, where = int(first[run]), int(source[run])
        while busy and busy[0][0] <= begin:
            heapq.heappush(free, heapq.heappop(busy)[1])
        if free:
            column = heapq.heappop(free)
        else:
            column, count = count, count + 1
        end = begin + int(lengths[ids[begin, where]])
        columns[begin:end, where] = column
        heapq.heappush(busy, (end + 1, column))
    return columns, count
