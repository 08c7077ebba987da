"""Depth images: what the camera shows, what must not matter to it, and the way back to meters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.space.transforms import quaternion_matrix, random_quaternions
from train.labelers.depth_image import SMALLEST_EXTENT, depth_images
from train.labelers.views import MIRROR_IMAGE, random_views, spread_views

STRAIGHT = np.eye(3)[None]
seeds = st.integers(0, 100_000)


def cloud(rng, batch=3, count=19):
    """Hand-sized clouds, each present at least in part, with rubbish for padding."""
    points = rng.uniform(-0.1, 0.1, size=(batch, count, 3)) + rng.normal(size=(batch, 1, 3))
    present = rng.random((batch, count)) < 0.9
    present[:, :2] = True
    points[~present] = rng.choice([np.nan, 0.0, 99.0])
    return points, present


def rotations(rng, batch=3):
    return quaternion_matrix(random_quaternions(batch, rng=rng))


def everything(points):
    return np.ones(points.shape[:2], dtype=bool)


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


def test_rows_are_y_columns_are_x_and_depth_is_z():
    points = np.array([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.1], [0.0, 0.05, 0.05], [0.0, -0.05, 0.05]]])
    image = depth_images(points, everything(points), STRAIGHT)[0][0]
    assert np.isclose(image[26, 46], 0.1)
    assert np.isclose(image[26, 5], 1.0)
    assert np.isclose(image[36, 26], 0.55)
    assert np.isclose(image[15, 26], 0.55)
    assert np.count_nonzero(image) == 4


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
