"""Visibility of markers: lines of sight past the hand's capsules, facing, and field of view."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.hand.capsules import bounding_spheres
from handsim.kernels.kernel import kernel
from handsim.kernels.segments import segment_distance_squared
from handsim.space.camera import in_picture
from handsim.space.rig import CameraRig

MAX_FACING: Final = np.deg2rad(85.0)
"""Largest angle between a marker's outward direction and the ray to a camera that still sees it [rad]."""


def free_rays(
    markers: Float[np.ndarray, "T M 3"],
    cameras: Float[np.ndarray, "C 3"],
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T M C"]:
    """Which straight lines from marker to camera, in the world [m], meet no capsule.

    A ray meets a capsule exactly when the segment marker-camera comes nearer to the capsule's axis than its
    radius, so one distance between two segments decides it.
    """
    free = np.ones((*markers.shape[:2], len(cameras)), dtype=np.bool_)
    _keep_free(markers, cameras, segments, radii, free)
    return free


def visible_cameras(
    markers: Float[np.ndarray, "T M 3"],
    normals: Float[np.ndarray, "T M 3"],
    rig: CameraRig,
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T M C"]:
    """Which cameras see each marker: in view, facing, and not occluded by the hand.

    Args:
        markers: Marker centers in the world [m].
        normals: Outward unit directions of the skin under the markers.
        segments: Both ends of every capsule's axis in the world [m].
    """
    seen = facing_cameras(markers, normals, rig)
    _keep_free(markers, rig.positions, segments, radii, seen)
    return seen


def facing_cameras(
    markers: Float[np.ndarray, "T M 3"], normals: Float[np.ndarray, "T M 3"], rig: CameraRig
) -> Bool[np.ndarray, "T M C"]:
    """Which cameras would see each marker without occlusion: in view, and on its outward side.

    Args:
        markers: Marker centers in the world [m].
        normals: Outward unit directions of the surface under the markers.
    """
    seen: NDArray[np.bool_] = _facing(
        np.ascontiguousarray(markers, dtype=np.float64),
        np.ascontiguousarray(normals, dtype=np.float64),
        rig.arrays,
        np.cos(MAX_FACING),
    )
    return seen


def pack_cameras(visible: Bool[np.ndarray, "*batch C"]) -> NDArray[np.uint32]:
    """Visibility as one bit per camera: bit c is set where camera c sees."""
    bits = visible.astype(np.uint32) << np.arange(visible.shape[-1], dtype=np.uint32)
    packed: NDArray[np.uint32] = bits.sum(axis=-1, dtype=np.uint32)
    return packed


@kernel
def _facing(markers: Any, normals: Any, cameras: Any, facing: float) -> Any:
    """Which cameras (T, M, C) have a marker in view and on its outward side; see `facing_cameras`."""
    frames, count = markers.shape[:2]
    seen = np.empty((frames, count, len(cameras.sizes)), dtype=np.bool_)
    for c in range(len(cameras.sizes)):
        pose, inner = cameras.T_world_camera[c], cameras.intrinsics[c]
        size, lens = cameras.sizes[c], cameras.lenses[c]
        for t in range(frames):
            for m in range(count):
                marker, normal = markers[t, m], normals[t, m]
                x, y, z = marker[0] - pose[0, 3], marker[1] - pose[1, 3], marker[2] - pose[2, 3]
                distance = np.sqrt(x * x + y * y + z * z)
                ahead = -(x * normal[0] + y * normal[1] + z * normal[2])
                seen[t, m, c] = (ahead > facing * distance) & in_picture(
                    inner, size, lens,
                    x * pose[0, 0] + y * pose[1, 0] + z * pose[2, 0],
                    x * pose[0, 1] + y * pose[1, 1] + z * pose[2, 1],
                    x * pose[0, 2] + y * pose[1, 2] + z * pose[2, 2],
                )  # fmt: skip
    return seen


@kernel
def _keep_free(
    markers: Float[np.ndarray, "T M 3"],
    cameras: Float[np.ndarray, "C 3"],
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
    free: Bool[np.ndarray, "T M C"],
) -> None:
    """Clear what is set of `free` (T, M, C) where a line meets a capsule; else as for `free_rays`."""
    frames, count = markers.shape[:2]
    capsules = len(radii)
    centers, reach = np.empty((capsules, 3)), np.empty(capsules)
    offset, gap, margin = np.empty((3, capsules)), np.empty(capsules), np.empty(capsules)
    for t in range(frames):
        bounding_spheres(segments[t], radii, centers, reach)
        for m in range(count):
            marker = markers[t, m]
            for k in range(capsules):
                for i in range(3):
                    offset[i, k] = centers[k, i] - marker[i]
                gap[k] = offset[0, k] ** 2 + offset[1, k] ** 2 + offset[2, k] ** 2 - reach[k] ** 2
            for c in range(len(cameras)):
                if not free[t, m, c]:
                    continue
                dx, dy, dz = (cameras[c, 0] - marker[0], cameras[c, 1] - marker[1], cameras[c, 2] - marker[2])
                squared = dx * dx + dy * dy + dz * dz
                inverse = 1.0 / squared
                for k in range(capsules):  # a capsule whose bounding sphere the ray misses cannot be met
                    along = offset[0, k] * dx + offset[1, k] * dy + offset[2, k] * dz
                    share = min(1.0, max(0.0, along * inverse))
                    margin[k] = gap[k] - share * (2.0 * along - share * squared)
                for k in range(capsules):
                    if margin[k] < 0.0 and (
                        segment_distance_squared(marker, cameras[c], segments[t, k, 0], segments[t, k, 1])
                        < radii[k] * radii[k]
                    ):
                        free[t, m, c] = False
                        break
