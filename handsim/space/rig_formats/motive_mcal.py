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
from handsim.space.lens import Lens
from handsim.space.rig_formats.lab_camera import (
    LabCamera,
    Skipped,
    attribute_number,
    camera_matrix,
    child,
    nearest_rotation,
    picture_size,
    rigid,
)

ROOT: Final = "calibrationProfile"
_TO_OPENCV: Final = np.diag([1.0, -1.0, -1.0])
_COLOR: Final = "30"
"""`ImagerIndex` of color cameras."""


def read_mcal(root: ET.Element) -> list[LabCamera | Skipped]:
    """The cameras of a `calibrationProfile` element.

    Raises:
        RigError: A value is missing or cannot be.
    """
    return [_camera(entry, number) for number, entry in enumerate(root.iter("Camera"), 1)]


def _camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
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
    K = camera_matrix(owner, (focal[0], focal[1]), (center[0], center[1]))
    numbers = [attribute_number(outer, f"OrientMatrix{n}", owner) for n in range(9)]
    axes = nearest_rotation(f"{owner}: OrientMatrix", np.array(numbers).reshape(3, 3))
    position = np.array([attribute_number(outer, axis, owner) for axis in "XYZ"])
    lens = Lens() if standard is None else _lens(standard, owner)
    camera = Camera(serial, size, K, rigid(axes @ _TO_OPENCV, position), lens)
    return LabCamera(camera, video=color, y_up=True)


def _lens(inner: ET.Element, owner: str) -> Lens:
    keys = ("k1", "k2", "TangentialX", "TangentialY", "k3")
    k1, k2, p1, p2, k3 = (attribute_number(inner, key, owner, 0.0) for key in keys)
    return Lens("brown", (k1, k2, p1, p2, k3)) if any((k1, k2, p1, p2, k3)) else Lens()
