"""Colours: surfaces lit and drawn by OpenGL, with how much of each pixel they cover."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from render._gl import load_pyrender, offscreen_renderer
from render.camera import Camera
from render.figures import Drawn
from render.lights import Lighting, add_lights
from render.scene import OPENGL_FROM_OPENCV

if TYPE_CHECKING:
    from jaxtyping import Float32, UInt8
    from numpy.typing import NDArray

_NEAR, _FAR = 0.02, 30.0  # [m]
_WHITE: Final = 255.0
_STEP: Final = 64  # [px] that windows grow by: every new size makes OpenGL begin anew


def paint(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    """Colours before black, sRGB, and in the fourth channel how much of each pixel is covered.

    Args:
        camera: A pinhole camera.
        drawn: What there is to see.
        lighting: In the camera's axes.

    Raises:
        HandSimError: Drawing is impossible on this machine; the sentence says what to install.
    """
    width, height = camera.size
    picture = np.zeros((height, width, 4), dtype=np.uint8)
    left, top, right, bottom = _window(camera, drawn)
    if left < right and top < bottom:
        inner = dataclasses.replace(
            camera, size=(right - left, bottom - top), K=camera.K - [[0, 0, left], [0, 0, top], [0, 0, 0]]
        )
        picture[top:bottom, left:right] = _paint_all(inner, drawn, lighting)
    return picture


def _window(camera: Camera, drawn: Sequence[Drawn]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of where there is anything to see: what is empty costs time too."""
    width, height = camera.size
    if not drawn:
        return 0, 0, 0, 0
    local = camera.local(np.concatenate([one.triangles.vertices for one in drawn]))
    if local[:, 2].min() < _NEAR:
        return 0, 0, width, height
    pixels = local[:, :2] / local[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    low, high = np.floor(pixels.min(axis=0) - 1.0), np.ceil(pixels.max(axis=0) + 1.0)
    left, top = (np.clip(low, 0, camera.size) // _STEP * _STEP).astype(int)
    right, bottom = np.minimum(np.ceil(np.clip(high, 0, camera.size) / _STEP) * _STEP, camera.size).astype(
        int
    )
    return int(left), int(top), int(right), int(bottom)


def _paint_all(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    pyrender = load_pyrender()
    renderer = offscreen_renderer(*camera.size)
    scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0])
    for one in drawn:
        primitive = pyrender.Primitive(
            positions=one.triangles.vertices,
            normals=one.triangles.normals,
            indices=one.triangles.faces,
            texcoord_0=one.uv,
            color_0=one.colors,
            material=one.material(),
        )
        scene.add(pyrender.Mesh([primitive]))
    lens = pyrender.IntrinsicsCamera(*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], znear=_NEAR, zfar=_FAR)
    scene.add(lens, pose=camera.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, camera.T_world_camera)
    flags = pyrender.RenderFlags
    painted: NDArray[np.uint8] = renderer.render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)[0]
    return painted


def put_before(
    painted: UInt8[np.ndarray, "H W 4"], background: Float32[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """What was painted before black, put before something else.

    Args:
        painted: See `paint`.
        background: sRGB from 0 to 255.
    """
    clear = 1.0 - painted[..., 3:].astype(np.float32) / _WHITE
    mixed: NDArray[np.uint8] = np.minimum(painted[..., :3] + clear * background, _WHITE).astype(np.uint8)
    return mixed
