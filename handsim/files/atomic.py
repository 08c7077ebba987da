"""Files that are written whole or not at all, and TOML files read with one kind of error."""

from __future__ import annotations

import errno
import glob
import os
import platform
import re
import shutil
import tomllib
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from handsim._checks import check_type
from handsim.errors import HandSimError, shortened
from handsim.files.inputs import read_bytes

_MOST_TOML: Final = 1 << 18  # bytes; a layout of 60 markers has 6000
_INTEGER_BITS: Final = 63
_DOTTED: Final = re.compile(r"""(?:\.\s{0,9}[\w"'-]+\s{0,9}){20}""")  # tomllib takes hours for very long ones


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the block ends well.

    The temporary file has the same suffix, because some writers add one they miss. If the block raises,
    whatever the reason, the temporary file is removed, an older file at `path` stays as it was, and the error
    goes on to the caller. Folders that are missing on the way to `path` are made. The finished file has the
    mode that the umask asks for, whatever its writer chose. What a killed process left of the same file is
    removed first.

    Args:
        path: Where the finished file shall be; an existing file there is replaced, of a link the file that
            it points to.

    Yields:
        The path to write to.

    Raises:
        ArgumentError: `path` is no path.
        OSError: The folder cannot be made, `path` is a folder or a device, the disk is full, or the block
            wrote nothing.
    """
    with atomic_writes(path) as (temporary,):
        yield temporary


@contextmanager
def atomic_writes(*paths: str | Path) -> Iterator[tuple[Path, ...]]:
    """Temporary paths of files that belong together: all take their names when the block ends well, or none.

    Args:
        paths: Where the finished files shall be; see `atomic_write`.

    Yields:
        The paths to write to, in the same order.

    Raises:
        ArgumentError: One is no path.
        OSError: As `atomic_write`.
    """
    for path in paths:
        check_type("path", path, (str, os.PathLike), "a path")
    finals = [Path(os.path.realpath(path)) if os.path.islink(path) else Path(path) for path in paths]
    for final in finals:
        # Renaming onto a device (/dev/null) would replace it; a folder would be noticed only after the work.
        if final.exists() and not final.is_file():
            raise FileExistsError(errno.EEXIST, "not a regular file, so it is not replaced", str(final))
        make_folder_of(final)
        remove_abandoned(final)
    temporaries = [temporary_beside(final) for final in finals]
    modes = [_usual_mode(*pair) for pair in zip(temporaries, finals, strict=True)]
    renamed: list[Path] = []
    try:
        yield tuple(temporaries)
        for temporary, mode in zip(temporaries, modes, strict=True):
            os.chmod(temporary, mode)
            _flush(temporary)
        for temporary, final in zip(temporaries, finals, strict=True):
            os.replace(temporary, final)
            renamed.append(final)
    except BaseException as error:  # also an interrupt must leave nothing behind
        for file in (*temporaries, *renamed):
            file.unlink(missing_ok=True)
        names = dict(zip(map(str, temporaries), map(str, finals), strict=True))
        if isinstance(error, OSError) and str(error.filename) in names:  # nobody knows the temporary name
            error.filename = names[str(error.filename)]
        raise


def make_folder_of(path: Path) -> None:
    """Make the folders that are missing on the way to a file.

    Raises:
        OSError: One cannot be made, or there is a file in its place.
    """
    for folder in path.parents:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{folder} is a file, not a folder", str(folder))
    path.parent.mkdir(parents=True, exist_ok=True)


def temporary_beside(path: Path) -> Path:
    """The hidden name under which this process writes `path`; `remove_leftovers` knows such names."""
    return path.with_name(f"{_prefix(path)}{os.getpid()}{path.suffix}")


def _prefix(path: Path) -> str:
    """How such names begin on this machine: another one that shares the folder has its own processes."""
    return f".{path.stem}.tmp-{zlib.crc32(platform.node().encode()):08x}-"


def remove_leftovers(folder: Path) -> None:
    """Remove every temporary file and folder in a folder and below it that no process writes any more.

    Only for a folder that one job owns: what another living process is writing there would be lost.
    """
    for leftover in folder.glob("**/.*.tmp-*"):
        _remove(leftover)


def _remove(leftover: Path) -> None:
    if leftover.is_dir() and not leftover.is_symlink():
        shutil.rmtree(leftover, ignore_errors=True)
    else:
        leftover.unlink(missing_ok=True)


def remove_abandoned(final: Path) -> None:
    """Remove what was to become `final` and whose process is gone; that of other machines stays."""
    prefix = _prefix(final)
    for leftover in final.parent.glob(f"{glob.escape(prefix)}*{glob.escape(final.suffix)}"):
        number = leftover.name.removeprefix(prefix).removesuffix(final.suffix)
        if number.isdecimal() and not _is_running(int(number)):
            _remove(leftover)


def _is_running(process: int) -> bool:
    if os.name != "posix":  # there a signal of zero would end the process
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        return True
    return True


def _usual_mode(temporary: Path, final: Path) -> int:
    """The mode of a new file here; some writers make theirs readable by the owner alone."""
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o666)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(final)) from error
    try:
        return os.fstat(descriptor).st_mode & 0o777
    finally:
        os.close(descriptor)
        temporary.unlink(missing_ok=True)


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
        error: What to raise, in one sentence, when the file cannot be read or is not TOML.
    """
    data = read_bytes(path, error=error, most=_MOST_TOML)
    try:
        text = data.decode("utf-8")
        deep = _DOTTED.search(text)
        if deep is not None:
            raise tomllib.TOMLDecodeError(f"the key {shortened(deep[0])!r} has too many parts")
        table = tomllib.loads(text)
        if _has_long_integer(table):
            raise OverflowError
        return table
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a TOML file: it is not UTF-8 text") from cause
    except tomllib.TOMLDecodeError as cause:
        raise error(f"{path}: not a TOML file: {cause}") from cause
    except (ValueError, OverflowError) as cause:  # Python reads no more than some thousand digits
        raise error(f"{path}: not a TOML file: an integer of more than 64 bits") from cause
    except RecursionError as cause:
        raise error(f"{path}: not a TOML file: brackets are nested too deep") from cause


def _has_long_integer(value: object) -> bool:
    """Whether an integer beyond the 64 bits of TOML is in a table, which Python would take."""
    if isinstance(value, dict | list):
        return any(map(_has_long_integer, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int) and value.bit_length() > _INTEGER_BITS
