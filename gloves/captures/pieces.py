"""Trajectories of a wide table, in memory proportional to its number of points.

An optical system gives an unlabeled marker a new number whenever it reappears, and the export gives it a new
column. Each such column holds one piece of a path; a minute may have thousands, which are packed into a few.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

_MANY_COLUMNS: Final = 100
"""More columns than this whose names differ only by a number may be pieces."""
_MAX_SHARE: Final = 0.5  # A piece has points in a smaller share of the frames.


def _are_pieces(names: Sequence[str], present: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Which columns, with points in this share of the frames, hold pieces of unlabeled paths."""
    stems = [name.rstrip("0123456789") for name in names]
    counts = Counter(stems)
    many = np.array([counts[stem] > _MANY_COLUMNS for stem in stems])
    return many & (present < _MAX_SHARE)


def shared_columns(
    first: Int[np.ndarray, "R"], last: Int[np.ndarray, "R"]
) -> tuple[Int[np.ndarray, "R"], int]:
    """Assign runs, by their first and last frames, to as few columns as possible; also how many these are.

    Runs are in the order of their first frames. A blank frame separates the runs in a column.
    """
    free: list[int] = []
    busy: list[tuple[int, int]] = []  # the frame from which a column is free again, and that column
    columns = np.empty(len(first), dtype=np.int64)
    count = 0
    for run, (begin, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        while busy and busy[0][0] <= begin:
            heapq.heappush(free, heapq.heappop(busy)[1])
        if free:
            columns[run] = heapq.heappop(free)
        else:
            columns[run], count = count, count + 1
        heapq.heappush(busy, (end + 2, int(columns[run])))
    return columns, count


def _pack_runs(frames: Int[np.ndarray, "P"], columns: Int[np.ndarray, "P"]) -> tuple[NDArray[np.int64], int]:
    """Give each run of points in a column a shared column.

    Returns the shared column of each point (P,), and how many shared columns there are.
    """
    order = np.lexsort((frames, columns))
    frames, columns = frames[order], columns[order]
    begins = np.flatnonzero(np.diff(frames, prepend=-2) * (np.diff(columns, prepend=-1) == 0) != 1)
    ends = np.append(begins[1:], len(frames))
    in_time = np.argsort(frames[begins], kind="stable")
    places = np.empty(len(begins), dtype=np.int64)
    places[in_time], number = shared_columns(frames[begins[in_time]], frames[ends[in_time] - 1])
    packed = np.empty(len(frames), dtype=np.int64)
    packed[order] = np.repeat(places, ends - begins)
    return packed, number


class Trajectories(NamedTuple):
    """The columns of a marker file."""

    names: tuple[str, ...]
    positions: Float[np.ndarray, "T N 3"]
    """Positions [m], NaN where there is none."""
    pieces: int = 0
    """Number of the file's columns that held pieces of paths and were packed into fewer."""


def packed_trajectories(
    names: Sequence[str],
    num_frames: int,
    frames: Int[np.ndarray, "P"],
    columns: Int[np.ndarray, "P"],
    points: Float[np.ndarray, "P 3"],
) -> Trajectories:
    """Trajectories of a list of points; columns packed from pieces come last."""
    share = np.bincount(columns, minlength=len(names)) / num_frames
    in_pieces = _are_pieces(names, share)
    whole = np.flatnonzero(~in_pieces)
    packed = in_pieces[columns]
    places = np.searchsorted(whole, columns)
    more, number = _pack_runs(frames[packed], columns[packed])
    places[packed] = len(whole) + more
    positions = np.full((num_frames, len(whole) + number, 3), np.nan)
    positions[frames, places] = points
    kept = [names[column] for column in whole.tolist()]
    kept += [f"*{place}" for place in range(len(whole) + 1, len(whole) + number + 1)]
    return Trajectories(tuple(kept), positions, int(in_pieces.sum()))
