"""Reconstruction by an optical system: blobs, rays, points, gaps and false points.

One model produces them all. A marker is a noisy blob in every camera that sees it; blobs that touch merge;
rays through blobs meet in points, if enough of them meet closely enough; rays without a point may meet by
chance.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.optics.blobs import MARKER_RADIUS
from gloves.optics.triangulation import reconstruct_frames
from handsim.errors import ArgumentError
from handsim.space.rig import CameraRig

MAX_FALSE_POINTS: Final = 6
"""False intersections kept per frame."""


@dataclass(frozen=True, slots=True)
class OpticsConfig:
    """Properties of cameras and solver; the defaults are those of a well-kept optical system.

    Raises:
        ArgumentError: A number is out of range.
    """

    noise: float = 0.12
    """Standard deviation of a blob's center per axis in the camera's own pixels [px], for a sphere of 3.2 mm
    radius; it falls with the root of the radius."""
    partial: float = 0.5
    """Each line of sight goes to a random point of the marker within this share of its radius, so markers
    behind an edge flicker."""
    marker_radius: float | None = None
    """Radius of the glove's spheres [m]; the layout's when not given."""
    roundness: float = 0.5
    """Two blobs that touch merge: they count as a marker while their centers are nearer than this share of
    the sum of their radii, and are discarded as not round beyond it."""
    blob_loss: float = 0.002
    """Chance that a camera misses a blob it should see."""
    dropout: float = 0.0002
    """Chance per frame that cameras begin to lose their pictures: a lost packet, or an arm in front."""
    dropout_length: float = 3.0
    """Mean number of pictures that they lose then."""
    dropout_cameras: int = 1
    """Number of cameras that lose them together, as those on one network switch do."""
    min_rays: int = 2
    """Rays that must meet for a point to exist."""
    min_rays_to_start: int = 3
    """Rays that must meet for a point that did not exist in the frame before."""
    max_residual: float = 0.003
    """Largest distance of a ray from its point [m]; the worst ray is dropped first."""
    min_angle: float = 10.0
    """Two rays alone must cross at this angle at least [deg]."""
    min_distance: float = 0.004
    """Points nearer to each other than this are one: the one with more rays [m]."""

    def __post_init__(self) -> None:
        if self.marker_radius is not None and not 0.0 < self.marker_radius < np.inf:
            raise ArgumentError(f"marker_radius is {self.marker_radius:g}, expected a positive finite number")
        for name in ("noise", "partial", "max_residual", "min_distance", "roundness"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ArgumentError(f"{name} is {value:g}, expected a finite number that is not negative")
        for name in ("blob_loss", "dropout"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ArgumentError(f"{name} is {getattr(self, name):g}, expected a chance from 0 to 1")
        if not 1.0 <= self.dropout_length < np.inf or self.dropout_cameras < 0:
            raise ArgumentError(
                f"dropout_length is {self.dropout_length:g} and dropout_cameras {self.dropout_cameras}, "
                "expected at least 1 picture, and 0 cameras or more"
            )
        if not 0.0 <= self.min_angle <= 90.0:
            raise ArgumentError(f"min_angle is {self.min_angle:g}, expected 0 to 90 degrees")
        if not 2 <= self.min_rays <= self.min_rays_to_start:
            raise ArgumentError(
                f"min_rays is {self.min_rays} and min_rays_to_start {self.min_rays_to_start}, "
                "expected 2 <= min_rays <= min_rays_to_start"
            )

    def worn(self, radius: float) -> OpticsConfig:
        """The same for a glove whose spheres have this radius [m], unless `marker_radius` is given."""
        return dataclasses.replace(self, marker_radius=self.radius_of(radius))

    def radius_of(self, radius: float) -> float:
        """`marker_radius`, or in its absence a layout's [m]."""
        return radius if self.marker_radius is None else self.marker_radius


class Reconstruction(NamedTuple):
    """The points of every frame, each under the source it comes from."""

    positions: Float[np.ndarray, "T S 3"]
    """Reconstructed position of each source [m], NaN where there is none."""
    rays: Int[np.ndarray, "T S"]
    """Rays that made each point, 0 where there is none."""
    false_points: Float[np.ndarray, "T F 3"]
    """Points where rays of different sources met by chance [m], NaN where none; a column holds one such point
    for as long as it stays."""


def reconstruct(
    sources: Float[np.ndarray, "T S 3"],
    seen: Bool[np.ndarray, "T S C"],
    rig: CameraRig,
    config: OpticsConfig,
    *,
    radii: Float[np.ndarray, "S"] | float = MARKER_RADIUS,
    continuous: bool,
    rng: np.random.Generator,
) -> Reconstruction:
    """Simulate detection and triangulation.

    Args:
        sources: True positions of markers, mirror images and strays [m]; NaN where there is none.
        seen: Which cameras have a free view of each.
        radii: Radius of each source, or of all [m].
        continuous: Frames follow each other in time; otherwise each stands alone, and `min_rays` is enough.
    """
    frames, count = sources.shape[:2]
    positions = np.full((frames, count, 3), np.nan)
    rays = np.zeros((frames, count), dtype=np.int64)
    false_points = np.full((frames, MAX_FALSE_POINTS, 3), np.nan)
    lost = _dropouts(frames, len(rig.positions), config, rng)
    reconstruct_frames(
        np.ascontiguousarray(sources, dtype=np.float64),
        np.broadcast_to(np.asarray(radii, dtype=np.float64), count).copy(),
        np.ascontiguousarray(seen & ~lost[:, None]),
        rig.arrays,
        (config.noise, config.blob_loss, config.roundness),
        (config.max_residual, np.sin(np.deg2rad(config.min_angle)), config.min_distance),
        (config.min_rays, config.min_rays_to_start if continuous else config.min_rays),
        rng,
        positions,
        rays,
        false_points,
    )
    return Reconstruction(positions, rays, false_points)


def _dropouts(
    frames: int, cameras: int, config: OpticsConfig, rng: np.random.Generator
) -> Bool[np.ndarray, "T C"]:
    """Pictures that are lost: each dropout affects some cameras for a geometric number of frames."""
    begins = np.flatnonzero(rng.random(frames) < config.dropout)
    lasts = rng.geometric(1.0 / config.dropout_length, size=len(begins))
    lost = np.zeros((frames, cameras), dtype=bool)
    for begin, last in zip(begins, lasts, strict=True):
        lost[
            begin : begin + last, rng.choice(cameras, min(cameras, config.dropout_cameras), replace=False)
        ] = True
    return lost
