"""The arrays of a take: their names, types and shapes, the list of points, and the statuses.

A shape is letters and numbers: T frames, P points of all frames, H hands, B bodies, M markers of all hands, Q
markers of all bodies. An array that begins with T or P grows with each frame while a take is recorded.

The points of all frames are one list, so memory is proportional to their number. A table with a row per frame
would be as wide as its fullest frame: one crowded frame, as when a camera sees the sun, could exceed the
memory.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from handsim._checks import as_array
from handsim.hand.shape import HAND_DTYPE, NUM_JOINTS, NUM_KEYPOINTS, NUM_QPOS


class Status(IntEnum):
    """State of the pose of a hand or a rigid body; `str` gives its word."""

    LOST = 0
    """There is no pose."""
    COASTING = 1
    """Too few markers are visible; the pose is predicted, for a few frames only."""
    INITIALIZED = 2
    """The pose was initialized from the points, without history; its word is "found"."""
    TRACKED = 3
    """The pose was tracked from the previous frame."""

    def __str__(self) -> str:
        return "found" if self is Status.INITIALIZED else self.name.lower()


class Column(NamedTuple):
    """An array of a take."""

    name: str
    dtype: str
    shape: tuple[str | int, ...]

    @property
    def of_points(self) -> bool:
        """Whether there is an entry per point, not per frame."""
        return self.shape[0] == "P"

    @property
    def entry(self) -> tuple[int, ...]:
        """Shape of one entry of a frame or a point, after `sized`."""
        return tuple(int(size) for size in self.shape[1:])

    @property
    def missing(self) -> float:
        """The value that stands for a missing entry: NaN in numbers, -1 in IDs and labels."""
        return np.nan if np.dtype(self.dtype).kind == "f" else -1

    @property
    def size(self) -> int:
        """Bytes of an entry."""
        return np.dtype(self.dtype).itemsize * math.prod(self.entry)

    def sized(self, sizes: Mapping[str, int]) -> Column:
        """The column with letters of its shape replaced by numbers."""
        return self._replace(shape=tuple(sizes.get(str(size), size) for size in self.shape))


FRAMES: Final = (
    Column("times", "<f8", ("T",)),
    Column("qpos", "<f8", ("T", "H", NUM_QPOS)),
    Column("status", "|i1", ("T", "H")),
    Column("rms", "<f8", ("T", "H")),
    Column("body_poses", "<f8", ("T", "B", 7)),
    Column("body_status", "|i1", ("T", "B")),
    Column("body_rms", "<f8", ("T", "B")),
)
"""Fields of a take with one row per frame."""
POINTS: Final = (
    Column("points", "<f8", ("P", 3)),
    Column("ids", "<i4", ("P",)),
    Column("labels", "<i2", ("P",)),
    Column("confidence", "<f8", ("P",)),
)
"""Arrays of a take with one entry per point."""
POINT_COUNTS: Final = Column("point_counts", "<u4", ("T",))
"""Number of points of each frame."""
POINT_COLUMNS: Final = Column("point_columns", "<i4", ("P",))
"""Column of each point in its capture; points of a stream have none."""
NUMBERS: Final = Column("numbers", "<i8", ("T",))
"""Frame numbers of a stream; other takes have none."""
SPREADS: Final = (
    Column("angle_spread", "<f4", ("T", "H", NUM_JOINTS)),
    Column("keypoint_spread", "<f4", ("T", "H", NUM_KEYPOINTS)),
)
"""Standard deviations of tracked poses; simulated takes and takes of older versions have none."""
WRIST_SPREAD: Final = Column("wrist_spread", "<f4", ("T", "H", 3))
"""Standard deviations of the angles of wrists and forearms; takes without a forearm have none."""
OPTIONAL: Final = (NUMBERS, *SPREADS, WRIST_SPREAD)
"""Fields with one row per frame that a take may lack."""
KEYPOINTS: Final = Column("keypoints", "<f8", ("T", "H", NUM_KEYPOINTS, 3))
"""Joint positions for programs without a model of the hand; `load_take` ignores them."""
ATTACHMENT: Final = (
    Column("attachment_points", "<f8", ("M", 3)),
    Column("attachment_normals", "<f8", ("M", 3)),
    Column("attachment_bone_indices", "<i8", ("M", 4)),
    Column("attachment_bone_weights", "<f8", ("M", 4)),
)
"""Attachments of the gloves, one glove after another."""
ARCH: Final = Column("arch", "<f8", ("H", 2))
"""`HandShape.arch` of each hand; files of hands without one lack it."""
BODY_MARKERS: Final = Column("body_markers", "<f8", ("Q", 3))
STORED: Final = (*FRAMES, POINT_COUNTS, *POINTS, KEYPOINTS, *ATTACHMENT, BODY_MARKERS)
"""The arrays that every file holds, besides the records of the hands."""


def fitted(column: Column, values: ArrayLike, sizes: Mapping[str, int]) -> NDArray[Any]:
    """Convert values to an array of a column's type, and check its shape (`sizes` by letter) and range."""
    array, dtype = as_array(values, column.dtype), np.dtype(column.dtype)
    expected = column.sized(sizes).shape
    if array.shape != expected:
        shape = ", ".join(map(str, expected))
        raise ValueError(f"{column.name} has shape {array.shape}, expected ({shape})")
    if array.dtype == dtype:
        return array
    whole = dtype.kind in "iu"
    if array.dtype.kind not in ("iu" if whole else "iuf"):
        kind = "whole numbers" if whole else "numbers"
        raise ValueError(f"{column.name} holds values of type {array.dtype}, expected {kind}")
    if whole and array.size:
        limits = np.iinfo(dtype)
        if array.min() < limits.min or array.max() > limits.max:
            raise ValueError(f"{column.name} holds numbers beyond {limits.min} to {limits.max}")
    return array.astype(dtype)


def check_stored(arrays: Mapping[str, NDArray[Any]], sizes: Mapping[str, int]) -> None:
    """Raise a `ValueError` unless a file's arrays have the types and shapes of the table."""
    if arrays["hands"].dtype != HAND_DTYPE or arrays["hands"].shape != (sizes["H"],):
        raise ValueError("the hands are of another type")
    for column in (*STORED, *(one for one in (*OPTIONAL, ARCH, POINT_COLUMNS) if one.name in arrays)):
        array = arrays[column.name]
        if array.dtype != column.dtype or array.shape != column.sized(sizes).shape:
            raise ValueError(f"{column.name} is of type {array.dtype} and shape {array.shape}")


def spread_out(frames: NDArray[Any], most: int) -> NDArray[Any]:
    """At most `most` evenly spaced frames of an array (F, ...)."""
    rows = np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(int)
    return np.asarray(frames[rows])


def far_apart(rows: Float[np.ndarray, "R K"], first: int, count: int) -> list[int]:
    """At most `count` rows, starting with `first`, each as far as possible from the rows chosen before."""
    chosen, far = [first], np.full(len(rows), np.inf)
    while len(chosen) < min(count, len(rows)):
        far = np.minimum(far, ((rows - rows[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(far.argmax()))
    return chosen


def spans(counts: Sequence[int]) -> tuple[range, ...]:
    """Index ranges of consecutive groups of these sizes."""
    bounds = np.cumsum([0, *counts]).tolist()
    return tuple(range(low, high) for low, high in itertools.pairwise(bounds))


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
        """The points of a stream, which occupy the first columns of their frame in the order of arrival."""
        if counts.sum(dtype=np.int64) != len(ids):  # before anything of that size is allocated
            raise ValueError("the counts of frames do not sum to the number of points")
        order, num_columns = _arrival_order(counts), int(counts.max(initial=0))
        return cls(counts, points, ids, labels, confidence, order, num_columns)

    @classmethod
    def of_tables(cls, points: ArrayLike, ids: ArrayLike, labels: ArrayLike, confidence: ArrayLike) -> Self:
        """The points of tables (T, N, 3) and (T, N), without those whose position is NaN.

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
        """Index of the first point of each frame, and the number of points."""
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.int64)])

    @cached_property
    def frames(self) -> Int[np.ndarray, "P"]:
        """The frame of each point."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def is_in_order(self) -> bool:
        """Whether the columns follow from the counts, as in a stream."""
        widest = int(self.counts.max(initial=0))
        return self.num_columns == widest and np.array_equal(self.columns, _arrival_order(self.counts))

    @cached_property
    def tables(self) -> dict[str, NDArray[Any]]:
        """Read-only tables (T, N, ...) of points, IDs, labels and confidences; NaN or -1 without a point."""
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
        """Slice of the points of a frame."""
        return slice(int(self.starts[frame]), int(self.starts[frame + 1]))

    def at(self, frame: int, column: int) -> int:
        """Index of the point in a frame and a column of the tables.

        Raises:
            IndexError: The column has no point in this frame.
        """
        part = self.of(frame)
        found: int = part.start + int(np.searchsorted(self.columns[part], column))
        if found == part.stop or self.columns[found] != column:
            raise IndexError(f"column {column} has no point in frame {frame}")
        return found

    def labeled(self, of: range, frames: Int[np.ndarray, "F"] | None = None) -> Float[np.ndarray, "F M 3"]:
        """The points with these labels [m], in the order of the labels; NaN where there is none.

        Args:
            of: A range of labels.
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
        """The points of the frames from `first` up to, not including, `last`."""
        part = slice(int(self.starts[first]), int(self.starts[last]))
        entries = {name: getattr(self, name)[part] for name in _POINT_FIELDS}
        return dataclasses.replace(self, counts=self.counts[first:last], **entries)

    def without(self, gone: NDArray[np.bool_]) -> PointList:
        """The points without those that are `gone` (P,); the others keep their columns."""
        counts = np.bincount(self.frames[~gone], minlength=len(self.counts))
        entries = {name: getattr(self, name)[~gone] for name in _POINT_FIELDS}
        return dataclasses.replace(self, counts=counts, **entries)

    def stored(self) -> tuple[dict[str, NDArray[Any]], int | None]:
        """The arrays of a file, and the number of columns, which is None for points of a stream."""
        arrays = {POINT_COUNTS.name: self.counts}
        arrays |= {column.name: getattr(self, column.name) for column in POINTS}
        if self.is_in_order:
            return arrays, None
        return {**arrays, POINT_COLUMNS.name: self.columns}, self.num_columns


_POINT_FIELDS = (*(column.name for column in POINTS), "columns")


def _arrival_order(counts: Int[np.ndarray, "T"]) -> NDArray[np.int64]:
    """The columns of points that fill the first columns of each frame."""
    counts = counts.astype(np.int64)
    ends = np.cumsum(counts)
    return np.asarray(np.arange(counts.sum()) - np.repeat(ends - counts, counts))
