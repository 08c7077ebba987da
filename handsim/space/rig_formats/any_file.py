"""The cameras of a file of any kind, by its ending and its content; those that see markers."""

from __future__ import annotations

import dataclasses
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np

from handsim.errors import HandSimError, HandSimWarning, RigError, shortened
from handsim.space.camera import Camera
from handsim.space.rig_file import checked_cameras, read_rig_file
from handsim.space.rig_formats import motive_mcal, qualisys_calibration, vicon_xcp
from handsim.space.rig_formats.colmap_file import CAMERAS, IMAGES, read_colmap_cameras
from handsim.space.rig_formats.lab_camera import LabCamera, Skipped, camera_names
from handsim.space.rig_formats.opencv_file import read_opencv_cameras
from handsim.space.rig_formats.xml_tree import read_xml

Up = Literal["y", "z"]
_Y_TO_Z: Final = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""A turn about x that makes y up into z up."""
_LEVEL: Final = 0.3  # least share of the cameras' tops, on average, along the axis that points up
_OPENCV: Final = (".yml", ".yaml", ".json")
_XML: Final = (".xcp", ".xml", ".txt", ".mcal")
_READERS: Final[dict[str, tuple[str, Callable[[ET.Element, int], LabCamera | Skipped]]]] = {
    vicon_xcp.ROOT: ("Camera", vicon_xcp.read_camera),
    qualisys_calibration.ROOT: ("camera", qualisys_calibration.read_camera),
    motive_mcal.ROOT: ("Camera", motive_mcal.read_camera),
}
"""Of the element that a calibration begins with: those of its cameras, and what reads one."""
_CLOSED: Final = {
    ".cal": "Motive's .cal is a closed format; load it in Motive 3.2 or newer and export the calibration "
    "from there as .mcal",
    ".qca": "QTM's .qca is a closed format; export the calibration from QTM as .txt or .xml",
}


def load_cameras(path: str | Path) -> tuple[Camera, ...]:
    """The cameras of a file, by its ending.

    Args:
        path: A camera or rig file of ours (`.toml`), Vicon's `.xcp`, Qualisys' calibration (`.xml`, `.txt`),
            Motive's `.mcal`, OpenCV's calibration (`.yml`, `.yaml`, `.json`), or COLMAP's `cameras.txt`,
            `images.txt` or their folder.

    Returns:
        Cameras with intrinsics [px], lenses and poses in the file's world [m].

    Raises:
        RigError: The file cannot be read, or does not describe cameras; the sentence names it.
    """
    return tuple(one.camera for one in load_lab_cameras(path))


def import_cameras(path: str | Path, up: Up | None = None) -> tuple[Camera, ...]:
    """The cameras of a calibration that see markers, in a world with z up.

    Those that take pictures are left out where there are others, and named in a warning.

    Args:
        path: As for `load_cameras`.
        up: The axis that points up in the file; when not given y where its format says so, else z.

    Raises:
        RigError: As `load_cameras`; or no camera is calibrated.
    """
    found = load_lab_cameras(path)
    seeing = [one for one in found if not one.video] or list(found)
    if len(seeing) < len(found):
        named = ", ".join(one.camera.name for one in found if one.video)
        _tell(f"{path}: video cameras see no markers and are left out: {named}")
    axis = up or ("y" if all(one.y_up for one in seeing) else "z")
    turn = _Y_TO_Z if axis == "y" else np.eye(4)
    cameras = tuple(one.camera.at(turn @ one.camera.T_world_camera) for one in seeing)
    if -np.mean([one.T_world_camera[2, 1] for one in cameras]) < _LEVEL:
        _tell(
            f"{path}: with {axis} up, the tops of its cameras' pictures do not point up on average; is "
            "another axis up? --up says which"
        )
    return cameras


def _tell(sentence: str) -> None:
    warnings.warn(sentence, HandSimWarning, stacklevel=3)


def load_lab_cameras(path: str | Path) -> tuple[LabCamera, ...]:
    """The cameras of a file as `load_cameras` gives them, with what the file says of each."""
    path, ending = Path(path), Path(path).suffix.lower()
    if ending == ".toml":
        return _plain(checked_cameras(path, read_rig_file(path).cameras))
    if ending in _OPENCV:
        return _plain(read_opencv_cameras(path))
    if path.is_dir() or path.name in (CAMERAS, IMAGES):
        return _plain(read_colmap_cameras(path))
    if ending in _CLOSED:
        raise RigError(f"{path}: {_CLOSED[ending]}")
    if ending in _XML:
        return _of_xml(path)
    hint = "; colmap model_converter writes text" if ending == ".bin" else ""
    raise RigError(
        f"{path}: unknown kind of camera file, expected .toml, Vicon's .xcp, Qualisys' .xml or .txt, "
        f"Motive's .mcal, OpenCV's .yml or .json, or COLMAP's {CAMERAS} and {IMAGES}{hint}"
    )


def _plain(cameras: Sequence[Camera]) -> tuple[LabCamera, ...]:
    return tuple(LabCamera(camera) for camera in cameras)


def _of_xml(path: Path) -> tuple[LabCamera, ...]:
    root = read_xml(path)
    tags = [root.tag, *(entry.tag for entry in root)]  # QTM's server wraps its answer
    known = next((tag for tag in tags if tag in _READERS), None)
    if known is None:
        raise RigError(
            f"{path}: its XML begins with <{shortened(root.tag)}>, expected <{'>, <'.join(_READERS)}>: "
            "Vicon's, Qualisys' or Motive's calibration"
        )
    try:
        tag, read_camera = _READERS[known]
        read = [read_camera(entry, number) for number, entry in enumerate(root.iter(tag), 1)]
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error
    skipped = [one for one in read if isinstance(one, Skipped)]
    if skipped:
        named = ", ".join(f"{shortened(one.name)} {one.why}" for one in skipped[:8])
        more = f" and {len(skipped) - 8} more" if len(skipped) > 8 else ""
        told = f"{path}: {len(skipped)} of {len(read)} cameras are left out: {named}{more}"
        warnings.warn(told, HandSimWarning, stacklevel=3)
    found = [one for one in read if isinstance(one, LabCamera)]
    names = camera_names([one.camera.name for one in found])
    renamed = [
        one._replace(camera=dataclasses.replace(one.camera, name=name))
        for one, name in zip(found, names, strict=True)
    ]
    checked_cameras(path, [one.camera for one in renamed])
    return tuple(renamed)
