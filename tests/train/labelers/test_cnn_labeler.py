"""The paper's network as a labeler: its views, its depth images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.space.transforms import quaternion_matrix, random_quaternions
from train import Corruption, corrupt
from train.labelers.cnn_labeler import (
    MIRROR_IMAGE,
    SIGNS,
    SMALLEST_EXTENT,
    MeanHand,
    depth_images,
    principal_axes,
    random_views,
    spread_views,
)

NUM_MARKERS = 12
STRAIGHT = np.eye(3)[None]


seeds = st.integers(0, 100_000)


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


def cloud(rng, batch=3, count=19):
    """Hand-sized clouds, each present at least in part, with rubbish for padding."""
    points = rng.uniform(-0.1, 0.1, size=(batch, count, 3)) + rng.normal(size=(batch, 1, 3))
    present = rng.random((batch, count)) < 0.9
    present[:, :2] = True
    points[~present] = rng.choice([np.nan, 0.0, 99.0])
    return points, present


def rotations(rng, batch=3):
    return quaternion_matrix(random_quaternions(batch, rng=rng))


@given(seed=seeds)
@settings(max_examples=40, deadline=None)
def test_points_keep_the_margin_and_fill_what_is_left(seed):
    rng = np.random.default_rng(seed)
    points, present = cloud(rng)
    views = rotations(rng)
    images, frames = depth_images(points, present, views)
    assert images.shape == (3, 52, 52)
    assert images.dtype == np.float32
    for image in images:
        rows, columns = np.nonzero(image)
        used = np.concatenate([rows, columns])
        assert used.min() >= 5  # 10 % of 52, rounded down
        assert used.max() <= 46
        assert used.min() == 5 or used.max() == 46
        assert np.isclose(image[image > 0].min(), 0.1)
    assert (images.max(axis=(1, 2)) <= 1.0).all()
    view = frames.normalize(np.where(present[..., None], points, np.nan))
    np.testing.assert_allclose(np.nanmax(np.abs(view[..., :2]), axis=(1, 2)), 0.8)
    np.testing.assert_allclose(np.nanmean(view, axis=1), 0.0, atol=1e-9)


@given(seed=seeds)
@settings(max_examples=40, deadline=None)
def test_moving_scaling_and_reordering_change_nothing(seed):
    rng = np.random.default_rng(seed)
    points, present = cloud(rng)
    views = rotations(rng)
    images, frames = depth_images(points, present, views)
    order = rng.permutation(points.shape[1])
    moved = 1.7 * points[:, order] + np.array([0.5, -2.0, 1.0])
    again, moved_frames = depth_images(moved, present[:, order], views)
    near_an_edge = np.abs((frames.normalize(points)[..., :2] + 1) * 26 % 1 - 0.5) > 0.5 - 1e-6
    if not near_an_edge[present].any():  # rounding may carry a point over there
        np.testing.assert_allclose(again, images, atol=1e-6)
    np.testing.assert_allclose(
        moved_frames.normalize(moved)[present[:, order]],
        frames.normalize(points)[:, order][present[:, order]],
    )
    np.testing.assert_allclose(moved_frames.scales * 1.7, frames.scales)


@given(seed=seeds)
@settings(max_examples=40, deadline=None)
def test_turning_cloud_and_camera_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    points, present = cloud(rng)
    views, turn = rotations(rng), rotations(rng)
    _, frames = depth_images(points, present, views)
    turned = points @ turn.swapaxes(1, 2)
    _, turned_frames = depth_images(turned, present, views @ turn.swapaxes(1, 2))
    np.testing.assert_allclose(
        turned_frames.normalize(turned)[present], frames.normalize(points)[present], atol=1e-9
    )


@given(seed=seeds)
@settings(max_examples=40, deadline=None)
def test_positions_come_back_from_the_view(seed):
    rng = np.random.default_rng(seed)
    points, present = cloud(rng)
    _, frames = depth_images(points, present, rotations(rng))
    others = rng.normal(size=(3, 7, 3))
    np.testing.assert_allclose(frames.restore(frames.normalize(others)), others, atol=1e-12)
    view = frames.normalize(others)  # isotropic: distances are to scale in all three directions
    gaps = np.linalg.norm(view[:, 1:] - view[:, :-1], axis=-1)
    truth = np.linalg.norm(others[:, 1:] - others[:, :-1], axis=-1)
    np.testing.assert_allclose(gaps, truth * frames.scales[:, None])


@given(seed=seeds)
@settings(max_examples=40, deadline=None)
def test_every_bright_pixel_is_a_point(seed):
    """Pixel and brightness, led back through the camera, end within half a pixel of a point."""
    rng = np.random.default_rng(seed)
    points, present = cloud(rng)
    images, frames = depth_images(points, present, rotations(rng))
    for index, image in enumerate(images):
        rows, columns = np.nonzero(image)
        depth = frames.nearest[index] + (image[rows, columns] - 0.1) / 0.9 * frames.depth_ranges[index]
        flat = np.stack([columns + 0.5, rows + 0.5], axis=1) / 26 - 1
        view = np.concatenate([flat, depth[:, None] * frames.scales[index]], axis=1)
        found = view[:, None] - frames.normalize(points)[index, present[index]]
        half = 0.5 / 26 + 1e-6
        assert (np.abs(found) <= [half, half, 1e-4]).all(axis=-1).any(axis=1).all()
        assert len(rows) <= present[index].sum()


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [1, 0, 3, 2]])
def test_nearer_point_keeps_the_pixel(order):
    points = np.array([[[0.1, 0.0, -0.02], [0.1, 0.0, 0.03], [-0.1, 0.0, 0.08], [-0.1, 0.0, 0.05]]])[:, order]
    image = depth_images(points, everything(points), STRAIGHT)[0][0]
    assert np.count_nonzero(image) == 2
    assert np.isclose(image[26, 46], 0.1)
    assert np.isclose(image[26, 5], 0.1 + 0.9 * 0.7)


@pytest.mark.parametrize("shape", ["nothing", "one", "equal", "line", "plane"])
def test_degenerate_clouds(shape, rng):
    points = rng.uniform(-0.1, 0.1, size=(1, 6, 3)) + 1.0
    present = everything(points)
    if shape == "nothing":
        present[:] = False
    elif shape == "one":
        present[:, 1:] = False
    elif shape == "equal":
        points[:] = points[:, :1]
    elif shape == "line":
        points[..., 1:] = 0.0
    else:
        points[..., 2] = 0.0
    for views in (STRAIGHT, random_views(1, rng=rng), spread_views(points, present, rng=rng)):
        images, frames = depth_images(points, present, views)
        assert np.isfinite(images).all()
        assert images.any() == (shape != "nothing")
        np.testing.assert_allclose(frames.restore(frames.normalize(points)), points, atol=1e-12)
        if shape in ("one", "equal"):
            assert np.count_nonzero(images) == 1
            assert np.isclose(images.max(), 0.55)
            assert np.isclose(frames.scales[0], 0.8 / SMALLEST_EXTENT)


def test_no_clouds_at_all(rng):
    points, present = np.zeros((0, 5, 3)), np.zeros((0, 5), dtype=bool)
    assert depth_images(points, present, spread_views(points, present, rng=rng))[0].shape == (0, 52, 52)


def test_a_mirrored_view_shows_the_mirrored_cloud(rng):
    points, present = cloud(rng, batch=4)
    views = random_views(4, rng=rng)
    mirrored = depth_images(points, present, MIRROR_IMAGE[:, None] * views)[0]
    mirrored_cloud = (points @ views.swapaxes(1, 2)) * MIRROR_IMAGE
    straight = np.broadcast_to(np.eye(3), (4, 3, 3))
    np.testing.assert_allclose(mirrored, depth_images(mirrored_cloud, present, straight)[0], atol=1e-5)
