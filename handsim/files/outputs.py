"""Checks before the work: outputs can be written, none over an input, and disk and memory have room."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from handsim.errors import ArgumentError, HandSimError
from handsim.files.atomic import atomic_write

_UNITS: Final = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")


def check_outputs(inputs: Iterable[object], outputs: Iterable[Path | None]) -> None:
    """Refuse an output that names an input or another one, in whatever spelling, or has no place.

    Args:
        inputs: Files and folders that a command reads, and names that may be none; objects are no files.
        outputs: What it writes; None where not given.
    """
    read, written = [Path(name) for name in inputs if isinstance(name, str | Path)], set()
    for output in (path for path in outputs if path is not None):
        _check_links(output)
        real = os.path.realpath(output)
        if real in written:
            raise ArgumentError(f"two outputs are {output}, expected two files")
        written.add(real)
        there = next((path for path in output.absolute().parents if path.exists()), None)
        if there is not None and not there.is_dir():
            raise ArgumentError(
                f"the output {output} lies in {there.name}, which is a file, expected a folder"
            )
        if there is not None and not os.access(there, os.W_OK | os.X_OK):
            raise ArgumentError(f"the output {output} cannot be written: {there} is closed to this user")
        for source in read:
            if _same(source, output):
                raise ArgumentError(f"the output {output} is the input {source}, expected another file")


def _check_links(output: Path) -> None:
    """Refuse links on the way to an output that lead to themselves, or to no folder."""
    for path in (*reversed(output.absolute().parents), output):
        if not path.is_symlink() or path.exists():
            continue
        try:
            path.stat()
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise ArgumentError(
                    f"the output {output} cannot be written: {path} is a link that leads to itself"
                ) from error
        if path != output:
            raise ArgumentError(
                f"the output {output} cannot be written: {path} is a link to a folder that is not there"
            )


def check_ending(path: Path, *endings: str, option: str = "--out") -> None:
    """Refuse an option's file whose name ends otherwise."""
    if path.suffix.lower() not in endings:
        raise ArgumentError(f"{option} is {path}, expected a file name that ends in {', '.join(endings)}")


def write_starter(file: Path, text: str, *, error: type[HandSimError]) -> None:
    """Write the text that a file of one's own begins with, under a new name in .toml."""
    if file.suffix.lower() != ".toml":
        raise error(f"{file}: expected a file name that ends in .toml")
    if file.exists():
        raise error(f"{file} exists already and is left as it is; name a new file")
    with atomic_write(file) as temporary:
        temporary.write_text(text, "utf-8")


def _same(source: Path, output: Path) -> bool:
    try:
        return os.path.samefile(source, output)
    except (OSError, ValueError):  # one of them does not exist
        return False


def check_free(folder: Path, needed: int, what: str, remedy: str, *, error: type[HandSimError]) -> None:
    """Refuse work that the disk has no space for; the folder need not exist yet.

    Args:
        needed: Bytes still to be written.
        what: What needs them, for the message, in the plural.
        remedy: What to do beside freeing space, as in `ask for fewer frames`.
    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if needed > free:
        raise error(
            f"{what} need {shown_bytes(needed)}, but the disk of {folder} has {shown_bytes(free)} free; "
            f"{remedy} or name a folder on another disk"
        )


def check_memory(needed: int, what: str, remedy: str) -> None:
    """Refuse work that the machine has no memory for by an `ArgumentError`; words as for `check_free`."""
    free = available_bytes()
    if needed > free:
        raise ArgumentError(
            f"{what} need {shown_bytes(needed)} of memory, but {shown_bytes(free)} are free; {remedy}"
        )


def available_bytes() -> int:
    """Memory to be had without swapping [bytes]; all that is built in where the system tells no more."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def shown_bytes(count: float) -> str:
    """A number of bytes with a unit that suits it."""
    unit = 0
    while count >= 1000.0 and unit < len(_UNITS) - 1:
        count, unit = count / 1000.0, unit + 1
    return f"{count:.3g} {_UNITS[unit]}"
