"""Normal random numbers for whole pictures, and smooth random functions of position.

Sixteen random bits pick one of 65,536 quantiles, several times as fast as a generator of normal numbers;
tails end at 4.2 standard deviations.
"""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, UInt16
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.frames import Doubles, Floats

_KNOTS: Final = 32
"""Knots of noise along each axis, a power of two; the noise repeats after them, unnoticed on a hand."""


@functools.cache
def quantiles() -> Float32[np.ndarray, "65536"]:
    """Quantiles of the standard normal at the middle of each sixteen-bit number's share."""
    from scipy.special import ndtri

    table = ndtri((np.arange(65536) + 0.5) / 65536)
    return np.asarray((table / table.std()).astype(np.float32))


def random_words(shape: tuple[int, ...], *, rng: np.random.Generator) -> UInt16[np.ndarray, "..."]:
    """Random sixteen-bit numbers, indices of tables like `quantiles`."""
    count = math.prod(shape)
    words = rng.integers(0, 2**64, (count + 3) // 4, dtype=np.uint64)
    return words.astype("<u8", copy=False).view("<u2")[:count].reshape(shape)


def normal_numbers(shape: tuple[int, ...], *, rng: np.random.Generator) -> Float32[np.ndarray, "..."]:
    """Independent standard normal numbers."""
    numbers = np.empty(shape, np.float32)
    return quantiles().take(random_words(shape, rng=rng), mode="clip", out=numbers)


def noise(positions: Doubles, sizes: tuple[float, ...], *, rng: np.random.Generator) -> Floats:
    """Smooth noise in space with a standard deviation of about one."""
    total = np.zeros(len(positions), dtype=np.float32)
    for size in sizes:
        knots = normal_numbers((_KNOTS, _KNOTS, _KNOTS), rng=rng)
        _add_octave(positions, rng.uniform(0.0, _KNOTS, 3), 1.0 / size, knots, total)
    total *= np.float32(1.6 / np.sqrt(len(sizes)))
    return total


@kernel
def _add_octave(positions: Doubles, start: Doubles, scale: float, knots: Floats, total: Floats) -> None:
    """Add the trilinear interpolation of knots (32, 32, 32), which repeat, to `total` (N,)."""
    far = float(64 * _KNOTS)  # so that no place is negative
    for number in range(len(positions)):
        x = positions[number, 0] * scale + start[0] + far
        y = positions[number, 1] * scale + start[1] + far
        z = positions[number, 2] * scale + start[2] + far
        i, j, k = int(x), int(y), int(z)
        u, v, w = np.float32(x - i), np.float32(y - j), np.float32(z - k)
        i, j, k = i & (_KNOTS - 1), j & (_KNOTS - 1), k & (_KNOTS - 1)
        right, down, on = (i + 1) & (_KNOTS - 1), (j + 1) & (_KNOTS - 1), (k + 1) & (_KNOTS - 1)
        near = knots[i, j, k] + w * (knots[i, j, on] - knots[i, j, k])
        beside = knots[i, down, k] + w * (knots[i, down, on] - knots[i, down, k])
        over = knots[right, j, k] + w * (knots[right, j, on] - knots[right, j, k])
        far_off = knots[right, down, k] + w * (knots[right, down, on] - knots[right, down, k])
        low, high = near + v * (beside - near), over + v * (far_off - over)
        total[number] += low + u * (high - low)


def smooth(values: NDArray[Any], low: float | NDArray[Any], high: float | NDArray[Any]) -> NDArray[Any]:
    """A step from 0 below `low` to 1 above `high`, smooth between them."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def along_segment(points: Doubles, start: Doubles, end: Doubles) -> tuple[Doubles, Doubles]:
    """Positions of points (N, 2) along a segment in a plane, from 0 to 1, and their distances from it."""
    way = end - start
    along = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
    return along, np.linalg.norm(points - start - along[:, None] * way, axis=1)


def bump(distance: NDArray[Any], width: float | np.float32) -> NDArray[Any]:
    """A Gaussian bell of height 1."""
    return np.exp(-((distance / width) ** 2))
