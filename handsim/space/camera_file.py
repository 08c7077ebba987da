"""Cameras of your own as a TOML file: a rig's file, or one with the size and the lens of every camera."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimError, RigError
from handsim.files.atomic import read_toml
from handsim.files.toml_values import check_keys, number_list, numbers, shown, tables_of, text_of
from handsim.space.camera import Camera, pinhole
from handsim.space.cameras import aimed, load_rig
from handsim.space.lens import Lens, LensKind
from handsim.space.rig_file import PLACE_KEYS, parse_place

_KEYS: Final = ("name", "description", "camera")
_OWN_KEYS: Final = ("name", "size", "focal", "center", "lens", "coefficients")
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MOST: Final = 256  # cameras
_FARTHEST: Final = 50.0  # [m]


def read_camera_file(path: Path) -> tuple[Camera, ...]:
    """The cameras of a `.toml` file (docs/rigs.md).

    Args:
        path: A file whose cameras have sizes and lenses of their own, or that of a rig, whose cameras become
            square pinhole cameras `camera1`, `camera2`, ... with its field of view and resolution.

    Returns:
        Cameras with their poses in the world [m]; pixels count from the picture's corner.

    Raises:
        RigError: The file cannot be read, or does not describe cameras; the sentence names it.
    """
    table = read_toml(path, error=RigError)
    if "field_of_view" in table:
        rig = load_rig(path)
        size = (rig.resolution, rig.resolution)
        return checked_cameras(
            path,
            [
                pinhole(f"camera{number}", size, rig.focal_length).at(pose)
                for number, pose in enumerate(rig.T_world_camera, 1)
            ],
        )
    try:
        check_keys(table, "the file", _KEYS, optional=("name", "description"))
        cameras = [
            _parse(entry, f"camera {number}") for number, entry in enumerate(tables_of(table, "camera"), 1)
        ]
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error
    return checked_cameras(path, cameras)


def checked_cameras(path: Path, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras of a file, after a check of their number, their names and their distances.

    Raises:
        RigError: There are none or too many, a name cannot be part of a file's name or comes twice, or a
            camera stands beyond 50 m: millimeters taken for meters.
    """
    if not 1 <= len(cameras) <= _MOST:
        raise RigError(f"{path}: {len(cameras)} cameras, expected 1 to {_MOST}")
    names = [camera.name for camera in cameras]
    for camera in cameras:
        if not _NAME.fullmatch(camera.name):
            raise RigError(
                f"{path}: a camera is called {shown(camera.name)}, expected up to 64 letters, digits, - and _"
            )
        if names.count(camera.name) > 1:
            raise RigError(f"{path}: two cameras are called '{camera.name}', expected different names")
        distance = float(np.linalg.norm(camera.T_world_camera[:3, 3]))
        if distance > _FARTHEST:
            raise RigError(
                f"{path}: camera '{camera.name}' stands {distance:.4g} m from the origin, expected at most "
                f"{_FARTHEST:g} m; are these millimeters? Positions are in meters"
            )
    return tuple(cameras)


def _parse(table: Mapping[str, object], owner: str) -> Camera:
    optional = (*PLACE_KEYS, "center", "lens", "coefficients")
    check_keys(table, owner, (*_OWN_KEYS, *PLACE_KEYS), optional=optional)
    size = numbers(f"{owner}: size", table["size"], (2,), "width and height in pixels")
    width, height = (int(length) for length in size)
    if (width, height) != tuple(size):
        raise HandSimError(f"{owner}: size is {shown(table['size'])}, expected whole numbers of pixels")
    focal = numbers(f"{owner}: focal", table["focal"], (2,), "two focal lengths [fx, fy] in pixels")
    middle = [width / 2, height / 2]
    center = numbers(
        f"{owner}: center", table.get("center", middle), (2,), "the principal point [cx, cy] in pixels"
    )
    kind = text_of(table, "lens", f"{owner}: ", default="pinhole")
    coefficients = number_list(f"{owner}: coefficients", table.get("coefficients", []))
    K = np.array([[focal[0], 0.0, center[0]], [0.0, focal[1], center[1]], [0.0, 0.0, 1.0]])
    lens = Lens(cast("LensKind", kind), coefficients)  # which refuses unknown kinds
    return Camera(text_of(table, "name", f"{owner}: "), (width, height), K, _pose(table, owner), lens)


def _pose(table: Mapping[str, object], owner: str) -> NDArray[np.float64]:
    place = parse_place({key: table[key] for key in PLACE_KEYS if key in table}, owner)
    pose = aimed(owner, *place) if isinstance(place, tuple) else place
    if not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise HandSimError(f"{owner}: the last row of T_world_camera is not [0, 0, 0, 1]")
    return pose
