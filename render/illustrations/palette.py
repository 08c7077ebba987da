"""Colors of ready-made pictures, sRGB in [0, 1]: paper, digits, coverings and the states of points."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, DIGITS
from handsim.hand.skin import vertex_normals
from render.painting.materials import Material, linear
from render.skin.glove_look import GLOVE_COLOR

Covering = Literal["skin", "glove"]
BACKGROUND: Final = (0.957, 0.961, 0.969)
SEEN_COLOR: Final = (0.13, 0.72, 0.33)
HIDDEN_COLOR: Final = (0.89, 0.2, 0.2)
UNLABELED_COLOR: Final = (0.5, 0.52, 0.56)
_DIGIT_COLORS: Final = (
    (0.85, 0.33, 0.1),
    (0.93, 0.66, 0.08),
    (0.15, 0.62, 0.35),
    (0.1, 0.47, 0.82),
    (0.56, 0.27, 0.68),
)
_PALM_COLOR: Final = (0.32, 0.36, 0.42)
_BASE: Final = {"skin": (0.86, 0.66, 0.56), "glove": GLOVE_COLOR}
_ROUGHNESS: Final = {"skin": 0.62, "glove": 0.85}


def bone_colors() -> Float[np.ndarray, "L 3"]:
    """One color (sRGB) per digit, and one for the palm, in the order of `topology.BONES`."""
    colors = [_PALM_COLOR if bone.digit < 0 else _DIGIT_COLORS[bone.digit] for bone in BONES]
    return np.array(colors)


def covering_material(covering: Covering) -> Material:
    """Bare skin or a dark glove, of one color."""
    return Material(linear(_BASE[covering]), _ROUGHNESS[covering])


def skin_tint(model: HandModel) -> Float[np.ndarray, "V 3"]:
    """Factors on the skin's color: redder towards the finger tips, paler on the palm's side."""
    surface = model.surface
    reddening = np.zeros(len(surface.vertices))
    for digit in range(len(DIGITS)):
        last = 3 + 3 * digit
        origin, along = model.rest_transforms[last, :3, 3], model.rest_transforms[last, :3, 0]
        share = ((surface.vertices - origin) @ along) / model.skeleton.lengths[last]
        mine = (surface.bone_weights * (surface.bone_indices == last)).sum(axis=1)
        reddening += mine * np.clip(share, 0.0, 1.0)
    pale = np.clip(-vertex_normals(surface.vertices, surface.faces)[:, 2], 0.0, 1.0)[:, None]
    paleness, redness = np.array([0.10, 0.06, 0.06]), np.array([0.0, -0.16, -0.13])
    tint: NDArray[np.float64] = 1.0 + pale * paleness + reddening[:, None] * redness
    return tint
