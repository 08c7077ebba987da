from __future__ import annotations

import numpy as np
import pytest

from handsim.errors import HandSimError
from render.skin.forearm import CUFF, Forearm
from render.skin.glove_look import GloveLook, glove_texture, sample_glove_look
from render.skin.look import SkinLook
from render.skin.texels import REFERENCE, behind_wrist, skin_texels
from render.skin.texture import skin_texture


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


def test_a_glove_without_a_cuff_is_told() -> None:
    with pytest.raises(HandSimError, match="cuff"):
        GloveLook(cuff=0.0)
