"""Output folders of jobs: on this machine, or in an object store that a local folder stands for."""

from __future__ import annotations

import platform
import re
import shutil
import tempfile
import warnings
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from upath import UPath

from handsim._checks import check_type
from handsim.app.workers import Job
from handsim.errors import ArgumentError, DatasetError, HandSimError, HandSimWarning, shortened
from handsim.files.inputs import checksum, load_json
from handsim.files.outputs import (
    claim,
    json_text,
    remove_abandoned,
    remove_leftovers,
    save_json,
    temporary_beside,
)

Make = Callable[[Path, int], int]
"""Writes the files of a number to a folder, and returns the number."""
Place = Path | UPath
"""A folder of this machine, or of an object store."""
_PASSWORD_PATTERN: Final = re.compile(r"[^/@]*:[^/]*@")
_LOCAL_PROTOCOLS: Final = ("", "file", "local")
CHECKSUMS: Final = "checksums-*.json"
"""Files that jobs write last, each with the SHA-256 of all the files that its job has made."""


def checksums_name(number: int) -> str:
    """Name of the file with the checksums of a job's files."""
    return CHECKSUMS.replace("*", f"{number:05d}")


def save_checksums(path: Path, files: Mapping[str, Path]) -> None:
    """Write the SHA-256 of files by their names in the output, which marks a finished job."""
    save_json(path, {name: checksum(files[name]) for name in sorted(files)})


def load_checksums(path: Path) -> dict[str, str]:
    """The checksums that `save_checksums` wrote; none if they are missing or damaged."""
    try:
        content = load_json(path)
        return content if path.read_text("utf-8") == json_text(content) else {}
    except (DatasetError, OSError, UnicodeDecodeError):
        return {}


def checked_list(path: Path, files: Mapping[str, Path]) -> tuple[dict[str, str], list[str]]:
    """The checksums in a list, and the names of missing and changed files (of a damaged list its own name).

    Files are beside the list, unless `files` has their paths.
    """
    record = load_checksums(path)
    if not record and path.exists():
        return {}, [path.name]

    def checksum_of(name: str) -> str:
        file = files.get(name, path.parent / name)
        return checksum(file) if file.is_file() else ""

    return record, changed_files(record, checksum_of)


def changed_files(record: Mapping[str, str], checksum_of: Callable[[str], str]) -> list[str]:
    """Names of the files that have other checksums than those of a record."""
    return [name for name in record if checksum_of(name) != record[name]]


def place_of(out: str | Place) -> Place:
    """The folder of a name: on this machine, or of an object store, as s3://bucket/prefix."""
    if isinstance(out, Path) or (isinstance(out, str) and "://" not in out):
        return Path(out)
    check_type("the address", out, (str, UPath), "a folder, or one like s3://bucket/prefix")
    wrong = f"the address is '{shortened(str(out), 200)}', expected"
    protocol, _, path = str(out).partition("://")
    if _PASSWORD_PATTERN.match(path):  # it would be in messages, and be sent to workers
        raise ArgumentError(
            f"the {protocol}:// address holds a password; credentials come from the environment"
        )
    try:
        place = UPath(out)
    except ValueError as error:
        raise ArgumentError(f"{wrong} one like s3://bucket/prefix: {error}") from error
    if place.protocol in _LOCAL_PROTOCOLS and not isinstance(place, Path):
        return Path(place.path)
    if isinstance(place, Path) or not path.strip("/"):
        raise ArgumentError(f"{wrong} one like s3://bucket/prefix")
    if "::" in str(out) or ".." in path.split("/"):
        raise ArgumentError(f"{wrong} one without :: and ..")
    return place


@dataclass(frozen=True, slots=True)
class Output:
    """A folder that all jobs write to.

    For an object store, each job writes to a temporary folder on its own machine and uploads the files. Files
    on all jobs together are made in `folder` from files that `fetch` downloads; `publish` uploads them.
    """

    place: Place
    folder: Path
    """`place`, or the local folder that stands for it."""
    _claimed: list[str] = field(default_factory=list)
    _fetched: set[str] = field(default_factory=set)

    def __str__(self) -> str:
        return str(self.place)

    @property
    def is_here(self) -> bool:
        """Whether the output is a folder of this machine."""
        return self.place is self.folder

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
        """Claim the folder by a settings file of this name, see `handsim.files.outputs.claim`."""
        path, old = self.folder / name, None if result is None else self.folder / result
        found = {} if self.is_here else self.sizes()
        if found and name not in found:
            raise error(f"{self} is not empty and holds no {noun}; name another folder")
        self.fetch(name)
        before = path.read_bytes() if path.is_file() else b""
        claim(path, settings, noun=noun, error=error, grows=grows, result=old, shown=str(self))
        if not self.is_here and path.read_bytes() != before:
            if result in found:
                with _store_errors(self.place, "removing"):
                    (self.place / str(result)).unlink()
            _upload(self.place, self.folder, [name])
        self._claimed.append(name)
        self._fetched.add(name)

    def job(self, make: Make, *, last: Sequence[str] = ()) -> Job:
        """A job that writes to the claimed folder.

        Files that match the patterns `last` mark a finished job, so they are uploaded after all others.
        """
        name = self._claimed[0]
        return _Job(make, self.place, self.folder, name, checksum(self.folder / name), tuple(last))

    def sizes(self) -> dict[str, int]:
        """Names and sizes [bytes] of all files in the output."""
        if self.is_here:
            return {name: (self.folder / name).stat().st_size for name in _files_in(self.folder)}
        start = self.place.path.rstrip("/") + "/"  # type: ignore[union-attr]
        with _store_errors(self.place, "listing") as files:
            files.invalidate_cache()  # other machines write there too
            try:
                found = files.find(start, detail=True)
            except FileNotFoundError:
                return {}
        names = {path.removeprefix(start): int(about["size"]) for path, about in found.items()}
        return {name: size for name, size in names.items() if _is_inside(name)}

    def fetch(self, *patterns: str, names_of: Sequence[str] = ()) -> None:
        """Copy files that match `patterns` to the local folder; those of `names_of` become empty files."""
        if self.is_here:
            return
        lacking = [name for name in self.sizes() if not (self.folder / name).exists()]
        wanted = [name for name in lacking if _matches(name, patterns)]
        for name in lacking:
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            if _matches(name, names_of):
                (self.folder / name).touch()
                self._fetched.add(name)
        self._fetched.update(wanted)
        if wanted:
            with _store_errors(self.place, "reading") as files:
                files.get(*([str(side / name) for name in wanted] for side in (self.place, self.folder)))

    def checksum(self, name: str) -> str:
        """SHA-256 of a file in the output."""
        with _store_errors(self.place, f"reading {name}"):
            return checksum(self.place / name)

    def warn_of(self, files: Collection[str], what: str) -> None:
        """Warn of damaged files; `what` ends the sentence with the damage and its consequence."""
        if files:
            warnings.warn(f"{self}: {', '.join(sorted(files))} {what}", HandSimWarning, stacklevel=5)

    def publish(self, last: str) -> None:
        """Put all files that were made in the local folder, `last` after all others."""
        if not self.is_here:
            made = [name for name in _files_in(self.folder) if name not in self._fetched]
            _upload(self.place, self.folder, made, [last])


@contextmanager
def open_output(out: str | Place) -> Iterator[Output]:
    """Open the output of jobs; files of workers that died are removed after the block."""
    place = place_of(out)
    if isinstance(place, Path):
        output = Output(place, place)
        try:
            yield output
        finally:
            if output._claimed:
                remove_leftovers(place)
        return
    check_store(place)
    name = Path(tempfile.gettempdir(), f"handsim-{zlib.crc32(str(place).encode()):08x}")
    remove_abandoned(name)  # left by a killed run
    here = temporary_beside(name)
    try:
        (here / "output").mkdir(mode=0o700, parents=True)
        yield Output(place, here / "output")
    finally:
        shutil.rmtree(here, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class _Job:
    """A job that writes to a folder that all workers share, or uploads its files to a store."""

    make: Make
    place: Place
    folder: Path
    claimed: str
    content: str
    """Checksum of the claimed settings file."""
    last: tuple[str, ...]

    def __call__(self, number: int) -> int:
        if isinstance(self.place, Path):
            path = self.folder / self.claimed
            if not path.is_file() or checksum(path) != self.content:
                raise HandSimError(
                    f"the worker on {platform.node()} does not see the files in {self.folder}; write to a "
                    "folder that all workers share, under the same path"
                )
            return self.make(self.folder, number)
        check_store(self.place)  # a missing package must show before the work
        near = self.folder.parent  # removed at the end of the run, if this machine has it
        with tempfile.TemporaryDirectory(prefix="handsim-", dir=near if near.is_dir() else None) as name:
            self.make(Path(name), number)
            _upload(self.place, Path(name), _files_in(Path(name)), self.last)
        return number


def check_store(store: UPath) -> None:
    """Import the packages that a store needs."""
    try:
        with _store_errors(store, "opening"):
            pass
    except ImportError as error:
        raise ArgumentError(
            f"{store} needs a package that cannot be imported ({' '.join(str(error).split())}); "
            "for s3:// run `pip install 'handsim[object-stores]'`"
        ) from error


def _upload(store: Place, folder: Path, names: Collection[str], last: Sequence[str] = ()) -> None:
    """Put files of a folder into a store, those that match `last` after the others."""
    for late in (False, True):
        chosen = [name for name in names if _matches(name, last) == late]
        if chosen:
            with _store_errors(store, "writing") as files:
                files.put(*([str(side / name) for name in chosen] for side in (folder, store)))


@contextmanager
def _store_errors(place: Place, doing: str) -> Iterator[Any]:
    """Yield the file system of a store, and raise a `HandSimError` for any of its errors."""
    try:
        yield None if isinstance(place, Path) else place.fs
    except ImportError:
        raise
    except Exception as error:
        if isinstance(place, Path):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        again = "what is there stays, and the same command goes on after it"
        raise HandSimError(f"{place}: {doing} failed: {reason}; {again}") from error


def _files_in(folder: Path) -> list[str]:
    """Names of all files below a folder, in order."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(PurePosixPath(name).match(pattern) for pattern in patterns)


def _is_inside(name: str) -> bool:
    """Whether an object's name is that of a file in a folder."""
    parts = PurePosixPath(name).parts
    return bool(parts) and "/".join(parts) == name and not {"..", "/"} & set(parts)
