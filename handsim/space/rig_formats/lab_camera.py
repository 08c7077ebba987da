"""`LabCamera`, a camera of a calibration that another program wrote, and the values that all formats have."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import RigError
from handsim.files.toml_values import shown
from handsim.space.camera import Camera, camera_matrix
from handsim.space.lens import Lens

_LARGEST: Final = 1e9  # in any unit
_SKEWED: Final = 1e-3  # of a rotation in a file of few digits
_NAMELESS: Final = re.compile(r"[^A-Za-z0-9_-]+")
_LONGEST_NAME: Final = 56


class LabCamera(NamedTuple):
    """A camera of a calibration."""

    camera: Camera
    """With its size and lens [px] and its pose in the calibration's world [m]."""
    video: bool = False
    """Whether it takes pictures and sees no markers."""
    y_up: bool = False
    """Whether y points up in the calibration's world; else it is z, or the file does not say."""


class Skipped(NamedTuple):
    """A camera that a calibration names but does not place."""

    name: str
    why: str


def attribute_numbers(element: ET.Element, key: str, count: int, owner: str) -> tuple[float, ...]:
    """The numbers of an attribute, parted by spaces."""
    text = element.get(key)
    if text is None:
        raise RigError(f"{owner} lacks {key}")
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(value) < _LARGEST for value in values):  # never so for NaN
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise RigError(f"{owner}: {key} is {shown(text)}, expected {expected}")
    return values


def attribute_number(element: ET.Element, key: str, owner: str, default: float | None = None) -> float:
    """The number of an attribute; `default`, unless None, where it is missing.

    Raises:
        RigError: It is missing without a default, or not a finite number.
    """
    if default is not None and element.get(key) is None:
        return default
    return attribute_numbers(element, key, 1, owner)[0]


def child(element: ET.Element, tag: str, owner: str) -> ET.Element:
    """The first child of a tag.

    Raises:
        RigError: There is none.
    """
    found = element.find(tag)
    if found is None:
        raise RigError(f"{owner} lacks <{tag}>")
    return found


def picture_size(owner: str, width: float, height: float) -> tuple[int, int]:
    """Width and height [px]."""
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise RigError(f"{owner}: the picture is {width:g} x {height:g}, expected whole numbers of pixels")
    return int(width), int(height)


def checked_matrix(
    owner: str, focal: tuple[float, float], center: tuple[float, float]
) -> Float[np.ndarray, "3 3"]:
    """K of focal lengths and a principal point [px]."""
    if not min(focal) > 0.0:
        raise RigError(
            f"{owner}: the focal lengths are {focal[0]:g} and {focal[1]:g}, expected positive pixels"
        )
    return camera_matrix(*focal, *center)


def nearest_rotation(owner: str, matrix: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """The rotation (3, 3) that a matrix of few digits stands for."""
    left, stretch, right = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    rotation: NDArray[np.float64] = left @ right
    if np.abs(stretch - 1.0).max() > _SKEWED or np.linalg.det(rotation) < 0.0:
        raise RigError(f"{owner} is not a rotation matrix")
    return rotation


def rigid(
    rotation: Float[np.ndarray, "3 3"], position: Sequence[float] | Float[np.ndarray, "3"]
) -> NDArray[np.float64]:
    """The transform (4, 4) of a rotation and a position."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, position
    return transform


def brown_lens(*coefficients: float) -> Lens:
    """OpenCV's lens of k1, k2, p1, p2 and k3; a pinhole where all are zero."""
    return Lens("brown", coefficients) if any(coefficients) else Lens()


def camera_names(given: Sequence[str]) -> list[str]:
    """Names of cameras with nothing but letters, digits, - and _, each once."""
    names: list[str] = []
    for number, text in enumerate(given, 1):
        plain = _NAMELESS.sub("_", text).strip("_")[:_LONGEST_NAME] or f"camera{number}"
        names.append(plain if plain not in names else f"{plain}_{number}")
    return names
