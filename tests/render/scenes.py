"""Scenes that several tests of pictures draw."""

from __future__ import annotations

import numpy as np
import trimesh

from handsim import Camera, HandModel, join_qpos
from handsim.hand.shape import Side
from poses.shapes import gesture
from render.illustrations import view_along
from render.painting.figures import Drawn, Material, shade_colors, skin_material
from render.painting.opengl import (
    OPENGL_FROM_OPENCV,
    add_lights,
    load_pyrender,
    offscreen_renderer,
    pyrender_material,
)
from render.painting.rasterizer import Triangles
from render.scenery.lights import Lighting
from render.skin.mesh import PosableSkin
from render.skin.texture import SkinTexture


def draw_back(
    side: Side, texture: SkinTexture, lighting: Lighting, size: tuple[int, int]
) -> tuple[np.ndarray, Camera]:
    """A flat hand's back as pyrender draws it (H, W, 4), and the camera in whose axes its light is."""
    pyrender = load_pyrender()
    skin = PosableSkin(HandModel.named("M", side=side)).posed(join_qpos(gesture("flat")[None])[0])
    view = view_along(np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), skin.vertices, size)
    scene = pyrender.Scene(bg_color=[0.0] * 4)
    primitive = pyrender.Primitive(
        positions=skin.vertices,
        normals=skin.normals,
        indices=skin.faces,
        texcoord_0=skin.uv,
        color_0=shade_colors(skin.shade),
        material=pyrender_material(skin_material(texture)),
    )
    scene.add(pyrender.Mesh([primitive]))
    camera = pyrender.PerspectiveCamera(np.deg2rad(24.0), znear=0.05, zfar=10.0)
    scene.add(camera, pose=view.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting.turned(view.T_world_camera[:3, :3]))
    flags = pyrender.RenderFlags.RGBA | pyrender.RenderFlags.SHADOWS_DIRECTIONAL
    return np.asarray(offscreen_renderer(*size).render(scene, flags=flags)[0]), view


def plain(level: float = 0.5, roughness: float = 1.0) -> Material:
    return Material(np.full(3, level), roughness)


def thing(mesh: trimesh.Trimesh, material: Material, smooth: bool = True) -> Drawn:
    """A mesh of one material; `smooth` shades across its edges."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if not smooth:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    normals = np.array(mesh.vertex_normals if smooth else np.repeat(mesh.face_normals, 3, axis=0))
    ids = np.ones(len(faces), dtype=np.uint8)
    triangles = Triangles(vertices, faces, normals, ids, ids, ids)
    return Drawn(triangles, np.ones((len(vertices), 4), dtype=np.float32), None, lambda: material)
