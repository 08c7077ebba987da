"""Small positive-definite systems, compiled: a call of LAPACK costs more than solving them does."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from track.kinematics.marker_kinematics import FAST


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def invert_positive(matrix: Any) -> None:
    """Overwrite a symmetric positive-definite matrix (N, N) by its inverse; its lower triangle is read."""
    count = len(matrix)
    for row in range(count):
        for column in range(row + 1):
            entry = matrix[row, column]
            for k in range(column):
                entry -= matrix[row, k] * matrix[column, k]
            matrix[row, column] = np.sqrt(entry) if row == column else entry / matrix[column, column]
    for row in range(count):
        scale = 1.0 / matrix[row, row]
        for column in range(row):
            entry = 0.0
            for k in range(column, row):
                entry -= matrix[row, k] * matrix[k, column]
            matrix[row, column] = entry * scale
        matrix[row, row] = scale
    for row in range(count):
        for column in range(row + 1):
            entry = 0.0
            for k in range(row, count):
                entry += matrix[k, row] * matrix[k, column]
            matrix[row, column] = entry
            matrix[column, row] = entry


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def eliminate(matrix: Any, rest: Any, first: Any, last: Any) -> None:
    """Eliminate unknowns of a symmetric positive system, of which all below is kept whole (Schur complement).

    Args:
        matrix: The system (N, N), overwritten.
        rest: Its right side (N,), overwritten.
        first: The first unknown that is eliminated from those after it.
        last: The first that is not.
    """
    for pivot in range(first, last):
        scale = 1.0 / matrix[pivot, pivot]
        for row in range(pivot + 1, len(matrix)):
            share = matrix[row, pivot] * scale
            if share != 0.0:
                for column in range(pivot + 1, len(matrix)):
                    matrix[row, column] -= share * matrix[pivot, column]
                rest[row] -= share * rest[pivot]


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def solve_positive(matrix: Any, rest: Any) -> None:
    """Solve a symmetric positive system (N, N), overwritten, in place of its right side (N,)."""
    count = len(matrix)
    eliminate(matrix, rest, 0, count)
    for row in range(count - 1, -1, -1):
        for column in range(row + 1, count):
            rest[row] -= matrix[row, column] * rest[column]
        rest[row] /= matrix[row, row]
