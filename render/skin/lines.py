"""Lines of the palm, creases of the fingers and wrinkles of the knuckles."""

from __future__ import annotations

import functools
import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from render.skin.fields import bump, smooth
from render.skin.texels import DigitTexels, skin_texels

# The palm's three lines on the reference hand [mm], (x, y) of the wrist's frame: heart, head, life.
_PALM_LINES: Final = (
    ((66.0, -37.0), (73.0, -27.0), (78.0, -14.0), (83.0, 0.0), (91.0, 12.0)),
    ((72.0, 31.0), (71.0, 20.0), (65.0, 5.0), (56.0, -10.0), (46.0, -24.0)),
    ((71.0, 31.0), (66.0, 18.0), (54.0, 8.0), (38.0, 2.0), (20.0, 1.0), (8.0, 5.0)),
)
_WRIST_LINES: Final = (-0.001, -0.009)  # across the palm's side of the wrist [m]


@functools.cache
def _palm_distances() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Texels of the palm (K,), and the distance of each palm line from them (3, K) [m]."""
    texels = skin_texels()
    near = np.flatnonzero((texels.dorsal < 0.1) & (texels.positions[:, 0] > -0.02))
    points = texels.positions[near, :2]
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


def line_depth(rng: np.random.Generator) -> NDArray[np.float64]:
    """Depth of each texel (N,) in a palm line, finger crease or knuckle wrinkle; 1 for a deep line."""
    texels = skin_texels()
    back = texels.back
    depth = np.zeros(len(back))
    near, distances = _palm_distances()
    on_palm = (1.0 - back[near]) * (
        1.0 - sum(_share_at(digit, near, len(back)) for digit in texels.digits[1:])
    )
    for distance in distances:
        wobble = rng.uniform(0.8, 1.2)
        depth[near] = np.maximum(depth[near], wobble * on_palm * bump(distance, 0.0011))
    x = texels.positions[:, 0]
    for position in _WRIST_LINES:
        depth = np.maximum(depth, 0.35 * bump(x - position, 0.0009) * (1.0 - back))
    for number, digit in enumerate(texels.digits):
        mine, joints = digit.texels, np.cumsum(digit.lengths)[:2]
        pad = 1.0 - back[mine]
        waves = 0.0006 * np.sin(3.0 * digit.angle + rng.uniform(0.0, 6.0))
        # Palmar creases lie off the joints: Bugbee and Botte 1993, Clin. Orthop. Relat. Res. 296:122.
        creases = [(joints[0] - 0.0025, 1.0), (joints[0] + 0.0004, 0.5)]
        if number:
            creases += [(joints[1] - 0.0075, 0.9), (0.017, 0.9)]
        for position, strength in creases:
            here = strength * pad * digit.share * bump(digit.along - position - waves, 0.0009)
            depth[mine] = np.maximum(depth[mine], here)
        for joint, count, spacing in ((joints[0], 5, 0.0020), (joints[1], 4, 0.0014)):
            positions = (
                joint + spacing * (np.arange(count) - (count - 1) / 2) + rng.normal(0.0, 0.0003, count)
            )
            arch = 0.0015 * np.cos(digit.angle)  # wrinkles are curved
            for number_here, position in enumerate(positions):
                bow = arch * (number_here - (count - 1) / 2) / count * 2.0
                here = 0.55 * back[mine] * digit.share * bump(digit.along - position - bow, 0.0006)
                depth[mine] = np.maximum(depth[mine], here * smooth(np.cos(digit.angle), -0.1, 0.6))
    return depth


def _share_at(digit: DigitTexels, texels: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    share = np.zeros(count)
    share[digit.texels] = digit.share
    return share[texels]
