from __future__ import annotations

import numpy as np
import pytest

from handsim import HandModel
from handsim.hand.shape import SIDES, Side
from render import SkinLook
from render.scenery.lights import Lamp, Lighting
from render.skin.look import CUFF, Forearm
from render.skin.mesh import skin_atlas
from render.skin.texture import (
    REFERENCE,
    GloveLook,
    SkinTexture,
    behind_wrist,
    glove_texture,
    normal_map,
    relief,
    sample_glove_look,
    skin_texels,
    skin_texture,
)
from tests.render.scenes import draw_back

SIZE = (400, 400)


def test_no_relief_is_the_skins_own_normals() -> None:
    width, rows = skin_atlas().size
    normals = normal_map(np.zeros(width * rows), "right").astype(int)
    assert normals.shape == (rows, width, 3)
    assert np.ptp(normals[..., :2] - 127) <= 1
    assert (normals[..., 2] == 255).all()


def test_relief_stays_under_a_millimeter_and_off_the_palm() -> None:
    texels = skin_texels()
    back = np.clip(texels.dorsal, 0.0, 1.0)
    height = relief()
    assert 3e-4 < height.max() < 1e-3
    assert -1e-3 < height.min()
    assert np.abs(height[texels.dorsal < -0.5]).max() < 1e-9
    # tendons and knuckles stand above what lies between the fingers
    knuckles = HandModel.named("M").shape.knuckles[1:, :2]
    top = [
        height[(np.linalg.norm(texels.positions[:, :2] - at, axis=1) < 0.004) & (back > 0.7)].max()
        for at in knuckles
    ]
    assert min(top) > 3e-4


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("axis", [0, 1])
def test_ridges_are_bright_on_the_side_of_the_light(side: Side, axis: int) -> None:
    """A ridge over the back of the hand, lengthwise or across, with a lamp to the left of it or above."""
    texels, (width, rows) = skin_texels(), skin_atlas().size
    where = (0.05, 0.0)[axis]
    height = 0.0015 * np.exp(-(((texels.positions[:, axis] - where) / 0.004) ** 2)) * (texels.dorsal > 0.0)
    gray = np.full((rows, width, 3), 150, dtype=np.uint8)
    texture = SkinTexture(gray, np.full((rows, width), 255, dtype=np.uint8), normal_map(height, side))
    plain = texture._replace(normals=normal_map(0.0 * height, side))
    lamp = Lamp((-1.0, 0.0, -1.0) if axis == 1 else (0.0, -1.0, -1.0), 1.0)
    drawn = []
    for paint in (texture, plain):
        picture, view = draw_back(side, paint, Lighting((lamp,), (0.1, 0.1, 0.1)), SIZE)
        drawn.append(picture[..., 0].astype(float))
    change = drawn[0] - drawn[1]
    # Seen from the back with the fingers up, x is up in the picture; y is to the left on a right hand.
    lit, dim = np.array([[0.05, 0.0, 0.02], [0.05, 0.0, 0.02]])
    step = 0.003
    if axis == 0:
        lit[0], dim[0] = lit[0] + step, dim[0] - step
    else:
        lit[0] = dim[0] = 0.06
        towards = view.T_world_camera[:3, 0] @ [0.0, 1.0, 0.0]  # is y to the right in the picture?
        lit[1], dim[1] = -np.sign(towards) * step, np.sign(towards) * step
    values = []
    for point in (lit, dim):
        column, row = view.project(point).astype(int)
        values.append(change[row - 1 : row + 2, column - 1 : column + 2].mean())
    assert values[0] > 4.0
    assert values[1] < -4.0


def test_a_glove_covers_the_hand_up_to_its_cuff() -> None:
    forearm = Forearm(length=0.2)
    skin, look = skin_texture(SkinLook(), forearm), GloveLook(cuff=0.05)
    gloved = glove_texture(look, skin, forearm)
    reach = -skin_texels().positions[:, 0] * 0.2 / REFERENCE.length
    assert gloved.color.reshape(-1, 3)[reach < 0.04].max() < 120
    behind = reach > 0.06
    for ours, theirs in zip(gloved, skin, strict=True):
        flat = (-1, *ours.shape[2:])
        assert (ours.reshape(flat)[behind] == theirs.reshape(flat)[behind]).all()
        assert ours.dtype == np.uint8


def test_a_sleeve_lies_over_the_cuff() -> None:
    forearm = Forearm(length=0.6, sleeve=0.04, sleeve_color=(0.9, 0.9, 0.9))
    skin = skin_texture(SkinLook(), forearm)
    gloved = glove_texture(GloveLook(cuff=0.07), skin, forearm)
    behind = behind_wrist(forearm)
    colors, sleeve = gloved.color.reshape(-1, 3), behind > forearm.sleeve + CUFF
    np.testing.assert_array_equal(colors[sleeve], skin.color.reshape(-1, 3)[sleeve])
    assert colors[behind < forearm.sleeve].max() < 120


def test_gloves_repeat_and_are_dark(rng: np.random.Generator) -> None:
    looks = [sample_glove_look(rng=rng) for _ in range(50)]
    assert len(set(looks)) == 50
    assert max(max(look.color) for look in looks) <= 0.4
    first, again = (sample_glove_look(rng=np.random.default_rng(8)) for _ in range(2))
    skin = skin_texture(SkinLook())
    assert glove_texture(first, skin).color.tobytes() == glove_texture(again, skin).color.tobytes()
