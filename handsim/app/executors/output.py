"""Where jobs leave their files: a folder, or an object store by way of folders that hold one job each."""

from __future__ import annotations

import functools
import re
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from handsim.app.workers import Job
from handsim.errors import HandSimError
from handsim.files.atomic import remove_abandoned, temporary_beside
from handsim.files.inputs import checksum
from handsim.files.json_files import claim, load_json, save_json
from handsim.files.object_folder import ObjectFolder

Make = Callable[[Path, int], int]
"""Takes a folder and a number, leaves the number's files in the folder, and returns the number."""
_RECEIPTS: Final = "finished"
_RECEIPT: Final = re.compile(rf"{_RECEIPTS}/(\d{{5,}})\.json")


@dataclass(frozen=True, slots=True)
class FolderOutput:
    """A folder that all jobs write to."""

    folder: Path

    def __str__(self) -> str:
        return str(self.folder)

    def claim(
        self,
        name: str,
        settings: dict[str, Any],
        *,
        noun: str,
        error: type[HandSimError],
        grows: str = "",
        result: str | None = None,
    ) -> None:
        """Claim the folder by a settings file, see `handsim.files.json_files.claim`."""
        old = None if result is None else self.folder / result
        claim(self.folder / name, settings, noun=noun, error=error, grows=grows, result=old)

    def job(self, make: Make) -> Job:
        """A job that writes to the folder."""
        return functools.partial(make, self.folder)

    def collect(self, *patterns: str) -> None:
        """The files of jobs are there already."""

    def checksums(self, names: Iterable[str]) -> dict[str, str]:
        """SHA-256 of files, by name."""
        return {name: checksum(self.folder / name) for name in names}

    def publish(self, last: str) -> None:
        """What was written is in its place already."""


@dataclass(frozen=True, slots=True)
class StoredOutput:
    """A folder of an object store.

    A job writes to a folder of its own, wherever it is done, and puts the files into the store; a receipt, an
    object with their lengths and checksums, is put last and says that the job is finished. What is made of
    all jobs is made in a folder here, out of what `collect` brings, and then put too.
    """

    folder: Path
    """The folder here."""
    store: ObjectFolder
    receipts: dict[int, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Files of each finished job, by number and name."""

    def __str__(self) -> str:
        return str(self.store)

    def claim(
        self,
        name: str,
        settings: dict[str, Any],
        *,
        noun: str,
        error: type[HandSimError],
        grows: str = "",
        result: str | None = None,
    ) -> None:
        """Claim the store's folder by a settings file, or check that its settings are equal.

        Args:
            name: The settings file.
            settings: What decides the content.
            noun: What the folder holds, for messages.
            error: Class of the error.
            grows: A setting that may be larger than before.
            result: An object that is true for the old settings only.

        Raises:
            HandSimError: Of class `error`: the `noun` there has other settings, or something else is there.
        """
        found, path = self.store.sizes(), self.folder / name
        if name in found:
            self.store.get([name], self.folder)
        elif found:
            raise error(f"{self.store} is not empty and holds no {noun}; name another folder")
        before = path.read_bytes() if path.is_file() else b""
        claim(path, settings, noun=noun, error=error, grows=grows, shown=str(self.store))
        if path.read_bytes() != before:
            if result in found:
                self.store.remove(str(result))
            self.store.put(self.folder, [name])
        self._read_receipts(found)

    def job(self, make: Make) -> Job:
        """A job that puts its files into the store."""
        return _StoredJob(make, self.store, self.folder.parent)

    def size(self, number: int, name: str) -> int | None:
        """Length of a file of a finished job [bytes]; None where there is none."""
        files = self.receipts.get(number, {})
        return files[name]["bytes"] if name in files else None

    def collect(self, *patterns: str) -> None:
        """Learn what all jobs have put, and copy files here whose names match."""
        self._read_receipts(self.store.sizes())
        names = [name for files in self.receipts.values() for name in files]
        wanted = [name for name in names if any(PurePosixPath(name).match(one) for one in patterns)]
        self.store.get(wanted, self.folder)

    def checksums(self, names: Iterable[str]) -> dict[str, str]:
        """SHA-256 of files that `collect` has found, by name.

        Raises:
            HandSimError: One is not there.
        """
        known = {name: about for files in self.receipts.values() for name, about in files.items()}
        names = list(names)
        missing = [name for name in names if name not in known]
        if missing:
            raise HandSimError(f"{self.store}: {missing[0]} is gone; run the same command again to go on")
        return {name: known[name]["sha256"] for name in names}

    def publish(self, last: str) -> None:
        """Put all files that are here and not of a job, one of them after all others."""
        known = {name for files in self.receipts.values() for name in files}
        made = [name for name in _files_in(self.folder) if name not in known and not _RECEIPT.fullmatch(name)]
        self.store.put(self.folder, [name for name in made if name != last])
        self.store.put(self.folder, [name for name in made if name == last])

    def _read_receipts(self, found: dict[str, int]) -> None:
        """Keep the receipts of jobs whose files are all there, in their lengths."""
        names = [name for name in found if _RECEIPT.fullmatch(name)]
        self.store.get(names, self.folder)
        self.receipts.clear()
        for name in names:
            files = load_receipt(self.folder / name)
            if files and all(found.get(file) == about["bytes"] for file, about in files.items()):
                self.receipts[int(PurePosixPath(name).stem)] = files


Output = FolderOutput | StoredOutput


@contextmanager
def open_output(out: Path | ObjectFolder) -> Iterator[Output]:
    """Where the files of jobs go.

    Raises:
        ArgumentError: What an object store needs is not installed.
    """
    if isinstance(out, Path):
        yield FolderOutput(out)
        return
    out.check()
    name = f"handsim-{zlib.crc32(str(out).encode()):08x}"
    remove_abandoned(Path(tempfile.gettempdir(), name))  # of a run that was killed
    here = temporary_beside(Path(tempfile.gettempdir(), name))
    here.mkdir(mode=0o700)
    try:
        (here / "output").mkdir()
        yield StoredOutput(here / "output", out)
    finally:
        shutil.rmtree(here, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class _StoredJob:
    """A job whose files go into a store, the receipt last."""

    make: Make
    store: ObjectFolder
    near: Path
    """Where to have its folder, if this machine has that: it is removed at the end of the run."""

    def __call__(self, number: int) -> int:
        self.store.check()  # before the work
        place = self.near if self.near.is_dir() else None
        with tempfile.TemporaryDirectory(prefix="handsim-", dir=place) as name:
            folder = Path(name)
            self.make(folder, number)
            files = {
                name: {"bytes": (folder / name).stat().st_size, "sha256": checksum(folder / name)}
                for name in _files_in(folder)
            }
            self.store.put(folder, files)
            receipt = f"{_RECEIPTS}/{number:05d}.json"
            (folder / _RECEIPTS).mkdir()
            save_json(folder / receipt, {"files": files})
            self.store.put(folder, [receipt])
        return number


def _files_in(folder: Path) -> list[str]:
    """Names of all files below a folder, in order."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def load_receipt(receipt: Path) -> dict[str, dict[str, Any]]:
    """The files of a receipt; none if it is damaged."""
    try:
        files = load_json(receipt).get("files")
    except HandSimError:
        return {}
    if not isinstance(files, dict) or not all(map(_is_entry, files.keys(), files.values())):
        return {}
    return files


def _is_entry(name: str, about: object) -> bool:
    """Whether this names a file inside a folder, its length and its checksum."""
    return (
        isinstance(about, dict)
        and type(about.get("bytes")) is int
        and isinstance(about.get("sha256"), str)
        and not {"", "..", "."} & set(name.split("/"))
    )
