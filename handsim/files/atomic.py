"""Files that are written whole or not at all, and TOML files read with one kind of error."""

from __future__ import annotations

import errno
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from handsim.errors import HandSimError
from handsim.files.inputs import read_bytes

_MOST_TOML: Final = 1 << 18  # bytes; a layout of 60 markers has 6000
_DOTTED: Final = re.compile(r"""(?:\.\s{0,9}[\w"'-]+\s{0,9}){20}""")  # tomllib takes hours for very long ones


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the block ends well.

    The temporary file has the same suffix, because some writers add one they miss. If the block raises,
    whatever the reason, the temporary file is removed, an older file at `path` stays as it was, and the error
    goes on to the caller. Folders that are missing on the way to `path` are made.

    Args:
        path: Where the finished file shall be; an existing file there is replaced.

    Yields:
        The path to write to.

    Raises:
        OSError: The folder cannot be made, `path` is a folder or a device, the disk is full, or the block
            wrote nothing.
    """
    final = Path(path)
    # Renaming onto a device (/dev/null) would replace it, and a folder would be noticed only after the work.
    if final.exists() and not final.is_file():
        raise FileExistsError(errno.EEXIST, "not a regular file, so it is not replaced", str(final))
    final.parent.mkdir(parents=True, exist_ok=True)
    temporary = final.with_name(f".{final.stem}.tmp-{os.getpid()}{final.suffix}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, final)
    except BaseException:  # also an interrupt must leave nothing behind
        temporary.unlink(missing_ok=True)
        raise


def _flush(path: Path) -> None:
    """Wait until the file is on the disk: a rename before that can leave an empty file after a power cut."""
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only what is open for writing
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_toml(path: Path, *, error: type[HandSimError]) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: The file.
        error: What to raise, in one sentence, when the file cannot be read or is not TOML.
    """
    data = read_bytes(path, error=error, most=_MOST_TOML)
    try:
        text = data.decode("utf-8")
        deep = _DOTTED.search(text)
        if deep is not None:
            raise ValueError(f"the key {deep[0][:20]}... has too many parts")
        return tomllib.loads(text)
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a TOML file: it is not UTF-8 text") from cause
    except ValueError as cause:
        raise error(f"{path}: not a TOML file: {cause}") from cause
    except RecursionError as cause:
        raise error(f"{path}: not a TOML file: brackets are nested too deep") from cause
