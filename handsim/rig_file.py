"""What a camera rig's TOML file says, each value checked for its kind."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.errors import ShapeError, choices
from handsim.io import read_toml

if TYPE_CHECKING:
    from numpy.typing import NDArray

_RIG_KEYS: Final = ("name", "description", "field_of_view", "resolution", "camera")
_CAMERA_KEYS: Final = ("position", "target", "T_world_camera")
_LARGEST: Final = 1e9  # in any unit; keeps out NaN, infinity and integers beyond float


class RigTable(NamedTuple):
    """A rig as written; whether cameras can stand like that is `CameraRig`'s to say."""

    name: str
    field_of_view: float
    """[deg]"""
    resolution: int
    """[px]"""
    cameras: list[tuple[NDArray[np.float64], NDArray[np.float64]] | NDArray[np.float64]]
    """Position and target (3,) [m], or a pose (4, 4)."""


def read_rig_file(path: Path) -> RigTable:
    """Read a rig's file.

    Raises:
        ShapeError: It cannot be read, is damaged, or a key is missing, unknown or of another kind.
    """
    table = read_toml(path, error=ShapeError)
    try:
        return _parse(table)
    except ShapeError as error:
        raise ShapeError(f"{path}: {error}") from error


def _parse(table: Mapping[str, object]) -> RigTable:
    _check_keys(table, "the file", _RIG_KEYS)
    for key in ("name", "field_of_view"):
        if key not in table:
            raise ShapeError(f"the file lacks the key '{key}'")
    name, tables = table["name"], table.get("camera", [])
    if not isinstance(name, str) or not name or not name.isprintable():
        raise ShapeError(f"name is {_shown(name)}, wanted printable text in quotes")
    if not isinstance(tables, list) or not all(isinstance(entry, dict) for entry in tables):
        raise ShapeError("camera is not a list of tables; wanted one [[camera]] table a camera")
    resolution = table.get("resolution", 1280)
    if isinstance(resolution, bool) or not isinstance(resolution, int):
        raise ShapeError(f"resolution is {_shown(resolution)}, wanted a whole number of pixels")
    angle = float(_numbers("field_of_view", table["field_of_view"], ()))
    cameras = [_parse_camera(entry, f"camera {number}") for number, entry in enumerate(tables, 1)]
    return RigTable(name, angle, resolution, cameras)


def _parse_camera(
    table: Mapping[str, object], owner: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | NDArray[np.float64]:
    _check_keys(table, owner, _CAMERA_KEYS)
    if set(table) == {"T_world_camera"}:
        return _numbers(f"{owner}: T_world_camera", table["T_world_camera"], (4, 4))
    if set(table) == {"position", "target"}:
        position, target = (_numbers(f"{owner}: {key}", table[key], (3,)) for key in ("position", "target"))
        return position, target
    given = " and ".join(table) or "nothing"
    raise ShapeError(f"{owner} has {given}, wanted position and target, or T_world_camera alone")


def _check_keys(table: Mapping[str, object], owner: str, valid: tuple[str, ...]) -> None:
    for key in table:
        if key not in valid:
            raise ShapeError(f"{owner} has an {choices(key, valid, noun='key')}")


def _numbers(owner: str, value: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Nested lists of numbers as an array of exactly this shape."""
    wanted = {(): "a number", (3,): "three numbers [x, y, z] in metres", (4, 4): "four rows of four numbers"}
    try:
        array = np.array(value, dtype=object)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    flat = array.ravel().tolist()
    if array.shape != shape or not all(
        isinstance(entry, int | float) and not isinstance(entry, bool) and abs(entry) < _LARGEST
        for entry in flat
    ):
        raise ShapeError(f"{owner} is {_shown(value)}, wanted {wanted[shape]}")
    return np.array(flat, dtype=np.float64).reshape(shape)


def _shown(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 40 else text[:40] + "..."
