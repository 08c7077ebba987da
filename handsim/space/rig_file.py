"""The TOML file of cameras: of a rig that sees markers, or of any cameras that pictures are drawn for.

What stands at the top holds for every camera whose own table says nothing else (docs/rigs.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimError, RigError
from handsim.files.atomic import read_toml
from handsim.files.names import as_text
from handsim.files.toml_values import (
    check_keys,
    number_list,
    number_of,
    numbers,
    quoted,
    shown,
    tables_of,
    text_of,
)
from handsim.space.camera import Camera, camera_matrix, focal_of_angle, look_at
from handsim.space.lens import Lens, LensKind

_SIZES: Final = ("size", "resolution")
_FOCALS: Final = ("focal", "K", "field_of_view", "horizontal_field_of_view")
_LENS: Final = ("lens", "coefficients")
_PICTURE: Final = (*_SIZES, *_FOCALS, "center", *_LENS)
"""Keys that say what a camera's picture is: at the top for all cameras, or a camera's own."""
_PLACE: Final = ("position", "target", "T_world_camera")
_TOP: Final = ("name", "description", *_PICTURE, "camera")
_CAMERA: Final = ("name", *_PICTURE, *_PLACE)
_USUAL: Final = 1280  # [px], where a file says nothing
_WIDEST: Final = 170.0  # [deg]
_MOST: Final = 256  # cameras
_FARTHEST: Final = 50.0  # [m]
_APART: Final = 1e-3  # [m] of a camera and its target
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")


class RigFile(NamedTuple):
    """What a file says; `CameraRig` checks whether its cameras can be a rig."""

    name: str
    description: str
    cameras: tuple[Camera, ...]


def read_rig_file(path: Path) -> RigFile:
    """Read a file of cameras."""
    table = read_toml(path, error=RigError)
    try:
        return _parse(table, as_text(path.stem))
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error


def checked_cameras(path: Path, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras of a file, after a check of their number, their names and their distances."""
    if not 1 <= len(cameras) <= _MOST:
        raise RigError(f"{path}: {len(cameras)} cameras, expected 1 to {_MOST}")
    check_names(str(path), cameras)
    for camera in cameras:
        try:
            check_near(f"camera '{camera.name}'", camera)
        except RigError as error:
            raise RigError(f"{path}: {error}") from error
    return tuple(cameras)


def check_names(owner: str, cameras: Sequence[Camera]) -> None:
    """Refuse two cameras of one name, and names that cannot be part of a file's.

    Raises:
        RigError: There are such.
    """
    names = [camera.name for camera in cameras]
    for name in names:
        if not _NAME.fullmatch(name):
            raise RigError(
                f"{owner}: a camera is called {shown(name)}, expected up to 64 letters, digits, - and _"
            )
        if names.count(name) > 1:
            raise RigError(f"{owner}: two cameras are called '{name}', expected different names")


def check_near(owner: str, camera: Camera) -> None:
    """Refuse a camera beyond 50 m."""
    distance = float(np.linalg.norm(camera.T_world_camera[:3, 3]))
    if distance > _FARTHEST:
        raise RigError(
            f"{owner} stands {distance:.4g} m from the origin, expected at most {_FARTHEST:g} m; "
            "are these millimeters? Positions are in meters"
        )


def rig_lines(name: str, cameras: Sequence[Camera]) -> list[str]:
    """The lines of a file, whose numbers are exact; pictures that all cameras share stand at the top."""
    pictures = [list(_picture_lines(one)) for one in cameras]
    shared = all(one == pictures[0] for one in pictures)
    lines = [f"name = {quoted(name)}", *(pictures[0] if shared else ())]
    for camera, picture in zip(cameras, pictures, strict=True):
        rows = [f"    {_written(row)}," for row in camera.T_world_camera.tolist()]
        lines += ["", "[[camera]]", f"name = {quoted(camera.name)}", *(() if shared else picture)]
        lines += ["T_world_camera = [", *rows, "]"]
    return lines


def _picture_lines(camera: Camera) -> Iterator[str]:
    yield f"size = {list(camera.size)}"
    yield f"focal = {_written(camera.focal_lengths)}"
    center = camera.K[:2, 2].tolist()
    if center != [length / 2 for length in camera.size]:
        yield f"center = {_written(center)}"
    if camera.lens.kind != "pinhole":
        yield f"lens = {quoted(camera.lens.kind)}"
        yield f"coefficients = {_written(camera.lens.coefficients)}"


def _written(values: Sequence[float]) -> str:
    """A list of TOML floats, to the last digit."""
    return f"[{', '.join(repr(float(value) + 0.0) for value in values)}]"


def _parse(table: Mapping[str, Any], stem: str) -> RigFile:
    check_keys(table, "the file", _TOP, optional=_TOP)
    name = table.get("name", stem)
    if not isinstance(name, str) or not name or not name.isprintable():
        raise RigError(f"name is {shown(name)}, expected printable text in quotes")
    top = {key: value for key, value in table.items() if key in _PICTURE}
    cameras = [_camera(top, entry, number) for number, entry in enumerate(tables_of(table, "camera"), 1)]
    return RigFile(name, text_of(table, "description", default=""), tuple(cameras))


def _camera(top: Mapping[str, Any], own: Mapping[str, Any], number: int) -> Camera:
    """A camera, with what its own table says in place of the like at the top."""
    owner = f"camera {number}"
    check_keys(own, owner, _CAMERA, optional=_CAMERA)
    pose = _pose(own, owner)
    given = {key: value for key, value in top.items() if not _replaced(key, own)} | dict(own)
    size = _size(given, f"{owner}: ")
    K, lens = _matrix(given, size, owner), _lens(given, owner)
    return Camera(text_of(own, "name", f"{owner}: ", default=f"camera{number}"), size, K, pose, lens)


def _replaced(key: str, own: Mapping[str, Any]) -> bool:
    """Whether a camera's own keys stand in place of one at the top."""
    if key == "center":
        return any(name in own for name in (*_SIZES, "K", "center"))
    return any(key in alike and name in own for alike in (_SIZES, _FOCALS, _LENS) for name in alike)


def _size(given: Mapping[str, Any], prefix: str) -> tuple[int, int]:
    """Width and height [px]."""
    if "size" in given and "resolution" in given:
        raise RigError(f"{prefix}size and resolution are given, expected one of them")
    if "size" not in given:
        resolution = given.get("resolution", _USUAL)
        if isinstance(resolution, bool) or not isinstance(resolution, int):
            raise RigError(f"{prefix}resolution is {shown(resolution)}, expected a whole number of pixels")
        return resolution, resolution
    sides = numbers(f"{prefix}size", given["size"], (2,), "width and height in pixels")
    if (sides % 1 != 0).any():
        raise RigError(f"{prefix}size is {shown(given['size'])}, expected whole numbers of pixels")
    return int(sides[0]), int(sides[1])


def _matrix(given: Mapping[str, Any], size: tuple[int, int], owner: str) -> NDArray[np.float64]:
    """K of the one key among `_FOCALS` that is given."""
    named = [key for key in _FOCALS if key in given]
    if len(named) != 1:
        raise RigError(
            f"{owner} has {' and '.join(named) or 'no focal length'}, expected one of {', '.join(_FOCALS)}"
        )
    key, prefix = named[0], f"{owner}: "
    if key == "K":
        if "center" in given:
            raise RigError(f"{owner} has K and center, expected one of them")
        return numbers(f"{prefix}K", given["K"], (3, 3), "three rows of three numbers")
    if key == "focal":
        shape = (2,) if isinstance(given["focal"], list) else ()
        focal = numbers(f"{prefix}focal", given["focal"], shape, "one or two focal lengths in pixels")
        focal = np.broadcast_to(focal, 2)
    else:
        degrees = number_of(given, key, prefix)
        if not 1.0 <= degrees <= _WIDEST:
            raise RigError(f"{prefix}{key} is {degrees:g} degrees, expected 1 to {_WIDEST:g}")
        length = min(size) if key == "field_of_view" else size[0]
        focal = np.full(2, focal_of_angle(length, np.deg2rad(degrees)))
    expected = "the principal point [cx, cy] in pixels"
    middle = [size[0] / 2, size[1] / 2]
    center = numbers(f"{prefix}center", given.get("center", middle), (2,), expected)
    return camera_matrix(*focal, *center)


def _lens(given: Mapping[str, Any], owner: str) -> Lens:
    kind = text_of(given, "lens", f"{owner}: ", default="pinhole")
    coefficients = number_list(f"{owner}: coefficients", given.get("coefficients", []))
    return Lens(cast("LensKind", kind), coefficients)  # which refuses unknown kinds


def _pose(table: Mapping[str, Any], owner: str) -> NDArray[np.float64]:
    """Where a camera is."""
    place = {key: table[key] for key in _PLACE if key in table}
    if set(place) == {"T_world_camera"}:
        return numbers(
            f"{owner}: T_world_camera", place["T_world_camera"], (4, 4), "four rows of four numbers"
        )
    if set(place) != {"position", "target"}:
        told = " and ".join(place) or "no place"
        raise RigError(f"{owner} has {told}, expected position and target, or T_world_camera alone")
    position, target = (
        numbers(f"{owner}: {key}", place[key], (3,), "three numbers [x, y, z] in meters")
        for key in ("position", "target")
    )
    if np.linalg.norm(target - position) < _APART:
        raise RigError(f"{owner} looks at its own position; expected a target in front of it")
    return look_at(position, target)
