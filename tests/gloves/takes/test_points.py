"""Lists of points: tables and lists hold the same, and what does not fit together is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gloves import PointList


@st.composite
def tables(draw):
    """Tables (T, N, ...) of points with gaps; a row may be empty or full."""
    shape = draw(st.integers(0, 6)), draw(st.integers(0, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    gone = rng.random(shape) < draw(st.sampled_from([0.0, 0.3, 0.9, 1.0]))
    points = np.where(gone[..., None], np.nan, rng.normal(size=(*shape, 3)))
    ids, labels = (np.where(gone, -1, rng.integers(-1, 50, shape)) for _ in range(2))
    return points, ids, labels, np.where(gone, np.nan, rng.random(shape))


@given(tables())
def test_a_list_holds_what_its_tables_hold(made):
    points = PointList.of_tables(*made)
    for table, again in zip(made, points.tables.values(), strict=True):
        np.testing.assert_array_equal(again, table)
        with pytest.raises(ValueError, match="read-only"):
            again[...] = 0
    present = ~np.isnan(made[0][..., 0])
    np.testing.assert_array_equal(points.counts, present.sum(axis=1))
    frames, columns = np.nonzero(present)
    for point, (frame, column) in enumerate(zip(frames, columns, strict=True)):
        assert points.at(frame, column) == point and point in range(*points.of(frame).indices(len(frames)))
    for frame, column in zip(*np.nonzero(~present), strict=True):
        with pytest.raises(IndexError, match=f"column {column} has no point in frame {frame}"):
            points.at(frame, column)


@given(tables(), st.data())
def test_parts_of_a_list_are_parts_of_its_tables(made, data):
    points = PointList.of_tables(*made)
    count = len(points.counts)
    first = data.draw(st.integers(0, count))
    last = data.draw(st.integers(first, count))
    for table, again in zip(made, points.cut(first, last).tables.values(), strict=True):
        np.testing.assert_array_equal(again, table[first:last])
    gone = points.labels < 10
    fewer = points.without(gone)
    hidden = np.where((made[2] < 10)[..., None], np.nan, made[0])
    np.testing.assert_array_equal(fewer.tables["points"], hidden)


@given(st.lists(st.integers(0, 5), max_size=6))
def test_points_of_a_stream_fill_the_first_columns(counts):
    total = sum(counts)
    points = PointList.in_order(
        np.array(counts, dtype=int),
        np.ones((total, 3)),
        np.arange(total),
        np.zeros(total, dtype=int),
        np.ones(total),
    )
    assert points.is_in_order and points.num_columns == max(counts, default=0)
    for frame, count in enumerate(counts):
        np.testing.assert_array_equal(points.columns[points.of(frame)], np.arange(count))


def test_frames_that_count_more_points_than_there_are_cost_no_memory():
    none = np.empty(0)
    with pytest.raises(ValueError, match="do not sum to the number of points"):
        PointList.in_order(np.array([2**31, 2**31]), np.empty((0, 3)), none, none, none)


def test_markers_are_found_by_their_labels():
    points = PointList.of_tables(
        np.arange(18.0).reshape(3, 2, 3),
        np.zeros((3, 2), dtype=int),
        [[4, 5], [5, -1], [6, 4]],
        np.ones((3, 2)),
    )
    markers = points.labeled(range(4, 6))
    np.testing.assert_array_equal(markers[:, 0, 0], [0.0, np.nan, 15.0])
    np.testing.assert_array_equal(markers[:, 1, 0], [3.0, 6.0, np.nan])
    np.testing.assert_array_equal(points.labeled(range(4, 6), np.array([0, 2])), markers[[0, 2]])


def test_what_does_not_fit_together_is_refused():
    fits = {
        "counts": np.array([2, 1]),
        "points": np.zeros((3, 3)),
        "ids": np.zeros(3, dtype=int),
        "labels": np.zeros(3, dtype=int),
        "confidence": np.ones(3),
        "columns": np.array([0, 2, 1]),
        "num_columns": 3,
    }
    PointList(**fits)
    for change in (
        {"counts": np.array([2, 2])},
        {"points": np.zeros((2, 3))},
        {"ids": np.zeros(3)},
        {"columns": np.array([0, 3, 1])},
        {"columns": np.array([2, 0, 1])},
        {"columns": np.array([0, 0, 1])},
        {"columns": np.array([-1, 0, 1])},
        {"num_columns": 2},
    ):
        with pytest.raises(ValueError):
            PointList(**fits | change)
