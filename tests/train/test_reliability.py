"""Calibration: sources whose error is known, and arrays small enough to count by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from train.metrics import BINS, error_without, expected_calibration_error, reliability

points = st.integers(1, 60).flatmap(
    lambda count: st.tuples(
        arrays.arrays(float, count, elements=st.floats(0.0, 1.0, allow_subnormal=False)),
        arrays.arrays(bool, count),
    )
)


def test_a_calibrated_source_has_no_error(rng):
    confidence = rng.uniform(size=200_000)
    right = rng.uniform(size=confidence.size) < confidence
    assert expected_calibration_error(confidence, right) < 0.01
    bins = reliability(confidence, right)
    np.testing.assert_allclose(bins.right, bins.confidence, atol=0.02)
    np.testing.assert_allclose(bins.confidence, (np.arange(BINS) + 0.5) / BINS, atol=0.005)


def test_always_sure_and_half_wrong():
    right = np.arange(1000) % 2 == 0
    assert expected_calibration_error(np.ones(1000), right) == 0.5
    assert expected_calibration_error(np.zeros(1000), right) == 0.5
    assert expected_calibration_error(np.full(1000, 0.5), right) == 0.0
    assert reliability(np.ones(1000), right).count.tolist() == [0] * (BINS - 1) + [1000]


def test_bins_are_weighted_by_their_points():
    # Three points are said 0.9 and right, one is said 0.1 and right: 3/4 x 0.1 + 1/4 x 0.9.
    error = expected_calibration_error(np.array([0.9, 0.1, 0.9, 0.9]), np.ones(4, dtype=bool))
    assert error == pytest.approx(0.3)


@given(points)
def test_the_error_is_at_least_the_mean_gap_and_at_most_one(drawn):
    confidence, right = drawn
    error = expected_calibration_error(confidence, right)
    assert abs(confidence.mean() - right.mean()) - 1e-12 <= error <= 1.0
    bins = reliability(confidence, right)
    assert bins.count.sum() == len(right)
    assert np.nansum(bins.right * bins.count) == pytest.approx(right.sum())


def test_leaving_the_least_sure_out():
    confidence, right = np.array([0.9, 0.2, 0.8, 0.4, 0.6]), np.array([True, False, True, True, False])
    assert error_without(confidence, right, 0.0) == pytest.approx(2 / 5)
    assert error_without(confidence, right, 0.2) == pytest.approx(1 / 4)  # without the one of 0.2
    assert error_without(confidence, right, 0.4) == pytest.approx(
        1 / 3
    )  # nor the one of 0.4, which was right
    assert error_without(confidence, right, 0.6) == 0.0
    assert np.isnan(error_without(confidence, right, 1.0))


def test_two_percent_of_fifty_is_one():
    confidence, right = np.linspace(0.5, 1.0, 50), np.ones(50, dtype=bool)
    right[[0, 7]] = False
    assert error_without(confidence, right) == pytest.approx(1 / 49)


@given(points, st.floats(0.0, 1.0, allow_subnormal=False), st.randoms(use_true_random=False))
def test_the_order_of_points_has_no_say(drawn, share, random):
    confidence, right = np.round(drawn[0], 1), drawn[1]  # rounded, so that there are ties
    order = list(range(len(right)))
    random.shuffle(order)
    np.testing.assert_allclose(
        error_without(confidence[order], right[order], share), error_without(confidence, right, share)
    )


def test_ties_count_by_the_mean_over_all_choices():
    right = np.array([True, False, True, True])
    # Of four alike two go; whichever they are, the one mistake stays half of the time.
    assert error_without(np.full(4, 0.7), right, 0.5) == pytest.approx(0.5 * 1 / 2)


def test_nothing_to_measure():
    none = np.zeros(0)
    assert np.isnan(expected_calibration_error(none, none.astype(bool)))
    assert np.isnan(error_without(none, none.astype(bool)))
