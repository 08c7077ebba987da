"""Tones of skin as pictures show them: from many sides, in the light of many scenes, perfect and noisy."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from handsim.hand.shape import PALM
from handsim.space.transforms import quaternion_matrix
from render import PictureStream, RenderConfig
from render.skin.look import TONES, hyphened, typology_angle

FEWEST = 150  # pixels of a back or a palm that count
PICTURES = 64
MOST_OFF = {"rgb": 8.0, "noisy_rgb": 10.0}  # [deg]; 20 backs spread by 20 degrees


def seen_colors(tone: str) -> dict[tuple[str, str], np.ndarray]:
    """Medians of CIELAB on backs and palms that face the camera (N, 3), by picture."""
    config = RenderConfig(passes=("rgb", "ids", "normals"), tones=hyphened(tone))
    stream = PictureStream(config=config, crop=96, people=8, sitting=8, seed=31)
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    for one in itertools.islice(stream, PICTURES):
        normals = one["normals"].numpy()
        rotation = one["T_world_camera"].numpy()[:3, :3]
        dorsal = rotation.T @ quaternion_matrix(one["qpos"].numpy()[3:7])[:, 2]
        along = np.einsum("cij,c->ij", normals, dorsal)
        near = (one["parts"].numpy() == 1 + PALM) & (normals[2] < -0.5)
        for where, mask in (("back", near & (along > 0.8)), ("palm", near & (along < -0.8))):
            for name in ("rgb", "noisy_rgb") if mask.sum() > FEWEST else ():
                picture = np.moveaxis(one[name].numpy(), 0, 2) / np.float32(255.0)
                lab = np.median(cv2.cvtColor(picture, cv2.COLOR_RGB2Lab)[mask], axis=0)
                found.setdefault((where, name), []).append(lab)
    return {key: np.array(rows) for key, rows in found.items()}


@pytest.mark.parametrize("tone", TONES)
def test_backs_have_the_tone_that_is_named_and_palms_are_lighter(tone: str) -> None:
    seen = seen_colors(tone)
    for name in ("rgb", "noisy_rgb"):
        backs, palms = seen["back", name], seen["palm", name]
        assert min(len(backs), len(palms)) >= 10
        angle = np.median([typology_angle(lightness, yellowness) for lightness, _, yellowness in backs])
        off = angle - np.mean(TONES[tone])
        assert abs(off) < MOST_OFF[name], (
            f"{name}: the median typology angle is {off:.1f} degrees off the class's middle"
        )
        assert np.median(palms[:, 0]) > np.median(backs[:, 0]) + 0.5, name
