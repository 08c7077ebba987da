"""COLMAP's reconstructions as text: `cameras.txt` with the lenses, `images.txt` with the poses."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from handsim.errors import HandSimError, RigError, choices, shortened
from handsim.files.inputs import read_bytes
from handsim.space.camera import Camera, camera_matrix
from handsim.space.lens import Lens
from handsim.space.rig_file import checked_cameras
from handsim.space.rig_formats.lab_camera import brown_lens, rigid
from handsim.space.transforms import quaternion_matrix

CAMERAS: Final = "cameras.txt"
IMAGES: Final = "images.txt"
_MOST_BYTES: Final = 1 << 28  # images.txt lists all points of each image
_MODELS: Final = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "OPENCV_FISHEYE": 8,
}
"""Models that we read, and their numbers of parameters."""
_ONE_FOCAL: Final = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_NAMELESS: Final = re.compile(r"[^A-Za-z0-9_-]+")


def read_colmap_cameras(path: Path) -> tuple[Camera, ...]:
    """A camera for each image of a reconstruction in meters, called after it.

    `path` is the folder of `cameras.txt` and `images.txt`, or one of the two.

    Raises:
        RigError: A file is missing or damaged, or a model is one that we do not have.
    """
    folder = path if path.is_dir() else path.parent
    lenses = dict(_lens(folder / CAMERAS, line) for line in _lines(folder / CAMERAS))
    lines = _lines(folder / IMAGES, keep_empty=True)
    cameras = [_image(folder / IMAGES, line, lenses) for line in lines[::2]]  # points are on the others
    return checked_cameras(folder / IMAGES, cameras)


def _lines(path: Path, *, keep_empty: bool = False) -> list[str]:
    """Lines without comments; an image without points has an empty one."""
    try:
        text = read_bytes(path, error=RigError, most=_MOST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RigError(
            f"{path}: not COLMAP's text: it is not UTF-8; colmap model_converter writes it"
        ) from error
    lines = [line.strip() for line in text.splitlines() if not line.startswith("#")]
    if not keep_empty:
        return [line for line in lines if line]
    while lines and not lines[-1]:
        lines.pop()
    return lines


def _lens(path: Path, line: str) -> tuple[str, Camera]:
    """`CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`."""
    number, *rest = line.split()
    owner = f"{path}: camera {shortened(number)}"
    if len(rest) < 3:
        raise RigError(f"{owner} has {1 + len(rest)} values, expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    model = rest[0]
    if model not in _MODELS:
        raise RigError(f"{owner}: {choices(model, _MODELS, noun='model')}")
    width, height, *parameters = _numbers(owner, rest[1:])
    if len(parameters) != _MODELS[model] or not (width.is_integer() and height.is_integer()):
        raise RigError(
            f"{owner}: {width:g} x {height:g} pixels and {len(parameters)} parameters, expected whole "
            f"numbers and {_MODELS[model]} parameters of {model}"
        )
    if model in _ONE_FOCAL:
        parameters.insert(0, parameters[0])
    try:
        K, lens = camera_matrix(*parameters[:4]), _bent(model, parameters[4:])
        return number, Camera(number, (int(width), int(height)), K, lens=lens)
    except HandSimError as error:
        raise RigError(f"{owner}: {error}") from error


def _bent(model: str, bent: list[float]) -> Lens:
    if model.endswith("FISHEYE"):
        return Lens("fisheye", (*bent, 0.0, 0.0, 0.0)[:4])
    if model.endswith("RADIAL"):
        return brown_lens(*(*bent, 0.0)[:2], 0.0, 0.0, 0.0)
    if any(bent[5:]):
        raise RigError("k4, k5 or k6 of FULL_OPENCV is not 0, expected the model OPENCV")
    return brown_lens(*(*bent, *[0.0] * 5)[:5])


def _image(path: Path, line: str, lenses: dict[str, Camera]) -> Camera:
    """`IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, the pose of the world as the camera sees it."""
    words = line.split(maxsplit=9)
    if len(words) != 10:
        raise RigError(
            f"{path}: the line '{shortened(line)}' has {len(words)} values, expected "
            "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points after it"
        )
    owner = f"{path}: image {shortened(words[0])}"
    pose = np.array(_numbers(owner, words[1:8]))
    length = float(np.linalg.norm(pose[:4]))
    if abs(length - 1.0) > 1e-3:
        raise RigError(f"{owner}: a quaternion of length {length:.4g}, expected 1")
    if words[8] not in lenses:
        raise RigError(f"{owner}: {choices(words[8], lenses, noun='camera')}")
    R_world_camera = quaternion_matrix(pose[:4] / length).T
    lens = lenses[words[8]]
    name = _NAMELESS.sub("_", words[9].rpartition(".")[0] or words[9])[-64:]
    return Camera(name, lens.size, lens.K, rigid(R_world_camera, -R_world_camera @ pose[4:]), lens.lens)


def _numbers(owner: str, words: list[str]) -> list[float]:
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            values.append(np.nan)
        if not abs(values[-1]) < 1e9:
            raise RigError(f"{owner}: '{shortened(word)}' is no number that fits")
    return values
