from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from handsim import Camera
from handsim.errors import ArgumentError
from handsim.space.camera import pinhole
from render import DepthSensor
from render.depth_sensor import (
    DEPTH_NOISES,
    SENSORS,
    StructuredLight,
    TimeOfFlight,
    apply_depth_noise,
    keep_lit,
    reflectance_of,
    sample_depth_noise,
)
from render.fields import normal_numbers

CAMERA = pinhole("test", (320, 240), 300.0)
SHAPE = (240, 320)
NO_NOISE = TimeOfFlight(
    sigma=(0.0, 0.0, 0.0),
    angle_sigma=0.0,
    flying=0.0,
    dropped=0.0,
    weakest=0.0,
    steepest=1.6,
    step=0.0,
    nearest=0.0,
)


def facing(depth: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall across the camera's axis."""
    return np.full(SHAPE, depth, np.float32), np.tile(np.float32([0.0, 0.0, -1.0]), (*SHAPE, 1))


def slanted(distance: float, angle: float, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """A wall that the camera's axis meets at a distance, its normal at an angle to the axis."""
    normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    rays = camera.rays()
    with np.errstate(divide="ignore"):
        depth = -np.cos(angle) * distance * rays[..., 2] / (rays @ normal)
    depth[(rays @ normal) >= 0] = 0.0
    return depth.astype(np.float32), np.tile(normal.astype(np.float32), (*depth.shape, 1))


def step_edge(near: float, far: float) -> np.ndarray:
    """Something near in the right half, something far in the left."""
    depth = np.full(SHAPE, far, np.float32)
    depth[:, 160:] = near
    return depth


def noisy(depth, normals, noise, seed=0, *, camera=CAMERA, light=0.8):
    """Depth with noise; without normals all surfaces face the camera, in the light of white walls."""
    turned = -camera.rays().astype(np.float32) if normals is None else normals
    light = np.full(depth.shape, light, np.float32)
    rng = np.random.default_rng(seed)
    return apply_depth_noise(depth, turned, noise, camera=camera, reflectance=light, rng=rng)


def test_normal_numbers_are_normal():
    numbers = normal_numbers((401, 501), rng=np.random.default_rng(0)).ravel()
    assert numbers.dtype == np.float32
    assert abs(numbers.mean()) < 0.01 and abs(numbers.std() - 1.0) < 0.01
    assert abs((numbers**4).mean() - 3.0) < 0.1
    assert abs(np.corrcoef(numbers[:-1], numbers[1:])[0, 1]) < 0.01


@pytest.mark.parametrize(("name", "window"), list(zip(SENSORS, (9, 7, 3, 3), strict=True)))
def test_noise_comes_in_blobs_as_wide_as_what_pixels_share(name, window):
    """Correlation at 1, 3 and 10 pixels, and the stated deviation, before rounding and shifts."""
    noise = dataclasses.replace(DEPTH_NOISES[name], step=0.0)
    if isinstance(noise, StructuredLight):
        noise = dataclasses.replace(noise, shift=0.0)
    depth, _ = facing(1.0)
    fields = [noisy(depth, None, noise, seed) - depth for seed in range(8)]
    power = np.mean([(field**2).mean() for field in fields])
    for apart in (1, 3, 10):
        wanted = max(0.0, 1.0 - apart / window)
        across = np.mean([(field[:, apart:] * field[:, :-apart]).mean() for field in fields])
        down = np.mean([(field[apart:] * field[:-apart]).mean() for field in fields])
        assert (across / power, down / power) == (pytest.approx(wanted, abs=0.04),) * 2
    if isinstance(noise, StructuredLight):
        disparities = 300.0 * noise.baseline / (depth + np.stack(fields))
        assert disparities.std() == pytest.approx(noise.disparity_noise, rel=0.05)


@pytest.mark.parametrize("name", SENSORS)
def test_the_same_seed_gives_the_same_depth(name):
    depth, normals = slanted(1.0, 0.6)
    first, second, other = (noisy(depth, normals, DEPTH_NOISES[name], seed) for seed in (3, 3, 4))
    assert first.dtype == np.float32 and first.shape == SHAPE
    assert first.tobytes() == second.tobytes() != other.tobytes()
    assert np.isfinite(first).all() and (first >= 0.0).all()


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_not_there_stays_away(name):
    depth, normals = facing(0.9)
    depth[50:120, 60:200] = 0.0
    normals[50:120, 60:200] = 0.0
    assert (noisy(depth, normals, DEPTH_NOISES[name])[50:120, 60:200][8:-8, 8:-8] == 0.0).all()
    nothing = np.zeros(SHAPE, np.float32)
    assert (noisy(nothing, None, DEPTH_NOISES[name]) == 0.0).all()


def test_no_noise_changes_no_byte():
    depth = step_edge(0.7, 1.3) + np.random.default_rng(0).random(SHAPE, dtype=np.float32) * np.float32(0.01)
    _, normals = facing(1.0)
    quiet = StructuredLight(
        step=0.0, disparity_noise=0.0, shift=0.0, support=0.0, shadow=False, nearest=0.0, steepest=1.6
    )
    assert noisy(depth, normals, NO_NOISE).tobytes() == depth.tobytes()
    np.testing.assert_allclose(noisy(depth, normals, quiet), depth, rtol=1e-6)


def test_disparities_are_eighths_of_a_pixel():
    depth, normals = slanted(1.2, 0.7)
    noise = DEPTH_NOISES["kinect1"]
    out = noisy(depth, normals, noise)
    seen = out > 0
    assert seen.mean() > 0.8
    eighths = 8.0 * noise.baseline * 300.0 / out[seen].astype(np.float64)
    assert np.abs(eighths - np.rint(eighths)).max() < 1e-3
    assert len(np.unique(np.rint(eighths))) > 20


def test_disparity_noise_grows_with_the_squared_depth():
    noise = StructuredLight(step=0.0, shift=0.0, disparity_noise=0.05)
    for distance in (0.6, 1.0, 2.0):
        depth, normals = facing(distance)
        out = noisy(depth, normals, noise)
        wanted = 0.05 * distance**2 / (noise.baseline * 300.0)
        assert out[out > 0].std() == pytest.approx(wanted, rel=0.03)


def test_shifts_stay_on_one_side_or_the_other():
    noise = StructuredLight(step=0.0, disparity_noise=0.0, support=0.0, shadow=False)
    out = noisy(step_edge(0.5, 1.0), None, noise)
    assert np.all(np.isclose(out, 0.5, rtol=1e-6) | np.isclose(out, 1.0, rtol=1e-6))
    wrong = (out < 0.7) != (np.arange(320) >= 160)
    # 16 % of normal numbers of half a pixel are above half a pixel
    assert wrong[:, 159].mean() == pytest.approx(0.159, abs=0.06)
    assert not wrong[:, :156].any() and not wrong[:, 165:].any()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"shift": np.nan}, "shift is nan, expected a number from 0 to 10"),
        ({"shift": np.inf}, "shift is inf, expected a number from 0 to 10"),
        ({"shift": -0.5}, "shift is -0.5, expected a number from 0 to 10"),
        ({"shift": "wide"}, "shift is 'wide', expected a number"),
        ({"window": 0}, "window is 0, expected at least 1"),
    ],
)
def test_numbers_of_a_sensor_of_ones_own_are_checked(given, said):
    with pytest.raises(ArgumentError, match=said):
        StructuredLight(**given)


def hidden_by(disparity):
    lit = np.ones(disparity.shape, np.bool_)
    keep_lit(disparity, lit)
    return ~lit


def test_the_projectors_shadow_is_as_wide_as_disparities_differ():
    near, far, scale = 0.5, 1.0, 0.075 * 300.0
    hidden = hidden_by((scale / step_edge(near, far)).astype(np.float32))
    width = hidden.sum(axis=1)
    assert np.abs(width - scale * (1 / near - 1 / far)).max() <= 2  # 22.5 px, left of the near thing
    assert not hidden[:, 160:].any() and not hidden[:, :135].any()
    thin = np.full(SHAPE, far, np.float32)
    thin[:, 200:206] = near
    hidden = hidden_by((scale / thin).astype(np.float32))
    columns = np.flatnonzero(hidden.any(axis=0))  # six columns, the disparity's difference further left
    assert abs(columns.mean() - (202.5 - 22.5)) <= 1.5 and 5 <= len(columns) <= 9


def test_windows_fail_at_corners_thin_things_and_grazing_angles():
    noise = StructuredLight(shadow=False)
    depth = np.full(SHAPE, 1.0, np.float32)
    depth[:, 100:103] = 0.5  # a wire
    depth[60:180, 200:260] = 0.5  # a board
    out = noisy(depth, None, noise)
    missing = out == 0.0
    assert missing[:, 100:103].mean() > 0.9
    assert missing[70:170, 210:250].mean() == 0.0 == missing[:, 20:80].mean()
    assert 0.1 < missing[70:170, 197:203].mean() < 0.8  # along a straight edge
    shares = []
    for angle in np.deg2rad([0.0, 60.0, 75.0, 84.0]):
        depth, normals = slanted(1.0, angle)
        seen = depth > 0
        shares.append((noisy(depth, normals, noise)[seen] == 0.0).mean())
    assert shares[0] < 0.01 and shares[1] < 0.2 and shares[3] > 0.5
    assert sorted(shares) == shares


@pytest.mark.parametrize("distance", [0.7, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("name", ["kinect2", "azure_kinect"])
def test_time_of_flight_noise_is_as_stated(name, distance):
    noise = DEPTH_NOISES[name]
    assert isinstance(noise, TimeOfFlight)
    depth, _ = facing(distance)
    c0, c1, c2 = noise.sigma
    wanted = np.hypot(c0 + c1 * distance + c2 * distance**2, noise.step / np.sqrt(12.0))
    out = noisy(depth, None, noise)
    assert (out > 0).all()
    assert out.std() == pytest.approx(wanted, rel=0.05)
    assert out.mean() == pytest.approx(distance, abs=1e-4)
    millimeters = 1000.0 * out.astype(np.float64)
    assert np.abs(millimeters - np.rint(millimeters)).max() < 1e-3


def test_time_of_flight_noise_grows_with_the_angle():
    camera = pinhole("narrow", (200, 200), 4000.0)  # one angle and one depth in all of the picture
    noise = dataclasses.replace(NO_NOISE, sigma=(1e-3, 0.0, 0.0), angle_sigma=1e-4)
    for angle in np.deg2rad([0.0, 45.0, 70.0, 80.0]):
        depth, normals = slanted(1.0, angle, camera)
        out = noisy(depth, normals, noise, camera=camera)
        wanted = 1e-3 + 1e-4 * (angle / (np.pi / 2 - angle)) ** 2
        assert (out - depth).std() == pytest.approx(wanted, rel=0.15 if angle > 1.3 else 0.03)


def test_dark_surfaces_are_noisier_and_then_gone():
    depth, normals = facing(2.0)
    noise = dataclasses.replace(DEPTH_NOISES["azure_kinect"], step=0.0)

    def out(level):
        return noisy(depth, normals, noise, light=reflectance_of(np.full((1, 1, 3), level, np.uint8)))

    gray = (128 / 255) ** 2.2
    assert out(128).std() == pytest.approx(2e-3 * np.sqrt(0.8 / gray), rel=0.05)
    assert (out(128) > 0).all()
    assert (out(10) == 0.0).all()
    least = noise.weakest * 4.0  # of the reflectance at 2 m, before the cosine
    half = (out(round(255 * (1.1 * least) ** (1 / 2.2))) > 0).mean()
    assert 0.2 < half < 0.8


def test_steep_surfaces_are_gone():
    camera = pinhole("narrow", (100, 100), 4000.0)
    noise = DEPTH_NOISES["kinect2"]
    shares = []
    for angle in (1.3, 1.44, 1.5):
        depth, normals = slanted(1.0, angle, camera)
        noise = dataclasses.replace(noise, edge=10.0)
        out = noisy(depth, normals, noise, camera=camera)
        shares.append((out == 0.0).mean())
    assert shares[0] == 0.0 and 0.2 < shares[1] < 0.9 and shares[2] == 1.0


def test_flying_pixels_lie_between_and_only_at_edges():
    noise = dataclasses.replace(NO_NOISE, flying=0.5, dropped=0.2)
    depth = step_edge(0.8, 1.2)
    out = noisy(depth, None, noise)
    changed = out != depth
    assert not changed[:, :159].any() and not changed[:, 161:].any()
    edge = out[:, 159:161]
    assert (edge == 0.0).mean() == pytest.approx(0.2, abs=0.06)
    between = (edge > 0.8) & (edge < 1.2)
    assert between.mean() == pytest.approx(0.5, abs=0.07)
    assert (edge[between] < 1.0).mean() > 0.6  # what is near is brighter


def test_sampling_is_plain_and_repeatable():
    config = DepthSensor(sensors=SENSORS)
    kinds = set()
    for seed in range(12):
        noise, again = (sample_depth_noise(config, rng=np.random.default_rng(seed)) for _ in range(2))
        assert noise == again and noise is not None
        json.dumps(dataclasses.asdict(noise))
        kinds.add(noise.sensor)
    assert kinds == set(SENSORS)
    assert sample_depth_noise(DepthSensor(sensors=()), rng=np.random.default_rng(0)) is None


def test_mistakes_are_told():
    with pytest.raises(ArgumentError, match="did you mean 'kinect2'"):
        DepthSensor("kinect3")
