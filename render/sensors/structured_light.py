"""Depth by disparity: structured light and active stereo.

After Barron and Malik (CVPR 2013), who shift pixels, add noise to the disparity and round it to eighths of
a pixel, and Bohg, Romero, Herzog and Schaal (ICRA 2014), whose matching windows fail at edges.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

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
    scale = np.float32(noise.baseline * focal)
    with np.errstate(divide="ignore"):
        ideal = np.where(depth > 0.0, scale / depth, np.float32(0.0))
    kept = (depth >= noise.nearest) & (depth <= noise.farthest)
    if cosines is not None:
        kept &= cosines >= np.cos(noise.steepest)
    if noise.support > 0.0:
        kept &= _supported(ideal, noise, rng=rng)
    if noise.shadow:
        kept &= ~shadowed(ideal)
    disparity = _shifted(ideal, noise.shift, rng=rng) if noise.shift > 0.0 else ideal
    if noise.disparity_noise > 0.0:
        disparity = disparity + np.float32(noise.disparity_noise) * normal_numbers(depth.shape, rng=rng)
    if noise.step > 0.0:
        disparity = np.rint(disparity / np.float32(noise.step)) * np.float32(noise.step)
    elif disparity is ideal:  # nothing to round and nothing to add: the depth itself
        return np.where(kept, depth, np.float32(0.0))
    kept &= disparity > 0.5 * scale / noise.farthest
    return np.where(kept, scale / np.maximum(disparity, np.float32(1e-6)), np.float32(0.0))


def shadowed(disparity: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels that a nearer surface hides from the projector, which stands to the right in the same row.

    A pixel of disparity d is d columns further left in the projector's picture. Where several pixels fall on
    one of its columns, the nearest one is visible to it.
    """
    height, width = disparity.shape
    most = int(np.ceil(disparity.max(initial=0.0))) + 1
    columns = np.arange(width, dtype=np.float32) - disparity + np.float32(most)
    cells = np.rint(columns).astype(np.intp)
    cells += np.arange(height)[:, None] * (width + most)
    first = np.zeros((height, width + most), np.float32)
    np.maximum.at(first.ravel(), cells.ravel(), disparity.ravel())
    first = cv2.dilate(first, np.ones((1, 3), np.uint8))  # close what rounding left open
    hidden: NDArray[np.bool_] = first.ravel().take(cells) > disparity + np.float32(_SHADOW_SLACK)
    return hidden


def _supported(
    disparity: NDArray[np.float32], noise: StructuredLight, *, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Where enough of the window's dots agree with its middle."""
    height, width = disparity.shape
    fixed = np.minimum(disparity * np.float32(_FIXED), np.float32(32767.0)).astype(np.int16)
    wide = cv2.copyMakeBorder(fixed, 3, 3, 3, 3, cv2.BORDER_REPLICATE)
    most = np.int16(noise.agreement * _FIXED)
    agreed = np.zeros((height, width), np.uint8)
    for down in _DOTS:
        for right in _DOTS:
            if down or right:
                other = wide[3 + down : 3 + down + height, 3 + right : 3 + right + width]
                agreed += cv2.absdiff(fixed, other) <= most
    coarse = normal_numbers(((height + 2) // 3, (width + 2) // 3), rng=rng)
    needed = 8.0 * (noise.support + noise.wavering * coarse)
    most_needed = np.clip(np.ceil(needed), 0, 8).astype(np.uint8)  # where all agree, nothing is lost
    patches = cv2.resize(most_needed, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
    enough: NDArray[np.bool_] = agreed >= patches[:height, :width]
    return enough


def _shifted(
    picture: NDArray[np.float32], deviation: float, *, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Each pixel taken from some whole pixels away: no value is made up between near and far."""
    height, width = picture.shape
    offsets = _whole_shifts(deviation)
    words = random_words((2, height, width), rng=rng)
    rows = np.arange(height, dtype=np.int32)[:, None] + offsets.take(words[0], mode="clip")
    columns = np.arange(width, dtype=np.int32) + offsets.take(words[1], mode="clip")
    np.clip(rows, 0, height - 1, out=rows)
    np.clip(columns, 0, width - 1, out=columns)
    rows *= width
    rows += columns
    moved: NDArray[np.float32] = picture.ravel().take(rows)
    return moved


@functools.lru_cache(maxsize=16)
def _whole_shifts(deviation: float) -> NDArray[np.int32]:
    return np.rint(deviation * quantiles()).astype(np.int32)
