"""OptiTrack Motive's `.mcal`, the calibration of Motive 3.2 and newer, in UTF-16.

`Extrinsic` has the position [m] and, row by row, the matrix whose columns are the camera's axes in the
world: x right, y up, z backward. Motive's world has y up. The lens of `IntrinsicStandardCameraModel` is
OpenCV's; that of `Intrinsic` is Motive's own.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Final

import numpy as np

from handsim.files.toml_values import shown
from handsim.space.camera import Camera
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

ROOT: Final = "calibrationProfile"
_TO_OPENCV: Final = np.diag([1.0, -1.0, -1.0])
_LENS: Final = ("k1", "k2", "TangentialX", "TangentialY", "k3")
_COLOR: Final = "30"
"""`ImagerIndex` of color cameras."""


def read_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    """The camera of an element; a `RigError` where a value is missing or cannot be."""
    serial = entry.get("Serial") or str(number)
    owner = f"camera {shown(serial)}"
    properties, outer = entry.find("Properties"), entry.find("Extrinsic")
    if properties is not None and properties.get("Enabled") == "0":
        return Skipped(serial, "is switched off")
    standard = entry.find("IntrinsicStandardCameraModel")
    inner = entry.find("Intrinsic") if standard is None else standard
    if outer is None or inner is None:
        return Skipped(serial, "is not calibrated")
    color = serial.startswith("C") or (properties is not None and properties.get("ImagerIndex") == _COLOR)
    imager = child(entry, "Attributes", owner)
    sides = (attribute_number(imager, f"ImagerPixel{side}", owner) for side in ("Width", "Height"))
    size = picture_size(owner, *sides)
    focal = tuple(attribute_number(inner, f"{way}FocalLength", owner) for way in ("Horizontal", "Vertical"))
    center = tuple(attribute_number(inner, f"LensCenter{axis}", owner) for axis in "XY")
    K = checked_matrix(owner, (focal[0], focal[1]), (center[0], center[1]))
    numbers = [attribute_number(outer, f"OrientMatrix{n}", owner) for n in range(9)]
    axes = nearest_rotation(f"{owner}: OrientMatrix", np.array(numbers).reshape(3, 3))
    position = np.array([attribute_number(outer, axis, owner) for axis in "XYZ"])
    bends = [] if standard is None else [attribute_number(standard, key, owner, 0.0) for key in _LENS]
    camera = Camera(serial, size, K, rigid(axes @ _TO_OPENCV, position), brown_lens(*bends))
    return LabCamera(camera, video=color, y_up=True)
