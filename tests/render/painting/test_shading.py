from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation

from handsim.space.camera import pinhole
from render.painting import shading
from render.painting.figures import Drawn
from render.painting.shading import (
    BUMP,
    COLOR,
    ROUGH,
    SPOT,
    TO_DISPLAY,
    TO_LINEAR,
    level_behind,
    light_behind,
)
from render.scenery.backgrounds import SHARE, Backdrop, sample_backdrop
from render.scenery.lights import Lamp, Lighting
from tests.render.scenes import plain, thing

CAMERA = pinhole("small", (160, 120), 150.0)
CENTER, RADIUS = (0.0, 0.0, 1.0), 0.15
SHARP = 1e-3


def test_texels_are_mixed_from_the_four_around_a_point(rng):
    rows, columns, count = 7, 5, 300
    texels = rng.integers(0, 256, (rows, columns, 8), dtype=np.uint8)
    u, v = rng.uniform(-0.1, 1.1, (2, count)).astype(np.float32)
    spots = np.zeros((SPOT, count), np.float32)
    spots[BUMP], spots[BUMP + 1] = u, v
    finish = np.array([0.9, 0.8, 0.7, 1.0, 0.0, 0.0, 0.0, 0.0])
    shading._read_texels(spots, texels.view(np.uint32), finish, TO_LINEAR)
    across = np.clip(u * columns - 0.5, 0.0, columns - 1.001)
    down = np.clip((1.0 - v) * rows - 0.5, 0.0, rows - 1.001)
    column, row = across.astype(int), down.astype(int)
    right, below = (across - column)[:, None], (down - row)[:, None]
    upper = (1.0 - right) * texels[row, column] + right * texels[row, column + 1]
    lower = (1.0 - right) * texels[row + 1, column] + right * texels[row + 1, column + 1]
    mixed = (1.0 - below) * upper + below * lower
    srgb = mixed[:, :3] / 255.0
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(spots[COLOR : COLOR + 3].T, light * finish[:3], atol=1e-3)
    np.testing.assert_allclose(spots[ROUGH], np.maximum(mixed[:, 3] / 255.0, shading.ROUGHEST), atol=1e-4)
    np.testing.assert_allclose(spots[BUMP : BUMP + 3].T, mixed[:, 4:7] / 127.5 - 1.0, atol=1e-3)


def test_display_values_follow_the_curve_and_are_clipped():
    light = np.array([-1.0, 0.0, 1e-4, 0.2, 0.5, 1.0, 3.0], dtype=np.float32)
    tint = np.full_like(light, 0.8)
    shown = light.copy()
    shading.display(shown, tint, TO_DISPLAY)
    np.testing.assert_allclose(shown, np.clip(0.8 * light, 0.0, 1.0) ** (1.0 / shading.GAMMA), atol=1e-4)


def ball(place: tuple[float, float, float] = CENTER) -> tuple[trimesh.Trimesh, Drawn]:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).apply_translation(place)
    return mesh, thing(mesh, plain())


@settings(max_examples=25, deadline=None)
@given(*[st.floats(-0.6, 0.6)] * 2, *[st.floats(-0.4, 0.4)] * 2, st.floats(0.0, 0.3))
def test_it_falls_where_the_lamp_is_hidden(aside, above, right, down, gap):
    mesh, drawn = ball()
    towards = np.array([aside, above, -1.0])
    lighting = Lighting((Lamp((aside, above, -1.0), 1.0),), (0.0, 0.0, 0.0))
    light = light_behind(CAMERA, [drawn], lighting, Backdrop(gap, (right, down), SHARP))
    assert light is not None
    normal = np.array([right, down, -1.0]) / np.linalg.norm([right, down, 1.0])
    level = gap - (np.array(mesh.vertices) @ normal).min()  # of the plane: points @ normal = -level
    rays = CAMERA.rays().reshape(-1, 3)
    places = rays * (-level / (rays @ normal))[:, None]
    to_center = CENTER - places
    off = np.linalg.norm(np.cross(to_center, towards / np.linalg.norm(towards)), axis=1)
    hidden = (off < RADIUS).reshape(light.shape)
    around = binary_dilation(hidden, iterations=13) & ~hidden
    inside = ~binary_dilation(~hidden, iterations=13)
    outside = ~hidden & ~around
    assert (light[outside] > 0.98).all()
    assert (light[inside] < 0.2).all()


def test_it_is_as_dark_as_the_share_of_the_lamp() -> None:
    _, drawn = ball()
    key, fill = Lamp((0.0, 0.0, -2.0), 0.6), Lamp((0.0, -1.0, -1.0), 0.4)
    for lamps, ambient, share in (
        ((key,), 0.0, 1.0),
        ((key,), 0.6, 0.5),
        ((key, fill), 0.0, 0.6 / (0.6 + 0.4 / np.sqrt(2.0))),
        ((key, Lamp((0.0, 0.0, 1.0), 5.0)), 0.0, 1.0),
    ):
        light = light_behind(CAMERA, [drawn], Lighting(lamps, (ambient,) * 3), Backdrop(0.0, softness=SHARP))
        assert light is not None
        assert light.min() == pytest.approx(1.0 - 0.9 * share, abs=1e-5)


def test_wide_lamps_and_wide_gaps_soften_it() -> None:
    _, drawn = ball()
    lighting = Lighting((Lamp((0.3, 0.0, -1.0), 1.0),), (0.2, 0.2, 0.2))

    def steepest(gap: float, softness: float) -> float:
        light = light_behind(CAMERA, [drawn], lighting, Backdrop(gap, softness=softness))
        assert light is not None
        return float(np.abs(np.diff(light, axis=1)).max())

    assert steepest(0.3, 0.05) > 1.5 * steepest(0.3, 0.2)
    assert steepest(0.05, 0.2) > 1.5 * steepest(0.6, 0.2)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_lamps_behind_the_backdrop_cast_none(direction: tuple[float, float, float]) -> None:
    _, drawn = ball()
    assert light_behind(CAMERA, [drawn], Lighting((Lamp(direction, 1.0),), (0.1,) * 3), Backdrop(0.1)) is None


def test_without_hands_or_lamps_there_is_none() -> None:
    _, drawn = ball()
    _, far = ball((3.0, 0.0, 1.0))
    lit = Lighting((Lamp((0.0, 0.0, -1.0), 1.0),), (0.1, 0.1, 0.1))
    assert light_behind(CAMERA, [], lit, Backdrop(0.1)) is None
    assert light_behind(CAMERA, [far], lit, Backdrop(0.1)) is None
    assert light_behind(CAMERA, [drawn], Lighting((), (0.1, 0.1, 0.1)), Backdrop(0.1)) is None


def test_backdrops_come_as_often_as_they_should(rng: np.random.Generator) -> None:
    drawn = [sample_backdrop(rng=rng) for _ in range(500)]
    assert np.mean([one.shadows for one in drawn]) == pytest.approx(SHARE, abs=0.08)
    assert all(0.0 < one.gap < (0.5 if one.shadows else 5.0) for one in drawn)


def test_a_backdrop_is_behind_what_is_in_the_picture() -> None:
    _, drawn = ball()
    _, beside = ball((9.0, 0.0, 1.0))
    wall = Backdrop(0.1, (0.3, -0.2))
    nearest = float((CAMERA.local(drawn.triangles.vertices) @ wall.normal).min())
    assert level_behind(wall, CAMERA, [drawn, beside]) == pytest.approx(nearest - 0.1)
    assert level_behind(dataclasses.replace(wall, level=-2.0), CAMERA, [drawn]) == -2.0
    assert level_behind(wall, CAMERA, [beside]) == level_behind(wall, CAMERA, []) == -1.1


def test_shadows_are_the_mean_over_the_texels_around_a_point(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    points, towards = ball.vertices.astype(np.float32), np.array([0.0, 0.6, -0.8])
    found = shading.shadow_map(points, ball.faces, towards, np.ones(len(points), np.bool_))
    nearest = found.nearest[0]
    assert np.isinf(nearest).any() and np.isfinite(nearest).any()
    shares = []
    for point in rng.uniform(-0.15, 0.15, (300, 3)):
        across, down, near = found.to_map @ [*point, 1.0]
        (column, right), (row, below) = ((int(np.floor(x - 0.5)), (x - 0.5) % 1.0) for x in (across, down))
        window = nearest[row - 1 : row + 3, column - 1 : column + 3] <= near + found.bias
        if row < 1 or column < 1 or window.shape != (4, 4):
            wanted = 1.0
        else:
            wanted = np.array([1 - below, 1, 1, below]) @ window @ np.array([1 - right, 1, 1, right]) / 9.0
        shares.append(shading.lit_share(found.to_map, found.nearest, found.bias, *point))
        assert shares[-1] == pytest.approx(wanted, abs=1e-9)
    assert {0.0, 1.0} < set(shares)
