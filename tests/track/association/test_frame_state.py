"""Numbers of points in streams whose IDs last, and in those whose IDs do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.space.transforms import quaternion_matrix
from track.association.frame_state import Numbering, PointHistory, PointLinker

NOWHERE = np.zeros((0, 3))


def linker_of(*counts: int) -> PointLinker:
    """A linker for hands with so many markers."""
    return PointLinker(Numbering(counts).owners)


def cloud(count: int, seed: int) -> np.ndarray:
    """Points of two hands' size, at least 15 mm apart."""
    rng, points = np.random.default_rng(seed), np.zeros((0, 3))
    while len(points) < count:
        new = rng.uniform(-0.1, 0.1, 3)
        if len(points) == 0 or np.linalg.norm(points - new, axis=1).min() > 0.015:
            points = np.vstack([points, new])
    return points


def test_ids_that_last_are_kept_and_new_ones_get_new_numbers():
    linker, points = linker_of(), cloud(6, 0)
    first = linker.number(points, np.array([10, 11, 12, 13, 14, -1]), {}, NOWHERE)
    assert len(set(first.tolist())) == 6
    second = linker.number(points[::-1], np.array([99, 14, 13, 12, 11, -1]), {}, NOWHERE)
    np.testing.assert_array_equal(second[1:5], first[4:0:-1])
    assert not set(second[[0, 5]].tolist()) & set(first.tolist())
    gone = linker.number(points[:0], np.arange(0), {}, NOWHERE)
    assert gone.shape == (0,)
    again = linker.number(points, np.arange(20, 26), {}, NOWHERE)
    assert not set(again.tolist()) & {*first.tolist(), *second.tolist()}


def test_only_points_with_a_label_count_where_there_are_any():
    """Many ghosts that are new in every frame do not tell that IDs do not last."""
    linker, points = linker_of(), cloud(30, 0)
    first = linker.number(points, np.arange(30), {}, NOWHERE)
    ids = np.where(np.arange(30) < 10, np.arange(30), 100 + np.arange(30))
    second = linker.number(
        points, ids, {number: 0 for number in first[:10].tolist()}, np.full((1, 3), np.nan)
    )
    np.testing.assert_array_equal(second[:10], first[:10])
    assert not set(second[10:].tolist()) & set(first.tolist())


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.booleans())
def test_points_with_new_ids_keep_their_numbers(seed, numbered):
    """The order changes, two points vanish and two come; without hands points stay nearly where they are."""
    rng, points, linker = np.random.default_rng(seed), cloud(20, seed), linker_of()
    ids = np.arange(20) if numbered else np.full(20, -1)
    first = linker.number(points, ids, {}, NOWHERE)
    order = rng.permutation(20)
    moved = points[order] + rng.uniform(-0.003, 0.003, (20, 3))
    moved[:2] += 0.5
    second = linker.number(moved, ids + 100 * numbered, {}, NOWHERE)
    np.testing.assert_array_equal(second[2:], first[order[2:]])
    assert not set(second[:2].tolist()) & set(first.tolist())


@pytest.mark.parametrize("seed", range(5))
def test_a_hand_that_moves_otherwise_than_predicted_is_aligned(seed):
    """It is 25 mm off and turned by 15 degrees; another one stands, and its points are 15 mm apart."""
    points, still, linker = cloud(19, seed), cloud(19, seed + 50) + [0.4, 0.0, 0.0], linker_of(19, 19)
    both = np.vstack([points, still])
    first = linker.number(both, np.full(38, -1), {}, NOWHERE)
    labels = {number: row for row, number in enumerate(first.tolist())}
    turn = quaternion_matrix(np.array([[np.cos(0.13), 0.0, 0.0, np.sin(0.13)]]))[0]
    moved = np.vstack([points @ turn.T + [0.0, 0.02, 0.015], still])
    second = linker.number(moved, np.full(38, -1), labels, both)
    assert (second == first).mean() > 0.9
    np.testing.assert_array_equal(second[19:], first[19:])
    without = linker_of()
    first = without.number(both, np.full(38, -1), {}, NOWHERE)
    assert (without.number(moved, np.full(38, -1), {}, NOWHERE) == first)[:19].mean() < 0.7


def test_a_point_without_a_label_moves_with_the_hand_beside_it():
    points, linker = cloud(20, 3), linker_of(20)
    first = linker.number(points, np.full(20, -1), {}, NOWHERE)
    loose = int(np.linalg.norm(points - points.mean(0), axis=1).argmin())
    labels = {number: row for row, number in enumerate(first.tolist()) if row != loose}
    moved = points + [0.03, 0.0, 0.01]
    second = linker.number(moved, np.full(20, -1), labels, points)
    assert second[loose] == first[loose] and (second == first).mean() > 0.9


def test_labels_go_along_with_ids_and_do_not_outlive_a_silence():
    history, points, ids = PointHistory(Numbering([6]), 0.25), cloud(6, 0), np.arange(10, 16)
    nowhere = np.full((6, 3), np.nan)
    first = history.carry(points, ids, 0.0, nowhere)
    assert (first.labels == -1).all() and (first.evidence == 0.0).all()
    history.keep(first._replace(labels=np.array([3, -1, 0, 5, 1, 2]), evidence=np.arange(6.0)))
    second = history.carry(points[::-1], ids[::-1], 0.01, nowhere)
    np.testing.assert_array_equal(second.labels, [2, 1, 5, 0, -1, 3])
    np.testing.assert_array_equal(second.evidence, [5, 4, 3, 2, 0, 0])
    np.testing.assert_array_equal(second.first_seen, np.zeros(6))
    np.testing.assert_array_equal(second.free_since, [0.01, 0.01, 0.01, 0.01, 0.0, 0.01])
    history.keep(second)
    late = history.carry(points, ids, 0.27, nowhere)
    assert (late.labels == -1).all() and (late.evidence == 0.0).all()
