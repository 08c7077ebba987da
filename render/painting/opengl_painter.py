"""Colors by OpenGL through pyrender: fast where there is a graphics card."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from handsim.space.camera import Camera
from render.painting.figures import Drawn
from render.painting.gl import load_pyrender, offscreen_renderer
from render.painting.materials import Material
from render.scenery.lights import Lighting

OPENGL_FROM_OPENCV: Final = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns a camera's axes: OpenCV's x right, y down, z ahead into OpenGL's x right, y up, z back."""
_NEAR, _FAR = 0.01, 30.0  # [m]
_GL_LINEAR: Final = 0x2601
_DISTANCE: Final = 300.0  # [m], so far that a lamp's rays are as good as parallel
_SHADOW_DEPTH: Final = 60.0  # [scene diagonals]


def paint_opengl(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    """See `render.painting.painter.paint`.

    Raises:
        HandSimError: Drawing is impossible on this machine; the message says what to install.
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
            material=pyrender_material(one.material()),
        )
        scene.add(pyrender.Mesh([primitive]))
    lens = pyrender.IntrinsicsCamera(*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], znear=_NEAR, zfar=_FAR)
    scene.add(lens, pose=camera.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, camera.T_world_camera)
    flags = pyrender.RenderFlags
    painted: NDArray[np.uint8] = renderer.render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)[0]
    return painted


@functools.lru_cache(maxsize=16)
def pyrender_material(material: Material) -> Any:
    """A material for pyrender; cached, so that textures are uploaded once.

    Raises:
        HandSimError: Drawing is impossible on this machine; the message says what to install.
    """
    pyrender, textures = load_pyrender(), {}
    if material.texels is not None:
        # No smaller copies of the texture: they would mix tiles that are no neighbors on the hand.
        sampler = pyrender.Sampler(magFilter=_GL_LINEAR, minFilter=_GL_LINEAR)
        rough = np.zeros((*material.texels.shape[:2], 3), dtype=np.uint8)
        rough[..., 0] = material.texels[..., 3]  # its shader reads roughness from red and metal from green
        sources = {
            "baseColorTexture": np.ascontiguousarray(material.texels[..., :3]),
            "normalTexture": np.ascontiguousarray(material.texels[..., 4:7]),
            "metallicRoughnessTexture": rough,
        }
        textures = {
            name: pyrender.Texture(source=source, source_channels="RGB", sampler=sampler)
            for name, source in sources.items()
        }
    return pyrender.MetallicRoughnessMaterial(
        baseColorFactor=[*material.color, 1.0],
        metallicFactor=0.0,
        roughnessFactor=material.roughness,
        emissiveFactor=np.sqrt(material.glow * material.color),  # its shader squares it
        **textures,
    )


def add_lights(
    pyrender: Any,
    scene: Any,
    lighting: Lighting,
    T_world_camera: Float[np.ndarray, "4 4"],
) -> None:
    """Light a pyrender scene that holds its meshes already; its ambient light is replaced.

    The lamps' directions are in the axes of the camera.
    """
    rotation = T_world_camera[:3, :3]
    scene.ambient_light = np.array(lighting.ambient)
    for number, lamp in enumerate(lighting.lamps):
        towards = rotation @ (np.array(lamp.direction) / np.linalg.norm(lamp.direction))
        pose = np.eye(4)
        color, intensity = np.array(lamp.color), np.pi * lamp.strength
        if number == 0:
            pose[:3, :3] = frame_with_z(towards)
            light = pyrender.DirectionalLight(color=color, intensity=intensity)
            _cast_shadows(pyrender, light, float(scene.scale))
        else:
            pose[:3, 3] = T_world_camera[:3, 3] + towards * _DISTANCE
            light = pyrender.PointLight(color=color, intensity=intensity * _DISTANCE**2)
        scene.add(light, pose=pose)


def _cast_shadows(pyrender: Any, light: Any, extent: float) -> None:
    # pyrender's shadow bias is a fixed share of this camera's depth, too little for skin; depth adds bias.
    # Its light stands one scene diagonal away from the middle, so half a diagonal takes in everything.
    diagonal = max(extent, 1e-3)  # an empty scene has none
    light._get_shadow_camera = lambda _: pyrender.OrthographicCamera(
        xmag=0.52 * diagonal, ymag=0.52 * diagonal, znear=0.3 * diagonal, zfar=_SHADOW_DEPTH * diagonal
    )


def frame_with_z(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Any rotation whose z axis is `direction`."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
