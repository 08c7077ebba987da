"""A camera rig's TOML file, each value checked for its type."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import HandSimError, RigError
from handsim.files.atomic import read_toml
from handsim.files.toml_values import (
    check_keys,
    number_of,
    numbers,
    quoted,
    shown,
    tables_of,
    text_of,
    written,
)

_RIG_KEYS: Final = ("name", "description", "field_of_view", "resolution", "camera")
PLACE_KEYS: Final = ("position", "target", "T_world_camera")
"""Keys that say where a camera is."""
_OWN_LENS: Final = ("size", "focal", "lens")


class RigTable(NamedTuple):
    """A rig as written in its file; `CameraRig` checks whether it can be set up."""

    name: str
    field_of_view: float
    """[deg]"""
    resolution: int
    """[px]"""
    cameras: list[tuple[NDArray[np.float64], NDArray[np.float64]] | NDArray[np.float64]]
    """Position and target (3,) [m], or a pose (4, 4)."""
    description: str = ""


def read_rig_file(path: Path) -> RigTable:
    """Read a rig's file.

    Raises:
        RigError: It cannot be read, is damaged, or a key is missing, unknown or of another type.
    """
    table = read_toml(path, error=RigError)
    try:
        return _parse(table)
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error


def _parse(table: Mapping[str, object]) -> RigTable:
    if any(key in camera for camera in tables_of(table, "camera") for key in _OWN_LENS):
        raise RigError(
            "its cameras have sizes and lenses of their own, which handsim render --cameras takes; expected "
            "a rig, whose cameras share field_of_view and resolution"
        )
    check_keys(table, "the file", _RIG_KEYS, optional=("description", "resolution", "camera"))
    name, tables = table["name"], tables_of(table, "camera")
    if not isinstance(name, str) or not name or not name.isprintable():
        raise RigError(f"name is {shown(name)}, expected printable text in quotes")
    resolution = table.get("resolution", 1280)
    if isinstance(resolution, bool) or not isinstance(resolution, int):
        raise RigError(f"resolution is {shown(resolution)}, expected a whole number of pixels")
    angle = number_of(table, "field_of_view")
    cameras = [parse_place(entry, f"camera {number}") for number, entry in enumerate(tables, 1)]
    return RigTable(name, angle, resolution, cameras, text_of(table, "description", default=""))


def rig_lines(
    name: str, field_of_view: float, resolution: int, poses: Float[np.ndarray, "C 4 4"]
) -> list[str]:
    """The lines of a rig's file.

    Args:
        name: The rig's name.
        field_of_view: Full opening of the view cone [deg].
        resolution: Pixels across it.
        poses: `T_world_camera` of each camera [m].
    """
    lines = [f"name = {quoted(name)}", f"field_of_view = {written(field_of_view)}"]
    lines.append(f"resolution = {resolution}")
    for pose in poses.tolist():
        rows = [f"    [{', '.join(map(written, row))}]," for row in pose]
        lines += ["", "[[camera]]", "T_world_camera = [", *rows, "]"]
    return lines


def parse_place(
    table: Mapping[str, object], owner: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | NDArray[np.float64]:
    """Where a camera is: position and target (3,) [m], or a pose (4, 4).

    Raises:
        HandSimError: The table has other keys, or values of another type.
    """
    check_keys(table, owner, PLACE_KEYS, optional=PLACE_KEYS)
    if set(table) == {"T_world_camera"}:
        return numbers(
            f"{owner}: T_world_camera", table["T_world_camera"], (4, 4), "four rows of four numbers"
        )
    if set(table) == {"position", "target"}:
        expected = "three numbers [x, y, z] in meters"
        position, target = (
            numbers(f"{owner}: {key}", table[key], (3,), expected) for key in ("position", "target")
        )
        return position, target
    given = " and ".join(table) or "nothing"
    raise RigError(f"{owner} has {given}, expected position and target, or T_world_camera alone")
