"""Readers of files that somebody else wrote: regular files of a bounded size, and values of TOML files.

A wrong value raises a `HandSimError` that names the key; the caller adds the name of the file.
"""

from __future__ import annotations

import codecs
import errno
import functools
import hashlib
import json
import os
import re
import stat
import tomllib
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import DatasetError, HandSimError, choices, shortened

if TYPE_CHECKING:
    from upath import UPath


_NONBLOCKING: Final = getattr(os, "O_NONBLOCK", 0)
_MAX_TOML_BYTES: Final = 1 << 18  # bytes; a layout of 60 markers has 6000
_MAX_JSON_BYTES: Final = 1 << 26  # bytes
_LONG_KEY: Final = re.compile(r"""(?:\.\s{0,9}[\w"'-]+\s{0,9}){20}""")
"""A dotted key of twenty parts; tomllib takes hours for very long ones."""
_SPECIAL_FILES: Final = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_MAX_NUMBER: Final = 1e9
"""Largest number, in any unit; it excludes NaN, infinity and integers beyond float."""


def check_regular(path: Path, *, error: type[HandSimError], max_bytes: int | None = None) -> None:
    """Refuse a pipe, a socket or a device, which may never end, and a file of more than `max_bytes`."""
    try:
        found = path.stat()
    except OSError:
        return
    except ValueError as cause:  # a zero byte in the name
        raise error(f"{str(path)!r}: not the name of a file") from cause
    for is_kind, kind in _SPECIAL_FILES:
        if is_kind(found.st_mode):
            raise error(f"{path}: this is {kind}, expected a regular file; write it to a file first")
    if max_bytes is not None and found.st_size > max_bytes and stat.S_ISREG(found.st_mode):
        raise error(f"{path}: the file is {found.st_size} bytes long, expected at most {max_bytes}")


def check_there(path: Path, *, error: type[HandSimError]) -> None:
    """Refuse a path where no file and no folder is, before long work that needs it later."""
    if not path.exists():
        raise error(f"{path}: cannot be read: {os.strerror(errno.ENOENT)}")


def read_bytes(path: Path, *, error: type[HandSimError], max_bytes: int | None = None) -> bytes:
    """The bytes of a regular file of at most `max_bytes`."""
    check_regular(path, error=error, max_bytes=max_bytes)
    try:
        # Without waiting: the path may have become a pipe since it was checked.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NONBLOCKING)) as file:
            return file.read(max_bytes)
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror or cause}") from cause


def text_encoding(data: bytes) -> str:
    """The encoding of a text: UTF-8, or UTF-16 (which programs of Windows write) with or without its mark."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    return {0: "utf-16-be", 1: "utf-16-le"}.get(data[:2].find(b"\0"), "utf-8-sig")


def checksum(path: Path | UPath) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


def read_toml(path: Path, *, error: type[HandSimError]) -> dict[str, Any]:
    """The tables of a TOML file."""
    data = read_bytes(path, error=error, max_bytes=_MAX_TOML_BYTES)
    try:
        text = data.decode(text_encoding(data))
        deep = _LONG_KEY.search(text)
        if deep is not None:
            raise tomllib.TOMLDecodeError(f"the key {shortened(deep[0])!r} has too many parts")
        table = tomllib.loads(text)
        if _has_long_integer(table):
            raise OverflowError
        return table
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a TOML file: it is not UTF-8 text") from cause
    except tomllib.TOMLDecodeError as cause:
        raise error(f"{path}: not a TOML file: {cause}") from cause
    except (ValueError, OverflowError) as cause:  # Python reads no more than some thousand digits
        raise error(f"{path}: not a TOML file: an integer of more than 64 bits") from cause
    except RecursionError as cause:
        raise error(f"{path}: not a TOML file: brackets are nested too deep") from cause


def _has_long_integer(value: object) -> bool:
    """Whether a table holds an integer beyond TOML's 64 bits, which Python accepts."""
    if isinstance(value, dict | list):
        return any(map(_has_long_integer, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int) and value.bit_length() > 63


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object."""
    try:
        content = json.loads(read_bytes(path, error=DatasetError, max_bytes=_MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is damaged: it does not hold JSON") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is damaged: it does not hold a JSON object")
    return content


@functools.cache
def package_data(package: str, name: str) -> dict[str, Any]:
    """A JSON file of a package's own data."""
    text = resources.files(package).joinpath(f"data/{name}.json").read_text(encoding="utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


def check_keys(
    table: Mapping[str, object], owner: str, valid: Collection[str], *, optional: Collection[str] = ()
) -> None:
    """Raise a `HandSimError` unless a table has all the keys that it must have, and no others."""
    for key in table:
        if key not in valid:
            raise HandSimError(f"{owner} has an {choices(key, valid, noun='key')}")
    for key in valid:
        if key not in table and key not in optional:
            raise HandSimError(f"{owner} lacks the key '{key}'")


def tables_of(table: Mapping[str, object], key: str) -> list[dict[str, Any]]:
    """A list of tables; empty if the key is missing."""
    tables = table.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(entry, dict) for entry in tables):
        raise HandSimError(f"{key} is not a list of tables; expected one [[{key}]] table per {key}")
    return tables


def text_of(table: Mapping[str, object], key: str, prefix: str = "", *, default: str | None = None) -> str:
    """The text under a key of a table."""
    value = table.get(key, default)
    if not isinstance(value, str):
        raise HandSimError(f"{prefix}{key} is {shown(value)}, expected text in quotes")
    return value


def number_of(
    table: Mapping[str, object], key: str, prefix: str = "", *, default: float | None = None
) -> float:
    """The finite number under a key of a table."""
    return float(numbers(f"{prefix}{key}", table.get(key, default), (), "a number"))


def numbers(owner: str, value: object, shape: tuple[int, ...], expected: str) -> NDArray[np.float64]:
    """Nested lists of finite numbers as an array of exactly this shape; `expected` describes it in words."""
    try:
        array = np.array(value, dtype=object)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    flat = array.ravel().tolist()
    if array.shape != shape or not all(
        isinstance(entry, int | float) and not isinstance(entry, bool) and abs(entry) < _MAX_NUMBER
        for entry in flat
    ):
        raise HandSimError(f"{owner} is {shown(value)}, expected {expected}")
    return np.array(flat, dtype=np.float64).reshape(shape)


def words_numbers(words: Sequence[str]) -> tuple[float, ...]:
    """Words as numbers; empty if a word is not a number."""
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        return ()


def number_list(owner: str, value: object) -> tuple[float, ...]:
    """A list of finite numbers, of any length."""
    count = len(value) if isinstance(value, list) else -1
    return tuple(numbers(owner, value, (count,), "a list of numbers").tolist())


def shown(value: object) -> str:
    """A value for a sentence, shortened where it is long."""
    return shortened(json.dumps(value, default=str, ensure_ascii=False))


def toml_string(text: str) -> str:
    """A TOML basic string, which escapes as JSON does, and the delete character too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def toml_number(value: float) -> str:
    """A TOML float without the noise of unit conversion; never '-0.0'."""
    return repr(round(value, 9) + 0.0)
