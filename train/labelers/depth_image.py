"""Clouds as sparse 52×52 depth images, the input of the paper's network.

Han et al. 2018, section 3.1: an orthographic camera whose axis passes through the cloud's mean, zoomed so
that every point stays clear of a 10 % margin; the depth of a point is the brightness of its one pixel. A view
frame has x to the right, y down and z away from the camera, all three in the same unit: half an image width.
The images stretch depth to a fixed range; network outputs do not, so that distances in them are to scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy.typing import NDArray

from train.labelers.views import centered

IMAGE_SIZE = 52
"""Width and height of a depth image [pixel]."""
MARGIN = 0.1
"""Empty border on each of the four sides [share of the image]."""
NEAREST, FARTHEST = 0.1, 1.0
"""Brightness of the nearest and of the farthest point; 0 is background."""
SMALLEST_EXTENT = 0.01
"""Least extent from the mean that the zoom assumes [m]; a single point has none."""
FLAT = 1e-6
"""Depth ranges below this are rounding [m]; their points get the middle brightness."""


@dataclass(frozen=True, slots=True)
class ViewFrames:
    """The cameras of a batch of depth images."""

    rotations: Float[np.ndarray, "B 3 3"]
    """From the input's frame into the camera's; with determinant -1 the image is mirrored."""
    centers: Float[np.ndarray, "B 3"]
    """Mean of each cloud in the input's frame [m]."""
    scales: Float[np.ndarray, "B"]
    """View units per meter [1/m], the same for x, y and z."""
    nearest: Float[np.ndarray, "B"]
    """Depth of each cloud's nearest point, of brightness 0.1, from the mean along the camera's axis [m]."""
    depth_ranges: Float[np.ndarray, "B"]
    """Depth between brightness 0.1 and 1.0 [m]; 0 where all points are equally deep."""

    def normalize(self, positions: Float[np.ndarray, "B N 3"]) -> NDArray[np.float64]:
        """Positions (B, N, 3) in the input's frame [m] as view units; NaN stays NaN."""
        rotated = (positions - self.centers[:, None]) @ self.rotations.swapaxes(1, 2)
        normalized: NDArray[np.float64] = rotated * self.scales[:, None, None]
        return normalized

    def restore(self, normalized: Float[np.ndarray, "B N 3"]) -> NDArray[np.float64]:
        """View units (B, N, 3), such as the network's output, as positions in the input's frame [m]."""
        rotated = (normalized / self.scales[:, None, None]) @ self.rotations
        positions: NDArray[np.float64] = rotated + self.centers[:, None]
        return positions


def depth_images(
    points: Float[np.ndarray, "B N 3"],
    present: Bool[np.ndarray, "B N"],
    rotations: Float[np.ndarray, "B 3 3"],
) -> tuple[Float32[np.ndarray, "B 52 52"], ViewFrames]:
    """Images of clouds by orthographic cameras whose axes pass through their means.

    The farther of two points in one pixel is lost. An empty cloud is an empty image.

    Args:
        points: Clouds [m]; padding is ignored.
        rotations: From the clouds' frame into the camera's; with determinant -1 the image is mirrored.

    Returns:
        Images (row, column), 0 for background and 0.1 (near) to 1.0 (far) for points; and the cameras.
    """
    frames = _view_frames(points, present, rotations)
    safe = np.where(present[..., None], points, frames.centers[:, None])
    view = frames.normalize(safe)  # (B, N, 3)
    pixels = np.floor((view[..., :2] + 1.0) * (IMAGE_SIZE / 2)).astype(np.int64)
    depth = view[..., 2] / frames.scales[:, None] - frames.nearest[:, None]
    ranges = frames.depth_ranges[:, None]
    share = np.where(ranges > 0, depth / np.where(ranges > 0, ranges, 1.0), 0.5).clip(0.0, 1.0)
    brightness = NEAREST + (FARTHEST - NEAREST) * share
    images = np.full((len(points), IMAGE_SIZE, IMAGE_SIZE), np.inf)
    cloud, point = np.nonzero(present)
    columns, rows = pixels[cloud, point].T
    np.minimum.at(images, (cloud, rows, columns), brightness[cloud, point])
    return np.where(np.isfinite(images), images, 0.0).astype(np.float32), frames


def _view_frames(
    points: NDArray[np.float64], present: NDArray[np.bool_], rotations: NDArray[np.float64]
) -> ViewFrames:
    """Cameras (B) that see every present point."""
    offsets, centers = centered(points, present)
    rotated = offsets @ rotations.swapaxes(1, 2)
    extent = np.abs(rotated[..., :2]).max(axis=(1, 2), initial=SMALLEST_EXTENT)
    nearest = np.where(present, rotated[..., 2], np.inf).min(axis=1, initial=np.inf)
    farthest = np.where(present, rotated[..., 2], -np.inf).max(axis=1, initial=-np.inf)
    seen = present.any(axis=1)
    nearest, farthest = np.where(seen, nearest, 0.0), np.where(seen, farthest, 0.0)
    ranges = farthest - nearest
    return ViewFrames(
        rotations=rotations,
        centers=centers,
        scales=(1.0 - 2.0 * MARGIN) / extent,
        nearest=nearest,
        depth_ranges=np.where(ranges > FLAT, ranges, 0.0),
    )
