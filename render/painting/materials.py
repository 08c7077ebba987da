"""`Material`, how a surface reflects light, and the materials of skin, markers and rigid bodies."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray

if TYPE_CHECKING:
    from render.skin.texture import SkinTexture


MARKER_COLOR: Final = (0.98, 0.98, 1.0)
_SCATTER: Final = (0.30, 0.13, 0.08)
"""Of skin: red light travels farthest in it (Jensen et al. 2001: mean free paths of 3.7, 1.4 and 0.7 mm)."""
_FOLDS: Final = 0.85  # strength of ambient shade; below 1, because lamps light folds in part


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How a surface reflects light: the microfacet model of glTF 2.0, without metals."""

    color: Float[np.ndarray, "3"]
    """Linear light."""
    roughness: float
    """From 0 (mirror) to 1 (chalk)."""
    glow: float = 0.0
    """Emitted light, as a share of its color."""
    scatter: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Light that travels under the surface, for red, green and blue: cosine beyond grazing at which lamps
    still light it."""
    texels: UInt8[np.ndarray, "H W 8"] | None = None
    """Factors on the above, the top row first: sRGB, roughness (255 for 1), normals over the surface's own
    (0 for -1, 255 for 1) in the axes along u and normal x that, and nothing."""


def linear(color: Float[np.ndarray, "*batch 3"] | tuple[float, float, float]) -> NDArray[np.float64]:
    """Linear light of an sRGB color, with the plain 2.2 power that pyrender's shader undoes."""
    return np.asarray(color, dtype=np.float64) ** 2.2


def plain_material(color: tuple[float, float, float]) -> Material:
    """A surface of one color, such as plastic."""
    return Material(linear(color), 0.5)


@functools.cache
def ball_material() -> Material:
    """Markers, colored by vertex; they glow a little, to stay visible in shadows."""
    return Material(np.ones(3), 0.45, glow=0.2)


def skin_material(texture: SkinTexture) -> Material:
    """Painted skin, for meshes with `DrawnSkin.uv`."""
    nothing = np.zeros_like(texture.roughness)
    texels = np.dstack([texture.color, texture.roughness, texture.normals, nothing])
    return Material(np.ones(3), 1.0, scatter=np.array(_SCATTER), texels=texels)


def shade_colors(shade: Float32[np.ndarray, "D"]) -> Float32[np.ndarray, "D 4"]:
    """Vertex colors for `DrawnSkin.shade`: red light passes through flesh into the folds."""
    colors = np.ones((len(shade), 4), dtype=np.float32)
    lit = 1.0 - _FOLDS * (1.0 - shade)
    for channel, power in enumerate((0.8, 1.0, 1.05)):
        colors[:, channel] = cv2.pow(lit, power).reshape(-1)
    return colors
