"""The placement of marker names in a drawing, where they cover neither dots nor arrows nor each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

FONT_SIZE: Final = 7.5
"""Of names [points]."""
DOT_RADIUS: Final = 4.2
"""Of a marker's dot [points]."""
DISTANCES: Final = (7.0, 11.0, 16.0, 23.0, 32.0, 43.0, 56.0, 72.0, 92.0)
"""Tried from a dot to its name [points]."""


def place_names(
    names: list[str],
    dots: Float[np.ndarray, "M 2"],
    curves: Sequence[Float[np.ndarray, "K 2"]],
    size: tuple[float, float],
) -> Float[np.ndarray, "M 2"]:
    """Centers of the names [points], each placed in turn where it overlaps least with what is there.

    Args:
        names: What to write.
        dots: Markers [points].
        curves: Points along the arrows [points].
        size: Width and height of the picture [points].
    """
    extents = np.array([name_extent(name) for name in names])
    taken = np.concatenate([dots, *curves])
    half_sizes = np.concatenate(
        [np.full((len(dots), 2), DOT_RADIUS + 1.0), np.full((len(taken) - len(dots), 2), 1.5)]
    )
    angles = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    centers = np.zeros_like(dots)
    crowd = np.linalg.norm(dots[:, None] - dots, axis=-1)
    # The most crowded dots come first.
    for number in np.argsort(np.sort(crowd, axis=1)[:, : min(4, len(dots))].sum(axis=1), kind="stable"):
        half = extents[number] / 2.0
        offsets = np.concatenate([around * (distance + half) for distance in DISTANCES])
        cost = np.repeat(np.array(DISTANCES), len(around)) - 2.0 * np.tile(around[:, 0], len(DISTANCES))
        candidates = dots[number] + offsets
        overlap = (half + half_sizes - np.abs(candidates[:, None] - taken)).clip(0.0, None).prod(axis=-1)
        others = np.arange(len(taken)) != number
        cost = cost + 4.0 * overlap[:, others].sum(axis=1) + 60.0 * (overlap[:, others] > 0.0).sum(axis=1)
        cost += 1e4 * ((candidates - half < 2.0) | (candidates + half > size)).any(axis=1)
        centers[number] = candidates[cost.argmin()]
        taken = np.concatenate([taken, centers[number, None]])
        half_sizes = np.concatenate([half_sizes, half[None] + 1.0])
    return centers


def name_extent(name: str) -> tuple[float, float]:
    """Width and height of a name as it is drawn [points]."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    width, _, _ = TextToPath().get_text_width_height_descent(
        name, FontProperties(size=FONT_SIZE), ismath=False
    )
    return float(width), 1.15 * FONT_SIZE
