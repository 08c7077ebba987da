"""Frames of a stream looked over: a clock that only goes forward, and points that can be used."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from handsim.errors import ArgumentError
from track.frames import FrameValidator

NOTHING = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
TIMES = st.one_of(st.integers(-(10**9), 10**9).map(lambda number: 1e-3 * number), st.just(np.nan))
POINTS = arrays(
    np.float64,
    st.tuples(st.integers(0, 12), st.just(3)),
    elements=st.one_of(st.floats(-2.0, 2.0), st.floats(allow_nan=True, allow_infinity=True)),
)
IDS = st.one_of(st.integers(-3, 5), st.integers(-(2**63), 2**63 - 1))


def clock(times: list[float]) -> tuple[np.ndarray, list[tuple[str, ...]]]:
    """What the times of a stream's frames become, and what is said of them."""
    intake = FrameValidator()
    taken = [intake.check_frame(*NOTHING, time) for time in times]
    return np.array([one.time for one in taken]), [one.notes for one in taken]


@settings(deadline=None)
@given(st.lists(TIMES, min_size=2, max_size=30))
def test_the_clock_only_goes_forward(times):
    now, _ = clock(times)
    assert np.isfinite(now).all() and (np.diff(now) > 0.0).all()


@settings(deadline=None)
@given(st.lists(st.floats(0.02, 0.2), min_size=1, max_size=30), st.floats(-1e4, 1e4))
def test_a_clock_that_is_right_is_followed(spans, begin):
    times = begin + np.cumsum([0.0, *spans])
    now, notes = clock(times.tolist())
    np.testing.assert_allclose(np.diff(now), np.diff(times), atol=1e-9)
    assert not any(notes)


def test_a_frame_without_a_time_takes_the_usual_interval():
    now, notes = clock([*(np.arange(100) / 50.0), np.nan, 2.0])
    assert now[100] - now[99] == pytest.approx(0.02, rel=0.01)
    assert [len(words) for words in notes] == [0] * 100 + [1, 0]


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0.0, 0.5], "no frame for 0.5 s"),
        ([1.0, 1.0], "the time stood still"),
        ([1.0, 0.75], "the time went back by 0.25 s"),
        ([0.0, np.nan], "the time is not a number"),
        ([np.nan, np.nan], "the time is not a number"),
    ],
)
def test_what_is_odd_about_a_time_is_said(times, said):
    assert clock(times)[1][-1] == (said,)


@pytest.mark.parametrize("odd", [np.inf, 1e18, 1.7e308])
def test_a_time_that_cannot_be_does_not_break_the_clock(odd):
    now, notes = clock([0.0, 0.01, -odd, odd, 0.02, 0.03, 0.04])
    assert np.isfinite(now).all() and (np.diff(now) > 0.0).all()
    assert notes[3]


@settings(deadline=None)
@given(POINTS, st.data())
def test_what_is_kept_are_points_of_the_frame_each_with_an_id_of_its_own(points, data):
    ids = data.draw(arrays(np.int64, len(points), elements=IDS))
    given_points, given_ids = points.copy(), ids.copy()
    taken = FrameValidator().check_frame(points, ids, 0.0)
    np.testing.assert_array_equal(points, given_points)
    np.testing.assert_array_equal(ids, given_ids)
    usable = np.isfinite(points).all(axis=1) & (np.nan_to_num(np.abs(points)) < 1e3).all(axis=1)
    np.testing.assert_array_equal(taken.kept, np.flatnonzero(usable))
    np.testing.assert_array_equal(taken.points, points[taken.kept])
    known = taken.ids[taken.ids >= 0]
    assert len(np.unique(known)) == len(known) and (taken.ids >= -1).all()
    alone = [np.sum(ids[usable] == one) == 1 and one >= 0 for one in ids[taken.kept]]
    np.testing.assert_array_equal(taken.ids, np.where(alone, ids[taken.kept], -1))
    doubled, nowhere = len(set(ids[usable & (ids >= 0)])) < np.sum(usable & (ids >= 0)), not usable.all()
    assert any("several points" in note for note in taken.notes) == doubled
    assert any("left out" in note for note in taken.notes) == nowhere


def test_stamps_that_lie_together_are_told_apart():
    now, notes = clock([0.0, 0.01, 0.02, 0.02 + 1e-6, 0.03])
    assert np.diff(now)[2] > 5e-4 and not any(notes)


def test_points_and_ids_that_do_not_fit_are_the_callers_mistake():
    for points, ids in [(np.zeros((2, 3)), np.zeros(3)), (np.zeros((2, 2)), np.zeros(2)), (np.zeros(3), [1])]:
        with pytest.raises(ArgumentError, match="expected"):
            FrameValidator().check_frame(points, np.asarray(ids, dtype=int), 0.0)
