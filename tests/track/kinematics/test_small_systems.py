"""Small systems against numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from track.kinematics.small_systems import eliminate, invert_positive, solve_positive


def positive(size: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((size, 2 * size))
    return rows @ rows.T


@pytest.mark.parametrize("size", [1, 4, 26])
def test_inverse(size):
    matrix = positive(size, size)
    inverse = np.tril(matrix)  # only the lower triangle is read
    invert_positive(inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [1, 4, 20])
def test_solution(size):
    matrix, rest = positive(size, size), np.arange(1.0, size + 1.0)
    solution = rest.copy()
    solve_positive(matrix.copy(), solution)
    np.testing.assert_allclose(matrix @ solution, rest, rtol=1e-9)


def test_what_elimination_leaves_is_the_schur_complement():
    matrix, rest = positive(9, 3), np.arange(9.0)
    left, right = matrix.copy(), rest.copy()
    eliminate(left, right, 0, 5)
    first, last = slice(0, 5), slice(5, 9)
    gone = matrix[last, first] @ np.linalg.inv(matrix[first, first])
    np.testing.assert_allclose(left[last, last], matrix[last, last] - gone @ matrix[first, last])
    np.testing.assert_allclose(right[last], rest[last] - gone @ rest[first])
