"""Checks at the public edges: each raises one sentence that says what was wanted and what came."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from handsim.errors import ArgumentError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def check_array(name: str, array: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """`array` as finite float64 whose last dimensions are `shape` (None: any length)."""
    values = np.asarray(array, dtype=np.float64)
    tail = values.shape[values.ndim - len(shape) :] if values.ndim >= len(shape) else ()
    if len(tail) != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, tail, strict=True)
    ):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise ArgumentError(f"{name} has shape {values.shape}, expected (..., {wanted})")
    if not np.isfinite(values).all():
        raise ArgumentError(f"{name} holds NaN or infinite values, expected finite numbers")
    return values
