"""The one table of a take's arrays: names, types and shapes of what is kept, checked, recorded and saved.

A shape is letters and numbers: T frames, P points of all frames, H hands, B bodies, M markers of all hands, Q
those of all bodies. An array that begins with T or P grows with each frame while a take is recorded.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handsim.hand.shape import HAND_DTYPE
from handsim.hand.topology import NUM_JOINTS, NUM_KEYPOINTS, NUM_QPOS


class Column(NamedTuple):
    """An array of a take."""

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    """Letters and numbers."""

    @property
    def of_points(self) -> bool:
        """Whether there is an entry per point, not per frame."""
        return self.shape[0] == "P"

    @property
    def entry(self) -> tuple[int, ...]:
        """Shape of one entry of a frame, or of a point; all its letters must have been given numbers."""
        return tuple(int(size) for size in self.shape[1:])

    @property
    def missing(self) -> float:
        """What stands for no entry: NaN among numbers, -1 among IDs and labels."""
        return np.nan if np.dtype(self.dtype).kind == "f" else -1

    @property
    def size(self) -> int:
        """Bytes of an entry."""
        return np.dtype(self.dtype).itemsize * math.prod(self.entry)

    def sized(self, sizes: Mapping[str, int]) -> Column:
        """The same with numbers in the place of letters."""
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
"""The fields of a take with a row a frame."""
POINTS: Final = (
    Column("points", "<f8", ("P", 3)),
    Column("ids", "<i4", ("P",)),
    Column("labels", "<i2", ("P",)),
    Column("confidence", "<f8", ("P",)),
)
"""What is kept of each point."""
POINT_COUNTS: Final = Column("point_counts", "<u4", ("T",))
"""How many points each frame has: where its points begin in the arrays of points."""
POINT_COLUMNS: Final = Column("point_columns", "<i4", ("P",))
"""The column of a capture that each point is from; the points of a stream have none."""
NUMBERS: Final = Column("numbers", "<i8", ("T",))
"""The numbers of streamed frames; a take of anything else has none."""
SPREADS: Final = (
    Column("angle_spread", "<f4", ("T", "H", NUM_JOINTS)),
    Column("keypoint_spread", "<f4", ("T", "H", NUM_KEYPOINTS)),
)
"""Standard deviations of tracked poses; a truth, and a take of an older version, has none."""
OPTIONAL: Final = (NUMBERS, *SPREADS)
"""Fields with a row a frame that a take may lack."""
KEYPOINTS: Final = Column("keypoints", "<f8", ("T", "H", NUM_KEYPOINTS, 3))
"""Joint positions, for programs without a model of the hand: written, and not read, as poses give them."""
ATTACHMENT: Final = (
    Column("attachment_points", "<f8", ("M", 3)),
    Column("attachment_normals", "<f8", ("M", 3)),
    Column("attachment_bone_indices", "<i8", ("M", 4)),
    Column("attachment_bone_weights", "<f8", ("M", 4)),
)
"""The gloves on the hands, one after another."""
BODY_MARKERS: Final = Column("body_markers", "<f8", ("Q", 3))
_HANDS: Final = "hands"
WORN: Final = (*ATTACHMENT, BODY_MARKERS)
"""What does not change from frame to frame, beside the `hands`, which are records."""
STORED: Final = (*FRAMES, POINT_COUNTS, *POINTS, KEYPOINTS, *WORN)
"""All that every file holds, beside the hands."""


def fitted(column: Column, values: ArrayLike, sizes: Mapping[str, int]) -> NDArray[Any]:
    """Values as an array of a column's type, of these sizes by letter.

    Raises:
        ValueError: They have another shape, or numbers of this type cannot hold them.
    """
    array, dtype = np.asarray(values), np.dtype(column.dtype)
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
    columns = [*STORED, *(column for column in (*OPTIONAL, POINT_COLUMNS) if column.name in arrays)]
    if arrays[_HANDS].dtype != HAND_DTYPE or arrays[_HANDS].shape != (sizes["H"],):
        raise ValueError("the hands are of another type")
    for column in columns:
        array = arrays[column.name]
        if array.dtype != column.dtype or array.shape != column.sized(sizes).shape:
            raise ValueError(f"{column.name} is of type {array.dtype} and shape {array.shape}")


def spans(counts: Sequence[int]) -> tuple[range, ...]:
    """The numbers of each of several groups, counted through all of them."""
    bounds = np.cumsum([0, *counts]).tolist()
    return tuple(range(low, high) for low, high in itertools.pairwise(bounds))
