"""One hand before one background, the plainest way: what `looks_like_a_hand.py` paints its pictures with."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from handsim.model import HandModel
from render._gl import load_pyrender, offscreen_renderer
from render.backgrounds import Background, draw_background
from render.camera import Camera
from render.forearm import Forearm
from render.lights import Lighting, add_lights
from render.materials import shade_colors, skin_material
from render.scene import OPENGL_FROM_OPENCV
from render.skin_look import SkinLook
from render.skin_mesh import SkinMesh
from render.skin_texture import skin_texture


def paint(
    model: HandModel,
    qpos: np.ndarray,
    camera: Camera,
    look: SkinLook,
    forearm: Forearm,
    lighting: Lighting,
    background: Background,
) -> tuple[np.ndarray, np.ndarray]:
    """Colour picture (H, W, 3), sRGB bytes, and depth (H, W) [m]."""
    pyrender = load_pyrender()
    renderer = offscreen_renderer(*camera.size)
    skin = SkinMesh(model, forearm).posed(qpos)
    primitive = pyrender.Primitive(
        positions=skin.vertices,
        normals=skin.normals,
        indices=skin.faces,
        texcoord_0=skin.uv,
        color_0=shade_colors(skin.shade),
        material=skin_material(skin_texture(look, forearm, side=model.shape.side)),
    )
    scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0])
    scene.add(pyrender.Mesh([primitive]))
    lens = pyrender.IntrinsicsCamera(*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], znear=0.05, zfar=10.0)
    scene.add(lens, pose=camera.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, camera.T_world_camera)
    flags = pyrender.RenderFlags
    hand, depth = renderer.render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)
    behind = 255.0 * draw_background(background, camera.size) ** (1 / 2.2)
    clear = 1.0 - hand[..., 3:].astype(np.float32) / 255.0
    return np.clip(hand[..., :3] + clear * behind, 0, 255).astype(np.uint8), depth


def record(*choices: Any) -> dict[str, Any]:
    """Random choices as JSON, by the names of their classes."""
    return {type(choice).__name__: asdict(choice) for choice in choices}
