"""Hands without history, found among points with the shipped labeler."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.cluster.hierarchy import fclusterdata
from scipy.sparse import coo_array, csgraph
from scipy.spatial.distance import cdist

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos
from handsim.hand.shape import Side
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles
from tests.labelers import CountingLabeler
from track.association.hand_state import HandState
from track.association.initialization import (
    MOST_POINTS,
    HandInitializer,
    connected_components,
    distances_to_nearest,
    linked_groups,
    longest_links,
)
from track.kinematics.pose_spread import resting_prior
from train import load_labeler
from train.labelers.protocol import Labeling

SIDES: tuple[Side, Side] = ("right", "left")


@pytest.fixture(scope="module")
def states() -> list[HandState]:
    return [HandState(nominal_fit(load_layout("dense19"), "M", side)) for side in SIDES]


@pytest.fixture
def initializer(states) -> HandInitializer:
    return HandInitializer(states, load_labeler("dense19"))


def markers(states: list[HandState], seed: int, apart: float = 0.6) -> np.ndarray:
    """Markers (2, 19, 3) [m] of both hands in poses of their own, anyhow in space."""
    rng = np.random.default_rng(seed)
    clouds = []
    for number, state in enumerate(states):
        angles = sample_valid_angles(state.hand.model, 1, rng=rng)
        place = np.array([[apart * number, 0.0, 1.0]])
        qpos = join_qpos(angles, position=place, quaternion=random_quaternions(1, rng=rng))[0]
        clouds.append(state.solver.marker_positions(qpos))
    return np.array(clouds) + 0.0005 * rng.standard_normal((2, 19, 3))


def shuffled(clouds: np.ndarray, strays: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points and their true labels, 19 and more for the second hand, -1 for strays around the hands."""
    points = clouds.reshape(-1, 3)
    around = points[rng.integers(len(points), size=strays)] + rng.uniform(-0.05, 0.05, (strays, 3))
    labels = np.append(np.arange(len(points)), np.full(strays, -1))
    order = rng.permutation(len(labels))
    return np.concatenate([points, around])[order], labels[order]


@pytest.mark.parametrize("seed", range(3))
def test_both_hands_are_found_each_with_its_own_points(initializer, states, seed):
    points, labels = shuffled(markers(states, seed), 4, np.random.default_rng(seed))
    found = {hand.index: hand for hand in initializer.initialize(points, (0, 1))}
    assert sorted(found) == [0, 1]
    for hand, one in found.items():
        own = np.where(labels // 19 == hand, labels % 19, -1)
        own[labels < 0] = -1
        np.testing.assert_array_equal(one.labels[own >= 0], own[own >= 0])
        assert one.fit.rms[0] < 0.002


def test_a_mirrored_hand_is_not_found(initializer, states):
    right = markers(states, 1)[0]
    assert initializer.initialize(right, (1,)) == []
    assert [hand.index for hand in initializer.initialize(right, (0, 1))] == [0]


def test_touching_hands_are_cut_apart(initializer, states):
    clouds = markers(states, 2, apart=0.0)
    gap = clouds[0, :, 0].max() - clouds[1, :, 0].min()
    clouds[1] += [gap + 0.01, 0.0, 0.0]
    points, labels = shuffled(clouds, 0, np.random.default_rng(0))
    found = initializer.initialize(points, (0, 1))
    assert {hand.index for hand in found} == {0, 1}
    right = sum(
        (hand.labels[labels // 19 == hand.index] == labels[labels // 19 == hand.index] % 19).sum()
        for hand in found
    )
    assert right >= 36


def test_a_hand_needs_nearly_half_of_its_markers(initializer, states):
    cloud = markers(states, 1)[0]
    assert len(initializer.initialize(cloud[::2], (0,))) <= 1
    assert initializer.initialize(cloud[:8], (0,)) == []
    assert initializer.initialize(np.zeros((0, 3)), (0, 1)) == []


def test_points_at_random_are_no_hand(initializer):
    rng = np.random.default_rng(0)
    assert initializer.initialize(rng.uniform(0.0, 0.2, (24, 3)), (0, 1)) == []
    assert initializer.initialize(rng.uniform(0.0, 0.2, (MOST_POINTS + 1, 3)), (0, 1)) == []


class _Known:
    """A labeler that knows the markers at some points."""

    def __init__(self, points: np.ndarray, labels: np.ndarray, names: tuple[str, ...]) -> None:
        self._points, self._labels, self.marker_names = points, labels, names

    def label_frames(self, frames: Sequence[np.ndarray]) -> list[Labeling]:
        nearest = [cdist(points, self._points).argmin(axis=1) for points in frames]
        return [Labeling(self._labels[one], np.ones(len(one))) for one in nearest]


def test_a_hand_that_shows_few_markers_is_found_once_calls_agree(rng):
    state = HandState(nominal_fit(load_layout("starter10"), "M", "right"))
    angles = resting_prior().angles
    worn = state.solver.marker_positions(join_qpos(angles[None])[0])
    shown = np.array([0, 1, 2, 3, 4, 6, 8])
    initializer = HandInitializer([state], _Known(worn[shown], shown, state.hand.layout.names))
    calls = [initializer.initialize(worn[shown] + 3e-4 * rng.standard_normal((7, 3)), (0,)) for _ in range(9)]
    assert not calls[0] and any(calls[1:])
    (hand,) = next(one for one in calls if one)
    np.testing.assert_array_equal(hand.labels, shown)
    for _ in range(30):  # points that are elsewhere each time agree with none before
        assert not initializer.initialize(rng.uniform(0.0, 0.15, (7, 3)), (0,))


def test_scores_grow_with_points_and_fall_with_their_distance(initializer):
    assert initializer.score(19, 0.001) > initializer.score(14, 0.001)
    assert initializer.score(19, 0.001) > initializer.score(19, 0.004)
    assert initializer.score(19, 0.004, spread=0.001) < initializer.score(19, 0.004)


def test_exchanged_hands_are_exchanged_back(initializer, states):
    clouds = markers(states, 0)
    points, labels = shuffled(clouds, 0, np.random.default_rng(0))
    of_hands = [np.where(labels // 19 == hand, labels % 19, -1) for hand in (0, 1)]
    initializer._points = points
    right = [initializer._fit(hand, of_hands[hand]) for hand in (0, 1)]
    wrong = [initializer._fit(1 - hand, of_hands[hand]) for hand in (0, 1)]
    assert initializer._sides_checked(right) is right
    for hand in initializer._sides_checked(wrong):
        seen = hand.labels >= 0
        assert (hand.labels[seen] == of_hands[hand.index][seen]).all() and seen.sum() >= 17


def test_a_search_goes_on_from_call_to_call_and_no_call_labels_many_clouds(states, rng):
    """Points at random are looked at along six directions, three in the first call."""
    labeler = CountingLabeler()
    initializer, points = HandInitializer(states, labeler), rng.uniform(0.0, 0.2, (60, 3))
    for call in range(4):
        assert initializer.initialize(points, (0, 1)) == []
        assert initializer.is_searching((0, 1)) == (call < 3) and not initializer.is_searching((0,))
    assert labeler.calls[:4] == [7, 2, 2, 2], "the whole group and two halves of it along each direction"


def test_connected_parts_are_those_of_scipy(rng):
    for count in range(60):
        links = rng.integers(0, max(count, 1), (2, count))
        graph = coo_array((np.ones(count), links), shape=(count, count))
        expected = csgraph.connected_components(graph, directed=False)[1] if count else []
        np.testing.assert_array_equal(connected_components(links, count), expected)


@pytest.mark.parametrize("distance", [0.05, 0.1, 0.3])
def test_groups_are_those_of_single_linkage(rng, distance):
    points = rng.uniform(0.0, 1.0, size=(60, 3))
    number = fclusterdata(points, distance, criterion="distance", method="single")
    expected = {frozenset(np.flatnonzero(number == one)) for one in np.unique(number)}
    groups = linked_groups(points, distance)
    assert {frozenset(group) for group in groups} == expected
    assert [len(group) for group in groups] == sorted(map(len, expected), reverse=True)
    assert linked_groups(np.empty((0, 3)), distance) == []


def test_the_longest_link_is_that_of_the_spanning_tree_and_the_nearest_point_is_scipys(rng):
    frames = rng.uniform(0.0, 0.2, size=(20, 13, 3))
    expected = [csgraph.minimum_spanning_tree(cdist(points, points)).max() for points in frames]
    np.testing.assert_allclose(longest_links(frames), expected)
    points, others = rng.normal(size=(7, 3)), rng.normal(size=(4, 3))
    np.testing.assert_allclose(distances_to_nearest(points, others), cdist(points, others).min(axis=1))
