"""Mirror images of markers in shiny patches, and the cameras that see them in the patch.

The path marker -> patch -> camera unfolds into the straight line from the mirror image to the camera, so an
optical system reconstructs a point at the image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.kernels.segments import segment_distance_squared
from handsim.space.camera import in_picture
from handsim.space.rig import CameraRig


def reflect(
    points: Float[np.ndarray, "*batch 3"],
    plane_point: Float[np.ndarray, "*batch 3"],
    plane_normal: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Mirror images of points in planes given by a point and a unit normal [m]."""
    height = np.einsum("...i,...i->...", points - plane_point, plane_normal)
    mirrored: NDArray[np.float64] = points - 2.0 * height[..., None] * plane_normal
    return mirrored


def cameras_by_mirror(
    images: Float[np.ndarray, "T P 3"],
    plane_point: Float[np.ndarray, "T 3"],
    plane_normal: Float[np.ndarray, "T 3"],
    radius: float,
    rig: CameraRig,
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T P C"]:
    """Which cameras see which mirror image: in the patch, in view, and with both legs of the path free.

    Args:
        images: Mirror images of the markers [m]; NaN where there is none.
        plane_point: Middle of the patch in each frame [m].
        plane_normal: Unit normal of its shiny side.
        radius: Radius of the patch [m].
        segments: Axes of the capsules that block the view, in the world [m].
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
            if not behind > 0.0:  # also where there is no image: NaN
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
