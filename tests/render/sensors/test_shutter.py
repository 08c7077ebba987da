from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import ArgumentError
from render.sensors.exposure import encoded, linear_of
from render.sensors.shutter import Shutter, ShutterConfig, combine, sample_shutter, shutter_times

HEIGHT, WIDTH = 60, 200


def bar(left: float, width: float = 20.0) -> np.ndarray:
    """Light of a bright upright bar on black, pixels at its edges covered in part."""
    edges = np.arange(WIDTH + 1, dtype=np.float64)
    covered = np.clip(np.minimum(edges[1:], left + width) - np.maximum(edges[:-1], left), 0.0, 1.0)
    return np.tile(covered[None, :, None], (HEIGHT, 1, 3)).astype(np.float32)


def middle(picture: np.ndarray) -> np.ndarray:
    """Center of light of each row [px]."""
    light = picture[..., 0].astype(np.float64)
    return light @ (np.arange(WIDTH) + 0.5) / light.sum(axis=1)


seconds = st.just(0.0) | st.floats(1e-6, 0.05)


@settings(max_examples=80, deadline=None)
@given(seconds, seconds, st.integers(1, 17), st.integers(1, 90))
def test_weights_add_up_and_middles_are_where_they_should_be(exposure, readout, sub_frames, height):
    times, weights = shutter_times(exposure, readout, sub_frames, height)
    assert times.shape == (sub_frames,) and weights.shape == (height, sub_frames)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(times, -times[::-1], atol=1e-15)  # 0 is the middle
    if exposure > 0.0:
        np.testing.assert_allclose(weights, weights[::-1, ::-1], atol=1e-6)
    # A row's mean time is its own, to within half a piece.
    own = readout * (np.linspace(-0.5, 0.5, height) if height > 1 else np.zeros(1))
    assert np.abs(weights @ times - own).max() <= 0.5 * (exposure + readout) / sub_frames + 1e-12


def test_what_does_not_move_does_not_change():
    rgb = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    _, weights = shutter_times(0.008, 0.013, 7, HEIGHT)
    assert (encoded(combine([rgb] * 7, weights)) == rgb).all()


def test_blur_keeps_the_light():
    times, weights = shutter_times(0.01, 0.0, 16, HEIGHT)
    frames = [bar(90.0 + 3000.0 * time) for time in times]  # 30 px in the exposure
    blurred = combine(frames, weights)
    np.testing.assert_allclose(blurred.sum(axis=1), frames[0].sum(axis=1), rtol=1e-5)
    np.testing.assert_allclose(middle(blurred), 100.0, atol=1e-3)
    assert blurred.max() == pytest.approx(20.0 / 30.0, abs=0.04)  # a bar of 20 px smeared over 50
    lit = np.flatnonzero(blurred[0, :, 0] > 1e-6)
    assert lit[0] == pytest.approx(75.9, abs=1.0) and lit[-1] == pytest.approx(124.1, abs=1.0)


def test_light_is_averaged_not_srgb_values():
    _, weights = shutter_times(0.01, 0.0, 2, 4)
    black, white = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 255, np.uint8)
    assert (encoded(combine([black, white], weights)) == 188).all()
    np.testing.assert_allclose(combine([black, white], weights), 0.5)


@pytest.mark.parametrize("exposure", [0.0, 0.004])
def test_a_rolling_shutter_slants_a_moving_bar(exposure):
    speed, readout = 2000.0, 0.02  # 40 px while rows are read out
    times, weights = shutter_times(exposure, readout, 48, HEIGHT)
    picture = combine([bar(90.0 + speed * time) for time in times], weights)
    opened = readout * np.linspace(-0.5, 0.5, HEIGHT)
    piece = speed * (exposure + readout) / 48
    assert np.abs(middle(picture) - (100.0 + speed * opened)).max() <= 0.51 * piece
    assert picture[0].sum() == pytest.approx(20.0 * 3, rel=1e-4)


def test_a_global_shutter_without_exposure_is_one_moment():
    times, weights = shutter_times(0.0, 0.0, 1, 5)
    assert times.tolist() == [0.0] and (weights == 1.0).all()


def test_frames_may_come_one_by_one():
    times, weights = shutter_times(0.01, 0.01, 5, HEIGHT)
    frames = [bar(50.0 + 1000.0 * time) for time in times]
    assert (combine(iter(frames), weights) == combine(frames, weights)).all()
    bytes_ = [encoded(frame) for frame in frames]
    np.testing.assert_allclose(
        combine(bytes_, weights), combine([linear_of(one) for one in bytes_], weights), atol=1e-6
    )


def test_samples_are_plain_and_within_limits():
    config = ShutterConfig()
    drawn = [sample_shutter(config, rng=np.random.default_rng(seed)) for seed in range(100)]
    assert drawn[3] == sample_shutter(config, rng=np.random.default_rng(3))
    json.dumps([dataclasses.asdict(one) for one in drawn])
    assert all(0.001 <= one.exposure <= 0.016 and one.sub_frames == 8 for one in drawn)
    assert 0.3 < np.mean([one.readout > 0 for one in drawn]) < 0.7
    assert Shutter() == Shutter(0.0, 0.0, 1)


def test_mistakes_are_told():
    with pytest.raises(ArgumentError, match="counts of at least 1"):
        shutter_times(0.01, 0.0, 0, 10)
    with pytest.raises(ArgumentError, match="times of at least 0"):
        shutter_times(-0.01, 0.0, 3, 10)
    _, weights = shutter_times(0.01, 0.0, 3, HEIGHT)
    for frames in ([bar(1.0)] * 2, [bar(1.0)] * 4, [bar(1.0)[:10]] * 3, []):
        with pytest.raises(ArgumentError, match="expected 3 of 60 rows"):
            combine(frames, weights)
