"""Arrays of other packages and of odd kinds, as arguments of public functions."""

from __future__ import annotations

import numpy as np
import pytest

from handsim._checks import as_numbers, check_array
from handsim.errors import ArgumentError

VALUES = np.arange(12.0).reshape(4, 3)
MASK = VALUES % 5 == 0


@pytest.mark.parametrize(
    "given",
    [
        np.ma.array(VALUES, mask=MASK),
        np.ma.array(VALUES.astype(np.float32), mask=MASK),
        np.ma.array(VALUES.astype(int), mask=MASK),
        [np.ma.array(row, mask=mask) for row, mask in zip(VALUES, MASK, strict=True)],
        np.where(MASK, None, VALUES.astype(object)),
    ],
    ids=["double", "single", "whole", "list", "None"],
)
def test_what_is_masked_is_missing(given):
    np.testing.assert_array_equal(as_numbers("points", given), np.where(MASK, np.nan, VALUES))
    with pytest.raises(ArgumentError, match="points holds NaN or infinite values"):
        check_array("points", given, (4, 3))


def test_masked_ids_are_none():
    ids = as_numbers("ids", np.ma.array([7, 8, 9], mask=[False, True, False]), np.int64)
    np.testing.assert_array_equal(ids, [7, -1, 9])


@pytest.mark.parametrize("gradient", [False, True])
def test_a_tensor_is_read_without_its_gradient(gradient):
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(as_numbers("x", torch.tensor(VALUES, requires_grad=gradient)), VALUES)


@pytest.mark.parametrize(
    "given", [np.full((2, 3), 1j), "abc", ["1", "2"], [[1.0, 2.0], [3.0]], (row for row in VALUES), object()]
)
def test_what_holds_no_numbers_is_told(given):
    with pytest.raises(ArgumentError, match=r"^points is .*, expected an array of numbers$"):
        as_numbers("points", given)
