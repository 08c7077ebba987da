"""Where things stand in the page: light, a ground grid, z upwards, and the first look."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.space.rig import ROOM_CENTER, CameraRig
from handsim.space.transforms import rotation_quaternions

if TYPE_CHECKING:
    from viser import ViserServer


_FROM: Final = np.array([0.62, -0.62, 0.48])  # direction of the first look, from its target
_NEAREST: Final = 0.22  # [m] between the eye and its target, at least
_HALF_SIDE: Final = 0.3  # [m] of the cube that wrists move in, as in training sets
_SPACING: Final = 0.2  # [m] between the points whose cameras are counted
_MOST_POINTS: Final = 40_000
_FRUSTUM: Final = 0.12  # [m]
_FEW, _MANY = np.array([214, 96, 60]), np.array([40, 120, 180])


def set_stage(server: ViserServer, points: Float[np.ndarray, "N 3"], *, ground: float | None = None) -> None:
    """Light, ground and the first look at some points [m]; NaN points are left out.

    Args:
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


def show_rig(server: ViserServer, rig: CameraRig) -> None:
    """The cameras as frusta, each with its number on the first one's side."""
    quaternions = rotation_quaternions(rig.T_world_camera[:, :3, :3])
    for number, (camera, quaternion) in enumerate(zip(rig.cameras, quaternions, strict=True), 1):
        width, height = camera.angles
        server.scene.add_camera_frustum(
            f"/cameras/{number}",
            fov=height,
            aspect=float(np.tan(width / 2) / np.tan(height / 2)),
            scale=_FRUSTUM,
            thickness=0.004,
            color=(60, 66, 76),
            position=camera.T_world_camera[:3, 3],
            wxyz=quaternion,
        )
        server.scene.add_label(
            f"/cameras/{number}/number", str(number), font_screen_scale=0.8, anchor="bottom-center"
        )


def show_volume(server: ViserServer, rig: CameraRig) -> None:
    """The cube that wrists move in, and dots that tell how many cameras see a place."""
    center = np.array(ROOM_CENTER)
    server.scene.add_line_segments(
        "/volume", points=box_edges(center - _HALF_SIDE, center + _HALF_SIDE), colors=(40, 120, 60)
    )
    places, counts = camera_counts(rig)
    share = (counts / len(rig.positions))[:, None]
    server.scene.add_point_cloud(
        "/coverage",
        points=places,
        colors=np.round((1.0 - share) * _FEW + share * _MANY).astype(np.uint8),
        point_size=0.012,
        point_shape="circle",
    )


def camera_counts(rig: CameraRig) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Places [m] that at least two cameras see, above the floor, and by how many each is seen.

    Returns:
        Places (N, 3) on a grid within the box of the cameras, and counts (N,).
    """
    low, high = rig.positions.min(axis=0), rig.positions.max(axis=0)
    low[2] = min(0.0, low[2])
    spacing = max(_SPACING, float((np.prod(high - low + _SPACING) / _MOST_POINTS) ** (1 / 3)))
    axes = [np.arange(low[axis], high[axis] + spacing / 2, spacing) for axis in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = rig.in_view(grid).sum(axis=1)
    return grid[counts >= 2], counts[counts >= 2]


def box_edges(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> NDArray[np.float64]:
    """The twelve edges (12, 2, 3) of a box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    pairs = [(a, b) for a in range(8) for b in range(a) if np.abs(corners[a] - corners[b]).sum() == 1]
    edges: NDArray[np.float64] = (low + corners * (high - low))[np.array(pairs)]
    return edges
