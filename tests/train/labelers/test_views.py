"""Views: the paper's policies, and views that turn hands like the mean hand."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.space.transforms import quaternion_matrix, random_quaternions
from train.data.batches import Corruption, corrupt
from train.labelers.views import (
    MIRROR_IMAGE,
    SIGNS,
    MeanHand,
    principal_axes,
    random_views,
    spread_views,
)

NUM_MARKERS = 12


@pytest.fixture(scope="module")
def shape():
    """A cloud without symmetry, 12 markers [m]."""
    return np.random.default_rng(3).normal(size=(NUM_MARKERS, 3)) * (0.06, 0.03, 0.015)


@pytest.fixture(scope="module")
def hands(shape):
    """Hands (500, 12, 3): the shape with a little bending, turned and moved anywhere."""
    rng = np.random.default_rng(4)
    bent = shape + rng.normal(scale=0.003, size=(500, NUM_MARKERS, 3))
    return bent @ random_views(500, rng=rng).swapaxes(1, 2) + rng.normal(size=(500, 1, 3))


@pytest.fixture(scope="module")
def mean_hand(hands):
    return MeanHand.of_clouds(hands, hands, everything(hands))


def everything(points):
    return np.ones(points.shape[:2], dtype=bool)


def angles(a, b):
    """Angles between rotations [degree]."""
    return np.degrees(np.arccos(np.clip((np.einsum("bij,bij->b", a, b) - 1) / 2, -1, 1)))


def assert_orthogonal(views):
    unit = np.broadcast_to(np.eye(3), views.shape)
    np.testing.assert_allclose(views @ views.swapaxes(-1, -2), unit, atol=1e-9)


def test_the_papers_views_are_rotations_and_follow_the_seed(hands):
    for draw in (
        lambda rng: random_views(8, rng=rng),
        lambda rng: spread_views(hands[:8], everything(hands[:8]), rng=rng),
    ):
        views = draw(np.random.default_rng(4))
        assert_orthogonal(views)
        np.testing.assert_allclose(np.linalg.det(views), 1.0)
        np.testing.assert_array_equal(views, draw(np.random.default_rng(4)))


def test_best_of_ten_spreads_best(rng):
    points = rng.normal(size=(20, 9, 3)) * (0.1, 0.1, 0.01)
    present = rng.random((20, 9)) < 0.8
    chosen = spread_views(points, present, rng=np.random.default_rng(7))
    candidates = quaternion_matrix(random_quaternions(10, rng=np.random.default_rng(7)))
    for index, view in enumerate(chosen):
        seen = points[index, present[index]]
        spreads = [np.linalg.eigvalsh(np.cov((seen @ turn.T)[:, :2].T))[0] for turn in candidates]
        np.testing.assert_array_equal(view, candidates[np.argmax(spreads)])


def test_a_line_is_seen_from_the_side():
    points = np.zeros((20, 5, 3))
    points[..., 0] = np.linspace(-0.1, 0.1, 5)
    views = spread_views(points, everything(points), rng=np.random.default_rng(7))
    candidates = quaternion_matrix(random_quaternions(10, rng=np.random.default_rng(7)))
    np.testing.assert_allclose(np.abs(views[:, 2, 0]), np.abs(candidates[:, 2, 0]).min())


def test_principal_axes_make_the_covariance_diagonal(hands):
    axes = principal_axes(hands, everything(hands))
    assert_orthogonal(axes)
    seen = (hands - hands.mean(1, keepdims=True)) @ axes.swapaxes(1, 2)
    covariance = seen.swapaxes(1, 2) @ seen
    off = covariance[:, [0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    assert (np.diff(np.diagonal(covariance, axis1=1, axis2=2), axis=1) <= 1e-12).all()


def test_the_mean_hand_has_the_shape_of_the_hands(shape, mean_hand):
    def distances(markers):
        return np.linalg.norm(markers[:, None] - markers, axis=-1)

    assert np.abs(distances(mean_hand.markers) - distances(shape)).max() < 0.001
    volume = np.linalg.det(mean_hand.markers[1:4] - mean_hand.markers[0])
    assert volume * np.linalg.det(shape[1:4] - shape[0]) > 0.0


def test_aligned_views_turn_hands_like_the_mean_hand(hands, mean_hand):
    for side in (1.0, -1.0):
        mirrored = hands * (side, 1.0, 1.0)
        views = mean_hand.align(mirrored, np.full(len(hands), side))
        assert_orthogonal(views)
        np.testing.assert_allclose(np.linalg.det(views), side)
        seen = (mirrored - mirrored.mean(1, keepdims=True)) @ views.swapaxes(1, 2)
        assert np.linalg.norm(seen - mean_hand.markers, axis=-1).mean() < 0.006


def test_the_first_views_are_all_signs_and_the_likeliest_is_mostly_right(hands, mean_hand):
    cloud = corrupt(hands, Corruption(occlude=1, ghosts=0), rng=np.random.default_rng(0))
    views = mean_hand.first_views(cloud.points, cloud.present)
    assert views.shape == (500, 8, 3, 3)
    assert_orthogonal(views)
    signs = np.einsum("bvij,bij->bvi", views, principal_axes(cloud.points, cloud.present))
    for found in signs[:20].round().astype(int):
        assert {tuple(row) for row in found} == {tuple(row) for row in SIGNS.astype(int)}
    truth = mean_hand.align(hands, np.ones(500))
    right = angles(views[:, 0], truth) < 60.0
    assert right.mean() > 0.8
    left = cloud.points * np.where(cloud.present[..., None], MIRROR_IMAGE, 1.0)
    mirrored = mean_hand.first_views(left, cloud.present)
    np.testing.assert_allclose(mirrored[:, 0] * MIRROR_IMAGE, views[:, 0], atol=1e-6)


def test_training_views_are_near_the_mean_hand_or_along_the_axes(hands, mean_hand):
    present = everything(hands)
    views = mean_hand.training_views(hands, present, hands, rng=np.random.default_rng(1))
    assert_orthogonal(views)
    np.testing.assert_allclose(np.linalg.det(views), 1.0)
    turned = angles(views, mean_hand.align(hands, np.ones(500)))
    cosines = np.abs(np.einsum("bij,bij->bi", views, principal_axes(hands, present)))
    along = (cosines > 1.0 - 1e-9).all(axis=1)
    assert 0.3 < along.mean() < 0.5
    assert 8.0 < np.sqrt((turned[~along] ** 2).mean()) < 16.0
