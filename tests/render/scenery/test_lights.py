"""Lamps as they are drawn, and light from all around against its integral."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import HandSimError, look_at
from handsim.space.camera import preset
from render import Backgrounds, write_environment_map
from render.scenery.backgrounds import Background, draw_surroundings, enclose, light_in
from render.scenery.lights import irradiance, sample_lighting, sample_surroundings, surround


def test_lightings_are_plain_values_and_repeat() -> None:
    first, again = (sample_lighting(rng=np.random.default_rng(4)) for _ in range(2))
    assert first == again
    assert json.loads(json.dumps(dataclasses.asdict(first)))["ambient"] == list(first.ambient)


def test_lightings_neither_blind_nor_leave_in_the_dark(rng: np.random.Generator) -> None:
    for _ in range(200):
        lighting = sample_lighting(rng=rng)
        total = sum(lamp.strength for lamp in lighting.lamps) + np.mean(lighting.ambient)
        assert 1.0 < total < 3.42
        assert lighting.lamps[0].direction == lighting.lamps[-1].direction  # the key light's unshadowed part
        assert all(0.6 < level < 1.6 for lamp in lighting.lamps for level in lamp.color)


def sent_back(rows: np.ndarray, normals: np.ndarray) -> np.ndarray:
    x, y, z = normals.T
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], 1) @ rows


def around(count: int, rng: np.random.Generator) -> np.ndarray:
    normals = rng.normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_an_even_picture_lights_evenly(red: float, green: float, blue: float) -> None:
    rows = irradiance(np.full((12, 16, 3), (red, green, blue)))
    shown = sent_back(rows, around(50, np.random.default_rng(0)))
    np.testing.assert_allclose(shown, np.broadcast_to((red, green, blue), shown.shape), atol=0.005)


def test_a_picture_lights_as_the_integral_over_it_says(rng: np.random.Generator) -> None:
    height, width = 48, 64
    down, across = np.mgrid[0:height, 0:width]
    picture = np.stack([down / height, across / width, 0.5 + 0.0 * down], axis=-1)
    directions = around(200_000, rng)
    away = np.arccos(np.abs(directions[:, 2])) / (np.pi / 2)
    aside = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
    column, row = ((0.5 + 0.5 * away[:, None] * aside) * (width, height)).astype(int).T
    light = picture[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    for normal in around(12, rng):
        cosines = np.maximum(directions @ normal, 0.0)
        wanted = 4.0 * (light * cosines[:, None]).mean(axis=0)  # over pi, times the sphere's 4 pi
        np.testing.assert_allclose(sent_back(irradiance(picture), normal[None])[0], wanted, atol=0.02)


def test_light_keeps_its_strength_and_takes_the_pictures_colors(rng: np.random.Generator) -> None:
    lighting = sample_lighting(rng=rng)
    red = np.zeros((12, 16, 3)) + (0.8, 0.1, 0.1)
    lit = surround(lighting, irradiance(red), 0.5)
    weights = np.array([0.2126, 0.7152, 0.0722])
    assert np.array(lit.ambient) @ weights == pytest.approx(np.array(lighting.ambient) @ weights, rel=0.01)
    assert lit.ambient[0] > lighting.ambient[0] and lit.ambient[1] < lighting.ambient[1]
    assert lit.lamps == lighting.lamps and lit.surroundings[0] == lit.ambient


def test_a_dark_picture_gives_no_light_that_is_none() -> None:
    lighting = sample_lighting(rng=np.random.default_rng(0))
    lit = surround(lighting, irradiance(np.zeros((12, 16, 3))), 0.5)
    assert np.isfinite(lit.surroundings).all() and min(lit.ambient) > 0.0


def test_surroundings_repeat() -> None:
    first, again = (
        sample_surroundings(Backgrounds(), np.eye(3), rng=np.random.default_rng(3)) for _ in range(2)
    )
    assert first == again and len(first[1].surroundings) == 9


def test_light_that_is_turned_lights_turned_surfaces_the_same(rng: np.random.Generator) -> None:
    lighting = surround(sample_lighting(rng=rng), rng.random((9, 3)), 0.5)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned, normals = lighting.turned(rotation), around(20, rng)
    for lamp, other in zip(lighting.lamps, turned.lamps, strict=True):
        np.testing.assert_allclose(rotation @ lamp.direction, other.direction)
        assert (lamp.strength, lamp.color) == (other.strength, other.color)
    there, here = np.array(turned.surroundings), np.array(lighting.surroundings)
    np.testing.assert_allclose(sent_back(there, normals @ rotation.T), sent_back(here, normals), atol=1e-12)


def test_an_enclosure_lights_hands_from_where_it_is_bright(rng: np.random.Generator) -> None:
    background = Background("room", ((0.0,) * 3, (0.0,) * 3), 3)
    towards = np.array([0.6, 0.0, 0.8])
    box = enclose(np.array([[0.0, 0.0, 1.0], [0.4, 0.3, 1.3]]), 0, towards)
    way = np.array(box.lamp) - np.mean(box.free, axis=0)
    np.testing.assert_allclose(way / np.linalg.norm(way), towards, atol=1e-5)
    assert (np.array(box.lamp) > box.low).all() and (np.array(box.lamp) < box.high).all()
    directions = around(4000, rng)
    light = light_in(background, box, directions)
    assert light.shape == (4000, 3) and 0.0 <= light.min() and light.max() <= 1.0
    assert light[directions @ towards > 0.5].mean() > light[directions @ towards < -0.5].mean()


@pytest.mark.parametrize("name", ["sky.hdr", "sky.exr"])
def test_an_environment_map_lights_hands_from_where_its_sun_stands(name: str, tmp_path) -> None:
    light = np.full((64, 128, 3), 0.2, np.float32)
    light[:32] = (0.2, 0.4, 0.9)
    light[20:24, 40:44] = (300.0, 250.0, 200.0)
    if name.endswith("exr"):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": light}).write(str(tmp_path / name))
    else:
        assert cv2.imwrite(str(tmp_path / name), light[..., ::-1])
    maps = Backgrounds({"photo": 1}, str(tmp_path))
    background, lighting, box = sample_surroundings(maps, np.eye(3), rng=np.random.default_rng(5))
    assert background.is_map and box is not None and len(lighting.lamps) == 1
    way, color = np.array(lighting.lamps[0].direction), lighting.lamps[0].color
    elevation = np.arcsin(way[2] / np.linalg.norm(way))
    assert elevation == pytest.approx(np.pi * (0.5 - 22 / 64), abs=0.05) and color[0] > color[2]
    up, down = sent_back(np.array(lighting.surroundings), np.array([[0.0, 0, 1], [0, 0, -1]]))
    assert up[2] > 2.0 * up[0] and down[2] < 1.8 * down[0], "the sky is blue, the ground is gray"
    place = np.array([0.3, 0.2, 1.0])
    seen = draw_surroundings(background, box, preset("vga").at(look_at(place, place + way)), bright=False)
    assert seen.rgb[235:245, 315:325].min() > 200 > seen.rgb[:20].mean(), "the sun is in the middle"
    assert not seen.depth.any()


def test_a_written_map_has_the_light_of_its_room(tmp_path) -> None:
    write_environment_map(tmp_path / "room.hdr", seed=3)
    written = cv2.imread(str(tmp_path / "room.hdr"), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)[..., ::-1]
    assert written.shape == (512, 1024, 3) and written.min() >= 0.0
    viewer, rng = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.random.default_rng(3)
    room, lighting, box = sample_surroundings(Backgrounds("room"), viewer, around=np.zeros((1, 3)), rng=rng)
    assert box is not None
    walls = light_in(room, box, around(20_000, np.random.default_rng(0))).mean(axis=0)
    lamps = sum(0.25 * lamp.strength * np.array(lamp.color) for lamp in lighting.lamps)
    areas = np.sin(np.pi * (np.arange(512) + 0.5) / 512)
    seen = np.average(written.mean(axis=1), axis=0, weights=areas)
    np.testing.assert_allclose(seen, walls + lamps, rtol=0.03)
    maps = Backgrounds({"photo": 1}, str(tmp_path))
    again = sample_surroundings(maps, np.eye(3), rng=rng)[1].lamps[0]
    wanted = sum(
        lamp.strength * np.array(lamp.direction) / np.linalg.norm(lamp.direction) for lamp in lighting.lamps
    )
    rise, expected = (way[2] / np.linalg.norm(way) for way in (np.array(again.direction), wanted))
    assert rise == pytest.approx(expected, abs=0.1), "pictures turn maps about the vertical alone"
    with pytest.raises(HandSimError, match=r"expected a file name that ends in \.hdr"):
        write_environment_map(tmp_path / "room.png")
    with pytest.raises(HandSimError, match="seed is -1, expected 0 or more"):
        write_environment_map(tmp_path / "room.hdr", seed=-1)


def test_a_damaged_environment_map_is_told(tmp_path) -> None:
    for name in ("sky.hdr", "sky.exr"):
        (tmp_path / name).write_bytes(b"#?RADIANCE or not")
    with pytest.raises(HandSimError, match="no photograph that can be read"):
        sample_surroundings(Backgrounds({"photo": 1}, str(tmp_path)), np.eye(3), rng=np.random.default_rng(5))
