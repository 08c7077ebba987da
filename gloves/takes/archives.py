"""Takes as files: arrays and a JSON header in one .npz, or in an archive that grows while it is recorded.

A growing archive holds all frames but those of the last half second, however the recording ends. It begins
with a JSON header and the arrays that do not grow. Each of the following blocks has some frames, their number
and a checksum; an incomplete block is ignored. If other hands follow, a block holds the hands of the frames
before it. `finish_archive` converts a growing archive to an .npz block by block, so that its memory does not
grow.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import struct
import sys
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from gloves.captures.capture import OF_ARRAYS
from gloves.takes.points import POINT_COUNTS, Column
from gloves.takes.worn import FORMER
from handsim.callbacks import Closing
from handsim.errors import DAMAGE, ArgumentError, CaptureError, HandSimWarning, shortened
from handsim.files.arrays import Member, check_npy_header, check_npz, read_npz, write_npz
from handsim.files.inputs import check_regular
from handsim.files.outputs import atomic_write, make_folder_of
from handsim.files.signals import signals_wait

GROWING_SUFFIX: Final = ".part"
"""Suffix that is added to the name of the archive."""
_MAGIC: Final = b"handsim recording 1\n"
_PART_SIZE: Final = struct.Struct("<I")
_BLOCK_HEAD: Final = struct.Struct("<4s4I")
"""Mark, number of the block, frames, points, and CRC-32 of the block's columns."""
_FRAMES_MARK: Final = b"blk\n"
_FORMER_MARK: Final = b"one\n"
"""Mark of a block with former hands; it states their size in place of the number of points."""
_CHECKSUM: Final = "checksum"
_BLOCK_INTERVAL: Final = 0.5  # time between two blocks [s]
_SPARE_BYTES: Final = 4096  # room in which the header may grow
_MAX_HEADER: Final = 1 << 26  # bytes
_MAX_WAITING_FRAMES: Final = 1 << 16
"""Number of frames after which a block is written early; half a second has far fewer."""
_MAX_WAITING_POINTS: Final = 1 << 21
"""Number of points after which a block is written early."""
SCHEMA: Final = 4
"""Version of the files of takes. Points are tables up to 3; up to 2 simulated and tracked takes differ."""
_READABLE_SCHEMAS: Final = (3, SCHEMA)
_HEADER_KINDS: Final = ("take", "tracked take")
"""Kinds in headers; trackers wrote the second one before schema 3."""


def growing_path(archive: Path) -> Path:
    """Path of the growing archive that will become `archive`."""
    return archive.with_name(archive.name + GROWING_SUFFIX)


def check_unused(path: Path) -> None:
    """Refuse to record to a file that exists: a recording that was cut off is never overwritten."""
    if os.path.lexists(path):
        raise CaptureError(
            f"{path} exists: a recording that was cut off, or one that is still running; give it another "
            "name or remove it, or name another output"
        )


class GrowingArchive(Closing):
    """Writes a new archive that grows by `columns`, in whose shapes only T and P are still letters."""

    def __init__(
        self,
        path: Path,
        header: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        columns: Sequence[Column],
    ) -> None:
        self.path, self._place = path, path.absolute()
        """Path of the file as given, or a new path after another program has replaced the file."""
        self._columns = (POINT_COUNTS, *columns)
        self._waiting: list[list[bytes]] = []  # each frame's entry of every column
        self._points = 0
        self._due = math.inf
        self._head = self._packed_head(header, arrays)
        if max(map(len, self._head)) > _MAX_HEADER:  # it could not be read again
            raise CaptureError(f"{path}: the settings take more than {_MAX_HEADER} bytes")
        make_folder_of(path)
        try:
            self._file = open(path, "x+b", buffering=0)
        except FileExistsError:
            check_unused(path)
            raise
        self._write_head()
        self._blocks = [
            (self._file.tell(), 0)
        ]  # end of the head and of each block [bytes], frames until there

    @property
    def num_frames(self) -> int:
        """Number of frames that are in the file or wait for it."""
        return self._blocks[-1][1] + len(self._waiting)

    def add(self, values: Mapping[str, NDArray[Any] | float], num_points: int) -> None:
        """Add a frame; a column of points needs an entry for each of `num_points` points."""
        rows: Mapping[str, Any] = {**values, POINT_COUNTS.name: num_points}
        packed = []
        for column in self._columns:
            row = np.asarray(rows[column.name], column.dtype)
            if row.shape != ((num_points,) if column.of_points else ()) + column.entry:
                raise ValueError(f"{column.name} has shape {row.shape}")
            packed.append(row.tobytes())
        self._waiting.append(packed)  # one step, so that an interrupt leaves no partial frame
        self._points += num_points
        self._due = min(self._due, time.monotonic() + _BLOCK_INTERVAL)
        self.flush_due()

    def replace_head(self, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write a header and arrays of fixed size over the old ones, if they fit into the same room."""
        head = self._packed_head(header, arrays, len(self._head[0]))
        if list(map(len, head)) == list(map(len, self._head)):
            self._head = head
            with signals_wait():  # until the file can be read again
                self._file.seek(0)
                self._write_head()
                self._file.seek(0, os.SEEK_END)

    def add_former(self, entry: NDArray[Any]) -> None:
        """Write the hands (1,) of the frames until now, because other hands follow."""
        self.flush()
        with signals_wait():
            self._restore()
            self._write_block(_FORMER_MARK, 0, entry.nbytes, entry.tobytes())

    def flush_due(self) -> None:
        """Write the waiting frames if there are many, or if they are half a second old."""
        is_full = len(self._waiting) >= _MAX_WAITING_FRAMES or self._points >= _MAX_WAITING_POINTS
        if is_full or time.monotonic() >= self._due:
            self.flush()

    def flush(self) -> None:
        """Write the waiting frames as a block."""
        if not self._waiting:
            return
        with signals_wait():  # until the block is whole and counted
            self._restore()
            rows, self._waiting, self._points, self._due = self._waiting, [], 0, math.inf
            counts, *others = (b"".join(column) for column in zip(*rows, strict=True))
            points = int(np.frombuffer(counts, POINT_COUNTS.dtype).sum(dtype=np.int64))
            content = b"".join((counts, *others))
            self._write_block(_FRAMES_MARK, len(rows), points, content)

    def _write_block(self, mark: bytes, frames: int, count: int, content: bytes) -> None:
        head = _BLOCK_HEAD.pack(mark, len(self._blocks) - 1, frames, count, zlib.crc32(content))
        _write_all(self._file, head + content)
        self._blocks.append((self._file.tell(), self._blocks[-1][1] + frames))

    def close(self) -> None:
        """Write the waiting frames, and close the file."""
        if self._file.closed:
            return
        try:
            self.flush()
            with signals_wait():
                self._restore()
        finally:
            self._file.close()

    def _restore(self) -> None:
        """Repair the file if another program has changed its length or removed it."""
        there = os.fstat(self._file.fileno())
        end, frames = self._blocks[-1]
        if there.st_size != end:
            while len(self._blocks) > 1 and self._blocks[-1][0] > there.st_size:
                self._blocks.pop()
            self._file.truncate(self._blocks[-1][0])
            if len(self._blocks) == 1:
                self._file.seek(0)
                self._write_head()
            if lost := frames - self._blocks[-1][1]:
                message = f"{self.path} was cut by another program: {lost} of its {frames} frames are lost"
                warnings.warn(message, HandSimWarning, stacklevel=2)
        self._file.seek(0, os.SEEK_END)
        if not _leads_to(self._place, there):
            self._write_again()

    def _write_again(self) -> None:
        """Write the whole file again at its path, or near it if the path is taken or cannot be written."""
        gone = self.path
        self._place, file = _open_near(self._place)
        self.path = self._place
        self._file.seek(0)
        while content := self._file.read(1 << 20):
            _write_all(file, content)
        self._file.close()
        self._file = file
        message = (
            f"{gone} was removed or replaced by another program: it is written again, whole, to {self.path}"
        )
        warnings.warn(message, HandSimWarning, stacklevel=2)

    def _packed_head(
        self, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], size: int = 0
    ) -> list[bytes]:
        """The header, padded to `size` bytes or else by `_SPARE_BYTES` bytes, and the arrays."""
        text = {**header, "arrays": list(arrays), "columns": [one._asdict() for one in self._columns[1:]]}
        parts = list[bytes]()
        for array in arrays.values():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            parts.append(buffer.getvalue())
        content = json.dumps(text | {_CHECKSUM: _head_checksum(text, parts)}).encode()
        return [content.ljust(size or len(content) + _SPARE_BYTES), *parts]

    def _write_head(self) -> None:
        _write_all(self._file, _MAGIC + b"".join(_PART_SIZE.pack(len(part)) + part for part in self._head))


def _write_all(file: io.FileIO, content: bytes) -> None:
    """Write bytes to a file without a buffer, which may take fewer at a time."""
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]


def _leads_to(path: Path, there: os.stat_result) -> bool:
    """Whether a path leads to the file with this status."""
    try:
        return os.path.samestat(path.stat(), there)
    except OSError:
        return False


def _open_near(path: Path) -> tuple[Path, io.FileIO]:
    """Open a new file at a path, or with a similar name in its folder or in that of temporary files."""
    try:
        make_folder_of(path)
        return path, open(path, "x+b", buffering=0)
    except OSError:
        pass
    try:
        number, name = tempfile.mkstemp(GROWING_SUFFIX, f"{path.stem}-", path.parent)
    except OSError:
        number, name = tempfile.mkstemp(GROWING_SUFFIX, f"{path.stem}-")
    return Path(name), open(number, "r+b", buffering=0)


class _Block(NamedTuple):
    """A block of a file."""

    at: int  # offset of its columns [bytes]
    frames: int
    points: int


class GrownArchive:
    """Reads a growing archive up to its last whole block."""

    def __init__(self, path: Path, *, check: bool = True) -> None:
        self.path = path
        self._size = os.path.getsize(path)
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("not a recording")
            self.header: dict[str, Any] = json.loads(_read_part(file))
            parts = [_read_part(file) for _ in self.header["arrays"]]
            known = self.header.pop(_CHECKSUM, None)  # None in files of earlier versions
            if known not in (None, _head_checksum(self.header, parts)):
                raise ValueError("a header with another checksum")
            names = map(str, self.header.pop("arrays"))
            self._arrays = dict(zip(names, map(_read_array, parts), strict=True))
            self._columns = (POINT_COUNTS, *map(_column, self.header.pop("columns")))
            self._end = file.tell()
            self._former = list[tuple[int, bytes]]()  # entries with the number of blocks of frames before
            self._blocks = list(self._scan(file, check))
        self.num_lost_bytes = self._size - self._end
        self.num_frames = sum(block.frames for block in self._blocks)

    def read(self, step: int = 1) -> dict[str, NDArray[Any]]:
        """All arrays, with the frames of every `step`-th block."""
        blocks = self._blocks[::step]
        columns = {column.name: self._joined(column, blocks) for column in self._columns}
        return {**self._fixed(step), **columns}

    def first(self, name: str, most: int) -> NDArray[Any]:
        """The first entries of a column of frames: at least `most`, or all if there are fewer."""
        column = next(column for column in self._columns if column.name == name)
        before = np.cumsum([0, *(block.frames for block in self._blocks)])[:-1]
        return self._joined(column, self._blocks[: int((before < most).sum())])

    def members(self, on_block: Callable[[], None]) -> Iterator[Member]:
        """Every array, read block by block, with a call of `on_block` after each block."""
        yield from (Member.of(name, array) for name, array in self._fixed().items())
        num_points = sum(block.points for block in self._blocks)
        for column in self._columns:
            shape = (num_points if column.of_points else self.num_frames, *column.entry)
            yield Member(column.name, np.dtype(column.dtype), shape, partial(self._parts, column, on_block))

    def _fixed(self, step: int = 1) -> dict[str, NDArray[Any]]:
        """The arrays without frames; stops of former hands count the frames of every `step`-th block."""
        arrays = dict(self._arrays)
        if (empty := arrays.pop(FORMER, None)) is not None and self._former:
            entries = np.frombuffer(b"".join(entry for _, entry in self._former), empty.dtype).copy()
            ends = np.cumsum([0, *(block.frames for block in self._blocks[::step])])
            entries["stop"] = ends[[-(-before // step) for before, _ in self._former]]
            arrays[FORMER] = entries
        return arrays

    def _scan(self, file: io.BufferedReader, check: bool) -> Iterator[_Block]:
        """The blocks before the first one that is cut off or damaged."""
        number = count = 0
        while len(head := file.read(_BLOCK_HEAD.size)) == _BLOCK_HEAD.size:
            mark, index, frames, points, checksum = _BLOCK_HEAD.unpack(head)
            if mark == _FORMER_MARK and index == number:
                entry = file.read(min(points, self._size))
                if len(entry) < points or zlib.crc32(entry) != checksum:
                    return
                self._former.append((count, entry))
                self._end, number = file.tell(), number + 1
                continue
            if mark != _FRAMES_MARK or index != number:
                return
            block = _Block(file.tell(), frames, points)
            size = sum(column.size * (points if column.of_points else frames) for column in self._columns)
            if not frames or size > self._size - block.at:
                return
            if check and zlib.crc32(file.read(size)) != checksum:
                return
            if int(self._column(POINT_COUNTS, block).sum(dtype=np.int64)) != points:
                return
            file.seek(block.at + size)
            number, count = number + 1, count + 1
            self._end = file.tell()
            yield block

    def _joined(self, column: Column, blocks: Sequence[_Block]) -> NDArray[Any]:
        """A column of several blocks."""
        none = np.empty((0, *column.entry), column.dtype)
        return np.concatenate([none, *(self._column(column, block) for block in blocks)])

    def _parts(self, column: Column, on_block: Callable[[], None]) -> Iterator[NDArray[Any]]:
        """Blocks of a column, with a call of `on_block` after each."""
        for block in self._blocks:
            yield self._column(column, block)
            on_block()

    def _column(self, column: Column, block: _Block) -> NDArray[Any]:
        """The values of one field in one block of an archive."""
        at = block.at
        for other in self._columns:
            count = block.points if other.of_points else block.frames
            if other.name == column.name:
                break
            at += other.size * count
        with self.path.open("rb") as file:
            file.seek(at)
            content = file.read(column.size * count)
        return np.frombuffer(content, column.dtype).reshape(count, *column.entry)


def is_growing(path: Path) -> bool:
    """Whether a file is a growing archive."""
    try:
        with path.open("rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False


def finish_archive(
    grown: GrownArchive, path: Path, header: Mapping[str, Any], *, on_block: Callable[[], None] = lambda: None
) -> None:
    """Write a growing archive as an .npz, whole or not at all, and read it back as a check."""
    with atomic_write(path) as temporary:
        write_npz(temporary, (Member.of("header", np.array(json.dumps(header))), *grown.members(on_block)))
        try:
            check_npz(temporary)
        except ValueError as error:
            raise OSError(errno.EIO, f"read back, it is {error}", str(path)) from error


def _read_part(file: io.BufferedReader) -> bytes:
    (size,) = _PART_SIZE.unpack(file.read(_PART_SIZE.size).ljust(_PART_SIZE.size, b"\xff"))
    if size > _MAX_HEADER:
        raise ValueError("a header that is too large")
    content = file.read(size)
    if len(content) < size:
        raise ValueError("a header that was cut off")
    return content


def _head_checksum(header: Mapping[str, Any], parts: Sequence[bytes]) -> int:
    """CRC-32 of the header and the arrays that a growing archive begins with."""
    return zlib.crc32(b"".join((json.dumps(header).encode(), *parts)))


def _read_array(content: bytes) -> NDArray[Any]:
    """An array from its .npy format; a `ValueError` unless the sizes agree."""
    buffer = io.BytesIO(content)
    check_npy_header(buffer, len(content))
    buffer.seek(0)
    return np.lib.format.read_array(buffer, allow_pickle=False)


def _column(stored: Mapping[str, Any]) -> Column:
    leading, *entry = stored["shape"]
    if entry[:1] == ["N"]:  # until schema 3 points were described as a table with a row per frame
        leading, entry = "P", entry[1:]
    column = Column(str(stored["name"]), str(stored["dtype"]), (leading, *map(int, entry)))
    if (
        leading not in ("T", "P")
        or np.dtype(column.dtype).hasobject
        or not 0 <= column.size <= _MAX_HEADER
        or min(column.entry, default=0) < 0
    ):
        raise ValueError("a column of no size")
    return column


Content = TypeVar("Content")


class CutOffWarning(HandSimWarning):
    """A recording was cut off: it is read up to its last whole half second."""


def write_archive(path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and a header as an .npz, whole or not at all."""
    with atomic_write(path) as temporary:
        every = {"header": np.array(json.dumps(dict(header))), **arrays}
        write_npz(temporary, (Member.of(name, array) for name, array in every.items()))


def read_archive(
    path: str | Path, unpack: Callable[[dict[str, Any], dict[str, np.ndarray]], Content]
) -> Content:
    """Read an archive, finished or growing; an exception of `unpack` means that it is damaged."""
    path = Path(path)
    header, arrays = _read(path)
    kind, schema = header.get("kind", _HEADER_KINDS[0]), header.get("schema")
    if not isinstance(kind, str) or not isinstance(schema, int):
        raise CaptureError(_damaged(path))
    if kind not in _HEADER_KINDS:
        raise CaptureError(f"{path}: a {shortened(kind)}, expected a take")
    if schema not in _READABLE_SCHEMAS or kind != _HEADER_KINDS[0]:
        raise CaptureError(
            f"{path}: a {kind} of schema {shortened(str(schema))}, expected a take of schema {SCHEMA}; "
            "simulate or track it again with this version of handsim"
        )
    try:
        return unpack(header, arrays)
    except ArgumentError as error:
        raise CaptureError(f"{_damaged(path)}: {error}") from error
    except DAMAGE as error:
        raise CaptureError(_damaged(path)) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of an archive."""
    check_regular(path, error=CaptureError)
    if path.is_dir():
        raise CaptureError(f"{path}: this is a folder, expected a take (.npz)")
    if not path.exists() and growing_path(path).exists():
        raise CaptureError(
            f"{path}: no such file, but {growing_path(path)} is a recording that was cut off or is still "
            "running, and can be read"
        )
    grown = None
    try:
        if is_growing(path):
            grown = GrownArchive(path)
            header, arrays = grown.header, grown.read()
        else:
            arrays = read_npz(path)
            array = arrays["header"]
            if array.dtype.kind != "U" or array.ndim or (array.reshape(1).view("u4") > sys.maxunicode).any():
                raise ValueError("not a text")
            header = json.loads(str(array))
            if not isinstance(header, dict):
                raise ValueError("the header is not a table")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except KeyError as error:  # no header
        raise CaptureError(f"{_damaged(path)}; {OF_ARRAYS}") from error
    except DAMAGE as error:
        raise CaptureError(_damaged(path)) from error
    if grown is None:
        return header, arrays
    if grown.num_frames < 2:
        raise CaptureError(
            f"{path}: a recording that was cut off with {grown.num_frames} frames, expected two or more"
        )
    message = f"{path}: a recording that was cut off or is still running; it has {grown.num_frames} frames"
    if grown.num_lost_bytes:
        message += f"; {grown.num_lost_bytes} bytes after them, an incomplete half second, are left out"
    warnings.warn(message, CutOffWarning, stacklevel=4)
    return header, arrays


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
