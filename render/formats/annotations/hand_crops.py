"""`hand_crops.json` of clips: cameras that look at one hand each, which UmeTrack's and HOT3D's tools cut out.

A crop's camera is a square pinhole camera at the place of the stream's camera. Its axis goes through the
middle of the hand's keypoints, and its picture has room around them. The tools warp the stream's picture to
it, which takes the lens out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.space.camera import Camera
from render.formats.annotations.common import by_side, is_seen, rigid_record
from render.frames import RenderedFrame

_FILLED: Final = 0.8  # of the crop's half width, by the keypoint that is farthest from its middle
_WIDEST: Final = np.deg2rad(120.0)  # a flat picture of more is mostly stretching
_ROUNDS: Final = 5  # towards the middle, which moves a little when the camera turns
_NEAREST: Final = 1e-3  # [m]


def crops_record(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """`hand_crops.json` of one time: for each side the crop's camera in each stream that sees the hand.

    Args:
        frames: One a stream.

    Returns:
        For `left` and `right`, by stream: `T_world_from_crop_camera`, and `crop_camera_fov`, the full angle
        of view [rad].

    Raises:
        HandSimError: Two hands are of the same side.
    """
    record: dict[str, Any] = {"left": {}, "right": {}}
    for frame in frames:
        for side, hand in by_side(frame).items():
            crop = crop_camera(frame.camera, hand.keypoints_world) if is_seen(hand) else None
            if crop is not None:
                T_world_crop, angle = crop
                record[side][frame.camera.name] = {
                    "T_world_from_crop_camera": rigid_record(T_world_crop),
                    "crop_camera_fov": angle,
                }
    return record


def crop_camera(
    camera: Camera, keypoints: Float[np.ndarray, "21 3"]
) -> tuple[Float[np.ndarray, "4 4"], float] | None:
    """The pose of a camera for one hand alone, and its full angle of view [rad].

    Args:
        camera: The camera that sees the hand.
        keypoints: Of the hand, in the world [m].

    Returns:
        None for a hand beside or behind the camera, or one that no flat picture of 120 degrees holds.
    """
    local = camera.local(keypoints)
    if local[:, 2].mean() < _NEAREST:
        return None
    rotation = _looking_along(local.mean(axis=0))
    for _ in range(_ROUNDS):
        turned = local @ rotation
        if turned[:, 2].min() < _NEAREST:
            return None
        flat = turned[:, :2] / turned[:, 2:]
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2.0
        rotation = _looking_along(rotation @ np.append(middle, 1.0))
    turned = local @ rotation
    if turned[:, 2].min() < _NEAREST:
        return None
    reach = float(np.abs(turned[:, :2] / turned[:, 2:]).max()) / _FILLED
    angle = 2.0 * float(np.arctan(reach))
    if angle > _WIDEST:
        return None
    T_world_crop: NDArray[np.float64] = camera.T_world_camera.copy()
    T_world_crop[:3, :3] = T_world_crop[:3, :3] @ rotation
    return T_world_crop, angle


def _looking_along(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation whose z axis is this direction, and whose x axis is as level as the camera's."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
