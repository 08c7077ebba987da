"""A skin's colors and roughness as a texture, painted on the map of `render.skin.texels`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from render.skin.atlas import skin_atlas
from render.skin.fields import bump, noise, smooth
from render.skin.forearm import CUFF, Forearm
from render.skin.look import SkinLook
from render.skin.relief import normal_map, relief
from render.skin.texels import behind_wrist, line_depth, skin_texels

if TYPE_CHECKING:
    from handsim.hand.shape import Side


_SHADED: Final = 0.006  # [m] of skin before a sleeve that lie in its shadow
_SHADE: Final = 0.4  # of the lightness that is missing in it
_FOLD: Final = 0.002  # [m] high folds of a sleeve
_CREASE: Final = (-0.012, 0.035)  # [m] behind the wrist, where the palm's skin ends
_VEIN: Final = 0.0017  # [m] half as wide as a vein
_UNEVEN: Final = np.float32(0.03)  # [m] of that border, where the border of pigment has 1
_GRAIN: Final = 4.5e-5  # [m] of the skin's own relief, which breaks its gloss: furrows are 20 to 100 um deep
_GRAIN_SIZES: Final = (0.0032, 0.0016, 0.0009)  # [m]
_MATT_GRAIN: Final = np.float32(0.05)  # of the roughness: ridges are drier than furrows
_INNER_ARM: Final = 0.8  # pigment of the inner forearm, where the back of the hand has 1


class SkinTexture(NamedTuple):
    """Texture of `DrawnSkin.uv`, its top row first."""

    color: UInt8[np.ndarray, "H W 3"]
    """sRGB."""
    roughness: UInt8[np.ndarray, "H W"]
    """Roughness of the microfacet model, 255 for 1."""
    normals: UInt8[np.ndarray, "H W 3"]
    """Relief over the drawn normals, see `render.skin.relief.normal_map`."""


class _Paint(NamedTuple):
    """Color, roughness and height of each texel; all three are written."""

    lab: NDArray[np.float32]
    """CIELAB."""
    roughness: NDArray[np.float32]
    height: NDArray[np.float32]
    """Height of the relief (N,) [m]."""


class _Blood(NamedTuple):
    """What blood in the skin adds to CIELAB (N, 3) at a flush of 1."""

    fixed: NDArray[np.float32]
    knuckles: NDArray[np.float32]
    """Where knuckles are darker (N,), which depends on the skin."""


class _Nail(NamedTuple):
    """The texels (K,) of a nail and its fold."""

    texels: NDArray[np.int64]
    plate: NDArray[np.float32]
    """Share of the nail (K,)."""
    fold: NDArray[np.float32]
    """Depth of the fold around it (K,)."""
    moon: NDArray[np.float32]
    """What its moon and its free edge add to CIELAB (K, 3)."""


def skin_texture(look: SkinLook, forearm: Forearm | None = None, *, side: Side = "right") -> SkinTexture:
    """Paint a skin; equal looks give equal texels.

    Args:
        forearm: Forearm whose sleeve is painted too.
        side: Side of the hand; colors are equal on both.
    """
    color, roughness, height = _painted(look, forearm)
    return SkinTexture(color, roughness, normal_map(height, side))


@functools.lru_cache(maxsize=2)  # both hands of a person share it
def _painted(
    look: SkinLook, forearm: Forearm | None
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"], NDArray[np.float32]]:
    """Color, roughness and height of the relief."""
    texels, rng = skin_texels(), np.random.default_rng(look.seed)
    # Pigment fades over the sides of fingers and hand, unevenly; relief ends sooner.
    edge = 0.10 * noise(texels.positions, (0.02, 0.006), rng=rng)
    pigment = smooth(texels.facing.astype(np.float32) + edge, -0.8, 0.55)
    # A palm's skin ends at the wrist's crease: the inner forearm is nearly as dark as the outer.
    behind = smooth(edge * _UNEVEN - texels.positions[:, 0].astype(np.float32), *_CREASE)
    pigment = np.maximum(pigment, np.float32(_INNER_ARM) * behind)
    # The palm of a dark hand is not redder or yellower than other palms: chroma depends on the pigment.
    bare = np.array([look.palm_lightness, 15.0, 16.0])
    whole = np.array([look.lightness, look.redness, look.yellowness])
    lab = bare.astype(np.float32) + pigment[:, None] * (whole - bare).astype(np.float32)
    blood = _blood()
    lab += np.float32(look.flush) * blood.fixed
    lab[:, 0] += np.float32(look.flush * (-1.5 - 0.06 * max(0.0, 60.0 - look.lightness))) * blood.knuckles
    veins = _veins(rng)
    _add(lab, look.veins * veins, (-1.6, -1.6, -2.2))
    blotches = noise(texels.positions, (0.05, 0.018, 0.007, 0.003), rng=rng)
    _add(lab, look.blotches * blotches, (1.0, -0.6, 0.2))
    weight = 0.8 + 0.3 * noise(texels.positions, (0.014, 0.005), rng=rng)
    lines = np.clip(line_depth(rng) * np.clip(weight, 0.2, 1.2), 0.0, 1.0)
    # Pigment collects in the lines; their darkness depends on the contrast that the skin allows.
    _add(lab, look.creases * lines, (-9.5, 4.0, 0.5))
    height = look.relief * relief() - 0.0004 * look.creases * lines + 0.00008 * look.veins * veins
    grain = noise(texels.positions, _GRAIN_SIZES, rng=rng)
    height += look.relief * _GRAIN * grain
    rough = np.minimum(look.roughness + 0.1 * (1.0 - texels.back), 1.0).astype(np.float32)
    rough += _MATT_GRAIN * np.clip(grain, -1.5, 1.5)
    paint = _Paint(lab, rough, height.astype(np.float32))
    _paint_nails(paint, look)
    if forearm is not None and forearm.sleeve < forearm.length:
        _sleeve(paint, forearm, rng)
    width, rows = skin_atlas().size
    roughness = np.rint(np.float32(255.0) * paint.roughness).astype(np.uint8).reshape(rows, width)
    return lab_to_srgb(paint.lab.reshape(rows, width, 3)), roughness, paint.height


def _add(lab: NDArray[np.float32], share: NDArray[Any], color: tuple[float, float, float]) -> None:
    """Add a share (N,) of a color to each texel's (N, 3)."""
    for channel, value in enumerate(color):
        lab[:, channel] += np.float32(value) * share


def lab_to_srgb(lab: NDArray[Any]) -> UInt8[np.ndarray, "H W 3"]:
    """SRGB of CIELAB colors (D65), clipped to the gamut of sRGB."""
    rgb = cv2.cvtColor(np.asarray(lab, dtype=np.float32), cv2.COLOR_Lab2RGB)
    color: NDArray[np.uint8] = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
    return color


@functools.cache
def _blood() -> _Blood:
    """Blood in the finger tips, knuckles and balls of the hand; knuckles are darker, too."""
    texels = skin_texels()
    back = texels.back
    lab, knuckles = np.zeros((len(back), 3)), np.zeros(len(back))
    for number, digit in enumerate(texels.digits):
        first, middle, end = np.cumsum(digit.lengths)
        mine = digit.texels
        tips = smooth(digit.along, middle, end) * digit.share
        lab[mine] += tips[:, None] * [-1.0, 4.0, 0.0]
        for joint, width in ((0.0, 0.010), (first, 0.0075), (middle, 0.006)):
            if number == 0 and joint == 0.0:
                continue  # the thumb's first joint lies deep under the skin
            knuckle = bump(digit.along - joint, width) * back[mine] * np.abs(np.cos(digit.angle / 2))
            lab[mine] += knuckle[:, None] * [0.0, 1.8, 0.3]
            knuckles[mine] += knuckle
    x, y = 1e3 * texels.positions[:, 0], 1e3 * texels.positions[:, 1]
    palm = 1.0 - back
    hollow = np.exp(-(((x - 50.0) / 22.0) ** 2) - (((y + 2.0) / 14.0) ** 2)) * palm
    lab += hollow[:, None] * [1.0, -3.0, 0.8]
    balls = np.exp(-(((x - 88.0) / 9.0) ** 2)) * palm
    balls += np.exp(-(((x - 35.0) / 22.0) ** 2) - (((y + 30.0) / 11.0) ** 2)) * palm
    lab += balls[:, None] * [-0.5, 2.2, 0.0]
    return _Blood(lab.astype(np.float32), knuckles.astype(np.float32))


def _veins(rng: np.random.Generator) -> NDArray[np.float32]:
    """Visibility of veins at each texel (N,): three of them wind along the back of hand and forearm."""
    near, x, y, back = _vein_texels()
    veins = np.zeros(len(skin_texels().back), dtype=np.float32)
    for start in (0.016, -0.004, -0.022):
        knots = np.linspace(-0.17, 0.09, 9)
        course = start + np.cumsum(rng.normal(0.0, 0.0035, 9)) - 0.006
        away = y - np.interp(x, knots, course).astype(np.float32)
        (close,) = np.nonzero(np.abs(away) < 4.0 * _VEIN)
        rows = near[close]
        veins[rows] = np.maximum(veins[rows], back[close] * bump(away[close], np.float32(_VEIN)))
    return veins


@functools.cache
def _vein_texels() -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Texels (K,) that may have veins, their x and y [m] and how far they are on the back (K,)."""
    texels = skin_texels()
    x, y, back = (values.astype(np.float32) for values in (*texels.positions[:, :2].T, texels.back))
    near = np.flatnonzero((back > 0.5) & (x > -0.16) & (x < 0.085))
    return near, x[near], y[near], back[near]


@functools.cache
def _nails() -> tuple[_Nail, ...]:
    """The nails: where they are, and what does not depend on the skin."""
    nails = []
    for number, digit in enumerate(skin_texels().digits):
        joint, tip = np.cumsum(digit.lengths)[1:]
        start, end = joint + 0.34 * (tip - joint), tip - 0.0012
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        wide = 1.0 if number else 1.12
        a = (digit.along - middle) / half
        b = digit.angle / wide
        where = np.abs(b) < 1.6
        shape = (np.abs(a) ** 3.2 + np.abs(b) ** 3.2) ** (1 / 3.2)
        plate = (1.0 - smooth(shape, 0.93, 1.03)) * where
        fold = bump(shape - 1.06, 0.085) * where * (a < 0.75)
        moon = (bump(a + 1.0, 0.42) * bump(b, 0.55))[:, None] * [4.0, -4.0, -1.0]
        moon += smooth(a, 0.72, 0.86)[:, None] * [8.0, -7.0, 1.0]
        near = np.flatnonzero((plate > 0.0) | (fold > 1e-4))
        parts = (part[near].astype(np.float32) for part in (plate, fold, moon))
        nails.append(_Nail(digit.texels[near], *parts))
    return tuple(nails)


def _paint_nails(paint: _Paint, look: SkinLook) -> None:
    """Nail plates: pinker and smoother than the skin, a pale moon, a whiter free edge, and a dark fold."""
    bed = np.array([look.lightness, look.redness, look.yellowness]) * [0.6, 0.5, 0.6]
    bed += np.array([68.0, 12.0, 13.0]) * [0.4, 0.5, 0.4]  # beds hold little pigment, as palms do
    for mine, plate, fold, moon in _nails():
        color = (bed + look.nail).astype(np.float32) + moon
        color += np.float32(look.polish) * (np.array(look.polish_color, dtype=np.float32) - color)
        lab = paint.lab[mine]
        lab += plate[:, None] * (color - lab)
        _add(lab, look.creases * fold, (-7.0, 4.0, 0.0))
        paint.lab[mine] = lab
        paint.roughness[mine] += plate * (np.float32(0.28) - paint.roughness[mine])
        paint.height[mine] *= 1.0 - plate
        paint.height[mine] += 0.00025 * plate - 0.00035 * fold


def _sleeve(paint: _Paint, forearm: Forearm, rng: np.random.Generator) -> None:
    """Cloth from some way behind the wrist on, with folds as darker and lighter bands."""
    behind = behind_wrist(forearm).astype(np.float32) - np.float32(forearm.sleeve)
    cloth = smooth(behind, 0.0, CUFF)
    color = cv2.cvtColor(np.array([[forearm.sleeve_color]], dtype=np.float32), cv2.COLOR_RGB2Lab)[0, 0]
    folds = noise(skin_texels().positions * [0.5, 1.0, 1.0], (0.03, 0.012), rng=rng)
    for channel in range(3):
        painted = color[channel] + (4.0 * folds if channel == 0 else 0.0)
        paint.lab[:, channel] += cloth * (painted - paint.lab[:, channel])
    inside = smooth(behind, -_SHADED, 0.0) * (1.0 - smooth(behind, 0.5 * CUFF, CUFF))
    paint.lab[:, 0] *= 1.0 - np.float32(_SHADE) * inside
    paint.roughness[:] += cloth * (0.9 - paint.roughness)
    paint.height[:] += cloth * (np.float32(_FOLD) * folds - paint.height)
