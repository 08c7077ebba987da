"""Points that are not markers: mirror images in shiny surfaces near the hand, and stray reflections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from jaxtyping import Bool, Float

from handsim.kernels import kernel, segment_distance_squared
from handsim.settings import Limits, Settings
from handsim.space.camera import in_picture
from handsim.space.rig import CameraRig
from handsim.space.transforms import unit

MAX_GHOSTS: Final = 4
"""Ghosts kept per frame; more are dropped at random."""
GHOST_REACH: Final = 0.1
"""Largest distance [m] of a ghost in a hand's cloud from the nearest marker; the paper clusters at 200 mm."""


def reflect(
    points: Float[np.ndarray, "*batch 3"],
    plane_point: Float[np.ndarray, "*batch 3"],
    plane_normal: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Mirror images of points in planes given by a point and a unit normal [m]."""
    height = np.einsum("...i,...i->...", points - plane_point, plane_normal)
    return np.asarray(points - 2.0 * height[..., None] * plane_normal)


def cameras_by_mirror(
    images: Float[np.ndarray, "T P 3"],
    plane_point: Float[np.ndarray, "T 3"],
    plane_normal: Float[np.ndarray, "T 3"],
    radius: float,
    rig: CameraRig,
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T P C"]:
    """Which cameras see which mirror image [m]: in the patch, in view, and with both legs of the path free.

    The patch is a disc with a unit normal on its shiny side [m]; capsules of these axes [m] block the view.
    """
    seen = np.zeros((*images.shape[:2], len(rig.positions)), dtype=np.bool_)
    _over_patch(images, plane_point, plane_normal, radius, rig.arrays, segments, radii, seen)
    return seen


@kernel
def _over_patch(
    images: Any, plane_point: Any, plane_normal: Any, radius: float, cameras: Any, segments: Any,
    radii: Any, seen: Any,
) -> None:  # fmt: skip
    """Write which cameras see which mirror image into `seen` (T, P, C); arguments as `cameras_by_mirror`."""
    hit, marker, camera, local = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for t in range(len(images)):
        point, normal = plane_point[t], plane_normal[t]
        for p in range(images.shape[1]):
            behind = 0.0  # how deep the image lies behind the plane
            for i in range(3):
                behind += (point[i] - images[t, p, i]) * normal[i]
            if not behind > 0.0:  # also skips missing images, whose `behind` is NaN
                continue
            for i in range(3):
                marker[i] = images[t, p, i] + 2.0 * behind * normal[i]
            for c in range(len(cameras.sizes)):
                pose = cameras.T_world_camera[c]
                ahead, off = 0.0, 0.0
                local[:] = 0.0
                for i in range(3):
                    camera[i] = pose[i, 3]
                    line = images[t, p, i] - camera[i]
                    ahead -= line * normal[i]
                    for k in range(3):
                        local[k] += line * pose[i, k]
                if ahead <= behind or not in_picture(
                    cameras.intrinsics[c], cameras.sizes[c], cameras.lenses[c], local[0], local[1], local[2]
                ):
                    continue
                for i in range(3):
                    hit[i] = images[t, p, i] + behind / ahead * (camera[i] - images[t, p, i])
                    off += (hit[i] - point[i]) ** 2
                seen[t, p, c] = (
                    off < radius * radius
                    and _clear(marker, hit, segments[t], radii)
                    and _clear(hit, camera, segments[t], radii)
                )


@kernel
def _clear(start: Any, end: Any, segments: Any, radii: Any) -> bool:
    """Whether the line between two points (3,) [m] meets no capsule (axes (K, 2, 3) and radii (K,) [m])."""
    for k in range(len(radii)):
        if segment_distance_squared(start, end, segments[k, 0], segments[k, 1]) < radii[k] * radii[k]:
            return False
    return True


@dataclass(frozen=True, slots=True)
class StrayConfig(Settings):
    """Number of reflecting spots, their positions and the duration of their flashes."""

    number: Annotated[float, Limits(0.0)] = 1.0
    """Mean number of reflecting spots, Poisson distributed."""
    reach: Annotated[float, Limits(0.0)] = 0.12
    """Spots lie within this distance of the middle of their carrier [m]."""
    shown: Annotated[float, Limits(0.0, above=True)] = 0.4
    """Mean time that a spot reflects [s]."""
    hidden: Annotated[float, Limits(0.0)] = 1.0
    """Mean time between two flashes of a spot [s]."""
    camera_share: Annotated[float, Limits(0.0, 1.0)] = 0.5
    """Share of the cameras that a spot reflects to."""


def sample_strays(
    T_world_carrier: Float[np.ndarray, "T 4 4"],
    middle: Float[np.ndarray, "3"],
    config: StrayConfig,
    *,
    rate: float,
    num_cameras: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T K 3"], Bool[np.ndarray, "T K C"]]:
    """Positions [m] of strays around the middle [m] of a carrier, and which cameras each reflects to.

    Occlusion is not tested here.
    """
    count = int(rng.poisson(config.number))
    directions = rng.standard_normal((count, 3))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    local = middle + config.reach * np.cbrt(rng.random((count, 1))) * directions
    positions = np.einsum("tij,kj->tki", T_world_carrier[:, :3, :3], local) + T_world_carrier[:, None, :3, 3]
    shining = np.zeros((len(positions), count), dtype=bool)
    for number in range(count):  # exponentially distributed times of light and dark alternate
        shown, at = rng.random() < config.shown / (config.shown + config.hidden), 0
        while at < len(positions):
            mean = config.shown if shown else config.hidden
            steps = max(1, round(rng.exponential(mean) * rate)) if mean > 0.0 else 0
            shining[at : at + steps, number] = shown
            at, shown = at + steps, not shown
    lit = rng.random((count, num_cameras)) < config.camera_share
    return positions, shining[..., None] & lit


@dataclass(frozen=True, slots=True)
class GhostConfig(Settings):
    """How often ghosts appear and where."""

    mirror_rate: Annotated[float, Limits(0.0, 1.0)] = 0.25
    """Share of frames with a shiny surface near the hand."""
    mirror_distance: Annotated[tuple[float, float], Limits(0.0, ascends=True)] = (0.02, 0.10)
    """Distance of the surface from the middle of the markers' box, beyond its half side [m]."""
    mirror_radius: Annotated[float, Limits(0.0)] = 0.06
    """Radius of the shiny patch [m]."""
    reflectance: Annotated[float, Limits(0.0, 1.0)] = 0.5
    """Chance that a marker's mirror image is bright enough."""
    stray_rate: Annotated[float, Limits(0.0)] = 0.8
    """Mean number of stray reflections per frame, Poisson distributed."""
    stray_margin: Annotated[float, Limits(0.0)] = 0.3
    """Strays lie in the markers' box grown by this share."""


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
    """Ghosts [m] of every frame near its markers [m]; NaN where there is none.

    A mirror image counts if at least `min_cameras` see it past the capsules of these axes and radii [m].
    """
    frames = len(markers)
    low, high = markers.min(axis=1), markers.max(axis=1)
    count = np.minimum(rng.poisson(config.stray_rate, frames), MAX_GHOSTS)
    uniform = rng.uniform(-config.stray_margin / 2, 1 + config.stray_margin / 2, size=(frames, MAX_GHOSTS, 3))
    strays = low[:, None] + uniform * (high - low)[:, None]
    strays[np.arange(MAX_GHOSTS) >= count[:, None]] = np.nan
    shiny = np.flatnonzero(rng.random(frames) < config.mirror_rate)
    low, high = low[shiny], high[shiny]
    normal = unit(rng.standard_normal((len(shiny), 3)))
    half = np.linalg.norm(high - low, axis=1) / (2 * np.sqrt(3.0))
    distance = half + rng.uniform(*config.mirror_distance, size=len(shiny))
    plane = (low + high) / 2 - distance[:, None] * normal
    mirrored = reflect(markers[shiny], plane[:, None], normal[:, None])
    mirrored[rng.random(mirrored.shape[:2]) >= config.reflectance] = np.nan
    seen = cameras_by_mirror(mirrored, plane, normal, config.mirror_radius, rig, segments[shiny], radii)
    mirrored[seen.sum(axis=2) < min_cameras] = np.nan
    images = np.full(markers.shape, np.nan)
    images[shiny] = mirrored
    return keep_some(np.concatenate([strays, images], axis=1), rng=rng)


def keep_some(
    candidates: Float[np.ndarray, "T N 3"], *, rng: np.random.Generator
) -> Float[np.ndarray, "T 4 3"]:
    """At most `MAX_GHOSTS` of each frame's candidates [m], chosen at random; NaN candidates come last."""
    order = rng.random(candidates.shape[:2]) + np.isnan(candidates[..., 0])
    chosen = order.argsort(axis=1)[:, :MAX_GHOSTS]
    return np.take_along_axis(candidates, chosen[..., None], axis=1)
