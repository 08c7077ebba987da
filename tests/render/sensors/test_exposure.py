from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest

from handsim.errors import ArgumentError
from render.sensors.exposure import Exposure, ExposureConfig, encoded, expose, linear_of, sample_exposure


def every_value() -> np.ndarray:
    """All 256 values in all three colors."""
    return np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)


def shot(light, exposure, seed=0):
    return expose(light, exposure, rng=np.random.default_rng(seed))


def test_the_plainest_exposure_changes_no_byte():
    rgb = every_value()
    assert (encoded(linear_of(rgb)) == rgb).all()
    assert (shot(linear_of(rgb), Exposure()) == rgb).all()


def test_the_curve_is_srgbs():
    light = linear_of(every_value())[..., 0].ravel()
    assert light[0] == 0.0 and light[255] == 1.0
    assert light[10] == pytest.approx(10 / 255 / 12.92)  # the straight part
    assert light[188] == pytest.approx(0.5, abs=0.003)  # the well-known middle
    assert np.all(np.diff(light) > 0)


def test_a_stop_doubles_the_light_and_balance_tints_it():
    light = np.full((8, 8, 3), 0.2, np.float32)
    assert (shot(light, Exposure(stops=1.0)) == encoded(2 * light)).all()
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


def test_samples_are_plain_and_within_limits():
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
    with pytest.raises(ArgumentError, match="expected \\(H, W, 3\\)"):
        shot(light[..., 0], Exposure())


def test_blur_spreads_light_and_loses_none() -> None:
    light = np.zeros((9, 9, 3), dtype=np.float32)
    light[4, 4] = 1.0
    seen = linear_of(shot(light, Exposure(blur=0.6)))
    assert 0.3 < seen[4, 4, 0] < 0.7 and seen[4, 5, 0] > 0.05
    assert seen[2].max() == 0.0
    assert np.abs(seen.sum(axis=(0, 1)) - 1.0).max() < 0.03
