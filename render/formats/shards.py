"""Shards of pictures on disk: each a tar file or folders, complete or absent.

Photographs lie in `images/shard-00000`, and nothing else that is a picture: programs train on whatever they
find there. Depth, ids and normals have folders of the same names beside it, `depth/shard-00000`.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import tarfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from handsim.errors import DatasetError, HandSimError
from handsim.files.outputs import atomic_write, remove_leftovers, temporary_beside
from render.formats.records import encode_pictures, to_json
from render.frames import RenderedFrame

INDEX: Final = "index.json"
"""Index file of a shard's folder: a list of records of its pictures."""
_NAME: Final = re.compile(r"shard-(\d{5,})(\.tar)?")
_IMAGES: Final = "images"
PICTURES: Final = ("depth", "depth_ideal", "normals", "ids")
"""Kinds of pictures beside the photographs, each of which has a folder."""
LABELS: Final = "labels"
BESIDE: Final = (*PICTURES, LABELS)
"""Folders that may stand beside that of the photographs."""


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
    """Raise errors of the disk in the block as one sentence."""
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
    remove_leftovers(path.parent, f".{path.stem}.tmp-*")
    temporary.mkdir(parents=True)
    try:
        yield temporary
        if path.exists():
            shutil.rmtree(path)
        temporary.replace(path)
    except BaseException:  # also an interrupt must leave nothing behind
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextmanager
def new_tar(path: Path) -> Iterator[Callable[[str, bytes], None]]:
    """Yield a function that adds files to a tar, which gets its name when the block ends without an error.

    The tar's bytes depend on its content alone, because it stores no times and no owners.
    """
    remove_leftovers(path.parent, f".{path.stem}.tmp-*")
    with atomic_write(path) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:

        def add(name: str, content: bytes) -> None:
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o644
            tar.addfile(entry, io.BytesIO(content))

        yield add


def save_index(folder: Path, records: list[dict[str, Any]]) -> None:
    """Write what a shard's folder holds, one record a line."""
    lines = ",\n".join(map(to_json, records))
    (folder / INDEX).write_text(f"[\n{lines}\n]\n", encoding="utf-8")


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


class FolderWriter:
    """For each shard a folder of pictures, which are named after frames, with an index of records."""

    def __init__(self, folder: Path, *, inside: str = _IMAGES) -> None:
        self.folder, self.pictures = folder, folder / inside

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.pictures)

    def files(self, shard: int) -> dict[str, Path]:
        """The files of a complete shard by their names in the folder, which stay when files move."""
        places = (self.pictures / shard_name(shard), *self.beside(shard).values())
        paths = (path for place in places if place.is_dir() for path in place.iterdir() if path.is_file())
        return {path.relative_to(self.folder).as_posix(): path for path in paths}

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew."""
        with one_sentence(self.folder, f"writing shard {shard}"), self.new_shard(shard) as temporary:
            records: dict[str, dict[str, Any]] = {}
            for frame in frames:
                if frame.key in records:
                    raise HandSimError(f"two frames of a shard are called '{frame.key}'; number them apart")
                records[frame.key] = self._add(temporary, frame, shard_name(shard))
            save_index(temporary, list(records.values()))

    @contextmanager
    def new_shard(self, shard: int) -> Iterator[Path]:
        """Yield a temporary folder that becomes a shard when the block ends without an error.

        Its folders of depth, ids and so on move first, so that a shard with photographs is complete.
        """
        with new_folder(self.pictures / shard_name(shard)) as temporary:
            yield temporary
            for kind, place in self.beside(shard).items():
                if place.exists():
                    shutil.rmtree(place)
                if (temporary / kind).is_dir():
                    place.parent.mkdir(parents=True, exist_ok=True)
                    (temporary / kind).replace(place)

    def beside(self, shard: int) -> dict[str, Path]:
        """The folders of a shard's depth, ids and so on by kind, whether they exist or not."""
        return {kind: self.folder / kind / shard_name(shard) for kind in BESIDE}

    def finish(self) -> list[Path]:
        """Merge all complete shards into the files that the format requires, if any; may be called again."""
        return []

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        """Write one frame into a shard's folder of that name."""
        raise NotImplementedError

    def _add_pictures(
        self, folder: Path, frame: RenderedFrame, name: str, *, lossless: bool = False
    ) -> dict[str, str]:
        """Write a frame's pictures and return where those beside the photograph will be, from `folder` on."""
        files = {}
        for suffix, content in encode_pictures(frame, lossless=lossless).items():
            kind, _, ending = suffix.strip(".").rpartition(".")
            write_file(folder / kind / f"{frame.key}.{ending}", content)
            if kind:
                files[f"{kind}_file"] = f"{kind}/{name}/{frame.key}.{ending}"
        return files

    def _records(self) -> Iterator[dict[str, Any]]:
        for shard in sorted(self.done()):
            yield from load_index(self.pictures / shard_name(shard))


def write_file(path: Path, content: bytes) -> None:
    """Write a file into a folder, which is made for its first file."""
    try:
        path.write_bytes(content)
    except FileNotFoundError:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
