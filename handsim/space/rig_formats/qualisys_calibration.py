"""Qualisys' calibration: what QTM exports as XML or text, and what its real-time server sends.

`transform` has the position [mm] and a matrix whose rows are the camera's axes in the world: x right, y up,
z backward. `intrinsic` counts in 64ths of a pixel of the sensor, v down; its distortion is OpenCV's.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Final

import numpy as np

from handsim.errors import RigError
from handsim.files.toml_values import shown
from handsim.space.camera import Camera
from handsim.space.lens import Lens
from handsim.space.rig_formats.lab_camera import (
    LabCamera,
    Skipped,
    attribute_number,
    brown_lens,
    checked_matrix,
    child,
    nearest_rotation,
    picture_size,
    rigid,
)

ROOT: Final = "calibration"
_MILLIMETER: Final = 1e-3
_PARTS: Final = 64.0  # of a pixel
_SIDES: Final = ("left", "top", "right", "bottom")
_TO_OPENCV: Final = np.diag([1.0, -1.0, -1.0])


def read_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    """The camera of an element; a `RigError` where a value is missing or cannot be."""
    serial = entry.get("serial") or str(number)
    owner = f"camera {shown(serial)}"
    if entry.get("active", "1").lower() in ("0", "false"):
        return Skipped(serial, "is switched off")
    if entry.get("calibrated", "true").lower() in ("0", "false"):
        return Skipped(serial, "is not calibrated")
    video = any(word in entry.get("model", "").lower() for word in ("video", "hybrid"))
    inner, view = child(entry, "intrinsic", owner), "fov_video" if video else "fov_marker"
    left, top, right, bottom = _sides(entry, view, owner)
    size = picture_size(owner, right - left + 1, bottom - top + 1)
    scale = 1.0 / (_PARTS * _binning(entry, view, inner, owner))
    u, v = (attribute_number(inner, f"centerPoint{axis}", owner) * scale for axis in "UV")
    focal = tuple(attribute_number(inner, f"focalLength{axis}", owner) * scale for axis in "UV")
    K = checked_matrix(owner, (focal[0], focal[1]), (u - left, v - top))
    place = child(entry, "transform", owner)
    rows = [[attribute_number(place, f"r{i}{j}", owner) for j in (1, 2, 3)] for i in (1, 2, 3)]
    axes = nearest_rotation(f"{owner}: the matrix r11 to r33", np.array(rows))
    position = np.array([attribute_number(place, axis, owner) for axis in "xyz"])
    pose = rigid(axes.T @ _TO_OPENCV, _MILLIMETER * position)
    return LabCamera(Camera(serial, size, K, pose, _lens(inner, owner)), video=video)


def _sides(entry: ET.Element, view: str, owner: str) -> tuple[float, ...]:
    """The part of the sensor that is used: its first and last columns and rows [px]."""
    found = entry.find(view)
    if found is None:
        found = child(entry, "fov_video" if view == "fov_marker" else "fov_marker", owner)
    sides = tuple(attribute_number(found, side, owner) for side in _SIDES)
    if sides[2] <= sides[0] or sides[3] <= sides[1]:
        raise RigError(f"{owner}: <{found.tag}> is empty, expected left < right and top < bottom")
    return sides


def _binning(entry: ET.Element, view: str, inner: ET.Element, owner: str) -> int:
    """How many pixels of the sensor, each way, are one of the picture."""
    whole = entry.find(f"{view}_max")
    if whole is None:
        return 1
    width = attribute_number(whole, "right", owner) - attribute_number(whole, "left", owner) + 1
    span = attribute_number(inner, "sensorMaxU", owner, 0.0) - attribute_number(
        inner, "sensorMinU", owner, 0.0
    )
    return max(1, round(span / _PARTS / width)) if width > 0 else 1


def _lens(inner: ET.Element, owner: str) -> Lens:
    k1, k2, k3 = (attribute_number(inner, f"radialDistortion{n}", owner, 0.0) for n in (1, 2, 3))
    p1, p2 = (attribute_number(inner, f"tangentalDistortion{n}", owner, 0.0) for n in (1, 2))
    return brown_lens(k1, k2, p1, p2, k3)
