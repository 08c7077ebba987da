"""Rows of a training set that stay in their files: the operating system keeps one copy for all processes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped
from numpy.typing import NDArray


class MappedRows:
    """Rows of several arrays one after the other, none of which is copied before it is asked for.

    Args:
        shards: The arrays, memory-mapped or not, of one type of records (`train.data.shards.row_dtype`).
        start: First row of the span that this is.
        stop: The row after its last one; all rows when not given.
    """

    def __init__(
        self, shards: Sequence[NDArray[np.void]], *, start: int = 0, stop: int | None = None
    ) -> None:
        self._shards = shards
        self._ends = np.cumsum([len(shard) for shard in shards])
        self._start, self._stop = start, int(self._ends[-1]) if stop is None else stop

    def __len__(self) -> int:
        return self._stop - self._start

    def span(self, start: int, stop: int) -> MappedRows:
        """The rows from `start` to before `stop`, left where they are."""
        return MappedRows(self._shards, start=self._start + start, stop=self._start + stop)

    def __getitem__(self, wanted: str | Int[np.ndarray, "B"]) -> Shaped[np.ndarray, "B *rest"]:
        """A copy of the rows of these numbers (0 or more), or of a field of all rows."""
        if isinstance(wanted, str):
            return np.concatenate([part[wanted] for part in self._parts()])
        numbers = np.asarray(wanted) + self._start
        if len(numbers) and not self._start <= numbers.min() <= numbers.max() < self._stop:
            raise IndexError(f"rows {wanted.min()} to {wanted.max()} of {len(self)}")
        rows: NDArray[Any] = np.empty(len(numbers), dtype=self._shards[0].dtype)
        holders = np.searchsorted(self._ends, numbers, side="right")
        for holder in np.unique(holders):
            here = holders == holder
            shard = self._shards[holder]
            rows[here] = shard[numbers[here] - (self._ends[holder] - len(shard))]
        return rows

    def _parts(self) -> list[NDArray[np.void]]:
        """What each array has of the rows."""
        firsts = [int(end) - len(shard) for end, shard in zip(self._ends, self._shards, strict=True)]
        return [
            shard[max(self._start - first, 0) : max(self._stop - first, 0)]
            for first, shard in zip(firsts, self._shards, strict=True)
        ]
