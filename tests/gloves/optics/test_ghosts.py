"""Mirror images, strays and ghosts."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gloves import GhostConfig
from gloves.optics.ghosts import (
    MAX_GHOSTS,
    StrayConfig,
    cameras_by_mirror,
    reflect,
    sample_ghosts,
    sample_strays,
)
from handsim import load_rig

RIG = load_rig("figure5")
NOTHING = (np.zeros((200, 0, 2, 3)), np.zeros(0))
PATCH, UP = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
MIRRORS_NOTHING = np.zeros((1, 0, 2, 3)), np.zeros(0)


def hand_sized_cloud(rng):
    return np.array([0.0, 0.0, 1.1]) + rng.uniform(-0.06, 0.06, size=(200, 19, 3))


@given(st.integers(0, 1000))
def test_reflection_is_its_own_inverse_and_keeps_distances(seed):
    rng = np.random.default_rng(seed)
    points, plane, normal = rng.normal(size=(5, 3)), rng.normal(size=3), rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    planes, normals = np.broadcast_to(plane, (5, 3)), np.broadcast_to(normal, (5, 3))
    images = reflect(points, planes, normals)
    np.testing.assert_allclose(reflect(images, planes, normals), points, atol=1e-12)
    np.testing.assert_allclose((points - plane) @ normal, -(images - plane) @ normal, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(points[0] - points[1]), np.linalg.norm(images[0] - images[1]), atol=1e-12
    )


def ghosts_of(config, rng, min_cameras=2, markers=None):
    markers = hand_sized_cloud(rng) if markers is None else markers
    return sample_ghosts(markers, RIG, *NOTHING, config, min_cameras=min_cameras, rng=rng)


def test_without_sources_there_are_no_ghosts(rng):
    ghosts = ghosts_of(GhostConfig(mirror_rate=0.0, stray_rate=0.0), rng)
    assert ghosts.shape == (200, MAX_GHOSTS, 3)
    assert np.isnan(ghosts).all()


def test_mirror_ghosts_lie_behind_the_surface_and_need_cameras(rng):
    config, markers = GhostConfig(mirror_rate=1.0, stray_rate=0.0, reflectance=1.0), hand_sized_cloud(rng)
    ghosts = ghosts_of(config, rng, markers=markers)
    there = np.isfinite(ghosts[..., 0])
    assert there.any()
    low, high = markers.min(axis=(0, 1)) - 0.6, markers.max(axis=(0, 1)) + 0.6
    assert ((ghosts[there] > low) & (ghosts[there] < high)).all()
    strict = ghosts_of(config, np.random.default_rng(0), 12, markers)
    assert np.isfinite(strict[..., 0]).sum() < there.sum()


def test_strays_follow_their_rate(rng):
    ghosts = ghosts_of(GhostConfig(mirror_rate=0.0, stray_rate=0.5), rng)
    assert 0.35 < np.isfinite(ghosts[..., 0]).sum(axis=1).mean() < 0.65


def _seen(marker: np.ndarray, radius: float, segments: np.ndarray, radii: np.ndarray) -> np.ndarray:
    images = reflect(marker[None, None], PATCH, UP)
    return cameras_by_mirror(images, PATCH[None], UP[None], radius, RIG, segments, radii)[0, 0]


def test_light_leaves_a_mirror_as_it_comes() -> None:
    marker = np.array([0.01, 0.02, 1.1])
    seen = _seen(marker, 0.5, *MIRRORS_NOTHING)
    assert (seen == (RIG.positions[:, 2] > 1.0)).all()  # a level mirror shows nothing to cameras below it
    image = reflect(marker, PATCH, UP)
    np.testing.assert_allclose(image, [0.01, 0.02, 0.9])
    for camera in RIG.positions[seen]:
        hit = image + (1.0 - image[2]) / (camera[2] - image[2]) * (camera - image)
        inwards, outwards = (way / np.linalg.norm(way) for way in (hit - marker, camera - hit))
        np.testing.assert_allclose(inwards * [1, 1, -1], outwards, atol=1e-12)


def test_a_small_patch_shows_less_and_its_back_nothing() -> None:
    marker = np.array([0.0, 0.0, 1.1])
    sizes = [_seen(marker, radius, *MIRRORS_NOTHING).sum() for radius in (0.001, 0.12, 0.5)]
    assert sizes[0] == 0 < sizes[1] <= sizes[2]
    assert not _seen(np.array([0.0, 0.0, 0.9]), 0.5, *MIRRORS_NOTHING).any()


def test_both_legs_must_be_free() -> None:
    marker = np.array([0.0, 0.0, 1.1])
    free = _seen(marker, 0.5, *MIRRORS_NOTHING)
    camera = int(np.flatnonzero(free)[0])
    image = reflect(marker, PATCH, UP)
    hit = image + (1.0 - image[2]) / (RIG.positions[camera, 2] - image[2]) * (RIG.positions[camera] - image)
    for middle in (0.5 * (marker + hit), 0.5 * (hit + RIG.positions[camera])):
        ball = np.stack([middle, middle])[None, None]
        assert not _seen(marker, 0.5, ball, np.array([0.005]))[camera]


def test_strays_ride_along_and_flash_for_their_time(rng: np.random.Generator) -> None:
    pose = np.tile(np.eye(4), (60_000, 1, 1))
    pose[:, 0, 3] = np.arange(60_000) * 1e-4
    config = StrayConfig(number=12.0, shown=0.2, hidden=0.6)
    places, seen = sample_strays(pose, np.array([0.1, 0.0, 0.0]), config, rate=120.0, num_cameras=16, rng=rng)
    np.testing.assert_allclose(places - pose[:, None, :3, 3], np.tile(places[:1], (60_000, 1, 1)), atol=1e-9)
    assert (np.linalg.norm(places[0] - [0.1, 0.0, 0.0], axis=1) <= config.reach).all()
    shining = seen.any(axis=2)
    assert abs(shining.mean() - 0.25) < 0.03
    starts = (shining[1:] & ~shining[:-1]).sum()
    assert abs(shining.sum() / starts / 120.0 - 0.2) < 0.03
    none, _ = sample_strays(pose, np.zeros(3), StrayConfig(number=0.0), rate=120.0, num_cameras=16, rng=rng)
    assert none.shape == (60_000, 0, 3)
