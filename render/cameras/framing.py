"""How near a camera may come to the hands of a take, so that all of them are in its picture, and large."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from gloves.takes.take import Take
from handsim.hand.model import hand_keypoints
from handsim.space.camera import Camera

_KEPT: Final = (0, 2, 4, 5, 6, 8, 10, 12, 14, 16, 17, 18, 20)  # keypoints that a hand's outline depends on
_CHUNK: Final = 2048  # frames whose keypoints are computed at once
_SKIN: Final = 0.012  # [m] around keypoints
_BORDER: Final = 0.04  # of half a picture, which hands keep free
_NEAREST: Final = 0.15  # [m] between a camera and the nearest keypoint, at least
_WIDEST: Final = 2.0  # tangent of half the angle of view that is made use of


class Framing:
    """The hands of a take as cameras have to show them."""

    def __init__(self, take: Take) -> None:
        shape = (take.num_frames, len(take.hands), len(_KEPT), 3)
        self.points: Float32[np.ndarray, "T H P 3"] = np.full(shape, np.nan, dtype=np.float32)
        """Keypoints of all hands in the world [m]; NaN where a hand is absent."""
        for number, hand in enumerate(take.hands):
            there = np.flatnonzero(np.isfinite(take.qpos[:, number]).all(axis=1))
            for first in range(0, len(there), _CHUNK):
                rows = there[first : first + _CHUNK]
                self.points[rows, number] = hand_keypoints(hand.model, take.qpos[rows, number])[:, _KEPT]
        self._there = np.isfinite(self.points[..., 0, 0])
        self.centers: Float[np.ndarray, "T 3"] = self._centers()
        """Middle of the box around all hands of each frame [m]; interpolated over frames without hands."""
        self._window = max(1, round(0.5 * take.rate))

    def _centers(self) -> NDArray[np.float64]:
        known = np.flatnonzero(self._there.any(axis=1))
        flat = self.points[known].reshape(len(known), -1, 3).astype(np.float64)
        middles = 0.5 * (np.nanmin(flat, axis=1) + np.nanmax(flat, axis=1))
        frames = np.arange(len(self.points))
        return np.stack([np.interp(frames, known, middles[:, axis]) for axis in range(3)], axis=1)

    def middle(self) -> Float[np.ndarray, "3"]:
        """Middle of all places where the hands are [m]."""
        middle: NDArray[np.float64] = 0.5 * (self.centers.min(axis=0) + self.centers.max(axis=0))
        return middle

    def followed(self) -> Float[np.ndarray, "T 3"]:
        """The centers as a person with a camera follows them [m]: without what is quicker than a second."""
        smooth: NDArray[np.float64] = uniform_filter1d(self.centers, self._window, axis=0, mode="nearest")
        return smooth

    def held(self, distances: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        """Distances that change slowly and are nowhere shorter than these [m]."""
        longest = maximum_filter1d(distances, 2 * (self._window // 2) + 1, mode="nearest")
        slow: NDArray[np.float64] = uniform_filter1d(longest, 2 * (self._window // 2) + 1, mode="nearest")
        return slow

    def sides(
        self, rotations: Float[np.ndarray, "F 3 3"], frames: Int[np.ndarray, "F"] | None = None
    ) -> Float[np.ndarray, "F"]:
        """Longer side of a hand in each frame, seen from afar, the mean of its hands [m]; NaN without hands.

        Args:
            rotations: Axes of the camera in the world, as columns.
            frames: Which frames; all when not given.
        """
        points, there = self._rows(frames)
        local = self._turned(points, rotations)[..., :2]
        longer = np.ptp(local, axis=2).max(axis=-1)
        count = there.sum(axis=1)
        total = np.where(there, longer, 0.0).sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def shares(
        self,
        camera: Camera,
        poses: Float[np.ndarray, "F 4 4"],
        most: float,
        frames: Int[np.ndarray, "F"] | None = None,
    ) -> Float[np.ndarray, "F"]:
        """Share of the picture's height that a hand's longer side has, the mean of a frame's hands.

        Two hands before one another count for less, by how much of the smaller one's box the other covers.

        Args:
            camera: Its matrix and size count.
            poses: Of the camera.
            most: What a share counts as at most, so that one near hand does not make up for a far one.
            frames: Which frames; all when not given.
        """
        points, there = self._rows(frames)
        rotations, positions = poses[:, :3, :3], poses[:, None, None, :3, 3]
        local = self._turned(points - positions.astype(np.float32), rotations)
        pixels = local[..., :2] / np.maximum(local[..., 2:], 1e-3) * camera.K[1, 1] / camera.size[1]
        low, high = pixels.min(axis=2), pixels.max(axis=2)
        longer = np.where(there, np.minimum((high - low).max(axis=-1), most), 0.0)
        total: NDArray[np.float64] = longer.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        if points.shape[1] == 2:
            common = np.clip(high.min(axis=1) - low.max(axis=1), 0.0, None).prod(axis=-1)
            covered = common / np.maximum((high - low).prod(axis=-1).min(axis=1), 1e-9)
            total = total * (1.0 - np.nan_to_num(covered))
        return np.where(there.any(axis=1), total, np.nan)

    def shortest(
        self,
        camera: Camera,
        centers: Float[np.ndarray, "F 3"],
        rotations: Float[np.ndarray, "F 3 3"],
        frames: Int[np.ndarray, "F"] | None = None,
    ) -> Float[np.ndarray, "F"]:
        """Shortest distance of a camera from the place that it looks at with all hands in its picture [m].

        Args:
            centers: Where it looks [m].
            rotations: Its axes in the world, as columns.
            frames: Which frames; all when not given.
        """
        points, there = self._rows(frames)
        around = points - centers[:, None, None].astype(np.float32)
        local = self._turned(around, rotations).reshape(len(centers), -1, 3)
        needed = ((np.abs(local[..., :2]) + _SKIN) / half_view(camera)).max(axis=-1)
        distances = np.maximum(needed, _NEAREST) - local[..., 2]
        return np.where(there.any(axis=1), np.nan_to_num(distances, nan=-np.inf).max(axis=1), 0.0)

    def centered(
        self,
        centers: Float[np.ndarray, "T 3"],
        rotations: Float[np.ndarray, "T 3 3"],
        distances: Float[np.ndarray, "T"],
    ) -> Float[np.ndarray, "T 3"]:
        """Places to look at [m] with all hands in the middle of the picture, as near these as may be.

        Args:
            centers: Where a camera looks [m].
            rotations: Its axes in the world, as columns.
            distances: From what it looks at [m].
        """
        around = self.points - centers[:, None, None].astype(np.float32)
        local = self._turned(around, rotations).reshape(len(centers), -1, 3)
        there = self._there.any(axis=1)
        rays = local[there, :, :2] / np.maximum(local[there, :, 2:] + distances[there, None, None], _NEAREST)
        shifts = np.zeros((len(centers), 2))
        shifts[there] = 0.5 * distances[there, None] * (np.nanmin(rays, axis=1) + np.nanmax(rays, axis=1))
        shifts = uniform_filter1d(shifts, self._window, axis=0, mode="nearest")
        moved: NDArray[np.float64] = centers + np.einsum("tij,tj->ti", rotations[..., :2], shifts)
        return moved

    def _rows(self, frames: NDArray[np.int64] | None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        if frames is None:
            return self.points, self._there
        return self.points[frames], self._there[frames]

    @staticmethod
    def _turned(points: NDArray[np.float32], rotations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (T, H, P, 3) in the axes of cameras (T, 3, 3)."""
        flat = points.reshape(len(points), -1, 3)
        return (flat @ rotations).reshape(points.shape)


def half_view(camera: Camera) -> Float[np.ndarray, "2"]:
    """Tangents of half the angles of view across and down that hands may fill."""
    (width, height), (cx, cy) = camera.size, camera.K[:2, 2]
    rays = camera.unproject(np.array([[0.0, cy], [width, cy], [cx, 0.0], [cx, height]]))
    ahead = np.where(rays[:, 2] > 0.0, rays[:, 2], np.nan)
    tangents = np.nan_to_num(np.abs(rays[:, :2]).max(axis=1) / ahead, nan=_WIDEST)
    half: NDArray[np.float64] = (1.0 - _BORDER) * np.minimum(tangents.reshape(2, 2).min(axis=1), _WIDEST)
    return half


def looking(directions: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Axes of upright cameras in these unit directions from what they look at, as columns."""
    forward = -directions
    steep = np.abs(forward[:, 2:]) >= 0.999
    up = np.where(steep, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def poses_at(
    positions: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T 4 4"]:
    """Poses of cameras at these positions [m] with these axes."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses
