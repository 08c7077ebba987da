"""IDs and columns, against the definition for any pattern of presence."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gloves.optics.reconstruction import number_runs, pack_columns

PRESENT = arrays(np.bool_, st.tuples(st.integers(1, 25), st.integers(1, 8)))


@given(PRESENT)
def test_an_unbroken_run_has_one_id_of_its_own(present):
    ids = number_runs(present)
    np.testing.assert_array_equal(ids >= 0, present)
    expected, last = np.full(present.shape, -1), 0
    for frame in range(len(present)):
        for source in range(present.shape[1]):
            if present[frame, source]:
                goes_on = frame > 0 and present[frame - 1, source]
                expected[frame, source] = expected[frame - 1, source] if goes_on else last
                last += not goes_on
    np.testing.assert_array_equal(ids, expected)


@given(PRESENT, st.integers(0, 1000))
def test_a_column_holds_one_run_at_a_time_and_an_empty_frame_after_it(present, seed):
    ids = number_runs(present)
    columns, count = pack_columns(present, rng=np.random.default_rng(seed))
    np.testing.assert_array_equal(columns >= 0, present)
    held = np.full((len(present), count), -1)
    for frame, source in np.argwhere(present):
        assert held[frame, columns[frame, source]] == -1, "two points in one column"
        held[frame, columns[frame, source]] = ids[frame, source]
    assert count == 0 or (held >= 0).any(axis=0).all(), "no column stays empty"
    together = (held[1:] >= 0) & (held[:-1] >= 0)
    assert (held[1:] == held[:-1])[together].all()
    for number in range(ids.max() + 1):
        assert len(np.unique(columns[ids == number])) == 1
    # No more columns than sources twice over: what is over waits one frame.
    assert count <= 2 * present.shape[1]


def test_columns_are_drawn():
    present = np.ones((3, 12), dtype=bool)
    orders = [pack_columns(present, rng=np.random.default_rng(seed))[0][0] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(orders[0], orders[1])
    assert not np.array_equal(orders[0], orders[2])
    assert sorted(orders[0]) == list(range(12))
