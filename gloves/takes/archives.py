"""Takes as files: named arrays and a JSON header in one .npz, whole or not at all, and never unpickled."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from gloves.takes.growing import GrownArchive, growing_path, is_growing
from handsim.errors import CaptureError, HandSimError, HandSimWarning, shortened
from handsim.files.arrays import Member, read_npz, write_npz
from handsim.files.atomic import atomic_write
from handsim.files.inputs import check_regular

Content = TypeVar("Content")

SCHEMA: Final = 4
"""Version of the form of takes. Until 3 points were tables, until 2 simulated and tracked takes differed."""
_READABLE: Final = (3, SCHEMA)
"""Versions that are read."""
_KINDS: Final = ("take", "tracked take")
"""Kinds in headers: the first of takes, the other of takes as trackers wrote them before schema 3."""
_DAMAGE: Final = (
    HandSimError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, RuntimeError,
    SyntaxError,
)  # fmt: skip
"""Exceptions that reading a damaged file may raise."""


class CutOffWarning(HandSimWarning):
    """A recording was cut off: it is read up to its last whole half second."""


def write_archive(path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and a header.

    Args:
        path: The file, whose name should end in .npz.
        header: As JSON, with `kind` and `schema`.
        arrays: By name; the name `header` is taken.
    """
    with atomic_write(path) as temporary:
        every = {"header": np.array(json.dumps(dict(header))), **arrays}
        write_npz(temporary, (Member.of(name, array) for name, array in every.items()))


def read_archive(
    path: str | Path, unpack: Callable[[dict[str, Any], dict[str, np.ndarray]], Content]
) -> Content:
    """Read what `write_archive` wrote, or what has been recorded of it until now.

    `unpack` makes the content from header and arrays; an exception means that they are damaged.
    """
    path = Path(path)
    header, arrays = _read(path)
    kind, schema = header.get("kind", _KINDS[0]), header.get("schema")
    if not isinstance(kind, str) or not isinstance(schema, int):
        raise CaptureError(_damaged(path))
    if kind not in _KINDS:
        raise CaptureError(f"{path}: a {shortened(kind)}, expected a take")
    if schema not in _READABLE or kind != _KINDS[0]:
        raise CaptureError(
            f"{path}: a {kind} of schema {shortened(str(schema))}, expected a take of schema {SCHEMA}; "
            "simulate or track it again with this version of handsim"
        )
    try:
        return unpack(header, arrays)
    except _DAMAGE as error:
        raise CaptureError(_damaged(path)) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays."""
    check_regular(path, error=CaptureError)
    if is_growing(path):
        return _read_cut_off(path)
    if not path.exists() and growing_path(path).exists():
        raise CaptureError(
            f"{path}: no such file, but {growing_path(path)} is a recording that was cut off or is still "
            "running, and can be read"
        )
    try:
        arrays = read_npz(path)
        array = arrays["header"]
        if array.dtype.kind != "U" or array.ndim or (array.reshape(1).view("u4") > sys.maxunicode).any():
            raise ValueError("not a text")
        header = json.loads(str(array))
        if not isinstance(header, dict):
            raise ValueError("the header is not a table")
    except CaptureError:
        raise
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise CaptureError(_damaged(path)) from error
    return header, arrays


def _read_cut_off(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a recording that was not finished."""
    try:
        grown = GrownArchive(path)
        arrays = grown.read()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise CaptureError(_damaged(path)) from error
    if grown.num_frames < 2:
        raise CaptureError(
            f"{path}: a recording that was cut off with {grown.num_frames} frames, expected two or more"
        )
    told = f"{path}: a recording that was cut off or is still running; it has {grown.num_frames} frames"
    if grown.num_lost_bytes:
        told += f"; {grown.num_lost_bytes} bytes after them, an incomplete half second, are left out"
    warnings.warn(told, CutOffWarning, stacklevel=4)
    return grown.header, arrays


def _damaged(path: Path) -> str:
    if path.suffix.lower() != ".npz":
        return f"{path}: not a take (.npz); handsim track makes one of a capture"
    return f"{path}: not a take, or a damaged one"


def names_of(stored: object) -> tuple[str, ...]:
    """A stored list of names; raises a `ValueError` if it is something else."""
    if not isinstance(stored, list) or not all(isinstance(name, str) for name in stored):
        raise ValueError("names are not a list of texts")
    return tuple(stored)


def settings_of(header: Mapping[str, Any]) -> dict[str, Any]:
    """The stored settings; raises a `ValueError` if they are not a table."""
    settings = header["settings"]
    if not isinstance(settings, dict):
        raise ValueError("settings are not a table")
    return settings
