"""Smooth functions of position that skins are painted with."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel

_MOST_KNOTS: Final = 128  # of noise, each way


def noise(
    positions: NDArray[np.float64], sizes: tuple[float, ...], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Smooth noise in space with a standard deviation of about one.

    Args:
        positions: Where to evaluate it (N, 3) [m].
        sizes: Size of the blots of each octave [m].
        rng: Source of the noise.
    """
    total = np.zeros(len(positions))
    low, high = _extent(positions)
    for size in sizes:
        count = np.minimum(np.ceil((high - low) / size).astype(int) + 2, _MOST_KNOTS)
        scale = (count - 1.001) / np.maximum(high - low, 1e-9)
        _add_octave(positions, low, scale, rng.standard_normal(count), total)
    total *= 1.6 / np.sqrt(len(sizes))
    return total


@kernel
def _extent(positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest coordinates (3,) of positions (N, 3)."""
    low, high = positions[0].copy(), positions[0].copy()
    for row in positions:
        for axis in range(3):
            low[axis] = min(low[axis], row[axis])
            high[axis] = max(high[axis], row[axis])
    return low, high


@kernel
def _add_octave(
    positions: NDArray[np.float64],
    low: NDArray[np.float64],
    scale: NDArray[np.float64],
    knots: NDArray[np.float64],
    total: NDArray[np.float64],
) -> None:
    """Add the trilinear interpolation of knots.

    Args:
        positions: Where (N, 3) [m].
        low: Position of the first knot (3,) [m].
        scale: Knots a meter, each way (3,).
        knots: Values (A, B, C), which reach over all positions.
        total: Added to (N,).
    """
    for number in range(len(positions)):
        x = (positions[number, 0] - low[0]) * scale[0]
        y = (positions[number, 1] - low[1]) * scale[1]
        z = (positions[number, 2] - low[2]) * scale[2]
        i, j, k = int(x), int(y), int(z)
        u, v, w = x - i, y - j, z - k
        near = (1.0 - w) * knots[i, j, k] + w * knots[i, j, k + 1]
        beside = (1.0 - w) * knots[i, j + 1, k] + w * knots[i, j + 1, k + 1]
        over = (1.0 - w) * knots[i + 1, j, k] + w * knots[i + 1, j, k + 1]
        far = (1.0 - w) * knots[i + 1, j + 1, k] + w * knots[i + 1, j + 1, k + 1]
        total[number] += (1.0 - u) * ((1.0 - v) * near + v * beside) + u * ((1.0 - v) * over + v * far)


def smooth(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """0 below `low`, 1 above `high`, smooth between."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    result: NDArray[np.float64] = share * share * (3.0 - 2.0 * share)
    return result


def bump(distance: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """A Gaussian bell of height 1."""
    height: NDArray[np.float64] = np.exp(-((distance / width) ** 2))
    return height
