"""Depth by time of flight: Kinect v2 and Azure Kinect.

Noise grows with distance and angle, pixels at edges see two surfaces at once, and what sends back too little
light is not measured.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from render.sensors.random_images import normal_numbers

_WALL: Final = 0.8  # reflectance of the white walls that noise was published for
_BANDS: Final = 1024  # of cosines in the tables below
_FADING: Final = 0.09  # [rad] over which surfaces go before the steepest
_NOTHING: Final = np.float32(1e6)


@dataclass(frozen=True, slots=True)
class TimeOfFlight:
    """Noise of a time-of-flight sensor; see `docs/sensors.md` for the sources of the numbers."""

    sensor: str = "kinect2"
    sigma: tuple[float, float, float] = (1.5e-3, -0.5e-3, 0.3e-3)
    """Standard deviation c0 + c1 z + c2 z^2 of a white wall that faces, depth z in meters [m]."""
    angle_sigma: float = 0.1e-3
    """What is added at an angle a, times z^1.5 (a / (pi/2 - a))^2 [m]."""
    offset: float = 0.0
    """Added to every depth [m]."""
    edge: float = 0.03
    """Step between neighboring pixels that makes an edge, as a share of the depth."""
    flying: float = 0.5
    """Share of pixels along edges that mix both surfaces."""
    dropped: float = 0.15
    """Share of pixels along edges that are not measured."""
    weakest: float = 0.0074
    """Least light: reflectance times the angle's cosine over the squared depth [1/m^2]."""
    steepest: float = 1.48
    """Largest angle between a surface's normal and the ray that comes back [rad]."""
    step: float = 0.001
    """What depths are rounded to [m]; 0: not at all."""
    nearest: float = 0.5
    farthest: float = 4.5
    """What is measured at all [m]."""


def measure(
    depth: Float32[np.ndarray, "H W"],
    cosines: Float32[np.ndarray, "H W"] | None,
    reflectance: Float32[np.ndarray, "H W"] | None,
    noise: TimeOfFlight,
    *,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "H W"]:
    """Depth along the camera's axis as the sensor has it [m], 0 where it has none.

    Cosines are of the angles between normals and the rays that come back (None: all surfaces face),
    reflectance the share of light that surfaces send back (None: all are white walls).
    """
    there = depth > 0.0
    measured = _mixed(depth, noise, rng=rng)
    sigma = _sigma(depth, cosines, reflectance, noise)
    if sigma is not None:
        measured += sigma * normal_numbers(depth.shape, rng=rng)
    measured += np.float32(noise.offset)
    if noise.step > 0.0:
        measured = np.rint(measured * np.float32(1.0 / noise.step)) / np.float32(1.0 / noise.step)
    there &= (measured >= noise.nearest) & (measured <= noise.farthest)
    _drop_weak(there, depth, cosines, reflectance, noise, rng=rng)
    return np.where(there, measured, np.float32(0.0))


def _mixed(
    depth: NDArray[np.float32], noise: TimeOfFlight, *, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Depth with flying pixels along edges, and 0 where an edge is not measured."""
    mixed = depth.copy()
    if noise.flying + noise.dropped <= 0.0:
        return mixed
    around = np.ones((3, 3), np.uint8)
    far = cv2.dilate(depth, around)
    near = cv2.erode(np.where(depth > 0.0, depth, _NOTHING), around)
    bare = cv2.erode(depth, around) <= 0.0
    pixels = np.flatnonzero((depth > 0.0) & (bare | (far - near > np.float32(noise.edge) * depth)))
    here, near, far = depth.ravel()[pixels], near.ravel()[pixels], far.ravel()[pixels]
    fate, share = rng.random((2, len(pixels)), dtype=np.float32)
    other = np.where(here - near < far - here, far, near)
    # Light goes with the squared distance, and the phase follows the brighter part.
    mine, theirs = (1.0 - share) / here**2, share / other**2
    flown = (mine * here + theirs * other) / (mine + theirs)
    flies = (fate < noise.flying) & (far - near > noise.edge * here)
    value = np.where(flies, flown, here)
    mixed.ravel()[pixels] = np.where(fate >= 1.0 - noise.dropped, np.float32(0.0), value)
    return mixed


def _sigma(
    depth: NDArray[np.float32],
    cosines: NDArray[np.float32] | None,
    reflectance: NDArray[np.float32] | None,
    noise: TimeOfFlight,
) -> NDArray[np.float32] | None:
    """Standard deviation of each pixel [m]; None: there is none."""
    c0, c1, c2 = (np.float32(c) for c in noise.sigma)
    if not (any(noise.sigma) or noise.angle_sigma):
        return None
    sigma = (c2 * depth + c1) * depth + c0
    if cosines is not None and noise.angle_sigma > 0.0:
        bands = (cosines * np.float32(_BANDS - 1) + np.float32(0.5)).astype(np.uint16)
        sigma += depth * np.sqrt(depth) * _angle_terms(noise.angle_sigma).take(bands, mode="clip")
    if reflectance is not None:  # shot noise: as the root of the light
        sigma *= np.sqrt(np.float32(_WALL) / np.maximum(reflectance, np.float32(0.02)))
    return sigma


def _drop_weak(
    there: NDArray[np.bool_],
    depth: NDArray[np.float32],
    cosines: NDArray[np.float32] | None,
    reflectance: NDArray[np.float32] | None,
    noise: TimeOfFlight,
    *,
    rng: np.random.Generator,
) -> None:
    """Take out what is too steep and, within half of the least light above and below it, too dark."""
    if cosines is not None:
        last = np.cos(noise.steepest - _FADING)
        steep = np.flatnonzero(there & (cosines < last))
        chance = (last - cosines.ravel()[steep]) / max(last - np.cos(noise.steepest), 1e-9)
        there.ravel()[steep] = rng.random(len(steep), dtype=np.float32) > chance
    if noise.weakest <= 0.0:
        return
    light = np.float32(1.0) if reflectance is None else reflectance
    if cosines is not None:
        light = light * cosines
    dim = np.flatnonzero(there & (light < np.float32(1.5 * noise.weakest) * depth * depth))
    bright = np.broadcast_to(light, depth.shape).ravel()[dim] / depth.ravel()[dim] ** 2
    chance = 1.5 - bright / noise.weakest
    there.ravel()[dim] = rng.random(len(dim), dtype=np.float32) > chance


@functools.lru_cache(maxsize=16)
def _angle_terms(angle_sigma: float) -> NDArray[np.float32]:
    angles = np.arccos(np.linspace(0.0, 1.0, _BANDS))
    angles = np.minimum(angles, np.deg2rad(85.0))  # the formula has no end, but noise has
    return (angle_sigma * (angles / (np.pi / 2 - angles)) ** 2).astype(np.float32)
