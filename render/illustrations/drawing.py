"""Colors and depth of the scene of a ready-made picture, drawn without OpenGL."""

from __future__ import annotations

import dataclasses
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy.typing import NDArray

from render.illustrations.scene import HandScene, View, scene_surfaces
from render.painting.painter import paint, put_before
from render.painting.rasterizer import join, rasterize
from render.scenery.lights import STUDIO

_OVERSAMPLING: Final = 2  # colors are painted this much larger and scaled down, for smooth outlines


def render_rgb(
    scene: HandScene, size: tuple[int, int], *, behind: UInt8[np.ndarray, "H W 3"] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Color picture, sRGB.

    Args:
        scene: What to draw.
        size: Width and height [px].
        behind: Picture behind the scene; the scene's background when not given.

    Raises:
        ArgumentError: No picture has that size.
    """
    width, height = size
    camera = scene.view.camera(size)
    K = camera.K.copy()
    K[:2] *= _OVERSAMPLING
    large = dataclasses.replace(camera, size=(_OVERSAMPLING * width, _OVERSAMPLING * height), K=K)
    painted = cv2.resize(paint(large, scene_surfaces(scene), STUDIO), size, interpolation=cv2.INTER_AREA)
    if behind is None:
        paper = np.rint(255.0 * np.array(scene.background))
        behind = np.broadcast_to(paper.astype(np.uint8), (height, width, 3))
    return put_before(painted, np.ascontiguousarray(behind, dtype=np.float32))


def render_depth(scene: HandScene, size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """Depth picture: distance along the camera's axis [m] at each pixel's center, 0 where there is nothing.

    Args:
        scene: What to draw.
        size: Width and height [px].

    Raises:
        ArgumentError: No picture has that size.
    """
    camera, surfaces = scene.view.camera(size), scene_surfaces(scene)
    if not surfaces:
        return np.zeros(size[::-1], dtype=np.float32)
    depth = rasterize(camera, join([one.triangles for one in surfaces]), with_normals=False).depth
    assert depth is not None
    return depth


def unoccluded(
    depth: Float32[np.ndarray, "H W"], view: View, points: Float[np.ndarray, "N 3"], *, slack: float
) -> Bool[np.ndarray, "N"]:
    """Which points lie in a depth picture with nothing in front of them.

    Args:
        depth: The picture [m], 0 where there is nothing.
        view: Its camera.
        points: Points in the world [m].
        slack: How far behind the first surface a point still counts [m], such as a marker's radius.
    """
    height, width = depth.shape
    column, row = np.floor(view.project(points, (width, height))).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    first = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    ahead = (points - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2]
    free: NDArray[np.bool_] = inside & (ahead > 0) & ((first == 0) | (ahead <= first + slack))
    return free
