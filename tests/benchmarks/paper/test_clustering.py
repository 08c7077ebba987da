"""Clusters of points that may be hands."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.paper_tracker import cluster_points

PLACES = arrays(np.float64, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-0.5, 0.5))


@settings(deadline=None, max_examples=50)
@given(PLACES, st.integers(1, 25))
def test_every_point_is_in_one_cluster_and_none_is_too_large(points, most):
    clusters = cluster_points(points, most=most)
    assert sorted(np.concatenate([np.zeros(0, dtype=int), *clusters]).tolist()) == list(range(len(points)))
    assert all(len(cluster) <= most for cluster in clusters)
    centers = [points[cluster].mean(axis=0) for cluster in clusters]
    for place, one in enumerate(clusters):
        for other in range(place):
            far = np.linalg.norm(centers[place] - centers[other]) > 0.2 - 1e-9
            assert far or len(one) + len(clusters[other]) > most, "nothing is left to join"


def test_centers_count_and_not_the_points_between():
    chain = np.zeros((6, 3))
    chain[:, 0] = np.arange(6) * 0.15
    assert [cluster.tolist() for cluster in cluster_points(chain, most=22)] == [[0, 1], [2, 3], [4, 5]]


def test_two_hands_apart_are_two_clusters_whatever_the_order(rng):
    hands = rng.uniform(-0.08, 0.08, size=(2, 19, 3))
    hands[1, :, 0] += 0.4
    points, order = hands.reshape(-1, 3), rng.permutation(38)
    clusters = cluster_points(points[order], most=22)
    assert sorted(sorted(order[cluster].tolist()) for cluster in clusters) == [
        list(range(19)),
        list(range(19, 38)),
    ]


def test_clusters_do_not_grow_beyond_the_most():
    points = np.random.default_rng(5).uniform(-0.05, 0.05, size=(45, 3))
    sizes = [len(cluster) for cluster in cluster_points(points, most=22)]
    assert max(sizes) <= 22 and len(sizes) >= 3
