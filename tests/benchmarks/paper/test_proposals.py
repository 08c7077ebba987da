"""Points named by what is near, and the clouds that a labeler is asked about."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.paper_tracker import labeler_cloud
from benchmarks.paper.plain_hand import label_by_proximity

SOME = arrays(np.float64, st.tuples(st.integers(0, 9), st.just(3)), elements=st.floats(0.0, 0.03))


@settings(deadline=None, max_examples=80)
@given(SOME, SOME)
def test_names_are_one_to_one_near_and_leave_no_pair(points, places):
    names = label_by_proximity(points, places, 0.015)
    named = names[names >= 0]
    assert len(np.unique(named)) == len(named)
    apart = np.linalg.norm(points[:, None] - places, axis=-1)
    assert (apart[names >= 0, named] < 0.015).all()
    left = np.delete(apart[names < 0], named, axis=1)
    assert not (left < 0.015).any()


def test_the_nearest_pair_goes_first():
    points, places = np.array([[0.010, 0, 0], [0.001, 0, 0]]), np.array([[0.004, 0, 0], [0.016, 0, 0]])
    assert label_by_proximity(points, places, 0.015).tolist() == [1, 0]
    assert label_by_proximity(points[:1], places[:1] + [0.021, 0, 0], 0.015).tolist() == [-1], "not nearer"


def test_a_place_at_infinity_is_nobodys():
    assert label_by_proximity(np.zeros((2, 3)), np.full((3, 3), np.inf), 0.015).tolist() == [-1, -1]


def test_a_cloud_is_the_hand_and_the_nearest_free_points():
    points = np.zeros((9, 3))
    points[:, 0] = [0.0, 0.02, 0.05, 0.04, 0.1, 0.19, 0.3, 0.06, 0.03]
    named, free = np.arange(9) < 2, (np.arange(9) >= 2) & (np.arange(9) < 8)
    assert labeler_cloud(points, named, free, most=5, radius=0.2).tolist() == [0, 1, 3, 2, 7]
    assert labeler_cloud(points, named, free, most=22, radius=0.2).tolist() == [0, 1, 3, 2, 7, 4, 5]
    assert labeler_cloud(points, named, free, most=2, radius=0.2).tolist() == [0, 1]
