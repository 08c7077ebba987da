"""Files that somebody else wrote: read only where they are regular files of a bounded size."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final

from handsim.errors import HandSimError

if TYPE_CHECKING:  # object stores' code takes as long to load as a capture to read
    from upath import UPath

_KINDS: Final = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def check_regular(path: Path, *, error: type[HandSimError], most: int | None = None) -> None:
    """Refuse a pipe, a socket or a device, which may never end, and a file of more than `most` bytes.

    A path that does not exist, or is a folder, is left to whoever opens it.

    Raises:
        HandSimError: Of class `error`: the path is not a regular file, or is too long.
    """
    try:
        found = path.stat()
    except OSError:
        return
    except ValueError as cause:  # a zero byte in the name
        raise error(f"{str(path)!r}: not the name of a file") from cause
    for is_kind, kind in _KINDS:
        if is_kind(found.st_mode):
            raise error(f"{path}: this is {kind}, expected a regular file; write it to a file first")
    if most is not None and found.st_size > most and stat.S_ISREG(found.st_mode):
        raise error(f"{path}: the file is {found.st_size} bytes long, expected at most {most}")


def read_bytes(path: Path, *, error: type[HandSimError], most: int | None = None) -> bytes:
    """The bytes of a regular file of at most `most` bytes.

    Raises:
        HandSimError: Of class `error`: the file cannot be read, is not a regular one, or is too long.
    """
    check_regular(path, error=error, most=most)
    try:
        # Without waiting: the path may have become a pipe since it was checked.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NO_WAITING)) as file:
            return file.read() if most is None else file.read(most)
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror or cause}") from cause


def checksum(path: Path | UPath) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


_NO_WAITING: Final = getattr(os, "O_NONBLOCK", 0)
