"""Compiled solvers of small positive-definite systems: a call of LAPACK costs more than their solution."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from handsim.kernels.kernel import kernel


@kernel
def invert_positive(matrix: Float[np.ndarray, "N N"]) -> None:
    """Overwrite a symmetric positive-definite matrix by its inverse; only its lower triangle is read."""
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


@kernel
def eliminate(
    matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"], first: int, last: int
) -> None:
    """Eliminate unknowns of a symmetric positive-definite system (Schur complement).

    The block below and right of the eliminated unknowns stays symmetric and complete.

    Args:
        matrix: The matrix, overwritten.
        right_side: The right side, overwritten.
        first: The first unknown that is eliminated from those after it.
        last: The first unknown that is not eliminated.
    """
    for pivot in range(first, last):
        scale = 1.0 / matrix[pivot, pivot]
        for row in range(pivot + 1, len(matrix)):
            share = matrix[row, pivot] * scale
            if share != 0.0:
                for column in range(pivot + 1, len(matrix)):
                    matrix[row, column] -= share * matrix[pivot, column]
                right_side[row] -= share * right_side[pivot]


@kernel
def solve_positive(matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"]) -> None:
    """Solve a symmetric positive-definite system; both are overwritten, the right side by the solution."""
    count = len(matrix)
    eliminate(matrix, right_side, 0, count)
    for row in range(count - 1, -1, -1):
        for column in range(row + 1, count):
            right_side[row] -= matrix[row, column] * right_side[column]
        right_side[row] /= matrix[row, row]
