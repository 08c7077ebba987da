"""Vicon's `.xcp`: the calibration that Nexus, Shogun, Tracker and Blade keep beside a capture.

A `KeyFrame` has the position [mm] and the rotation from the world to the camera, a quaternion xyzw. The
camera's axes are x right, y down, z ahead. Radial coefficients straighten measured points: a point at r
pixels from the principal point belongs at r (1 + k1 r^2 + k2 r^4 + k3 r^6).
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimWarning, RigError
from handsim.files.toml_values import shown
from handsim.space.camera import Camera
from handsim.space.lens import Lens
from handsim.space.rig_formats.lab_camera import (
    LabCamera,
    Skipped,
    attribute_number,
    attribute_numbers,
    checked_matrix,
    picture_size,
    rigid,
)
from handsim.space.transforms import quaternion_matrix

ROOT: Final = "Cameras"
_MILLIMETER: Final = 1e-3
_STRONGEST: Final = 0.5  # of a corner's distance; no lens moves it farther
_SAMPLES: Final = 256
_VIDEO: Final = ("vue", "videoinputdevice")


def read_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    """The camera of an element; a `RigError` where a value is missing or cannot be."""
    device = entry.get("DEVICEID") or entry.get("USERID") or str(number)
    owner = f"camera {shown(device)}"
    frames = entry.findall("KeyFrames/KeyFrame")
    if not frames:
        return Skipped(device, "is not calibrated")
    if len(frames) > 1:
        told = f"{owner} moves: it has {len(frames)} key frames, of which the first is taken"
        warnings.warn(told, HandSimWarning, stacklevel=2)
    frame = frames[0]
    size = picture_size(owner, *attribute_numbers(entry, "SENSOR_SIZE", 2, owner))
    focal = attribute_number(frame, "FOCAL_LENGTH", owner)
    aspect = attribute_number(entry, "PIXEL_ASPECT_RATIO", owner, 1.0)
    if not aspect > 0.0:
        raise RigError(f"{owner}: PIXEL_ASPECT_RATIO is {aspect:g}, expected a positive number")
    center = attribute_numbers(frame, "PRINCIPAL_POINT", 2, owner)
    K = checked_matrix(owner, (focal, focal / aspect), (center[0], center[1]))
    kind = (entry.get("DISPLAY_TYPE") or entry.get("TYPE") or "").lower()
    video = entry.get("SYSTEM") == "DV" or entry.get("ISDV") == "1" or kind.startswith(_VIDEO)
    camera = Camera(device, size, K, _pose(frame, owner), _lens(frame, owner, size, K))
    return LabCamera(camera, video=video)


def _pose(frame: ET.Element, owner: str) -> NDArray[np.float64]:
    x, y, z, w = attribute_numbers(frame, "ORIENTATION", 4, owner)
    quaternion = np.array([w, x, y, z])
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-2:
        raise RigError(f"{owner}: ORIENTATION is a quaternion of length {length:.4g}, expected 1")
    position = np.array(attribute_numbers(frame, "POSITION", 3, owner))
    return rigid(quaternion_matrix(quaternion).T, _MILLIMETER * position)


def _lens(frame: ET.Element, owner: str, size: tuple[int, int], K: NDArray[np.float64]) -> Lens:
    """Our lens bends where Vicon's straightens; the inverse is fitted over the picture."""
    straighten = _coefficients(frame, owner)
    if not any(straighten):
        return Lens()
    corner = float(np.hypot(*np.maximum(K[:2, 2], size - K[:2, 2])))  # [px]
    measured = np.linspace(0.0, corner, _SAMPLES + 1)[1:]
    factor = 1.0 + sum(k * measured ** (2 * n) for n, k in enumerate(straighten, 1))
    if not np.abs(factor - 1.0).max() < _STRONGEST:
        told = f"{owner}: its lens would move a corner by more than half its distance; it is left out"
        warnings.warn(told, HandSimWarning, stacklevel=2)
        return Lens()
    straight = measured * factor / K[0, 0]  # [focal lengths]
    powers = straight[:, None] ** np.array([2, 4, 6])
    fitted = np.linalg.lstsq(powers * straight[:, None], straight / factor - straight, rcond=None)[0]
    k1, k2, k3 = map(float, fitted)
    return Lens("brown", (k1, k2, 0.0, 0.0, k3))


def _coefficients(frame: ET.Element, owner: str) -> tuple[float, ...]:
    """k1, k2, ... [1/px^2, 1/px^4, ...]; of the newer form they follow a name and a center."""
    words = (frame.get("VICON_RADIAL2") or "").split()
    if words and len(words) != 6:
        raise RigError(f"{owner}: VICON_RADIAL2 has {len(words)} words, expected a name and five numbers")
    if words:
        newer = ET.Element("KeyFrame", {"VICON_RADIAL2": " ".join(words[1:])})
        return attribute_numbers(newer, "VICON_RADIAL2", 5, owner)[2:]
    return attribute_numbers(frame, "VICON_RADIAL", 2, owner) if frame.get("VICON_RADIAL") else ()
