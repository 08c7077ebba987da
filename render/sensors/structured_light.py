"""Depth by disparity: structured light and active stereo.

After Barron and Malik (CVPR 2013), who shift pixels, add noise to the disparity and round it to eighths of
a pixel, and Bohg, Romero, Herzog and Schaal (ICRA 2014), whose matching windows fail at edges.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.sensors.random_images import normal_numbers, quantiles, random_words

_DOTS: Final = (-3, 0, 3)  # one pixel in nine is a dot, so that a window of 9 x 9 holds these
_FIXED: Final = 32.0  # disparities are compared in 1/32 px, which fit sixteen bits up to 1023 px
_SHADOW_SLACK: Final = 2.0  # [px] of disparity that a surface may differ from itself


@dataclass(frozen=True, slots=True)
class StructuredLight:
    """Noise of a disparity sensor; see `docs/sensors.md` for the sources of the numbers."""

    sensor: str = "kinect1"
    baseline: float = 0.075
    """From the camera to the projector or second camera, to its right [m]."""
    step: float = 0.125
    """What disparities are rounded to [px]; 0: not at all."""
    disparity_noise: float = 0.125 / 6
    """Standard deviation before rounding [px]."""
    shift: float = 0.5
    """Standard deviation of where a pixel's depth is taken, each way [px]; rounded to whole pixels."""
    support: float = 0.6
    """Share of a window's other dots that must agree with its middle, give or take `wavering`."""
    wavering: float = 0.15
    """Standard deviation of that share, alike in patches of 3 x 3 pixels."""
    agreement: float = 1.0
    """Largest difference of disparity inside a window [px]."""
    steepest: float = 1.4
    """Largest angle between a surface's normal and the ray that comes back [rad]."""
    shadow: bool = True
    """Whether the projector must see a surface too."""
    nearest: float = 0.4
    farthest: float = 4.0
    """What is measured at all [m]."""


def measure(
    depth: Float32[np.ndarray, "H W"],
    cosines: Float32[np.ndarray, "H W"] | None,
    noise: StructuredLight,
    focal: float,
    *,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "H W"]:
    """Depth along the camera's axis as the sensor has it [m], 0 where it has none.

    Cosines are of the angles between normals and the rays that come back (None: all surfaces face), `focal`
    is the camera's horizontal focal length [px].
    """
    scale, height, width = np.float32(noise.baseline * focal), *depth.shape
    with np.errstate(divide="ignore"):
        ideal = np.where(depth > 0.0, scale / depth, np.float32(0.0))
    kept = (depth >= noise.nearest) & (depth <= noise.farthest)
    if cosines is not None:
        kept &= cosines >= np.cos(noise.steepest)
    if noise.support > 0.0:
        coarse = normal_numbers(((height + 2) // 3, (width + 2) // 3), rng=rng)
        needed = np.ceil((len(_DOTS) ** 2 - 1) * (noise.support + noise.wavering * coarse))
        _keep_supported(ideal, needed.astype(np.int64), int(noise.agreement * _FIXED), kept)
    if noise.shadow:
        _keep_lit(ideal, kept)
    if max(noise.shift, noise.disparity_noise, noise.step) <= 0.0:
        return np.where(kept, depth, np.float32(0.0))
    moved, wavering = noise.shift > 0.0, noise.disparity_noise > 0.0
    shifts = random_words((2, height, width) if moved else (2, 0, 0), rng=rng)
    words = random_words((height, width) if wavering else (0, 0), rng=rng)
    measured = np.zeros_like(depth)
    table, least = np.float32(noise.disparity_noise) * quantiles(), np.float32(0.5 * scale / noise.farthest)
    step = np.float32(noise.step)
    _match(ideal, kept, shifts, _whole_shifts(noise.shift), words, table, step, least, scale, measured)
    return measured


def shadowed(disparity: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels that a nearer surface hides from the projector, which stands to the right in the same row.

    A pixel of disparity d is d columns further left in the projector's picture. Where several pixels fall on
    one of its columns, the nearest one is visible to it.
    """
    lit = np.ones(disparity.shape, np.bool_)
    _keep_lit(disparity, lit)
    return ~lit


@kernel
def _keep_lit(disparity: NDArray[np.float32], kept: NDArray[np.bool_]) -> None:
    """Clear what is `shadowed` of `kept` (H, W)."""
    height, width = disparity.shape
    most = (
        np.float32(np.ceil(max(disparity.max(), np.float32(0.0))) + 1.0)
        if disparity.size
        else np.float32(1.0)
    )
    first, cells = np.empty(width + int(most) + 2, np.float32), np.empty(width, np.int64)
    for row in range(height):
        first[:] = 0.0
        for column in range(width):
            near = disparity[row, column]
            cells[column] = 1 + int(np.rint(np.float32(column) - near + most))
            first[cells[column]] = max(first[cells[column]], near)
        for column in range(width):
            if kept[row, column]:  # neighbors close what rounding left open
                cell = cells[column]
                nearest = max(first[cell - 1], first[cell], first[cell + 1])
                kept[row, column] = nearest <= disparity[row, column] + np.float32(_SHADOW_SLACK)


@kernel
def _keep_supported(
    disparity: NDArray[np.float32], needed: NDArray[np.int64], most: int, kept: NDArray[np.bool_]
) -> None:
    """Clear those of `kept` (H, W) with fewer dots in the window that agree with its middle than are needed.

    `needed` is alike in patches of 3 x 3 pixels, and `most` the largest difference in 1/32 px.
    """
    height, width = disparity.shape
    fixed = np.empty((height, width), np.int16)
    for row in range(height):
        for column in range(width):
            fixed[row, column] = int(min(disparity[row, column] * np.float32(_FIXED), np.float32(32767.0)))
    for row in range(height):
        for column in range(width):
            if not kept[row, column]:
                continue
            middle, agreed = fixed[row, column], -1
            for down in _DOTS:
                for right in _DOTS:
                    i, j = min(max(row + down, 0), height - 1), min(max(column + right, 0), width - 1)
                    agreed += abs(fixed[i, j] - middle) <= most
            # Where all agree, nothing is lost.
            kept[row, column] = agreed >= min(needed[row // 3, column // 3], len(_DOTS) ** 2 - 1)


@kernel
def _match(
    disparity: NDArray[np.float32],
    kept: NDArray[np.bool_],
    shifts: NDArray[np.uint16],
    offsets: NDArray[np.int32],
    words: NDArray[np.uint16],
    noise: NDArray[np.float32],
    step: np.float32,
    least: np.float32,
    scale: np.float32,
    depth: NDArray[np.float32],
) -> None:
    """Write the depth [m] of the pixels that are kept.

    Each takes its disparity from some whole pixels away, so that no value is made up between near and far;
    then come noise and rounding. Random words pick offsets (65536,) [px] and noise (65536,) [px]; those of
    shape 0 pick none. Less than the `least` disparity is nothing.
    """
    height, width = disparity.shape
    for row in range(height):
        for column in range(width):
            if not kept[row, column]:
                continue
            i, j = row, column
            if shifts.shape[1]:
                i = min(max(row + offsets[shifts[0, row, column]], 0), height - 1)
                j = min(max(column + offsets[shifts[1, row, column]], 0), width - 1)
            value = disparity[i, j]
            if len(words):
                value += noise[words[row, column]]
            if step > 0.0:
                value = np.rint(value / step) * step
            if value > least:
                depth[row, column] = scale / max(value, np.float32(1e-6))


@functools.lru_cache(maxsize=16)
def _whole_shifts(deviation: float) -> NDArray[np.int32]:
    return np.rint(deviation * quantiles()).astype(np.int32)
