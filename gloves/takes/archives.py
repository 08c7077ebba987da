"""Takes as files: named arrays and a JSON header in one .npz, whole or not at all, and never unpickled."""

from __future__ import annotations

import json
import sys
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from gloves.takes.growing import GrownArchive, growing_path, is_growing
from handsim.errors import CaptureError, HandSimError, HandSimWarning
from handsim.files.arrays import read_npz
from handsim.files.atomic import atomic_write
from handsim.files.inputs import check_regular

Content = TypeVar("Content")

KINDS: Final = {
    "take": "the truth of a simulated capture",
    "tracked take": "a tracked take",
}
"""Kinds of content, and their names in messages."""
_OLDEST_KIND: Final = "take"  # of headers without a kind
_DAMAGE: Final = (
    HandSimError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, EOFError,
    RuntimeError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions that reading a damaged file may raise."""


class CutOffWarning(HandSimWarning):
    """A recording was cut off: it is read up to its last whole half second."""


def write_archive(
    path: Path, kind: str, schema: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    """Write arrays and a header.

    Args:
        path: The file, whose name should end in .npz.
        kind: One of `KINDS`.
        schema: Version of the form.
        header: The rest of the header, as JSON.
        arrays: By name; the name `header` is taken.
    """
    text = json.dumps({"kind": kind, "schema": schema} | dict(header))
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(text), **arrays)


def read_archive(
    path: str | Path,
    kind: str,
    schemas: Sequence[int],
    unpack: Callable[[dict[str, Any], dict[str, np.ndarray]], Content],
) -> Content:
    """Read what `write_archive` wrote.

    Args:
        path: The file.
        kind: The expected kind.
        schemas: Versions of the form that can be read.
        unpack: Makes the content from header and arrays; an exception means that they are damaged.

    Raises:
        CaptureError: No such file, of another kind or schema, or damaged.
    """
    path = Path(path)
    header, arrays = _read(path, kind)
    found = header.get("kind", _OLDEST_KIND)
    if found != kind and found in KINDS:
        raise CaptureError(f"{path}: {KINDS[found]}, expected {KINDS[kind]}")
    if "schema" not in header:
        raise CaptureError(f"{path}: not a {kind}, or a damaged one")
    if header["schema"] not in schemas:
        expected = " or ".join(map(str, schemas))
        raise CaptureError(f"{path}: a {kind} of schema {header['schema']}, expected {expected}")
    try:
        return unpack(header, arrays)
    except _DAMAGE as error:
        raise CaptureError(f"{path}: not a {kind}, or a damaged one") from error


def archive_kind(path: str | Path) -> str:
    """Which of `KINDS` a file is.

    Raises:
        CaptureError: No such file, or none of them.
    """
    path = Path(path)
    found = _read(path, "take")[0].get("kind", _OLDEST_KIND)
    if found not in KINDS:
        raise CaptureError(f"{path}: a {found}, expected {' or '.join(KINDS.values())}")
    return str(found)


def _read(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of any kind."""
    check_regular(path, error=CaptureError)
    if is_growing(path):
        return _read_cut_off(path, kind)
    if not path.exists() and growing_path(path).exists():
        raise CaptureError(
            f"{path}: no such file, but {growing_path(path)} is a recording that was cut off or is still "
            "running, and can be read"
        )
    try:
        arrays = read_npz(path)
        header = json.loads(_text(arrays["header"]))
        if not isinstance(header, dict):
            raise ValueError("the header is not a table")
    except CaptureError:
        raise
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise CaptureError(f"{path}: not a {kind}, or a damaged one") from error
    return header, arrays


def _read_cut_off(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a recording that was not finished."""
    try:
        grown = GrownArchive(path)
        arrays = grown.read()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise CaptureError(f"{path}: not a {kind}, or a damaged one") from error
    if grown.num_frames < 2:
        raise CaptureError(
            f"{path}: a recording that was cut off with {grown.num_frames} frames, expected two or more"
        )
    told = f"{path}: a recording that was cut off or is still running; it has {grown.num_frames} frames"
    warnings.warn(told, CutOffWarning, stacklevel=4)
    return grown.header, arrays


def _text(array: np.ndarray) -> str:
    """The text in an array; raises a `ValueError` if it is not one."""
    if array.dtype.kind != "U" or array.ndim or (array.reshape(1).view("u4") > sys.maxunicode).any():
        raise ValueError("not a text")
    return str(array)


def check_types(arrays: Mapping[str, np.ndarray], expected: Mapping[str, np.dtype[Any] | str]) -> None:
    """Raise a `ValueError` unless every array has its type."""
    if any(arrays[name].dtype != dtype for name, dtype in expected.items()):
        raise ValueError("numbers of another type")


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


def check_shapes(expected: Iterable[tuple[np.ndarray, tuple[int, ...]]]) -> None:
    """Raise a `ValueError` unless every array has its shape."""
    if any(array.shape != shape for array, shape in expected):
        raise ValueError("the arrays do not fit together")
