"""Colors by OpenGL through pyrender: quick where there is a graphics card."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from render.cameras.camera import Camera
from render.painting.figures import Drawn
from render.painting.gl import load_pyrender, offscreen_renderer
from render.painting.lights import Lighting, add_lights
from render.painting.materials import Material
from render.painting.scene import OPENGL_FROM_OPENCV

if TYPE_CHECKING:
    from jaxtyping import UInt8
    from numpy.typing import NDArray

_NEAR, _FAR = 0.01, 30.0  # [m]


def paint_opengl(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    """See `render.painting.painter.paint`.

    Raises:
        HandSimError: Drawing is impossible on this machine; the sentence says what to install.
    """
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
            material=_material(one.material()),
        )
        scene.add(pyrender.Mesh([primitive]))
    lens = pyrender.IntrinsicsCamera(*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], znear=_NEAR, zfar=_FAR)
    scene.add(lens, pose=camera.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, camera.T_world_camera)
    flags = pyrender.RenderFlags
    painted: NDArray[np.uint8] = renderer.render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)[0]
    return painted


@functools.lru_cache(maxsize=16)
def _material(material: Material) -> Any:
    """Kept, so that textures go to the card once."""
    return material.for_pyrender()
