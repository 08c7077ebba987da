"""What each candidate camera sees of hands at work: bits of marker-frames, and what it tells of points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, UInt64
from numpy.typing import NDArray

from gloves.optics.blobs import MARKER_RADIUS
from handsim.space.cameras import FEWEST_CAMERAS, MAX_CAMERAS, CameraRig, look_at
from train.rig_advice.forecast import ROOM
from train.simulation.light_sources import marker_radii
from train.simulation.motion import SceneMotion
from train.simulation.sight import SceneSight

_WIDE: Final = float(np.deg2rad(170.0))  # a view in which hands are wherever the camera is aimed
_SAMPLED: Final = 1200  # marker-frames whose error is looked at


class CandidateViews(NamedTuple):
    """K candidate cameras before N marker-frames."""

    bits: UInt64[np.ndarray, "K W"]
    """Marker-frames that each sees, 64 in a word."""
    num_marker_frames: int
    told: Float[np.ndarray, "6 K S"]
    """What each tells of S of the marker-frames, the inverse of a covariance [1/mm^2]: xx, xy, xz, yy, yz,
    zz; 0 where it does not see."""


def view_candidates(
    scenes: Sequence[SceneMotion],
    T_world_camera: Float[np.ndarray, "K 4 4"],
    field_of_view: float,
    resolution: int,
    *,
    rng: np.random.Generator,
) -> CandidateViews:
    """Cast the lines of sight from every marker to every candidate, once for candidates at one position.

    Args:
        scenes: Hands at work.
        T_world_camera: The candidates' poses.
        field_of_view: Of every camera [rad].
        resolution: Of every camera [px].
        rng: Source of visible spots, and of the marker-frames whose error is looked at.
    """
    positions, which = np.unique(T_world_camera[:, :3, 3].round(6), axis=0, return_inverse=True)
    which = which.reshape(-1)
    seen, points, noise = [], [], []
    for scene in scenes:
        free, centers, radii = _free_views(scene, positions, rng)
        cone = _in_cones(centers, T_world_camera, field_of_view)
        seen.append(free[:, which].T & cone.T)
        points.append(centers)
        noise.append(ROOM.optics.noise * np.sqrt(MARKER_RADIUS / radii))
    views, centers = np.concatenate(seen, axis=1), np.concatenate(points)
    sampled = rng.choice(len(centers), min(_SAMPLED, len(centers)), replace=False)
    focal = resolution / 2 / np.tan(field_of_view / 2)
    told = _told(centers[sampled], T_world_camera[:, :3, 3], np.concatenate(noise)[sampled] / focal)
    return CandidateViews(_packed(views), len(centers), told * views[:, sampled])


def _free_views(
    scene: SceneMotion, positions: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Of the hands' markers in all frames: which positions see them (N, P), where (N, 3), how large (N,)."""
    count = sum(hand.fit.layout.num_markers for hand in scene.hands)
    parts = []
    for begin in range(0, len(positions), MAX_CAMERAS):
        few = positions[begin : begin + MAX_CAMERAS]
        # A rig has two cameras at least: where one is left, it comes with another that is cut off again.
        some = few if len(few) >= FEWEST_CAMERAS else np.concatenate([few, few + np.array([0.0, 0.0, 1.0])])
        middle = scene.hands[0].qpos[:, :3].mean(axis=0)
        rig = CameraRig("candidates", np.stack([look_at(one, middle) for one in some]), _WIDE)
        sight = SceneSight(scene, rig)
        radii = marker_radii(scene, ROOM.optics)
        visible = sight.visible_markers(ROOM.optics.partial * radii, rng=rng)
        parts.append(visible[:, :count, : len(few)].reshape(-1, len(few)))
    centers = sight.markers[0][:, :count].reshape(-1, 3)
    return np.concatenate(parts, axis=1), centers, np.tile(radii[:count], scene.num_frames)


def _in_cones(
    points: NDArray[np.float64], poses: NDArray[np.float64], field_of_view: float
) -> NDArray[np.bool_]:
    """Which candidates have each point in view (N, K); as `CameraRig.in_view`, of any number of cameras."""
    parts = []
    for pose in poses:
        rays = points - pose[:3, 3]
        ahead = np.cos(field_of_view / 2) * np.linalg.norm(rays, axis=1)
        parts.append(rays @ pose[:3, 2] >= ahead)
    return np.stack(parts, axis=1)


def _told(
    points: NDArray[np.float64], positions: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float32]:
    """What a ray with noise [rad] tells across itself (6, K, S) [1/mm^2]."""
    rays = points - positions[:, None]
    distances = np.linalg.norm(rays, axis=-1)
    x, y, z = np.moveaxis(rays / distances[..., None], -1, 0)
    weight = 1e-6 / (noise * distances) ** 2
    parts = (1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z)
    return np.stack([(weight * part).astype(np.float32) for part in parts])


def _packed(views: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Rows of flags (K, N) as bits, 64 in a word, the last word filled with zeros."""
    padded = np.zeros((len(views), -(-views.shape[1] // 64) * 64), dtype=bool)
    padded[:, : views.shape[1]] = views
    return np.packbits(padded, axis=1).view(np.uint64)
