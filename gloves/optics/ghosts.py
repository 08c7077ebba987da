"""Ghosts, points that are not markers: mirror images in shiny surfaces near the hand, stray reflections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.optics.mirrors import cameras_by_mirror, reflect
from handsim._checks import check_number, check_span
from handsim.space.rig import CameraRig

MAX_GHOSTS: Final = 4
"""Ghosts kept per frame; more are dropped at random."""
GHOST_REACH: Final = 0.1
"""Largest distance [m] of a ghost in a hand's cloud from the nearest marker; the paper clusters at 200 mm."""


@dataclass(frozen=True, slots=True)
class GhostConfig:
    """How often ghosts appear and where.

    Raises:
        ArgumentError: A number is out of range.
    """

    mirror_rate: float = 0.25
    """Share of frames with a shiny surface near the hand."""
    mirror_distance: tuple[float, float] = (0.02, 0.10)
    """Distance of the surface from the middle of the markers' box, beyond its half side [m]."""
    mirror_radius: float = 0.06
    """Radius of the shiny patch [m]."""
    reflectance: float = 0.5
    """Chance that a marker's mirror image is bright enough."""
    stray_rate: float = 0.8
    """Mean number of stray reflections per frame, Poisson distributed."""
    stray_margin: float = 0.3
    """Strays lie in the markers' box grown by this share."""

    def __post_init__(self) -> None:
        for name in ("mirror_rate", "reflectance"):
            check_number(name, getattr(self, name), 0.0, 1.0)
        for name in ("mirror_radius", "stray_rate", "stray_margin"):
            check_number(name, getattr(self, name), 0.0)
        check_span("mirror_distance", self.mirror_distance)


def sample_ghosts(
    markers: Float[np.ndarray, "T M 3"],
    rig: CameraRig,
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
    config: GhostConfig,
    *,
    min_cameras: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4 3"]:
    """Ghosts [m] of every frame, NaN where there is none.

    Args:
        markers: Marker centers in the world [m].
        segments: Axes of the capsules that block the view, in the world [m].
        min_cameras: Cameras that must see a mirror image before it is a point.
    """
    frames = len(markers)
    low, high = markers.min(axis=1), markers.max(axis=1)
    count = np.minimum(rng.poisson(config.stray_rate, frames), MAX_GHOSTS)
    uniform = rng.uniform(-config.stray_margin / 2, 1 + config.stray_margin / 2, size=(frames, MAX_GHOSTS, 3))
    strays = low[:, None] + uniform * (high - low)[:, None]
    strays[np.arange(MAX_GHOSTS) >= count[:, None]] = np.nan
    images = np.full(markers.shape, np.nan)
    shiny = np.flatnonzero(rng.random(frames) < config.mirror_rate)
    images[shiny] = _mirror_images(
        markers[shiny], rig, segments[shiny], radii, config, min_cameras=min_cameras, rng=rng
    )
    return keep_some(np.concatenate([strays, images], axis=1), rng=rng)


def _mirror_images(
    markers: NDArray[np.float64],
    rig: CameraRig,
    segments: NDArray[np.float64],
    radii: NDArray[np.float64],
    config: GhostConfig,
    *,
    min_cameras: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Mirror images (T, M, 3) that enough cameras see in the shiny patch, NaN elsewhere."""
    frames, count = markers.shape[:2]
    normal = rng.standard_normal((frames, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle = (markers.min(axis=1) + markers.max(axis=1)) / 2
    half = np.linalg.norm(markers.max(axis=1) - markers.min(axis=1), axis=1) / (2 * np.sqrt(3.0))
    distance = half + rng.uniform(*config.mirror_distance, size=frames)
    plane = middle - distance[:, None] * normal
    images = reflect(markers, plane[:, None], normal[:, None])
    images[rng.random((frames, count)) >= config.reflectance] = np.nan
    seen = cameras_by_mirror(images, plane, normal, config.mirror_radius, rig, segments, radii)
    images[seen.sum(axis=2) < min_cameras] = np.nan
    return images


def keep_some(
    candidates: Float[np.ndarray, "T N 3"], *, rng: np.random.Generator
) -> Float[np.ndarray, "T 4 3"]:
    """At most `MAX_GHOSTS` of each frame's candidates [m], chosen at random; NaN candidates come last."""
    order = rng.random(candidates.shape[:2]) + np.isnan(candidates[..., 0])
    chosen = order.argsort(axis=1)[:, :MAX_GHOSTS]
    return np.take_along_axis(candidates, chosen[..., None], axis=1)
