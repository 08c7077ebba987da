"""The cameras of a file of any kind, by its ending and its content."""

from __future__ import annotations

import dataclasses
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from handsim.errors import HandSimError, HandSimWarning, RigError
from handsim.space.camera_file import checked_cameras, read_camera_file
from handsim.space.rig_formats import motive_mcal, qualisys_calibration, vicon_xcp
from handsim.space.rig_formats.colmap_file import CAMERAS, IMAGES, read_colmap_cameras
from handsim.space.rig_formats.lab_camera import LabCamera, Skipped, camera_names
from handsim.space.rig_formats.opencv_file import read_opencv_cameras
from handsim.space.rig_formats.xml_tree import read_xml

if TYPE_CHECKING:
    from handsim.space.camera import Camera


_OPENCV: Final = (".yml", ".yaml", ".json")
_XML: Final = (".xcp", ".xml", ".txt", ".mcal")
_READERS: Final[dict[str, Callable[[ET.Element], list[LabCamera | Skipped]]]] = {
    vicon_xcp.ROOT: vicon_xcp.read_xcp,
    qualisys_calibration.ROOT: qualisys_calibration.read_qualisys,
    motive_mcal.ROOT: motive_mcal.read_mcal,
}
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


def load_lab_cameras(path: str | Path) -> tuple[LabCamera, ...]:
    """The cameras of a file as `load_cameras` gives them, with what the file says of each.

    Raises:
        RigError: As `load_cameras`.
    """
    path, ending = Path(path), Path(path).suffix.lower()
    if ending == ".toml":
        return _plain(read_camera_file(path))
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
    reader = next((_READERS[tag] for tag in tags if tag in _READERS), None)
    if reader is None:
        raise RigError(
            f"{path}: its XML begins with <{root.tag[:40]}>, expected <{'>, <'.join(_READERS)}>: Vicon's, "
            "Qualisys' or Motive's calibration"
        )
    try:
        read = reader(root)
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error
    skipped = [one for one in read if isinstance(one, Skipped)]
    if skipped:
        named = ", ".join(f"{one.name[:40]} {one.why}" for one in skipped[:8])
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
