"""Segment distance against a bounded least squares solve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import lsq_linear

from handsim.kernels.segments import segment_distance_squared


def segment_distance(p, q, a, b):
    return np.sqrt(segment_distance_squared(p, q, a, b))


points = arrays(np.float64, (4, 3), elements=st.floats(-1, 1, width=32))


@given(points)
@settings(max_examples=200, deadline=None)
def test_distance_is_the_bounded_least_squares_one(corners):
    p, q, a, b = corners
    solved = lsq_linear(np.stack([q - p, a - b], axis=1), a - p, bounds=(0, 1), tol=1e-14)
    expected = np.sqrt(2 * solved.cost)
    assert segment_distance(p, q, a, b) <= expected + 1e-6
    assert segment_distance(p, q, a, b) >= expected - 1e-4  # the solver stops short on flat valleys


@given(points)
@settings(max_examples=100, deadline=None)
def test_distance_does_not_depend_on_order(corners):
    p, q, a, b = corners
    first = segment_distance(p, q, a, b)
    rounding = 4e-6  # segments of up to 3.5 m within 1e-6 rad of each other are parallel
    assert segment_distance(q, p, a, b) == pytest.approx(first, abs=rounding)
    assert segment_distance(a, b, p, q) == pytest.approx(first, abs=rounding)


def test_points_parallel_and_crossing():
    o, x, y = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert segment_distance(o, o, x, x) == 1.0
    assert segment_distance(o, x, y, y + x) == 1.0
    assert segment_distance(-x, x, -y, y) == 0.0
    assert segment_distance(o, x, 3 * x, 2 * x) == 1.0
