"""How far triangulated points lie from the truth: covariance from the noise of blobs in the pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.space.cameras import CameraRig


class ErrorEllipsoid(NamedTuple):
    """The error of points, averaged."""

    axes: Float[np.ndarray, "3"]
    """Standard deviations along the directions, the longest first [m]; NaN without points."""
    directions: Float[np.ndarray, "3 3"]
    """Unit vectors in the world, one in each row."""
    mean: float
    """Root mean square of the distance from the truth, averaged over the points [m]."""


def covariances(
    points: Float[np.ndarray, "N 3"],
    seen: Bool[np.ndarray, "N C"],
    rig: CameraRig,
    noise: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N 3 3"]:
    """Covariance of each triangulated point [m^2], the one nearest to its rays, which all count alike.

    Args:
        points: In the world [m].
        seen: Which cameras see each: two or more, from different directions.
        rig: The cameras.
        noise: Standard deviation of each point's blob per axis [px].
    """
    total, shifts = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, 3))
    for camera, pose in enumerate(rig.T_world_camera):
        rays = points - pose[:3, 3]
        distances = np.linalg.norm(rays, axis=1)
        directions = rays / distances[:, None]
        across = (np.eye(3) - directions[:, :, None] * directions[:, None]) * seen[:, camera, None, None]
        total += across
        # A pixel to the right or down moves the ray at the point's depth by so much, across the ray.
        scale = (rays @ pose[:3, 2]) * noise / rig.focal_length
        moved = across @ pose[:3, :2] * scale[:, None, None]
        shifts += moved @ moved.transpose(0, 2, 1)
    inverse = np.linalg.inv(total)
    spread: NDArray[np.float64] = inverse @ shifts @ inverse
    return spread


def ellipsoid(spread: Float[np.ndarray, "N 3 3"]) -> ErrorEllipsoid:
    """The mean of some points' covariances [m^2]."""
    if not len(spread):
        return ErrorEllipsoid(np.full(3, np.nan), np.eye(3), float("nan"))
    values, vectors = np.linalg.eigh(spread.mean(axis=0))
    mean = float(np.sqrt(np.trace(spread, axis1=1, axis2=2)).mean())
    return ErrorEllipsoid(np.sqrt(np.maximum(values[::-1], 0.0)), vectors.T[::-1], mean)
