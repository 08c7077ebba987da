"""Groups of linked points against scipy's clusters and spanning trees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.hierarchy import fclusterdata
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from track.association.point_groups import distances_to_nearest, linked_groups, longest_links


@pytest.mark.parametrize("distance", [0.05, 0.1, 0.3])
def test_groups_are_those_of_single_linkage(rng, distance):
    points = rng.uniform(0.0, 1.0, size=(60, 3))
    number = fclusterdata(points, distance, criterion="distance", method="single")
    expected = {frozenset(np.flatnonzero(number == one)) for one in np.unique(number)}
    groups = linked_groups(points, distance)
    assert {frozenset(group) for group in groups} == expected
    assert [len(group) for group in groups] == sorted(map(len, expected), reverse=True)


def test_no_points_are_no_groups():
    assert linked_groups(np.empty((0, 3)), 0.1) == []


def test_the_longest_link_is_that_of_the_spanning_tree(rng):
    frames = rng.uniform(0.0, 0.2, size=(20, 13, 3))
    expected = [minimum_spanning_tree(cdist(points, points)).max() for points in frames]
    np.testing.assert_allclose(longest_links(frames), expected)


def test_distances_to_the_nearest_of_others(rng):
    points, others = rng.normal(size=(7, 3)), rng.normal(size=(4, 3))
    np.testing.assert_allclose(distances_to_nearest(points, others), cdist(points, others).min(axis=1))
