"""A check that the cameras of a user's file look at the hands."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimWarning, RigError
from handsim.hand.keypoints import hand_keypoints
from handsim.space.camera import Camera
from render.shown_take import ShownTake

_CHUNK: Final = 2048  # frames


def check_hands_in_view(path: str | Path, cameras: Sequence[Camera], take: ShownTake) -> None:
    """Refuse cameras that never have a hand in their pictures, and tell of those among them.

    Args:
        path: Their file, for messages.
        cameras: The cameras.
        take: The take; keypoints of all frames are projected, and hidden ones count.

    Raises:
        RigError: No camera has a keypoint in its picture in any frame.
    """
    blind = list(cameras)
    for hand in take.hands:
        there = hand.qpos[np.isfinite(hand.qpos).all(axis=1)]
        for first in range(0, len(there), _CHUNK):
            points = hand_keypoints(hand.fit.model, there[first : first + _CHUNK])
            blind = [camera for camera in blind if not _any_inside(camera, points)]
            if not blind:
                return
    if len(blind) == len(cameras):
        one = blind[0]
        middle, place = np.nanmedian(take.wrists()[..., :3], axis=(0, 1)), one.T_world_camera[:3, 3]
        raise RigError(
            f"{path}: no camera has a hand in its picture in any of {take.num_frames} frames: wrists are "
            f"around {_shown(middle)} m, and camera '{one.name}' stands at {_shown(place)} m and looks along "
            f"{_shown(one.T_world_camera[:3, 2])}"
        )
    for camera in blind:
        told = f"{path}: camera '{camera.name}' has no hand in its picture in any frame"
        warnings.warn(told, HandSimWarning, stacklevel=2)


def _any_inside(camera: Camera, points: NDArray[np.float64]) -> bool:
    pixels = camera.project(points)
    return bool(((pixels >= 0.0) & (pixels < camera.size)).all(axis=-1).any())  # never so for NaN


def _shown(vector: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in vector + 0.0) + ")"
