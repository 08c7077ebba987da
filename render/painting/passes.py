"""One scene, drawn as colors or as depth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from render.painting.gl import load_pyrender, offscreen_renderer
from render.painting.scene import HandScene, View, build_scene

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, UInt8
    from numpy.typing import NDArray


def render_rgb(scene: HandScene, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Color picture, sRGB.

    Args:
        scene: What to draw.
        size: Width and height [pixels].

    Raises:
        HandSimError: Drawing is impossible on this machine; the sentence says what to install.
    """
    renderer = offscreen_renderer(*size)
    built = build_scene(scene)
    flags = load_pyrender().RenderFlags
    # pyrender fails over the shadows of nothing
    color, _ = renderer.render(built, flags=flags.SHADOWS_DIRECTIONAL if built.mesh_nodes else flags.NONE)
    picture: NDArray[np.uint8] = np.array(color[..., :3])
    return picture


def render_depth(scene: HandScene, size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """Depth picture: distance along the camera's axis [m] at each pixel's center, 0 where there is nothing.

    Args:
        scene: What to draw.
        size: Width and height [pixels].

    Raises:
        HandSimError: Drawing is impossible on this machine; the sentence says what to install.
    """
    renderer = offscreen_renderer(*size)
    built = build_scene(scene)
    # Of all of pyrender's passes only this one takes a pixel's center; the others take some sample off it.
    everything = dict.fromkeys(built.mesh_nodes, (255, 255, 255))
    flags = load_pyrender().RenderFlags.SEG
    _, depth = renderer.render(built, flags=flags, seg_node_map=everything)
    picture: NDArray[np.float32] = np.asarray(depth, dtype=np.float32)
    return picture


def nothing_before(
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
