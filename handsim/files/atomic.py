"""Files that are written whole or not at all, alone or together; TOML files read with one kind of error."""

from __future__ import annotations

import errno
import glob
import os
import platform
import re
import shutil
import tomllib
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

from handsim._checks import check_type
from handsim.errors import HandSimError, shortened
from handsim.files.inputs import read_bytes
from handsim.files.signals import signals_wait

_MOST_TOML: Final = 1 << 18  # bytes; a layout of 60 markers has 6000
_INTEGER_BITS: Final = 63
_OLDER: Final = "-older"  # marks the second name of a file that is being replaced
_PROBE: Final = 1 << 20  # bytes
_DOTTED: Final = re.compile(r"""(?:\.\s{0,9}[\w"'-]+\s{0,9}){20}""")  # tomllib takes hours for very long ones


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the block ends well.

    The temporary file has the same suffix, because some writers add one they miss. If the block raises,
    whatever the reason, the temporary file is removed, an older file at `path` stays as it was, and the error
    goes on to the caller; one of the system that names no file names `path` then. Folders that are missing on
    the way to `path` are made. The finished file has the mode that the umask asks for, whatever its writer
    chose. What a killed process left of the same file is removed first.

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
    check_type("path", path, (str, os.PathLike), "a path")
    final = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    # Renaming onto a device (/dev/null) would replace it; a folder would be noticed only after the work.
    if final.exists() and not final.is_file():
        raise FileExistsError(errno.EEXIST, "not a regular file, so it is not replaced", str(final))
    make_folder_of(final)
    remove_abandoned(final)
    temporary = temporary_beside(final)
    with _errors_name(final, temporary):
        mode = _usual_mode(temporary)
        try:
            yield temporary
            os.chmod(temporary, mode)
            _flush(temporary)
            together = _TOGETHER.get()
            if together is None:
                _name({final: temporary})
            else:
                together[final] = temporary
        except BaseException:  # also an interrupt must leave nothing behind
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def _errors_name(final: Path, temporary: Path) -> Iterator[None]:
    """Errors name the file that was asked for, not the temporary one, nor none as those of full disks do."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary), temporary):
            error.filename = str(final)
        raise


_TOGETHER: Final[ContextVar[dict[Path, Path] | None]] = ContextVar("together", default=None)
"""Temporary files that wait for the end of a block of `written_together`, by their final names."""


@contextmanager
def written_together() -> Iterator[None]:
    """Files of `atomic_write` within the block take their names at its end, all of them or none.

    If the block raises, or one file cannot take its name, older files stay as they were, and those that were
    not there before are not there. Signals to end wait for the renames. Only a process that is killed between
    two of them leaves new files beside older ones.

    Raises:
        OSError: A file cannot take its name.
    """
    if _TOGETHER.get() is not None:
        yield
        return
    files: dict[Path, Path] = {}
    token = _TOGETHER.set(files)
    try:
        yield
        _name(files)
    finally:
        _TOGETHER.reset(token)
        for temporary in files.values():
            temporary.unlink(missing_ok=True)


def _name(files: Mapping[Path, Path]) -> None:
    """Rename all temporary files, or none.

    Args:
        files: The temporary file of each final name.
    """
    older: dict[Path, Path] = {}
    named: list[Path] = []
    with signals_wait():
        try:
            if len(files) > 1:  # a single rename is whole in itself
                for final in filter(Path.exists, files):
                    older[final] = temporary_beside(final, _OLDER)
                    _keep(final, older[final])
            for final, temporary in files.items():
                with _errors_name(final, temporary):
                    os.replace(temporary, final)
                named.append(final)
        except BaseException:
            for final in reversed(named):
                _put_back(final, older.pop(final, None))
            raise
        finally:
            for kept in older.values():
                kept.unlink(missing_ok=True)


def _keep(final: Path, older: Path) -> None:
    """Keep a file under a second name."""
    older.unlink(missing_ok=True)
    try:
        os.link(final, older)
    except OSError:  # the file system has no hard links
        with _errors_name(final, older):
            shutil.copy2(final, older)


def _put_back(final: Path, older: Path | None) -> None:
    """Undo a rename; where that fails too, the older file stays under its second name."""
    with suppress(OSError):
        if older is None:
            final.unlink()
        else:
            os.replace(older, final)


def unwritten(path: Path) -> OSError:
    """The system's error for a file that a library did not write whole, without saying why."""
    try:
        with path.open("ab") as file:
            file.write(bytes(_PROBE))
    except OSError as error:
        return error
    return OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def make_folder_of(path: Path) -> None:
    """Make the folders that are missing on the way to a file.

    Raises:
        OSError: One cannot be made, or there is a file in its place.
    """
    for folder in path.parents:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{folder} is a file, not a folder", str(folder))
    path.parent.mkdir(parents=True, exist_ok=True)


def temporary_beside(path: Path, mark: str = "") -> Path:
    """The hidden name under which this process writes `path`; `remove_leftovers` knows such names."""
    return path.with_name(f"{_prefix(path)}{os.getpid()}{mark}{path.suffix}")


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
    """Remove what was to become `final`, or was it before, and whose process is gone.

    What processes of other machines left stays.
    """
    prefix = _prefix(final)
    for leftover in final.parent.glob(f"{glob.escape(prefix)}*{glob.escape(final.suffix)}"):
        number = leftover.name.removeprefix(prefix).removesuffix(final.suffix).removesuffix(_OLDER)
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


def _usual_mode(temporary: Path) -> int:
    """The mode of a new file here; some writers make theirs readable by the owner alone."""
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o666)
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
