"""Curves of long takes keep their peaks and their gaps, and the spans that are shaded."""

from __future__ import annotations

import numpy as np
import pytest

from track.reports.take_plots import decimated, shaded


def test_a_short_curve_is_drawn_as_it_is(rng):
    times, values = np.arange(1500) / 120.0, rng.normal(size=1500)
    drawn = decimated(times, values)
    np.testing.assert_array_equal(drawn[0], times)
    np.testing.assert_array_equal(drawn[1], values)


def test_a_long_curve_keeps_its_peaks_and_its_gaps(rng):
    times, values = np.arange(10_000) / 120.0, rng.normal(size=10_000)
    values[4321], values[8765], values[5000:5400] = 50.0, -60.0, np.nan
    drawn_times, drawn = decimated(times, values)
    assert len(drawn) <= 1500 and (np.diff(drawn_times) > 0.0).all()
    assert np.nanmax(drawn) == 50.0 and np.nanmin(drawn) == -60.0
    for peak, frame in ((50.0, 4321), (-60.0, 8765)):
        (place,) = drawn_times[drawn == peak]
        assert place == pytest.approx(times[frame], abs=14 / 120.0)
    gap = drawn_times[np.isnan(drawn)]
    assert times[5000] <= gap[0] < times[5030] and times[5370] < gap[-1] <= times[5400]


@pytest.mark.parametrize("num_frames", [30, 10_000])
def test_what_is_shaded_is_what_is_flagged(num_frames):
    times, flags = np.arange(num_frames) / 100.0, np.zeros(num_frames, dtype=bool)
    flags[5], flags[-10:] = True, True
    first, last = shaded(times, flags)
    width = 1 if num_frames == 30 else 14
    assert first[0] <= times[5] < first[0] + first[1] <= times[5 + width] + 1e-9
    assert times[-10 - width] < last[0] <= times[-10] and sum(last) == pytest.approx(num_frames / 100.0)
    assert shaded(times, np.zeros(num_frames, dtype=bool)) == []
    assert shaded(times[:1], np.ones(1, dtype=bool)) == [(0.0, 1.0)], "a take of one frame"
