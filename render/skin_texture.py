"""A skin's colours and roughness as a texture, painted on the map of `render.skin_texels`."""

from __future__ import annotations

import functools
import itertools
from typing import TYPE_CHECKING, Final, NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from render.forearm import Forearm
from render.skin_atlas import skin_atlas
from render.skin_look import SkinLook
from render.skin_texels import REFERENCE, DigitTexels, skin_texels

if TYPE_CHECKING:
    from jaxtyping import UInt8
    from numpy.typing import NDArray

_GRID: Final = 24  # knots of the noise along its longest side
# The palm's three lines on the reference hand [mm], (x, y) of the wrist's frame: heart, head, life.
_PALM_LINES: Final = (
    ((66.0, -37.0), (73.0, -27.0), (78.0, -14.0), (83.0, 0.0), (91.0, 12.0)),
    ((72.0, 31.0), (71.0, 20.0), (65.0, 5.0), (56.0, -10.0), (46.0, -24.0)),
    ((71.0, 31.0), (66.0, 18.0), (54.0, 8.0), (38.0, 2.0), (20.0, 1.0), (8.0, 5.0)),
)
_WRIST_LINES: Final = (-0.001, -0.009)  # across the palm's side of the wrist [m]


class SkinTexture(NamedTuple):
    """Texture of `DrawnSkin.uv`, its top row first."""

    color: UInt8[np.ndarray, "H W 3"]
    """sRGB."""
    roughness: UInt8[np.ndarray, "H W"]
    """Roughness of the microfacet model, 255 for 1."""


def skin_texture(look: SkinLook, forearm: Forearm | None = None) -> SkinTexture:
    """Paint a skin; the same look gives the same texels.

    Args:
        look: The skin.
        forearm: Its sleeve is painted too.
    """
    texels, rng = skin_texels(), np.random.default_rng(look.seed)
    back = _smooth(texels.dorsal, -0.25, 0.35)
    lab = np.empty((len(back), 3))
    lab[:, 0] = look.palm_lightness + back * (look.lightness - look.palm_lightness)
    # The palm of a dark hand is no redder or yellower than other palms: chroma goes with the pigment.
    lab[:, 1] = 13.0 + back * (look.redness - 13.0)
    lab[:, 2] = 16.0 + back * (look.yellowness - 16.0)
    _flush(lab, back, look)
    _veins(lab, back, look, rng)
    blotches = noise(texels.places, (0.05, 0.018, 0.007), rng=rng)
    lab += look.blotches * blotches[:, None] * [1.6, -1.0, 0.3]
    lines = np.clip(_lines(back, rng), 0.0, 1.0)[:, None]
    # Pigment gathers in the lines; how dark they are goes with the contrast that the skin has room for.
    lab += look.creases * lines * [-7.0, 3.0, 0.5]
    roughness = np.full(len(back), look.roughness)
    _nails(lab, roughness, look)
    if forearm is not None and forearm.sleeve < forearm.length:
        _sleeve(lab, roughness, forearm, rng)
    width, height = skin_atlas().size
    color = lab_to_srgb(lab.reshape(height, width, 3))
    return SkinTexture(color, np.rint(255.0 * roughness).astype(np.uint8).reshape(height, width))


def lab_to_srgb(lab: NDArray[np.float64]) -> UInt8[np.ndarray, "H W 3"]:
    """SRGB of CIELAB colours (D65), cut to what sRGB holds."""
    rgb = cv2.cvtColor(lab.astype(np.float32), cv2.COLOR_Lab2RGB)
    color: NDArray[np.uint8] = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
    return color


def noise(
    places: NDArray[np.float64], sizes: tuple[float, ...], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Smooth noise in space of about unit spread, one octave for each size of its blots [m]."""
    total = np.zeros(len(places))
    low, high = places.min(axis=0), places.max(axis=0)
    for size in sizes:
        count = np.minimum(np.ceil((high - low) / size).astype(int) + 2, 4 * _GRID)
        knots = rng.standard_normal(count)
        at = (places - low) / np.maximum(high - low, 1e-9) * (count - 1.001)
        total += ndimage.map_coordinates(knots, at.T, order=1, mode="nearest")
    scaled: NDArray[np.float64] = total * (1.6 / np.sqrt(len(sizes)))
    return scaled


def _smooth(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """0 below `low`, 1 above `high`, smooth between."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    result: NDArray[np.float64] = share * share * (3.0 - 2.0 * share)
    return result


def _bump(distance: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    bump: NDArray[np.float64] = np.exp(-((distance / width) ** 2))
    return bump


def _flush(lab: NDArray[np.float64], back: NDArray[np.float64], look: SkinLook) -> None:
    """Blood in the finger tips, knuckles and balls of the hand; knuckles are darker, too."""
    texels = skin_texels()
    for digit in texels.digits:
        _, middle, _ = ends = np.cumsum(digit.lengths)
        mine = digit.texels
        tips = _smooth(digit.along, middle, ends[2]) * digit.share
        lab[mine] += look.flush * tips[:, None] * [-1.0, 4.0, 0.0]
        for joint, width in zip((0.0, ends[0], middle), (0.010, 0.0075, 0.006), strict=True):
            if digit.lengths is texels.digits[0].lengths and joint == 0.0:
                continue  # the thumb's first joint lies deep under the skin
            knuckle = _bump(digit.along - joint, width) * back[mine] * np.abs(np.cos(digit.turn / 2))
            darker = -1.5 - 0.06 * max(0.0, 60.0 - look.lightness)
            lab[mine] += look.flush * knuckle[:, None] * [darker, 1.8, 0.3]
    x, y = 1e3 * texels.places[:, 0], 1e3 * texels.places[:, 1]
    palm = 1.0 - back
    hollow = np.exp(-(((x - 50.0) / 22.0) ** 2) - (((y + 2.0) / 14.0) ** 2)) * palm
    lab += look.flush * hollow[:, None] * [1.0, -3.0, 0.8]
    balls = np.exp(-(((x - 88.0) / 9.0) ** 2)) * palm
    balls += np.exp(-(((x - 35.0) / 22.0) ** 2) - (((y + 30.0) / 11.0) ** 2)) * palm
    lab += look.flush * balls[:, None] * [-0.5, 2.2, 0.0]


def _veins(
    lab: NDArray[np.float64], back: NDArray[np.float64], look: SkinLook, rng: np.random.Generator
) -> None:
    """Three or four winding veins under the back of the hand, bluer and a little darker."""
    texels = skin_texels()
    x, y = texels.places[:, 0], texels.places[:, 1]
    near = np.flatnonzero((back > 0.5) & (x > -0.16) & (x < 0.085))
    x, y = x[near], y[near]
    total = np.zeros(len(near))
    for start in (0.016, -0.004, -0.022):
        knots = np.linspace(-0.17, 0.09, 9)
        course = start + np.cumsum(rng.normal(0.0, 0.0035, 9)) - 0.006
        total = np.maximum(total, _bump(y - np.interp(x, knots, course), 0.0017))
    lab[near] += look.veins * (total * back[near])[:, None] * [-1.6, -1.6, -2.2]


@functools.cache
def _palm_distances() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Texels of the palm, and how far each of the palm's lines is from them [m]."""
    texels = skin_texels()
    near = np.flatnonzero((texels.dorsal < 0.1) & (texels.places[:, 0] > -0.02))
    points = texels.places[near, :2]
    distances = np.full((len(_PALM_LINES), len(near)), np.inf)
    for number, line in enumerate(_PALM_LINES):
        knots = 1e-3 * np.array(line)
        fine = np.linspace(0.0, len(knots) - 1.0, 10 * len(knots))
        knots = np.stack([np.interp(fine, np.arange(len(knots)), knots[:, i]) for i in range(2)], axis=1)
        knots = ndimage.gaussian_filter1d(knots, 4.0, axis=0, mode="nearest")
        for a, b in itertools.pairwise(knots):
            along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
            distances[number] = np.minimum(
                distances[number], np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)
            )
    return near, distances


def _lines(back: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """How deep in a line of the palm, a crease of a finger or a wrinkle of a knuckle each texel lies."""
    texels = skin_texels()
    depth = np.zeros(len(back))
    near, distances = _palm_distances()
    on_palm = (1.0 - back[near]) * (
        1.0 - sum(_share_at(digit, near, len(back)) for digit in texels.digits[1:])
    )
    for distance in distances:
        wobble = rng.uniform(0.8, 1.2)
        depth[near] = np.maximum(depth[near], wobble * on_palm * _bump(distance, 0.0011))
    x = texels.places[:, 0]
    for place in _WRIST_LINES:
        depth = np.maximum(depth, 0.35 * _bump(x - place, 0.0009) * (1.0 - back))
    for number, digit in enumerate(texels.digits):
        mine, joints = digit.texels, np.cumsum(digit.lengths)[:2]
        pad = 1.0 - back[mine]
        waves = 0.0006 * np.sin(3.0 * digit.turn + rng.uniform(0.0, 6.0))
        creases = [(joints[0], 1.0), (joints[0] + 0.0024, 0.6), (joints[1] - 0.001, 0.9)]
        if number:
            creases.append((0.47 * digit.lengths[0], 0.9))
        for place, strength in creases:
            here = strength * pad * digit.share * _bump(digit.along - place - waves, 0.0009)
            depth[mine] = np.maximum(depth[mine], here)
        for joint, count, spacing in ((joints[0], 5, 0.0020), (joints[1], 4, 0.0014)):
            places = joint + spacing * (np.arange(count) - (count - 1) / 2) + rng.normal(0.0, 0.0003, count)
            arch = 0.0015 * np.cos(digit.turn)  # wrinkles bow
            for number_here, place in enumerate(places):
                bow = arch * (number_here - (count - 1) / 2) / count * 2.0
                here = 0.55 * back[mine] * digit.share * _bump(digit.along - place - bow, 0.0006)
                depth[mine] = np.maximum(depth[mine], here * _smooth(np.cos(digit.turn), -0.1, 0.6))
    return depth


def _share_at(digit: DigitTexels, texels: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    share = np.zeros(count)
    share[digit.texels] = digit.share
    return share[texels]


def _nails(lab: NDArray[np.float64], roughness: NDArray[np.float64], look: SkinLook) -> None:
    """Nail plates: pinker and smoother than the skin, a pale moon, a whiter free edge, and a dark fold."""
    for number, digit in enumerate(skin_texels().digits):
        joint, tip = np.cumsum(digit.lengths)[1:]
        start, end = joint + 0.42 * (tip - joint), tip - 0.0012
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        wide = 1.0 if number else 1.12
        a = (digit.along - middle) / half
        b = digit.turn / wide
        where = np.abs(b) < 1.6
        shape = (np.abs(a) ** 3.2 + np.abs(b) ** 3.2) ** (1 / 3.2)
        plate = (1.0 - _smooth(shape, 0.93, 1.03)) * where
        fold = _bump(shape - 1.06, 0.085) * where * (a < 0.75)
        mine = digit.texels
        bed = np.array([look.lightness, look.redness, look.yellowness]) * [0.35, 0.5, 0.6]
        bed += np.array([68.0, 12.0, 13.0]) * [0.65, 0.5, 0.4]  # beds hold little pigment, as palms do
        color = np.broadcast_to(bed + look.nail, (len(mine), 3)).copy()
        color += (_bump(a + 1.0, 0.42) * _bump(b, 0.55))[:, None] * [4.0, -4.0, -1.0]
        color += _smooth(a, 0.72, 0.86)[:, None] * [8.0, -7.0, 1.0]
        color += look.polish * (np.array(look.polish_color) - color)
        lab[mine] += plate[:, None] * (color - lab[mine]) + (look.creases * fold)[:, None] * [-7.0, 4.0, 0.0]
        roughness[mine] += plate * (0.28 - roughness[mine])


def _sleeve(
    lab: NDArray[np.float64], roughness: NDArray[np.float64], forearm: Forearm, rng: np.random.Generator
) -> None:
    """Cloth from some way behind the wrist on, with folds as darker and lighter bands."""
    places = skin_texels().places
    reach = -places[:, 0] * forearm.length / REFERENCE.length
    cloth = _smooth(reach, forearm.sleeve - 0.0015, forearm.sleeve + 0.0015)
    color = cv2.cvtColor(np.array([[forearm.sleeve_color]], dtype=np.float32), cv2.COLOR_RGB2Lab)[0, 0]
    folds = noise(places * [0.5, 1.0, 1.0], (0.03, 0.012), rng=rng)
    hem = _bump(reach - forearm.sleeve, 0.0025)
    painted = color + (4.0 * folds - 9.0 * hem)[:, None] * [1.0, 0.0, 0.0]
    lab += cloth[:, None] * (painted - lab)
    roughness += cloth * (0.9 - roughness)
