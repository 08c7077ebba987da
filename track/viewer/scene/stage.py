"""Where things stand in the page: light, a ground grid, z upwards, and the first look."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from viser import ViserServer

_FROM: Final = np.array([0.62, -0.62, 0.48])  # direction of the first look, from its target
_NEAREST: Final = 0.22  # [m] between the eye and its target, at least


def set_stage(server: ViserServer, points: Float[np.ndarray, "N 3"], *, ground: float | None = None) -> None:
    """Light, ground and the first look at some points [m]; NaN points are left out.

    Args:
        server: Where the page is.
        points: What shall be in view.
        ground: Height of the ground [m]; below the points when None.
    """
    there = points[np.isfinite(points).all(axis=1)]
    low, high = np.percentile(there, [2, 98], axis=0) if len(there) else np.tile([[-0.1], [0.1]], 3)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    height = float(low[2]) - 0.02 - 0.1 * size if ground is None else ground
    cell = 0.01 if size < 0.5 else 0.1
    server.scene.set_up_direction("+z")
    _set_light(server)
    server.scene.add_grid(
        "/ground",
        width=200 * cell,
        height=200 * cell,
        cell_size=cell,
        section_size=10 * cell,
        cell_color=(180, 180, 180),  # on white as on black
        section_color=(140, 140, 140),
        cell_thickness=0.6,
        section_thickness=1.0,
        fade_distance=30.0,
        plane_opacity=0.0,
        position=(round(float(middle[0]), 1), round(float(middle[1]), 1), height),
    )
    away = max(size, _NEAREST)
    camera = server.initial_camera
    camera.position = middle + away * _FROM / np.linalg.norm(_FROM)
    camera.look_at = middle
    camera.up = np.array([0.0, 0.0, 1.0])
    camera.near, camera.far = 0.005, 100.0


def _set_light(server: ViserServer) -> None:
    """Light from above and from one side, soft enough to keep the colors of the labels."""
    scene = server.scene
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map("studio", environment_intensity=0.12)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(150, 140, 130), intensity=0.55
    )
    scene.add_light_directional("/light/key", intensity=1.3, position=(1.5, -1.0, 2.5))
    scene.add_light_directional("/light/fill", intensity=0.3, position=(-2.0, 1.5, 1.0))
