from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest

from handsim import HandSimError
from render import SkinLook
from render.skin.look import ALL_TONES, CUFF, TONES, Forearm, arm_places, sample_forearm, sample_skin_look
from render.skin.mesh import skin_atlas
from render.skin.texture import SkinTexture, skin_texels, skin_texture


def lab_of(texture: SkinTexture, texels: np.ndarray) -> np.ndarray:
    """Mean CIELAB of some texels, numbered row by row."""
    color = texture.color.reshape(-1, 3)[texels].astype(np.float32) / 255.0
    mean: np.ndarray = cv2.cvtColor(color[None], cv2.COLOR_RGB2Lab)[0].mean(axis=0)
    return mean


@pytest.fixture(scope="module")
def places() -> dict[str, np.ndarray]:
    """Texels of the back and the palm of the hand."""
    texels = skin_texels()
    x = texels.positions[:, 0]
    flat = (texels.palm > 0.95) & (x > 0.01) & (x < 0.07)
    return {
        "back": np.flatnonzero(flat & (texels.dorsal > 0.8)),
        "palm": np.flatnonzero(flat & (texels.dorsal < -0.8)),
    }


@pytest.mark.parametrize("tone", TONES)
def test_tones_come_out_as_wanted(tone: str, places: dict[str, np.ndarray], rng: np.random.Generator) -> None:
    low, high = TONES[tone]
    for _ in range(3):
        look = sample_skin_look(TONES[tone], rng=rng)
        assert low - 1e-6 <= look.typology_angle <= high + 1e-6
        texture = skin_texture(look)
        back, palm = (lab_of(texture, places[side]) for side in ("back", "palm"))
        np.testing.assert_allclose(back, [look.lightness, look.redness, look.yellowness], atol=3.0)
        assert palm[0] > back[0] - 1.5
        if tone == "dark":
            assert palm[0] > back[0] + 12.0


def test_everybody_is_within_measured_skin(rng: np.random.Generator) -> None:
    looks = [sample_skin_look(rng=rng) for _ in range(300)]
    angles = np.array([look.typology_angle for look in looks])
    assert ALL_TONES[0] <= angles.min() < -40.0
    assert 58.0 < angles.max() <= ALL_TONES[1]
    for name, low, high in (("lightness", 30, 80), ("redness", 4, 15), ("yellowness", 8, 23)):
        values = np.array([getattr(look, name) for look in looks])
        assert low < values.min() < values.max() < high


def test_looks_are_plain_values_and_repeat() -> None:
    first, second = (sample_skin_look(rng=np.random.default_rng(3)) for _ in range(2))
    assert first == second
    arms = [sample_forearm(rng=np.random.default_rng(3)) for _ in range(2)]
    assert arms[0] == arms[1]
    assert (
        SkinLook(**json.loads(json.dumps(dataclasses.asdict(first)))).typology_angle == first.typology_angle
    )
    textures = [skin_texture(look, arms[0]) for look in (first, second)]
    assert textures[0].color.tobytes() == textures[1].color.tobytes()
    assert textures[0].roughness.tobytes() == textures[1].roughness.tobytes()
    other = skin_texture(dataclasses.replace(first, seed=first.seed + 1), arms[0])
    assert (other.color != textures[0].color).any()


def test_neighboring_tiles_agree_along_their_sides() -> None:
    """Every corner of the skin has one color, whichever tile it is looked up in."""
    atlas, texture = skin_atlas(), skin_texture(SkinLook(seed=5))
    width, height = atlas.size
    column = np.floor(atlas.uv[:, 0] * width).astype(int)
    row = np.floor((1.0 - atlas.uv[:, 1]) * height).astype(int)
    on_texel = np.isclose(atlas.uv[:, 0] * width % 1.0, 0.5, atol=0.02) & np.isclose(
        atlas.uv[:, 1] * height % 1.0, 0.5, atol=0.02
    )
    hand = on_texel & (atlas.corners < atlas.num_hand)
    colors = texture.color[row, column].astype(int)
    order = np.flatnonzero(hand)[np.argsort(atlas.corners[hand], kind="stable")]
    same = atlas.corners[order][1:] == atlas.corners[order][:-1]
    apart = np.abs(colors[order][1:] - colors[order][:-1]).max(axis=1)[same]
    assert len(apart) > 300
    assert apart.max() <= 1


def test_nails_are_smooth_and_pale_on_dark_hands() -> None:
    look = SkinLook(lightness=36.0, redness=8.0, yellowness=11.0, palm_lightness=58.0)
    texture = skin_texture(look)
    for digit in skin_texels().digits:
        joint, tip = digit.joints[1:]
        middle = joint + 0.68 * (tip - joint)
        nail = digit.texels[(np.abs(digit.along - middle) < 0.002) & (np.abs(digit.angle) < 0.4)]
        assert len(nail) > 4
        assert lab_of(texture, nail)[0] > look.lightness + 10.0
        assert texture.roughness.ravel()[nail].mean() < 255 * 0.35


def test_sleeves_begin_where_they_are_told(rng: np.random.Generator) -> None:
    forearm = Forearm(length=0.2, sleeve=0.08, sleeve_color=(0.1, 0.1, 0.6))
    texture, x = skin_texture(SkinLook(), forearm), skin_texels().positions[:, 0]
    reach = -x * 0.2 / Forearm().length
    assert lab_of(texture, np.flatnonzero(reach > 0.1))[2] < -20.0
    assert lab_of(texture, np.flatnonzero((reach > 0.02) & (reach < 0.07)))[2] > 10.0


def test_impossible_looks_are_told() -> None:
    with pytest.raises(HandSimError, match="lightness is 120"):
        SkinLook(lightness=120.0)
    with pytest.raises(HandSimError, match="roughness is 2"):
        SkinLook(roughness=2.0)


def test_rings_lie_at_the_end_of_a_glove_and_at_the_edge_of_a_sleeve() -> None:
    for sleeve, cuff, steps in ((0.09, 0.03, (0.03, 0.09)), (0.05, 0.045, (0.05,)), (1.0, 0.06, (0.06,))):
        places = arm_places(Forearm(length=0.7, sleeve=sleeve, cuff=cuff), 20)
        assert places[0] == 0.0 and places[-1] == pytest.approx(0.7) and (np.diff(places) > 0.0).all()
        for step in steps:
            np.testing.assert_allclose(
                places[np.abs(places - step).argmin() + np.arange(2)], [step, step + CUFF]
            )
        assert (np.diff(places) < 0.001).sum() == len(steps)
