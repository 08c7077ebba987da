"""Atomic writing of files, alone or together, and checks of outputs, disk and memory before long work."""

from __future__ import annotations

import errno
import glob
import json
import math
import os
import platform
import re
import shutil
import tempfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from handsim._checks import check_type
from handsim._process import memory_limit, text_of_system
from handsim.errors import ArgumentError, HandSimError, shortened
from handsim.files.inputs import load_json
from handsim.files.signals import signals_wait

_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
_OLDER_MARK: Final = "-older"  # marks the second name of a file that is being replaced
_MAX_STEM: Final = 32  # characters of a name that its temporary name shows
_WAITING_FILES: Final[ContextVar[dict[Path, Path] | None]] = ContextVar("together", default=None)
"""Temporary files that wait for the end of a block of `written_together`, by their final names."""
_BYTE_UNITS: Final = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")
_MAX_SHOWN: Final = 4  # settings that a message lists


def as_text(name: str) -> str:
    """A file's name as a line of text, with a replacement character for what is not printable."""
    return "".join(one if one.isprintable() else _REPLACEMENT for one in name)


@contextmanager
def plain_path(path: Path) -> Iterator[Path]:
    """The path, or a link to it if the path is not UTF-8, which some libraries require."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / f"link{as_text(path.suffix)}"
            link.symlink_to(path.absolute())
            yield link
            if not link.is_symlink():  # some writers replace what is there
                shutil.copyfile(link, path)
    else:
        yield path


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with its suffix, and rename the file to `path` after the block.

    If the block raises, the temporary file is removed, and an older file at `path` stays unchanged. Missing
    folders are made. Temporary files that a killed process left are removed first. The mode of the file
    follows from the umask.
    """
    check_type("path", path, (str, os.PathLike), "a path")
    final = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    # Renaming onto a device (/dev/null) would replace it; a folder would be noticed only after the work.
    if final.exists() and not final.is_file():
        raise FileExistsError(errno.EEXIST, "not a regular file, so it is not replaced", str(final))
    make_folder_of(final)
    remove_abandoned(final)
    temporary = temporary_beside(final)
    with _naming_final(final, temporary):
        mode = _default_mode(temporary)
        try:
            yield temporary
            with suppress(OSError):  # network drives and memory cards may keep no modes
                os.chmod(temporary, mode)
            _flush(temporary)
            together = _WAITING_FILES.get()
            if together is None:
                _rename_all({final: temporary})
            else:
                together[final] = temporary
        except BaseException:  # also an interrupt must leave nothing behind
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def _naming_final(final: Path, temporary: Path) -> Iterator[None]:
    """Make errors of the block name the final file in place of the temporary one, or of none."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary), temporary):
            error.filename = str(final)
        raise


@contextmanager
def written_together() -> Iterator[None]:
    """Rename all files of `atomic_write` in the block at its end, or none of them.

    New files stand beside older ones only if the process is killed between two renames.
    """
    if _WAITING_FILES.get() is not None:
        yield
        return
    files: dict[Path, Path] = {}
    token = _WAITING_FILES.set(files)
    try:
        yield
        _rename_all(files)
    finally:
        _WAITING_FILES.reset(token)
        for temporary in files.values():
            temporary.unlink(missing_ok=True)


def _rename_all(files: Mapping[Path, Path]) -> None:
    """Rename all temporary files, or none."""
    older: dict[Path, Path] = {}
    named: list[Path] = []
    with signals_wait():
        try:
            if len(files) > 1:  # a single rename is atomic
                for final in filter(Path.exists, files):
                    older[final] = temporary_beside(final, _OLDER_MARK)
                    _keep_older(final, older[final])
            for final, temporary in files.items():
                with _naming_final(final, temporary):
                    os.replace(temporary, final)
                named.append(final)
        except BaseException:
            for final in reversed(named):
                with suppress(OSError):  # where undoing fails, the older file stays under its second name
                    if final in older:
                        os.replace(older[final], final)
                    else:
                        final.unlink()
                older.pop(final, None)
            raise
        finally:
            for kept in older.values():
                kept.unlink(missing_ok=True)


def _keep_older(final: Path, older: Path) -> None:
    """Give a file a second name, under which it survives being replaced."""
    older.unlink(missing_ok=True)
    try:
        os.link(final, older)
    except OSError:  # the file system has no hard links
        with _naming_final(final, older):
            shutil.copy2(final, older)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, complete or not at all; what is not UTF-8, as in some file names, is replaced."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8", errors="replace")


@contextmanager
def writing(path: str | Path, kind: type[HandSimError]) -> Iterator[None]:
    """Raise an error of this kind in place of the block's `OSError`s: a file cannot be written."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path}: cannot be written: {error.strerror or error}") from error


def unwritten(path: Path) -> OSError:
    """The system's error for a file that a library did not write completely, without a reason."""
    try:
        with path.open("ab") as file:
            file.write(bytes(1 << 20))
    except OSError as error:
        return error
    return OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def make_folder_of(path: Path) -> None:
    """Make the folders that are missing on the way to a file."""
    for folder in path.parents:
        if str(folder) == "~" and not folder.exists():
            raise ArgumentError(f"{path}: only shells replace ~, expected Path('{path}').expanduser()")
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{folder} is a file, not a folder", str(folder))
    path.parent.mkdir(parents=True, exist_ok=True)


def temporary_beside(path: Path, mark: str = "") -> Path:
    """The hidden name under which this process writes `path`; `remove_leftovers` knows such names."""
    return path.with_name(f"{_temporary_prefix(path)}{os.getpid()}{mark}{path.suffix}")


def _temporary_prefix(path: Path) -> str:
    """The beginning of the temporary names of a file.

    It has a hash of this machine, because process IDs are unique on one machine only. A hash replaces the end
    of a long name, because names may have 255 bytes.
    """
    stem = path.stem
    if len(stem) > _MAX_STEM:
        stem = f"{stem[:_MAX_STEM]}-{zlib.crc32(os.fsencode(stem)):08x}"
    return f".{stem}.tmp-{_machine_hash()}-"


def _machine_hash() -> str:
    """A hash of this machine's name."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def remove_leftovers(folder: Path, names: str = "**/.*.tmp-*") -> None:
    """Remove files and folders that match a pattern: by default all temporary ones at any depth.

    Temporary files of another running process of this machine stay.
    """
    for leftover in folder.glob(names):
        writer = re.search(rf"\.tmp-{_machine_hash()}-(\d{{1,9}})", leftover.name)
        if writer and int(writer[1]) != os.getpid() and _is_running(int(writer[1])):
            continue
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


def remove_abandoned(final: Path) -> None:
    """Remove the temporary files that processes left beside the output `final` when they were killed."""
    prefix = _temporary_prefix(final)
    for leftover in final.parent.glob(f"{glob.escape(prefix)}*{glob.escape(final.suffix)}"):
        number = leftover.name.removeprefix(prefix).removesuffix(final.suffix).removesuffix(_OLDER_MARK)
        if number.isdecimal() and int(number) != os.getpid():
            remove_leftovers(final.parent, glob.escape(leftover.name))


def _is_running(process: int) -> bool:
    if os.name != "posix":  # on Windows signal 0 would end the process
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # the process is another user's
        return True
    return True


def _default_mode(temporary: Path) -> int:
    """The mode of a new file in this folder; some writers make theirs readable by the owner only."""
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o666)
    try:
        return os.fstat(descriptor).st_mode & 0o777
    finally:
        os.close(descriptor)
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Wait until the file is on the disk; an earlier rename can leave an empty file after a power failure."""
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only what is open for writing
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_outputs(inputs: Iterable[object], outputs: Sequence[Path | None], *endings: str) -> None:
    """Refuse an output that cannot be written, or is the same file as an input or another output.

    If `endings` are given, the first output is --out, and its name must have one of them.
    """
    if endings:
        check_ending(cast("Path", outputs[0]), *endings)
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
            with suppress(OSError, ValueError):  # one of them does not exist
                if os.path.samefile(source, output):
                    raise ArgumentError(f"the output {output} is the input {source}, expected another file")


def _check_links(output: Path) -> None:
    """Refuse an output whose path has a link to itself, or to a folder that does not exist."""
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
    """Refuse a file of an option whose name has none of these endings."""
    if path.suffix.lower() not in endings:
        raise ArgumentError(f"{option} is {path}, expected a file name that ends in {', '.join(endings)}")


def write_starter(file: Path, text: str, *, error: type[HandSimError]) -> None:
    """Write a starter file to a new .toml file."""
    if file.suffix.lower() != ".toml":
        raise error(f"{file}: expected a file name that ends in .toml")
    if file.exists():
        raise error(f"{file} exists already and is left as it is; name a new file")
    write_text(file, text)


def check_free(folder: Path, needed: int, what: str, remedy: str, *, error: type[HandSimError]) -> None:
    """Refuse work that needs more space [bytes] than the disk of a folder has; the folder may be missing."""
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
    """Refuse work that needs more memory [bytes] than is free; `what` and `remedy` as for `check_free`."""
    free = available_bytes()
    if needed > free:
        raise ArgumentError(
            f"{what} need {shown_bytes(needed)} of memory, but {shown_bytes(free)} are free; {remedy}"
        )


def available_bytes() -> int:
    """Memory that is free without swapping, and that control groups allow [bytes].

    If the system does not state the free memory, all of its memory counts as free.
    """
    stated = re.search(r"^MemAvailable: *(\d{1,15}) kB$", text_of_system(Path("/proc/meminfo")), re.M)
    free = 1024 * int(stated[1]) if stated else os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return int(min(free, memory_limit()))


def shown_bytes(count: float) -> str:
    """A number of bytes in kB, MB or a larger unit."""
    unit = 0
    while count >= 1000.0 and unit < len(_BYTE_UNITS) - 1:
        count, unit = count / 1000.0, unit + 1
    return f"{count:.3g} {_BYTE_UNITS[unit]}"


def save_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    write_text(path, json_text(content))


def json_text(content: dict[str, Any]) -> str:
    """The text of a JSON file."""
    return json.dumps(plain_json(content), indent=1, allow_nan=False) + "\n"


def plain_json(value: Any) -> Any:
    """A value as JSON can hold it: lists in place of arrays, None in place of NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: plain_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain_json(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def claim(
    path: Path,
    settings: dict[str, Any],
    *,
    noun: str,
    error: type[HandSimError],
    grows: str = "",
    free: Collection[str] = (),
    result: Path | None = None,
    shown: str = "",
) -> None:
    """Claim a folder by writing a settings file, or check that the settings in it are equal.

    Temporary files of a killed run are removed. The setting `grows`, written like `train.samples`, may be
    larger than in the file; then the file gets the new settings, and `result` (made with the old ones) is
    removed. Settings in `free` may differ.
    """
    out, shown = path.parent, shown or str(path.parent)
    if path.is_file():
        stored = load_json(path)
        found, expected = _flat_settings(stored), _flat_settings(json.loads(json.dumps(settings)))
        keys = sorted((found.keys() | expected) - set(free))
        differing = [key for key in keys if key not in found.keys() & expected or found[key] != expected[key]]
        new, old = expected.get(grows), found.get(grows)
        grown = differing == [grows] and isinstance(new, int) and isinstance(old, int) and new > old
        if differing and not grown:
            hint = f" ({grows} may only grow)" if grows and differing == [grows] else ""
            raise error(
                f"{path.name} says that {shown} holds a {noun} begun with other settings "
                f"({_differences(differing, found, expected)}); use them or another folder{hint}"
            )
        remove_leftovers(out)
        if grown and result is not None:
            result.unlink(missing_ok=True)
        if grown or path.read_text("utf-8") != json_text(stored):  # the text is damaged, its content is not
            save_json(path, settings)
    elif out.exists() and not out.is_dir():
        raise error(f"{out} is a file, expected a folder")
    elif out.is_dir() and {*out.iterdir()} - {*out.glob(f".{path.stem}.tmp-*")}:  # left by a killed run
        raise error(f"{out} is not empty and holds no {noun}; name another folder")
    else:
        if out.is_dir():
            remove_leftovers(out)
        save_json(path, settings)


def _flat_settings(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by their dotted names, such as `train.network.width`; lists are values."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict) and value:
            flat |= _flat_settings(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _differences(differing: Collection[str], found: dict[str, Any], expected: dict[str, Any]) -> str:
    """The settings that differ, with both values."""
    pairs = [
        f"{key}: {_shown_setting(found, key)} there, {_shown_setting(expected, key)} here"
        for key in list(differing)[:_MAX_SHOWN]
    ]
    more = len(differing) - _MAX_SHOWN
    return "; ".join(pairs) + (f"; and {more} more" if more > 0 else "")


def _shown_setting(settings: dict[str, Any], key: str) -> str:
    return shortened(json.dumps(settings[key], ensure_ascii=False)) if key in settings else "nothing"
