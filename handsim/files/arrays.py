"""Files of arrays (.npz): sizes are checked before memory is allocated, and nothing is unpickled.

The writer writes no file that the reader would refuse because of its size.
"""

from __future__ import annotations

import io
import lzma
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

_ALWAYS_ALLOWED: Final = 1 << 28  # size to which every archive may expand [bytes]
_COMPRESSION_LEVEL: Final = 1  # Level 6 makes takes 3 % smaller, and takes 2.4 times as long.
_MAX_RATIO: Final = 20  # largest ratio of the expanded size of a larger archive to the size of its file
_DAMAGE_ERRORS: Final = (
    AttributeError, EOFError, IndexError, KeyError, OverflowError, RuntimeError, SyntaxError, TypeError,
    tokenize.TokenError, lzma.LZMAError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What the libraries raise for a damaged archive, beside a ValueError."""


class Member(NamedTuple):
    """An array of an archive, given in parts, so that it may be larger than memory."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    parts: Callable[[], Iterable[NDArray[Any]]]
    """Gives its entries in contiguous parts; called once or twice."""

    @classmethod
    def of(cls, name: str, array: NDArray[Any]) -> Member:
        """The member of an array in memory."""
        return cls(name, array.dtype, array.shape, lambda: (np.ascontiguousarray(array),))


def write_npz(path: Path, members: Iterable[Member]) -> None:
    """Write arrays as an `.npz` that `read_npz` reads.

    Arrays are compressed. The reader refuses an archive that expands too much, such as hours in which nothing
    moves; such an archive is written again without compression.
    """
    members = list(members)
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
        with zipfile.ZipFile(path, "w", method, compresslevel=_COMPRESSION_LEVEL) as archive:
            for name, dtype, shape, parts in members:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    form = {
                        "descr": np.lib.format.dtype_to_descr(dtype),
                        "fortran_order": False,
                        "shape": shape,
                    }
                    np.lib.format.write_array_header_1_0(file, form)
                    for part in parts():
                        file.write(part.reshape(-1).view(np.uint8))
            held = _unpacked_bytes(archive)
        if held <= _max_unpacked(path.stat().st_size):
            return


def check_npz(path: Path) -> None:
    """Read an `.npz` to its end without keeping its arrays."""
    with _damage_as_value_error(), path.open("rb") as file, zipfile.ZipFile(file) as archive:
        _check_archive(archive, file)
        if archive.testzip() is not None:
            raise ValueError("damaged")


def read_npz(source: Path | bytes) -> dict[str, np.ndarray[Any, Any]]:
    """All arrays of an `.npz`, given by its path or as its content, by name."""
    with (
        _damage_as_value_error(),
        io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as file,
        zipfile.ZipFile(file) as archive,
    ):
        _check_archive(archive, file)
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}


@contextmanager
def _damage_as_value_error() -> Iterator[None]:
    """Turn what the libraries raise for a damaged archive into a ValueError."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # raised by a decompressor
            raise ValueError("damaged") from error
        raise
    except _DAMAGE_ERRORS as error:
        raise ValueError("damaged") from error


def _check_archive(archive: zipfile.ZipFile, file: IO[bytes]) -> None:
    """Raise a ValueError unless an archive holds plain arrays that expand to an allowed size."""
    check_members(archive, file.seek(0, io.SEEK_END))
    for member in archive.infolist():
        with archive.open(member) as array:
            check_npy_header(array, member.file_size)


def check_members(archive: zipfile.ZipFile, size: int) -> None:
    """Raise a ValueError if an archive holds far more than a file of its size [bytes] may."""
    members, held, most = archive.infolist(), _unpacked_bytes(archive), _max_unpacked(size)
    if len(members) > 10_000 or held > most:
        raise ValueError(f"{len(members)} members of {held} bytes, expected at most {most} bytes")


def _unpacked_bytes(archive: zipfile.ZipFile) -> int:
    """Bytes of an archive's members in memory."""
    return sum(member.file_size for member in archive.infolist())


def _max_unpacked(size: int) -> int:
    """Bytes that a file of a size may hold in memory."""
    return max(_ALWAYS_ALLOWED, _MAX_RATIO * size)


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
    if dtype.hasobject or dtype.itemsize == 0 or len(shape) > 8 or min(shape, default=0) < 0:
        raise ValueError(f"an array of type {dtype} and shape {shape}")
    if math.prod(shape) * dtype.itemsize != size - file.tell():
        raise ValueError(f"an array of type {dtype} and shape {shape} in {size} bytes")
    return shape, dtype
