from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from render import ExposureConfig, ShutterConfig
from render.color_sensor import (
    Exposure,
    Shutter,
    combine,
    expose,
    linear_of,
    sample_exposure,
    sample_shutter,
    shutter_times,
)

HEIGHT, WIDTH = 60, 200


seconds = st.just(0.0) | st.floats(1e-6, 0.05)


def every_value() -> np.ndarray:
    """All 256 values in all three colors."""
    return np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)


def shot(light, exposure, seed=0):
    return expose(light, exposure, rng=np.random.default_rng(seed))


def test_the_plainest_exposure_changes_no_byte():
    rgb = every_value()
    assert (shot(linear_of(rgb), Exposure()) == rgb).all()


def test_the_curve_is_srgbs():
    light = linear_of(every_value())[..., 0].ravel()
    assert light[0] == 0.0 and light[255] == 1.0
    assert light[10] == pytest.approx(10 / 255 / 12.92)  # the straight part
    assert light[188] == pytest.approx(0.5, abs=0.003)  # the well-known middle
    assert np.all(np.diff(light) > 0)


def test_a_stop_doubles_the_light_and_balance_tints_it():
    light = np.full((8, 8, 3), 0.2, np.float32)
    assert (shot(light, Exposure(stops=1.0)) == shot(2 * light, Exposure())).all()
    assert (shot(light, Exposure(stops=3.0)) == 255).all()
    tinted = linear_of(shot(light, Exposure(balance=(1.2, 1.0, 0.8))))[0, 0]
    np.testing.assert_allclose(tinted / 0.2, [1.2, 1.0, 0.8], rtol=0.02)


@pytest.mark.parametrize("level", [0.1, 0.3, 0.6])
@pytest.mark.parametrize(("white", "read"), [(500.0, 3.0), (300.0, 6.0)])
def test_noise_is_shot_and_read_noise(level, white, read):
    light = np.full((240, 320, 3), level, np.float32)
    measured = linear_of(shot(light, Exposure(white_electrons=white, read_noise=read)))
    wanted = np.sqrt(level * white + read**2) / white  # [share of white]
    assert measured.mean() == pytest.approx(level, rel=0.01)
    assert measured.std() == pytest.approx(wanted, rel=0.04)
    flat = measured.reshape(-1, 3) - level
    assert np.abs(np.corrcoef(flat.T) - np.eye(3)).max() < 0.02  # colors know nothing of each other


def test_balance_amplifies_noise_too():
    light = np.full((240, 320, 3), 0.2, np.float32)
    measured = linear_of(shot(light, Exposure(balance=(2.0, 1.0, 1.0), white_electrons=2000.0)))
    deviations = measured.reshape(-1, 3).std(axis=0)
    assert deviations[0] == pytest.approx(2 * deviations[1], rel=0.05)


def test_corners_lose_light():
    light = np.full((240, 320, 3), 0.5, np.float32)
    measured = linear_of(shot(light, Exposure(vignetting=0.3)))[..., 1]
    assert measured[120, 160] == pytest.approx(0.5, rel=0.01)
    assert measured[0, 0] == pytest.approx(0.35, rel=0.02)
    assert measured[0, 0] == measured[0, -1] == measured[-1, 0] == measured[-1, -1]
    assert measured[120, 0] == pytest.approx(0.5 * (1 - 0.3 * 0.64), rel=0.02)  # 160^2 of 200^2


def test_jpeg_is_opencvs_and_keeps_the_colors_order():
    rgb = np.zeros((64, 64, 3), np.uint8)
    rgb[:, :32] = 200, 40, 90
    out = shot(linear_of(rgb), Exposure(jpeg_quality=60))
    assert out.shape == rgb.shape and (out != rgb).any()
    assert np.abs(out[8:56, 4:24].astype(int) - [200, 40, 90]).max() <= 6
    _, file = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 60])
    assert (out == cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1]).all()


def test_the_same_seed_gives_the_same_picture():
    light = linear_of(every_value())
    exposure = sample_exposure(ExposureConfig(jpeg_share=1.0), rng=np.random.default_rng(5))
    assert (shot(light, exposure, 1) == shot(light, exposure, 1)).all()
    assert (shot(light, exposure, 1) != shot(light, exposure, 2)).any()


def test_exposures_are_plain_and_within_limits():
    config = ExposureConfig()
    drawn = [sample_exposure(config, rng=np.random.default_rng(seed)) for seed in range(200)]
    assert drawn[7] == sample_exposure(config, rng=np.random.default_rng(7))
    assert Exposure(**dataclasses.asdict(drawn[0])) == drawn[0]
    json.dumps([dataclasses.asdict(one) for one in drawn])
    for name in ("stops", "white_electrons", "read_noise", "vignetting"):
        low, high = getattr(config, name)
        values = [getattr(one, name) for one in drawn]
        assert low <= min(values) < low + 0.2 * (high - low)
        assert high >= max(values) > high - 0.2 * (high - low)
    compressed = [one.jpeg_quality for one in drawn if one.jpeg_quality is not None]
    assert 0.35 < len(compressed) / 200 < 0.65 and 70 <= min(compressed) <= max(compressed) <= 98


def test_odd_sizes_work():
    light = np.full((37, 23, 3), 0.3, np.float32)
    assert shot(light, Exposure(0.1, (1.1, 1.0, 0.9), 900.0, 3.0, 0.2, 80)).shape == (37, 23, 3)


def test_blur_spreads_light_and_loses_none() -> None:
    light = np.zeros((9, 9, 3), dtype=np.float32)
    light[4, 4] = 1.0
    seen = linear_of(shot(light, Exposure(blur=0.6)))
    assert 0.3 < seen[4, 4, 0] < 0.7 and seen[4, 5, 0] > 0.05
    assert seen[2].max() == 0.0
    assert np.abs(seen.sum(axis=(0, 1)) - 1.0).max() < 0.03


def bar(left: float, width: float = 20.0) -> np.ndarray:
    """Light of a bright upright bar on black, pixels at its edges covered in part."""
    edges = np.arange(WIDTH + 1, dtype=np.float64)
    covered = np.clip(np.minimum(edges[1:], left + width) - np.maximum(edges[:-1], left), 0.0, 1.0)
    return np.tile(covered[None, :, None], (HEIGHT, 1, 3)).astype(np.float32)


def middle(picture: np.ndarray) -> np.ndarray:
    """Center of light of each row [px]."""
    light = picture[..., 0].astype(np.float64)
    return light @ (np.arange(WIDTH) + 0.5) / light.sum(axis=1)


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
    assert (shot(combine([rgb] * 7, weights), Exposure()) == rgb).all()


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
    assert (shot(combine([black, white], weights), Exposure()) == 188).all()
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


def test_frames_may_come_one_by_one():
    times, weights = shutter_times(0.01, 0.01, 5, HEIGHT)
    frames = [bar(50.0 + 1000.0 * time) for time in times]
    assert (combine(iter(frames), weights) == combine(frames, weights)).all()
    bytes_ = [shot(frame, Exposure()) for frame in frames]
    np.testing.assert_allclose(
        combine(bytes_, weights), combine([linear_of(one) for one in bytes_], weights), atol=1e-6
    )


def test_shutters_are_plain_and_within_limits():
    config = ShutterConfig()
    drawn = [sample_shutter(config, rng=np.random.default_rng(seed)) for seed in range(100)]
    assert drawn[3] == sample_shutter(config, rng=np.random.default_rng(3))
    json.dumps([dataclasses.asdict(one) for one in drawn])
    assert all(0.001 <= one.exposure <= 0.016 and one.sub_frames == 8 for one in drawn)
    assert 0.3 < np.mean([one.readout > 0 for one in drawn]) < 0.7
    assert Shutter() == Shutter(0.0, 0.0, 1)
