"""Ghosts: mirror images are where mirrors put them, and never too many."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gloves.optics.ghosts import MAX_GHOSTS, GhostConfig, reflect, sample_ghosts
from handsim.space.rig import named_rig

NOTHING = (np.zeros((200, 0, 2, 3)), np.zeros(0))


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


def test_without_sources_there_are_no_ghosts(rng):
    config = GhostConfig(mirror_rate=0.0, stray_rate=0.0)
    ghosts = sample_ghosts(
        hand_sized_cloud(rng), named_rig("figure5"), *NOTHING, config, min_cameras=2, rng=rng
    )
    assert ghosts.shape == (200, MAX_GHOSTS, 3)
    assert np.isnan(ghosts).all()


def test_mirror_ghosts_lie_behind_the_surface_and_need_cameras(rng):
    config = GhostConfig(mirror_rate=1.0, stray_rate=0.0, reflectance=1.0)
    markers, rig = hand_sized_cloud(rng), named_rig("figure5")
    ghosts = sample_ghosts(markers, rig, *NOTHING, config, min_cameras=2, rng=rng)
    there = np.isfinite(ghosts[..., 0])
    assert there.any()
    low, high = markers.min(axis=(0, 1)) - 0.6, markers.max(axis=(0, 1)) + 0.6
    assert ((ghosts[there] > low) & (ghosts[there] < high)).all()
    strict = sample_ghosts(markers, rig, *NOTHING, config, min_cameras=12, rng=np.random.default_rng(0))
    assert np.isfinite(strict[..., 0]).sum() < there.sum()


def test_strays_follow_their_rate(rng):
    config = dataclasses.replace(GhostConfig(), mirror_rate=0.0, stray_rate=0.5)
    ghosts = sample_ghosts(
        hand_sized_cloud(rng), named_rig("figure5"), *NOTHING, config, min_cameras=2, rng=rng
    )
    assert 0.35 < np.isfinite(ghosts[..., 0]).sum(axis=1).mean() < 0.65
