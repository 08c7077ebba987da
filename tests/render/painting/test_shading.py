"""What textures and display curves give surface points, against numpy."""

from __future__ import annotations

import numpy as np

from render.painting import shading
from render.painting.shading import BUMP, COLOR, ROUGH, SPOT, TO_DISPLAY, TO_LINEAR


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
