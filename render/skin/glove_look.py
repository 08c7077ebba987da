"""A marker glove's cloth over the skin: dark, matt, with a cuff behind the wrist."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

from handsim.errors import HandSimError
from render.skin.atlas import skin_atlas
from render.skin.fields import bump, noise, smooth
from render.skin.forearm import CUFF, Forearm
from render.skin.relief import normal_map
from render.skin.texels import REFERENCE, behind_wrist, skin_texels
from render.skin.texture import SkinTexture, lab_to_srgb

if TYPE_CHECKING:
    from handsim.hand.shape import Side

GLOVE_COLOR: Final = (0.235, 0.25, 0.29)
"""Of an average glove, sRGB in [0, 1]."""


@dataclass(frozen=True, slots=True)
class GloveLook:
    """A glove's cloth in plain values.

    Raises:
        HandSimError: The cuff does not extend behind the wrist.
    """

    color: tuple[float, float, float] = GLOVE_COLOR
    """sRGB in [0, 1]."""
    cuff: float = 0.04
    """End of the cuff, behind the wrist [m]."""
    roughness: float = 0.85
    wear: float = 1.0
    """Unevenness of the cloth, 1 for a used glove."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.cuff >= 0.01:
            raise HandSimError(f"a glove's cuff {self.cuff:g} m behind the wrist, expected at least 0.01")


def sample_glove_look(*, rng: np.random.Generator) -> GloveLook:
    """A random glove: dark, as marker gloves are, so that the markers stand out."""
    gray = rng.uniform(0.05, 0.32)
    red, green, blue = np.clip(gray * np.exp(rng.normal(0.0, 0.12, 3)), 0.02, 0.4)
    return GloveLook(
        (float(red), float(green), float(blue)),
        float(rng.uniform(0.015, 0.07)),
        float(rng.uniform(0.7, 0.95)),
        float(rng.uniform(0.4, 1.4)),
        int(rng.integers(2**31)),
    )


def glove_texture(
    look: GloveLook, skin: SkinTexture, forearm: Forearm | None = None, *, side: Side = "right"
) -> SkinTexture:
    """The texture of a glove over painted skin; only the forearm behind the cuff stays visible.

    Args:
        skin: The texture of the skin under it.
        forearm: The forearm of the skin; its length scales the cuff.
    """
    texels, rng = skin_texels(), np.random.default_rng(look.seed)
    width, rows = skin_atlas().size
    arm = REFERENCE if forearm is None else forearm
    behind = behind_wrist(arm)
    lab = cv2.cvtColor(np.array([[look.color]], dtype=np.float32), cv2.COLOR_RGB2Lab)[0, 0]
    cloth = noise(texels.positions, (0.02, 0.006, 0.0025), rng=rng)
    hem = bump(behind - look.cuff + 0.004, 0.0015)
    painted = lab + (look.wear * 2.0 * cloth - 5.0 * hem)[:, None] * [1.0, 0.0, 0.0]
    height = look.wear * 1.2e-4 * cloth - 4e-4 * hem
    cloth_share = 1.0 - smooth(behind, look.cuff - 0.004, look.cuff + 0.004)
    cloth_share *= 1.0 - smooth(behind, arm.sleeve, arm.sleeve + CUFF)  # a sleeve lies over the cuff
    cloth_share = cloth_share.reshape(rows, width, 1)
    covered = cloth_share > 0.5
    cloth_color = lab_to_srgb(painted.reshape(rows, width, 3)).astype(np.float64)
    rough = np.uint8(round(255.0 * look.roughness))
    return SkinTexture(
        np.rint(skin.color + cloth_share * (cloth_color - skin.color)).astype(np.uint8),
        np.where(covered[..., 0], rough, skin.roughness),
        np.where(covered, normal_map(height, side), skin.normals),
    )
