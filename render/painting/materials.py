"""What surfaces look like: skin, glove and markers. Colors are sRGB in [0, 1]."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from handsim.hand.model import HandModel
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import BONES, DIGITS
from render.painting.gl import load_pyrender

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, UInt8
    from numpy.typing import NDArray

    from render.skin.texture import SkinTexture

Covering = Literal["skin", "glove"]
BACKGROUND: Final = (0.957, 0.961, 0.969)
MARKER_COLOR: Final = (0.98, 0.98, 1.0)
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
_GL_LINEAR: Final = 0x2601
_FOLDS: Final = 0.85  # a lamp that shines into a fold lights it up in part
GLOVE_COLOR: Final = (0.235, 0.25, 0.29)
_BASE: Final = {"skin": (0.86, 0.66, 0.56), "glove": GLOVE_COLOR}
_ROUGHNESS: Final = {"skin": 0.62, "glove": 0.85}


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How a surface sends back light: the microfacet model of glTF 2.0, without metals."""

    color: Float[np.ndarray, "3"]
    """Linear light."""
    roughness: float
    """0 a mirror, 1 chalk."""
    glow: float = 0.0
    """Share of its color that it sends out by itself."""
    texels: UInt8[np.ndarray, "H W 8"] | None = None
    """Factors on the above, the top row first: sRGB, roughness (255 for 1), normals over the surface's own
    (0 for -1, 255 for 1) in the axes along u and normal x that, and nothing."""

    def for_pyrender(self) -> Any:
        """The same for pyrender.

        Raises:
            HandSimError: Drawing is impossible on this machine; the sentence says what to install.
        """
        pyrender, textures = load_pyrender(), {}
        if self.texels is not None:
            # No smaller copies of the texture: they would mix tiles that are no neighbors on the hand.
            sampler = pyrender.Sampler(magFilter=_GL_LINEAR, minFilter=_GL_LINEAR)
            rough = np.zeros((*self.texels.shape[:2], 3), dtype=np.uint8)
            rough[..., 0] = self.texels[..., 3]  # its shader looks for roughness in red and metal in green
            sources = {
                "baseColorTexture": np.ascontiguousarray(self.texels[..., :3]),
                "normalTexture": np.ascontiguousarray(self.texels[..., 4:7]),
                "metallicRoughnessTexture": rough,
            }
            textures = {
                name: pyrender.Texture(source=source, source_channels="RGB", sampler=sampler)
                for name, source in sources.items()
            }
        return pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[*self.color, 1.0],
            metallicFactor=0.0,
            roughnessFactor=self.roughness,
            emissiveFactor=np.sqrt(self.glow * self.color),  # its shader squares it
            **textures,
        )


def bone_colors() -> Float[np.ndarray, "L 3"]:
    """One color a digit, and one for the palm, in the order of `topology.BONES`."""
    colors = [_PALM_COLOR if bone.digit < 0 else _DIGIT_COLORS[bone.digit] for bone in BONES]
    return np.array(colors)


def linear(color: Float[np.ndarray, "*batch 3"] | tuple[float, float, float]) -> NDArray[np.float64]:
    """Linear light of an sRGB color, with the plain 2.2 power that pyrender's shader undoes."""
    light: NDArray[np.float64] = np.asarray(color, dtype=np.float64) ** 2.2
    return light


def covering_material(covering: Covering) -> Material:
    """Bare skin or a dark glove, of one color."""
    return Material(linear(_BASE[covering]), _ROUGHNESS[covering])


def plain_material(color: tuple[float, float, float]) -> Material:
    """A thing of one color, such as plastic."""
    return Material(linear(color), 0.5)


@functools.cache
def ball_material() -> Material:
    """Markers, colored by vertex; they glow a little, so that no shadow swallows them."""
    return Material(np.ones(3), 0.45, glow=0.2)


def skin_material(texture: SkinTexture) -> Material:
    """Painted skin, for meshes with `DrawnSkin.uv`."""
    nothing = np.zeros_like(texture.roughness)
    texels = np.dstack([texture.color, texture.roughness, texture.normals, nothing])
    return Material(np.ones(3), 1.0, texels=texels)


def shade_colors(shade: Float32[np.ndarray, "D"]) -> Float32[np.ndarray, "D 4"]:
    """Vertex colors for `DrawnSkin.shade`: red light finds its way through flesh into the folds."""
    colors = np.ones((len(shade), 4), dtype=np.float32)
    colors[:, :3] = (1.0 - _FOLDS * (1.0 - shade))[:, None] ** np.array([0.8, 1.0, 1.05], dtype=np.float32)
    return colors


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
