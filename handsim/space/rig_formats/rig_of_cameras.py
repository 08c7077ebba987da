"""A camera rig as near as possible to the cameras of a calibration.

A rig's cameras share one round field of view and one resolution, have no distortion, and look along the
middle of their pictures. What that leaves out is told.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import HandSimError, HandSimWarning, RigError
from handsim.space.camera import Camera
from handsim.space.cameras import CameraRig
from handsim.space.rig_formats.lab_camera import LabCamera

Up = Literal["y", "z"]
_Y_TO_Z: Final = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""A turn about x that makes y up into z up."""
_LEVEL: Final = 0.3  # least share of the cameras' tops, on average, along the axis that points up
_UNLIKE: Final = 0.05  # relative difference of fields of view and focal lengths that is told
_OFF_CENTER: Final = 0.05  # of the picture's width or height
_BENT: Final = 0.5  # [px]
_LONGEST: Final = 1e6  # [px] of a focal length


def marker_cameras(path: Path, cameras: Sequence[LabCamera]) -> tuple[LabCamera, ...]:
    """The cameras that see markers; those that take pictures stay where there are no others.

    Args:
        path: Their file, for messages.
        cameras: What `load_lab_cameras` read.
    """
    seeing = tuple(one for one in cameras if not one.video)
    if not seeing or len(seeing) == len(cameras):
        return tuple(cameras)
    named = ", ".join(one.camera.name for one in cameras if one.video)
    _tell(f"{path}: video cameras see no markers and are left out: {named}")
    return seeing


def rig_of_cameras(path: Path, cameras: Sequence[LabCamera], up: Up | None = None) -> CameraRig:
    """The rig of some cameras: their median field of view across the shorter side, and median focal length.

    Args:
        path: Their file, which names the rig.
        cameras: In one world [m].
        up: The axis that points up in that world; when not given y where the file's format says so, else z.
            A rig's is z.

    Returns:
        The rig, in the cameras' order.

    Raises:
        RigError: No rig may be so: too few or too many cameras, or two at one position.
    """
    if not cameras:
        raise RigError(f"{path}: no camera is calibrated, expected two or more")
    turned = (up or ("y" if all(one.y_up for one in cameras) else "z")) == "y"
    poses = np.stack([one.camera.T_world_camera for one in cameras])
    poses = _Y_TO_Z @ poses if turned else poses
    plain = [one.camera for one in cameras]
    angles = np.array([field_of_view(camera) for camera in plain])
    focals = np.array([np.prod(np.sqrt(np.diag(camera.K)[:2])) for camera in plain])
    angle, focal = float(np.median(angles)), float(np.median(focals))
    across = 2.0 * focal * np.tan(angle / 2.0)
    if not (focals.max() < _LONGEST and np.isfinite(across)):
        raise RigError(
            f"{path}: a focal length is {focals.max():.3g} pixels, expected less than {_LONGEST:g}"
        )
    resolution = round(across)
    try:
        rig = CameraRig(_printable(path.stem), poses, angle, resolution)
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error
    _tell_of_up(path, poses, "y" if turned else "z")
    _tell_of_lenses(path, plain, angles, focals)
    return rig


def field_of_view(camera: Camera) -> float:
    """Opening of the round view cone within a camera's picture [rad]: that of the shorter side."""
    width, height = camera.size
    cx, cy = camera.K[:2, 2]
    middles = np.array([[0.0, cy], [width, cy], [cx, 0.0], [cx, height]])
    rays = _rays(camera, middles)
    sides = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    return float(min(sides[0] + sides[1], sides[2] + sides[3]))


def corner_distortion(camera: Camera) -> float:
    """Farthest that the lens moves a corner of the picture [px]."""
    width, height = camera.size
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    rays = _rays(camera, corners)
    straight = rays[:, :2] / rays[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return float(np.linalg.norm(straight - corners, axis=1).max())


def _rays(camera: Camera, pixels: Float[np.ndarray, "N 2"]) -> NDArray[np.float64]:
    """Rays (N, 3) of pixels, straight ones where the lens has none."""
    flat = (pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    straight = np.concatenate([flat, np.ones_like(flat[:, :1])], axis=1)
    rays = camera.lens.undistort(flat)
    behind = ~np.isfinite(rays).all(axis=1, keepdims=True) | (rays[:, 2:] <= 1e-6)
    return np.where(behind, straight, rays)


def _tell_of_up(path: Path, poses: Float[np.ndarray, "C 4 4"], up: Up) -> None:
    top = -poses[:, :3, 1].mean(axis=0)
    if top[2] < _LEVEL:
        _tell(
            f"{path}: with {up} up, the tops of its cameras' pictures do not point up on average; is another "
            "axis up? --up says which"
        )


def _tell_of_lenses(
    path: Path, cameras: Sequence[Camera], angles: NDArray[np.float64], focals: NDArray[np.float64]
) -> None:
    angle, focal = np.median(angles), np.median(focals)
    if np.abs(angles / angle - 1.0).max() > _UNLIKE or np.abs(focals / focal - 1.0).max() > _UNLIKE:
        degrees = np.rad2deg(angles)
        _tell(
            f"{path}: fields of view are {degrees.min():.1f} to {degrees.max():.1f} degrees and focal "
            f"lengths {focals.min():.0f} to {focals.max():.0f} pixels; a rig has one of each, the medians "
            f"{np.rad2deg(angle):.1f} degrees and {focal:.0f} pixels"
        )
    bent = np.array([corner_distortion(camera) for camera in cameras])
    if bent.max() > _BENT:
        _tell(
            f"{path}: lenses move the corners of pictures by up to {bent.max():.0f} pixels (camera "
            f"'{cameras[int(bent.argmax())].name}'); a rig has no distortion, as marker systems take it out"
        )
    shifts = np.array([np.abs(one.K[:2, 2] / one.size - 0.5).max() for one in cameras])
    if shifts.max() > _OFF_CENTER:
        worst = cameras[int(shifts.argmax())]
        x, y = worst.K[:2, 2] - np.array(worst.size) / 2
        _tell(
            f"{path}: camera '{worst.name}' has its principal point {x:.0f} and {y:.0f} pixels from the "
            "middle of its picture; a rig's cameras look along the middle of theirs"
        )


def _printable(name: str) -> str:
    return "".join(one for one in name if one.isprintable()) or "rig"


def _tell(sentence: str) -> None:
    warnings.warn(sentence, HandSimWarning, stacklevel=4)
