"""Arrays from files of others: sizes are checked before anything is allocated, nothing is unpickled."""

from __future__ import annotations

import lzma
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

_MOST_MEMBERS: Final = 10_000
_MOST_DIMENSIONS: Final = 8
_ALWAYS: Final = 1 << 28  # bytes that any archive may hold
_LARGEST_RATIO: Final = 20  # of the bytes in memory to those of the file beyond that
_DAMAGE: Final = (
    AttributeError, EOFError, IndexError, KeyError, OverflowError, RuntimeError, SyntaxError, TypeError,
    tokenize.TokenError, lzma.LZMAError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What the libraries raise for a damaged archive, beside a ValueError."""


def read_npz(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """All arrays of an `.npz`, by name.

    Raises:
        ValueError: Not an archive of plain arrays, a header that does not fit its bytes, or far more bytes
            than such a file may hold.
        OSError: It cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            check_members(archive, path.stat().st_size)
            for member in archive.infolist():
                with archive.open(member) as file:
                    check_npy_header(file, member.file_size)
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except OSError as error:
        if error.errno is None:  # of a decompressor
            raise ValueError("damaged") from error
        raise
    except _DAMAGE as error:
        raise ValueError("damaged") from error


def check_members(archive: zipfile.ZipFile, size: int) -> None:
    """Raise a ValueError if an archive holds far more than a file of its size [bytes] may."""
    members = archive.infolist()
    held, most = sum(member.file_size for member in members), max(_ALWAYS, _LARGEST_RATIO * size)
    if len(members) > _MOST_MEMBERS or held > most:
        raise ValueError(f"{len(members)} members of {held} bytes, expected at most {most} bytes")


def check_npy_header(file: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the array in an `.npy` of `size` bytes, whose header must state exactly these."""
    version = np.lib.format.read_magic(file)
    if version not in {(1, 0), (2, 0)}:
        raise ValueError(f"an array file of version {version}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, _, dtype = read(file)
    except Exception as error:  # numpy reads it as Python text, which fails in many ways
        raise ValueError("no header of an array") from error
    if dtype.hasobject or dtype.itemsize == 0 or len(shape) > _MOST_DIMENSIONS or min(shape, default=0) < 0:
        raise ValueError(f"an array of type {dtype} and shape {shape}")
    if math.prod(shape) * dtype.itemsize != size - file.tell():
        raise ValueError(f"an array of type {dtype} and shape {shape} in {size} bytes")
    return shape, dtype
