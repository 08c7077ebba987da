from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.model import HandModel, join_qpos
from poses.shapes import gesture
from render.illustrations.scene import view_along
from render.painting.gl import load_pyrender, offscreen_renderer
from render.painting.materials import shade_colors, skin_material
from render.painting.opengl_painter import OPENGL_FROM_OPENCV, add_lights, frame_with_z, pyrender_material
from render.scenery.lights import STUDIO, Lamp, Lighting
from render.skin.look import SkinLook
from render.skin.mesh import PosableSkin
from render.skin.texture import skin_texture


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, -2.0, 0.5), (0.0, -3.0, 0.0)])
def test_frame_with_z(direction: tuple[float, float, float]) -> None:
    frame = frame_with_z(np.array(direction))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame[:, 2], np.array(direction) / np.linalg.norm(direction), atol=1e-12)
    assert np.linalg.det(frame) > 0.0


def draw(lighting: Lighting) -> np.ndarray:
    """A flat hand's back, (200, 200, 4)."""
    pyrender = load_pyrender()
    model = HandModel.named("M")
    skin = PosableSkin(model).posed(join_qpos(gesture("flat")[None])[0])
    view = view_along(np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), skin.vertices, (200, 200))
    scene = pyrender.Scene(bg_color=[0.0] * 4)
    primitive = pyrender.Primitive(
        positions=skin.vertices,
        normals=skin.normals,
        indices=skin.faces,
        texcoord_0=skin.uv,
        color_0=shade_colors(skin.shade),
        material=pyrender_material(skin_material(skin_texture(SkinLook()))),
    )
    scene.add(pyrender.Mesh([primitive]))
    camera = pyrender.PerspectiveCamera(view.field_of_view, znear=0.05, zfar=10.0)
    scene.add(camera, pose=view.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, view.T_world_camera)
    flags = pyrender.RenderFlags
    picture, _ = offscreen_renderer(200, 200).render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)
    return np.asarray(picture)


@pytest.mark.usefixtures("drawing")
def test_light_comes_from_where_it_is_told_in_its_color() -> None:
    dark = Lighting((), (0.0, 0.0, 0.0))
    hand = draw(STUDIO)[..., 3] == 255
    assert 2000 < hand.sum() < 20_000
    assert draw(dark)[hand, :3].max() == 0
    ahead = Lighting((Lamp((0.0, 0.0, -1.0), 1.0, (1.0, 0.0, 0.0)),), (0.0, 0.0, 0.0))
    red = draw(ahead)[hand].mean(axis=0)
    assert red[0] > 100.0
    assert red[1:3].max() == 0.0
    behind = Lighting((Lamp((0.0, 0.0, 1.0), 1.0),), (0.0, 0.0, 0.0))
    assert draw(behind)[hand, :3].mean() < 15.0
    # Lamps without a shadow are as strong as the one with
    off = Lamp((0.0, 0.0, 1.0), 0.0)
    second = Lighting((off, Lamp((0.0, 0.0, -1.0), 1.0, (1.0, 0.0, 0.0))), (0.0, 0.0, 0.0))
    assert abs(draw(second)[hand].mean(axis=0)[0] - red[0]) < 4.0


@pytest.mark.usefixtures("drawing")
def test_a_white_surface_sends_back_what_a_lamp_gives() -> None:
    """A lamp of strength one shows the skin in about its own color."""
    look = SkinLook(creases=0.0, blotches=0.0, veins=0.0, flush=0.0)
    picture = draw(Lighting((Lamp((0.0, 0.0, -1.0), 1.0),), (0.0, 0.0, 0.0)))
    hand = picture[..., 3] == 255
    shown = np.median(picture[hand, :3], axis=0)
    texture = skin_texture(look)
    own = np.median(texture.color.reshape(-1, 3), axis=0)
    assert np.abs(shown - own).max() < 45.0
