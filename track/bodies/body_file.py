"""Rigid bodies as TOML files: a name, and the markers' positions in millimeters in the body's own frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from handsim._checks import check_type
from handsim.errors import ArgumentError, HandSimError, choices
from handsim.files.inputs import check_keys, numbers, quoted, read_toml, tables_of, text_of, written
from handsim.files.outputs import atomic_write
from handsim.hand.shape import SIDES
from handsim.space.objects import named_object, object_names
from track.bodies.constellation import FEWEST
from track.bodies.rigid_body import RigidTemplate

SUFFIX: Final = ".toml"
AnyBody = RigidTemplate | str | Path
"""A rigid body, the name of one of handsim's objects, or the path of a .toml file."""
_EXPECTED: Final = "RigidTemplates, names of handsim's objects, or paths of .toml files"
_BODY_KEYS: Final = ("name", "description", "marker")
_MARKER_KEYS: Final = ("name", "place_mm")


class BodyError(HandSimError):
    """A body's file that cannot be read or written."""


def load_body(name_or_path: AnyBody) -> RigidTemplate:
    """The markers of one of handsim's objects by its name, or of any body by the path of a `.toml` file.

    A body itself is given back.
    """
    check_type("body", name_or_path, (RigidTemplate, str, Path), _EXPECTED)
    if isinstance(name_or_path, RigidTemplate):
        return name_or_path
    path = Path(name_or_path)
    if str(name_or_path) in object_names():
        return RigidTemplate.of(named_object(str(name_or_path)))
    if path.suffix.lower() != SUFFIX:
        ours = [name for name in object_names() if len(named_object(name).markers) >= FEWEST]
        unknown = choices(str(name_or_path), ours, noun="body")
        raise ArgumentError(f"{unknown}, or the path of a .toml file")
    table = read_toml(path, error=BodyError)
    try:
        return _parse_body(table)
    except HandSimError as error:
        raise BodyError(f"{path}: {error}") from error


def load_bodies(names_or_paths: AnyBody | Iterable[AnyBody]) -> tuple[RigidTemplate, ...]:
    """Bodies that are tracked together, or one.

    Raises:
        ArgumentError: An object is unknown, or a body has the name of another body or of a hand.
        BodyError: A file cannot be loaded.
    """
    if isinstance(names_or_paths, AnyBody):
        names_or_paths = (names_or_paths,)
    check_type("bodies", names_or_paths, Iterable, _EXPECTED)
    bodies: list[RigidTemplate] = []
    for name_or_path in names_or_paths:
        body = load_body(name_or_path)
        taken = (*SIDES, *(other.name for other in bodies))
        if body.name in taken:
            owner = "" if body is name_or_path else f"{name_or_path}: "
            raise ArgumentError(
                f"{owner}a body is named '{body.name}', expected a name of its own; taken are "
                f"{', '.join(taken)}"
            )
        bodies.append(body)
    return tuple(bodies)


def save_body(path: str | Path, body: RigidTemplate) -> None:
    """Write a body as TOML, numbers to nine decimals; `load_body` gives the same body again."""
    lines = [f"name = {quoted(body.name)}"]
    for name, position in zip(body.marker_names, 1e3 * body.positions, strict=True):
        numbers_mm = ", ".join(written(value) for value in position.tolist())
        lines += ["", "[[marker]]", f"name = {quoted(name)}", f"place_mm = [{numbers_mm}]"]
    try:
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", "utf-8")
    except OSError as error:
        raise BodyError(f"{path}: cannot be written: {error.strerror or error}") from error


def _parse_body(table: Mapping[str, object]) -> RigidTemplate:
    check_keys(table, "the file", _BODY_KEYS, optional=("description", "marker"))
    text_of(table, "description", default="")
    name = _printable("the body's name", text_of(table, "name"))
    markers = [_parse_marker(entry, number) for number, entry in enumerate(tables_of(table, "marker"), 1)]
    positions = np.array([position for _, position in markers]).reshape(-1, 3)
    return RigidTemplate(name, tuple(marker for marker, _ in markers), 1e-3 * positions)


def _parse_marker(table: Mapping[str, object], number: int) -> tuple[str, list[float]]:
    name = table.get("name")
    owner = f"marker '{name}'" if isinstance(name, str) else f"marker number {number}"
    check_keys(table, owner, _MARKER_KEYS)
    name = _printable("marker name", text_of(table, "name", f"{owner}: "))
    expected = "three numbers [x, y, z] in millimeters"
    return name, numbers(f"{owner}: place_mm", table["place_mm"], (3,), expected).tolist()


def _printable(what: str, name: str) -> str:
    """A name that marker files can hold."""
    if not name or name != name.strip() or not name.isprintable():
        raise ArgumentError(f"{what} {name!r}: expected printable characters without outer blanks")
    return name
