"""Smooth functions of position that skins are painted with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
    low, high = positions.min(axis=0), positions.max(axis=0)
    for size in sizes:
        count = np.minimum(np.ceil((high - low) / size).astype(int) + 2, _MOST_KNOTS)
        knots = rng.standard_normal(count)
        at = (positions - low) / np.maximum(high - low, 1e-9) * (count - 1.001)
        total += ndimage.map_coordinates(knots, at.T, order=1, mode="nearest")
    scaled: NDArray[np.float64] = total * (1.6 / np.sqrt(len(sizes)))
    return scaled


def smooth(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """0 below `low`, 1 above `high`, smooth between."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    result: NDArray[np.float64] = share * share * (3.0 - 2.0 * share)
    return result


def bump(distance: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """A Gaussian bell of height 1."""
    height: NDArray[np.float64] = np.exp(-((distance / width) ** 2))
    return height
