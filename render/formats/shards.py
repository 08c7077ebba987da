"""Shards of pictures on disk: each a tar file or a folder, complete or absent."""

from __future__ import annotations

import io
import json
import re
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from handsim.errors import DatasetError, HandSimError
from handsim.files.outputs import atomic_write, temporary_beside
from render.formats.annotations.common import to_json

INDEX: Final = "index.json"
"""Index file of a shard's folder: a list of records of its pictures."""
_NAME: Final = re.compile(r"shard-(\d{5,})(\.tar)?")


def shard_name(shard: int) -> str:
    """Name of a shard's folder; a tar has it with its suffix."""
    return f"shard-{shard:05d}"


def shards_in(folder: Path, *, suffix: str = "") -> frozenset[int]:
    """Which shards are complete."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    matches = [_NAME.fullmatch(name) for name in names]
    return frozenset(int(match[1]) for match in matches if match and (match[2] or "") == suffix)


@contextmanager
def one_sentence(folder: Path, doing: str) -> Iterator[None]:
    """Tell trouble with the disk in one sentence."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise HandSimError(
            f"{folder}: {doing} failed: {reason}; shards that were finished before are whole, and the same "
            "command goes on after them"
        ) from error


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` that replaces it when the block ends without an error."""
    temporary = temporary_beside(path)
    clear_leftovers(path)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        if path.exists():
            shutil.rmtree(path)
        temporary.replace(path)
    except BaseException:  # also an interrupt must leave nothing behind
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def clear_leftovers(path: Path) -> None:
    """Remove what killed writers of a shard's folder or file left beside it."""
    for leftover in path.parent.glob(f".{path.stem}.tmp-*"):
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


class Tar:
    """A tar file whose bytes depend on its content alone: no times, no owners.

    Args:
        path: The file, open for writing until `close`.
    """

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)

    def add(self, name: str, content: bytes) -> None:
        """Add one file."""
        entry = tarfile.TarInfo(name)
        entry.size, entry.mode = len(content), 0o644
        self._tar.addfile(entry, io.BytesIO(content))

    def close(self) -> None:
        """Write the end."""
        self._tar.close()


@contextmanager
def new_tar(path: Path) -> Iterator[Tar]:
    """A tar file that takes its name when the block ends well."""
    clear_leftovers(path)
    with atomic_write(path) as temporary:
        tar = Tar(temporary)
        try:
            yield tar
        finally:
            tar.close()


def save_index(folder: Path, records: list[dict[str, Any]]) -> None:
    """Write what a shard's folder holds, one record a line."""
    lines = ",\n".join(map(to_json, records))
    (folder / INDEX).write_text(f"[\n{lines}\n]\n", encoding="utf-8")


def load_indexes(folder: Path, shards: Iterable[int]) -> Iterator[dict[str, Any]]:
    """The records of some shards, one after another.

    Raises:
        DatasetError: A shard's index is missing or damaged.
    """
    for shard in shards:
        yield from load_index(folder / shard_name(shard))


def load_index(folder: Path) -> list[dict[str, Any]]:
    """The records of one shard."""
    path = folder / INDEX
    remedy = f"delete the folder {folder.name} and render again"
    try:
        records = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}; {remedy}") from error
    except ValueError as error:
        raise DatasetError(f"{path}: damaged: it holds no JSON; {remedy}") from error
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise DatasetError(f"{path}: damaged: it holds no list of records; {remedy}")
    return records


def save_text(path: Path, pieces: Iterable[str]) -> None:
    """Write a file piece by piece, whole or not at all."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(pieces)


def json_list(items: Iterable[Any]) -> Iterator[str]:
    """The pieces of a JSON list, one item a line, however long it is."""
    yield "["
    for number, item in enumerate(items):
        yield (",\n" if number else "\n") + to_json(item)
    yield "\n]"
