"""The points of a take: one list over all frames, and the number of points of each frame.

The size of the list goes with the number of points. A table with a row per frame is as wide as its fullest
frame, so a single crowded frame, as when a camera sees the sun, can make it larger than memory.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from gloves.takes.columns import POINT_COLUMNS, POINT_COUNTS, POINTS, fitted


@dataclass(frozen=True, eq=False)
class PointList:
    """P points of T frames, frame by frame.

    Raises:
        ValueError: The arrays do not fit together, or hold what they cannot.
    """

    counts: Int[np.ndarray, "T"]
    """Number of points of each frame."""
    points: Float[np.ndarray, "P 3"]
    """Positions in the world [m]."""
    ids: Int[np.ndarray, "P"]
    """The system's ID of each point, -1 where it has none."""
    labels: Int[np.ndarray, "P"]
    """Label of each point, -1 where it has none."""
    confidence: Float[np.ndarray, "P"]
    """Probability that each label is right, or that a point without one is no marker."""
    columns: Int[np.ndarray, "P"]
    """The column of each point in a table; columns increase within a frame."""
    num_columns: int
    """Number of columns of a table, N."""

    def __post_init__(self) -> None:
        counts = np.asarray(self.counts)
        sizes = {"T": len(counts), "P": int(counts.sum(dtype=np.int64))}
        object.__setattr__(self, "counts", fitted(POINT_COUNTS, counts, sizes))
        for column in POINTS:
            object.__setattr__(self, column.name, fitted(column, getattr(self, column.name), sizes))
        object.__setattr__(self, "columns", fitted(POINT_COLUMNS, self.columns, sizes))
        falls = 1 + np.flatnonzero(np.diff(self.columns) <= 0)
        is_within = 0 <= self.columns.min(initial=0) and self.columns.max(initial=-1) < self.num_columns
        if not is_within or not np.isin(falls, self.starts).all():
            raise ValueError(f"columns of points do not increase from 0 to {self.num_columns - 1} at most")

    @classmethod
    def in_order(
        cls,
        counts: Int[np.ndarray, "T"],
        points: Float[np.ndarray, "P 3"],
        ids: Int[np.ndarray, "P"],
        labels: Int[np.ndarray, "P"],
        confidence: Float[np.ndarray, "P"],
    ) -> Self:
        """The points of a stream: those of a frame fill its first columns, as they arrived."""
        return cls(
            counts, points, ids, labels, confidence, _arrival_order(counts), int(counts.max(initial=0))
        )

    @classmethod
    def of_tables(cls, points: ArrayLike, ids: ArrayLike, labels: ArrayLike, confidence: ArrayLike) -> Self:
        """The points of tables (T, N, 3) and (T, N); there is none where its position is NaN.

        Raises:
            ValueError: The tables do not fit together, or hold what they cannot.
        """
        tables = {"points": points, "ids": ids, "labels": labels, "confidence": confidence}
        shape = np.shape(points)
        sizes = dict(zip("TN", shape if len(shape) == 3 else (0, 0), strict=False))
        checked = {
            column.name: fitted(column._replace(shape=("T", "N", *column.entry)), tables[column.name], sizes)
            for column in POINTS
        }
        present = ~np.isnan(checked["points"]).any(axis=-1)
        columns, num_columns = np.nonzero(present)[1], present.shape[1]
        entries = {name: table[present] for name, table in checked.items()}
        return cls(present.sum(axis=1), **entries, columns=columns, num_columns=num_columns)

    @cached_property
    def starts(self) -> Int[np.ndarray, "T+1"]:
        """The first point of each frame, and the number of points."""
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.int64)])

    @cached_property
    def frames(self) -> Int[np.ndarray, "P"]:
        """The frame of each point."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def is_in_order(self) -> bool:
        """Whether the columns follow from the counts, as those of a stream do."""
        widest = int(self.counts.max(initial=0))
        return self.num_columns == widest and np.array_equal(self.columns, _arrival_order(self.counts))

    @cached_property
    def tables(self) -> dict[str, NDArray[Any]]:
        """Tables (T, N, ...) of the points, IDs, labels and confidences; NaN or -1 where there is no point.

        They cannot be written to.
        """
        tables = {column.name: self.table(getattr(self, column.name), column.missing) for column in POINTS}
        for table in tables.values():
            table.flags.writeable = False
        return tables

    def table(self, entries: NDArray[Any], missing: float) -> NDArray[Any]:
        """An entry per point (P, ...) as a table (T, N, ...), with `missing` where there is no point."""
        table = np.full((len(self.counts), self.num_columns, *entries.shape[1:]), missing, entries.dtype)
        table[self.frames, self.columns] = entries
        return table

    def of(self, frame: int | np.integer[Any]) -> slice:
        """Which points belong to a frame."""
        return slice(int(self.starts[frame]), int(self.starts[frame + 1]))

    def at(self, frame: int, column: int) -> int:
        """The point of a frame in a column of the tables.

        Raises:
            IndexError: There is none.
        """
        part = self.of(frame)
        found: int = part.start + int(np.searchsorted(self.columns[part], column))
        if found == part.stop or self.columns[found] != column:
            raise IndexError(f"column {column} has no point in frame {frame}")
        return found

    def labeled(self, of: range, frames: Int[np.ndarray, "F"] | None = None) -> Float[np.ndarray, "F M 3"]:
        """The points with these labels [m], in the order of the labels; NaN where there is none.

        Args:
            of: Labels that follow one another.
            frames: Increasing numbers of frames; all when None.
        """
        which = np.flatnonzero((self.labels >= of.start) & (self.labels < of.stop))
        rows = self.frames[which]
        if frames is not None:
            row_of = np.full(len(self.counts), -1)
            row_of[frames] = np.arange(len(frames))
            which, rows = which[row_of[rows] >= 0], row_of[rows][row_of[rows] >= 0]
        markers = np.full((len(self.counts) if frames is None else len(frames), len(of), 3), np.nan)
        markers[rows, self.labels[which] - of.start] = self.points[which]
        return markers

    def cut(self, first: int, last: int) -> PointList:
        """The points of the frames from `first` to `last`, the latter not included."""
        part = slice(int(self.starts[first]), int(self.starts[last]))
        entries = {name: getattr(self, name)[part] for name in _PER_POINT}
        return dataclasses.replace(self, counts=self.counts[first:last], **entries)

    def without(self, gone: NDArray[np.bool_]) -> PointList:
        """The points but for some (P,); the others keep their columns."""
        counts = np.bincount(self.frames[~gone], minlength=len(self.counts))
        entries = {name: getattr(self, name)[~gone] for name in _PER_POINT}
        return dataclasses.replace(self, counts=counts, **entries)

    def stored(self) -> tuple[dict[str, NDArray[Any]], int | None]:
        """The arrays of a file and the number of columns; points of a stream have no columns there."""
        arrays = {POINT_COUNTS.name: self.counts}
        arrays |= {column.name: getattr(self, column.name) for column in POINTS}
        if self.is_in_order:
            return arrays, None
        return {**arrays, POINT_COLUMNS.name: self.columns}, self.num_columns


_PER_POINT = (*(column.name for column in POINTS), "columns")


def _arrival_order(counts: Int[np.ndarray, "T"]) -> NDArray[np.int64]:
    """The columns of points that fill the first columns of each frame."""
    counts = counts.astype(np.int64)
    ends = np.cumsum(counts)
    order: NDArray[np.int64] = np.arange(counts.sum()) - np.repeat(ends - counts, counts)
    return order
