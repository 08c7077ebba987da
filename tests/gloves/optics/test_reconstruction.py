"""The optical system: noise, merging, gates, false points, IDs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gloves import OpticsConfig
from gloves.optics.reconstruction import number_runs, pack_columns, reconstruct
from handsim import CameraRig, load_rig, look_at
from handsim.errors import ArgumentError
from tests.rigs import square_rig

STILL = OpticsConfig(noise=0.0, blob_loss=0.0, dropout=0.0)
RIG = load_rig("figure5")
MIDDLE = np.array([0.0, 0.0, 1.1])
PRESENT = arrays(np.bool_, st.tuples(st.integers(1, 25), st.integers(1, 8)))


def _all_seen(sources: np.ndarray, rig: CameraRig = RIG) -> np.ndarray:
    return np.ones((*sources.shape[:2], len(rig.positions)), dtype=bool)


def _grid(frames: int, count: int, step: float) -> np.ndarray:
    return MIDDLE + step * np.tile(np.arange(count)[:, None] * [1.0, 0.7, 0.4], (frames, 1, 1))


def test_without_noise_points_are_where_the_markers_are(rng: np.random.Generator) -> None:
    sources = MIDDLE + rng.uniform(-0.2, 0.2, (50, 12, 3))
    apart = np.linalg.norm(sources[:, :, None] - sources[:, None], axis=-1) + np.eye(12)
    sources = sources[apart.min(axis=(1, 2)) > 0.03]
    found = reconstruct(sources, _all_seen(sources), RIG, STILL, continuous=False, rng=rng)
    there = np.isfinite(found.positions[..., 0])
    assert there.mean() > 0.99  # in chance alignments, a few blobs touch in too many cameras
    np.testing.assert_allclose(found.positions[there], sources[there], atol=1e-3)
    assert np.median(np.linalg.norm(found.positions - sources, axis=-1)[there]) < 1e-9


def test_noise_is_that_of_least_squares(rng: np.random.Generator) -> None:
    """The covariance of a point follows from its cameras: linearized, as a textbook has it."""
    config = OpticsConfig(noise=0.3, blob_loss=0.0, dropout=0.0)
    sources = np.tile(MIDDLE + [0.03, 0.02, 0.05], (4000, 1, 1))
    found = reconstruct(sources, _all_seen(sources), RIG, config, continuous=False, rng=rng)
    off = found.positions[:, 0] - sources[:, 0]
    weights, spread = np.zeros((3, 3)), np.zeros((3, 3))
    for pose in RIG.T_world_camera:
        ray, axis = sources[0, 0] - pose[:3, 3], pose[:3, 2]
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        sigma = (
            config.noise * (axis @ ray) / RIG.cameras[0].focal_length
        )  # in the picture's plane, at the marker
        weights += across
        spread += sigma**2 * across @ (np.eye(3) - np.outer(axis, axis)) @ across
    covariance = np.linalg.inv(weights) @ spread @ np.linalg.inv(weights)
    assert np.abs(off.mean(axis=0)).max() < 4 * np.sqrt(covariance.trace() / len(off))
    np.testing.assert_allclose(np.cov(off.T).trace(), covariance.trace(), rtol=0.1)


def test_too_few_rays_make_no_point(rng: np.random.Generator) -> None:
    sources = _grid(6, 1, 0.0)
    seen = _all_seen(sources)
    seen[..., 2:] = False
    seen[5, :, 1] = False
    started = reconstruct(sources, seen, RIG, STILL, continuous=True, rng=rng)
    alone = reconstruct(sources, seen, RIG, STILL, continuous=False, rng=rng)
    assert (started.rays == 0).all()  # two rays cannot start a point
    assert (alone.rays[:5] == 2).all() and alone.rays[5, 0] == 0
    seen[0, :, :4] = True
    going_on = reconstruct(sources, seen, RIG, STILL, continuous=True, rng=rng)
    assert going_on.rays[:, 0].tolist() == [4, 2, 2, 2, 2, 0]  # but two rays keep one up


def test_two_rays_along_one_line_make_no_point(rng: np.random.Generator) -> None:
    poses = np.stack([look_at(MIDDLE + np.array(at), MIDDLE) for at in ((1.5, 0, 0), (1.5, 0.1, 0))])
    rig = square_rig("narrow", poses, 1.0)
    sources = _grid(1, 1, 0.0)
    found = reconstruct(sources, _all_seen(sources, rig), rig, STILL, continuous=False, rng=rng)
    assert found.rays[0, 0] == 0
    wide = OpticsConfig(noise=0.0, blob_loss=0.0, dropout=0.0, min_angle=1.0)
    assert reconstruct(sources, _all_seen(sources, rig), rig, wide, continuous=False, rng=rng).rays[0, 0] == 2


def test_markers_that_nearly_touch_are_one_point(rng: np.random.Generator) -> None:
    near, far = _grid(200, 2, 0.0015), _grid(200, 2, 0.02)
    found = reconstruct(near, _all_seen(near), RIG, STILL, continuous=False, rng=rng)
    assert (np.isfinite(found.positions[..., 0]).sum(axis=1) == 1).all()
    point = np.nanmean(found.positions, axis=1)
    np.testing.assert_allclose(point, near.mean(axis=1), atol=1e-3)  # between the two
    found = reconstruct(far, _all_seen(far), RIG, STILL, continuous=False, rng=rng)
    assert (np.isfinite(found.positions[..., 0]).sum(axis=1) == 2).all()


def test_large_markers_merge_where_small_ones_do_not(rng: np.random.Generator) -> None:
    sources = _grid(200, 2, 0.0055)  # 7 mm apart
    count = {}
    for radius in (0.0016, 0.0032, 0.008):
        found = reconstruct(sources, _all_seen(sources), RIG, STILL, radii=radius, continuous=False, rng=rng)
        count[radius] = np.isfinite(found.positions[..., 0]).sum(axis=1).mean()
    assert count[0.0016] == 2.0 and count[0.008] == 1.0
    mixed = reconstruct(
        np.concatenate([sources, sources + 0.2], axis=1), _all_seen(np.tile(sources, (1, 2, 1))), RIG, STILL,
        radii=np.array([0.008, 0.008, 0.0016, 0.0016]), continuous=False, rng=rng,
    )  # fmt: skip
    assert np.isfinite(mixed.positions[..., 0]).sum(axis=1).tolist() == [3] * 200


def test_the_noise_falls_with_the_root_of_the_radius() -> None:
    config = OpticsConfig(noise=0.3, blob_loss=0.0, dropout=0.0)
    sources = np.tile(MIDDLE, (500, 1, 1))
    off = []
    for radius in (0.0032, 4 * 0.0032):
        rng = np.random.default_rng(1)
        found = reconstruct(sources, _all_seen(sources), RIG, config, radii=radius, continuous=False, rng=rng)
        off.append(found.positions - sources)
    np.testing.assert_allclose(off[1], 0.5 * off[0], atol=1e-7)


def test_rays_without_a_point_meet_by_chance(rng: np.random.Generator) -> None:
    """Two cameras see one marker each, on rays that cross where no marker is."""
    crossing = MIDDLE + np.array([0.05, 0.0, 0.0])
    ways = crossing - RIG.positions[[10, 13]]
    sources = (crossing + 0.04 * ways / np.linalg.norm(ways, axis=1, keepdims=True))[None]
    seen = np.zeros((1, 2, 16), dtype=bool)
    seen[0, 0, 10] = seen[0, 1, 13] = True
    found = reconstruct(sources, seen, RIG, STILL, continuous=False, rng=rng)
    assert np.isnan(found.positions).all()
    there = found.false_points[np.isfinite(found.false_points[..., 0])]
    np.testing.assert_allclose(there, crossing[None], atol=1e-9)
    strict = OpticsConfig(noise=0.0, blob_loss=0.0, dropout=0.0, min_rays=3)
    assert np.isnan(reconstruct(sources, seen, RIG, strict, continuous=False, rng=rng).false_points).all()


def test_the_same_seed_gives_the_same_points() -> None:
    sources = _grid(30, 8, 0.02)
    every, usual = _all_seen(sources), OpticsConfig()
    rngs = [np.random.default_rng(3) for _ in range(2)]
    first, second = (reconstruct(sources, every, RIG, usual, continuous=True, rng=rng) for rng in rngs)
    np.testing.assert_array_equal(first.positions, second.positions)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("noise", -1.0, "noise is -1, expected a number of at least 0"),
        ("blob_loss", 2.0, "blob_loss is 2, expected a number from 0 to 1"),
        ("min_rays", 4, "expected 2 <= min_rays <= min_rays_to_start"),
        ("marker_radius", 0.0, "marker_radius is 0, expected a number above 0"),
        ("dropout_length", 0.0, "dropout_length is 0, expected a number of at least 1"),
        ("dropout_cameras", -1, "dropout_cameras is -1, expected 0 or more"),
        ("min_angle", np.nan, "min_angle is nan, expected a number from 0 to 90"),
    ],
)
def test_nonsense_is_refused(field: str, value: float, sentence: str) -> None:
    with pytest.raises(ArgumentError, match=sentence):
        OpticsConfig(**{field: value})


@given(PRESENT)
def test_an_unbroken_run_has_one_id_of_its_own(present):
    ids = number_runs(present)
    np.testing.assert_array_equal(ids >= 0, present)
    expected, last = np.full(present.shape, -1), 0
    for frame in range(len(present)):
        for source in range(present.shape[1]):
            if present[frame, source]:
                goes_on = frame > 0 and present[frame - 1, source]
                expected[frame, source] = expected[frame - 1, source] if goes_on else last
                last += not goes_on
    np.testing.assert_array_equal(ids, expected)


@given(PRESENT, st.integers(0, 1000))
def test_a_column_holds_one_run_at_a_time_and_an_empty_frame_after_it(present, seed):
    ids = number_runs(present)
    columns, count = pack_columns(present, rng=np.random.default_rng(seed))
    np.testing.assert_array_equal(columns >= 0, present)
    held = np.full((len(present), count), -1)
    for frame, source in np.argwhere(present):
        assert held[frame, columns[frame, source]] == -1, "two points in one column"
        held[frame, columns[frame, source]] = ids[frame, source]
    assert count == 0 or (held >= 0).any(axis=0).all(), "no column stays empty"
    together = (held[1:] >= 0) & (held[:-1] >= 0)
    assert (held[1:] == held[:-1])[together].all()
    for number in range(ids.max() + 1):
        assert len(np.unique(columns[ids == number])) == 1
    # No more columns than there are sources, and another for each that comes: what is over waits one frame.
    assert count <= present.shape[1] + present.any(axis=0).sum()


def test_columns_are_drawn():
    present = np.ones((3, 12), dtype=bool)
    orders = [pack_columns(present, rng=np.random.default_rng(seed))[0][0] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(orders[0], orders[1])
    assert not np.array_equal(orders[0], orders[2])
    assert sorted(orders[0]) == list(range(12))
