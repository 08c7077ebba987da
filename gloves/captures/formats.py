"""Marker files by their suffix: TRC, C3D and Motive CSV both ways, Vicon CSV and Qualisys TSV in.

Many captures make one stack of labeled frames (`read_markers`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.captures.c3d import read_c3d, write_c3d
from gloves.captures.capture import (
    AT_ORIGIN,
    Capture,
    all_at_origin,
    select_hands,
    unit_fault,
    unlabeled_frames,
    zeros_as_missing,
)
from gloves.captures.text import Tell, separator_behind, split_lines
from gloves.captures.text_formats import (
    MOTIVE_BEGIN,
    read_motive_csv,
    read_qtm_tsv,
    read_trc,
    read_vicon_csv,
    vicon_sections,
    write_motive_csv,
    write_trc,
)
from handsim._checks import check_type
from handsim.errors import CaptureError, HandSimWarning, choices
from handsim.files.inputs import read_bytes
from handsim.files.outputs import as_text, atomic_write


def _read_csv(data: bytes, tell: Tell) -> Capture:
    """A CSV by its content, since Motive's and Vicon's have the same suffix."""
    if separator_behind([MOTIVE_BEGIN], split_lines(data[:_BEGIN])[0][0]) is not None:
        return read_motive_csv(data, tell)
    if vicon_sections(split_lines(data)[0]):
        return read_vicon_csv(data, tell)
    raise CaptureError(
        "not a CSV of markers: expected Motive's, whose line 1 begins with 'Format Version', or Vicon's, "
        "where a line reads 'Trajectories'"
    )


_BEGIN: Final = 200  # bytes that show which program wrote a CSV
_READERS: Final = {".trc": read_trc, ".c3d": read_c3d, ".csv": _read_csv, ".tsv": read_qtm_tsv}
_TEXT_WRITERS: Final = {".trc": write_trc, ".csv": write_motive_csv}
READABLE: Final = tuple(_READERS)
WRITABLE: Final = (".trc", ".c3d", ".csv")


def read_capture(capture: Capture | str | Path) -> Capture:
    """Read a `.trc` or `.c3d` file, a `.csv` of Motive or Vicon, or a `.tsv` of Qualisys.

    Args:
        capture: The file; its suffix decides the format, its content between the two kinds of `.csv`. A
            capture that was read before is returned as it is.

    Returns:
        Positions (T, N, 3) in [m], whatever the file's unit, with one trajectory per column, and the rate
        [Hz].

    Raises:
        ArgumentError: It is neither.
        CaptureError: The suffix is unknown, the file is missing, cut or damaged, or its unit is unknown or
            cannot be that of its positions.

    Warns:
        HandSimWarning: Points at exactly (0, 0, 0) were taken as missing; the file states no unit or rate, or
            contradicts itself, in a way that leaves one reading.
    """
    if isinstance(capture, Capture):
        return capture
    check_type("capture", capture, (str, Path), "a Capture or the path of a file", READABLE)
    path = Path(capture)
    check_suffix(path, READABLE)
    data = read_bytes(path, error=CaptureError)
    if not data:
        raise CaptureError(f"{path}: the file is empty")

    def tell(text: str) -> None:
        warnings.warn(f"{path}: {text}", HandSimWarning, stacklevel=3)

    try:
        read = _READERS[path.suffix.lower()](data, tell)
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}") from error
    return _checked(path, read)


def _checked(path: Path, capture: Capture) -> Capture:
    """The capture without zeros for missing points, if its positions can be in the unit of its file."""
    capture, zeros = zeros_as_missing(capture)
    if zeros:
        warnings.warn(
            f"{path}: {zeros} points at exactly (0, 0, 0) are read as missing; if they are points, move the "
            "origin",
            HandSimWarning,
            stacklevel=3,
        )
    clouds = unlabeled_frames(capture)
    if all_at_origin(clouds):
        raise CaptureError(f"{path}: {AT_ORIGIN}, expected positions of markers")
    fault = unit_fault(clouds)
    if fault is not None:
        raise CaptureError(
            f"{path}: by the unit of length that the file states, {fault.found}; correct that unit, probably "
            f"to {fault.guess}"
        )
    return capture


def write_capture(path: str | Path, capture: Capture) -> None:
    """Write a `.trc`, `.c3d` or Motive `.csv` file in millimeters, whole or not at all.

    A TRC keeps positions to 5e-9 m, a CSV to 5e-10 m; a C3D keeps single precision (6e-8 of the value).

    Args:
        path: The file; its suffix decides the format.
        capture: Positions (T, N, 3) [m] at a rate [Hz].

    Raises:
        ArgumentError: An argument is of another type.
        CaptureError: The suffix is unknown, a name cannot be written to the file, or writing fails.
    """
    check_type("path", path, (str, Path), "the path of a file", WRITABLE)
    check_type(
        "capture",
        capture,
        Capture,
        "a Capture, as read_capture, Take.capture() or Take.labeled_capture() give it",
    )
    path = Path(path)
    check_suffix(path, WRITABLE)
    for name in capture.names:
        if not name or name != name.strip() or not name.isprintable():
            raise CaptureError(
                f"{path}: marker name {name!r} cannot be written; expected printable characters without "
                "tabs, line ends or outer blanks"
            )
    try:
        with atomic_write(path) as temporary:
            if path.suffix.lower() in _TEXT_WRITERS:
                _TEXT_WRITERS[path.suffix.lower()](temporary, capture, title=as_text(path.name))
            else:
                write_c3d(temporary, capture)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}") from error


def check_suffix(path: Path, valid: tuple[str, ...]) -> None:
    """Raise a `CaptureError` with the valid suffixes unless the path has one of them."""
    if path.suffix.lower() not in valid:
        raise CaptureError(f"{path}: {choices(path.suffix, valid, noun='file type')}")


def find_captures(paths: Sequence[Path]) -> list[Path]:
    """The capture files among paths, folders searched through."""
    files = []
    for path in paths:
        inside = (
            sorted(file for file in path.rglob("*") if file.suffix.lower() in READABLE)
            if path.is_dir()
            else [path]
        )
        if not inside:
            raise CaptureError(f"{path} holds no capture; expected files {', '.join(READABLE)}")
        files += inside
    if not files:
        raise CaptureError("no capture was given; expected files or folders")
    return files


def read_markers(files: Sequence[Path], names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The named markers of labeled captures [m], NaN where missing, hand by hand; no frames without any.

    Raises:
        CaptureError: A file cannot be read or lacks a marker; the file is named.
    """
    markers = np.concatenate([_markers_of(file, names) for file in files])
    shown: Float[np.ndarray, "T M 3"] = markers[np.isfinite(markers).any(axis=(1, 2))]
    return shown


def _markers_of(file: Path, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    try:
        return np.concatenate(select_hands(read_capture(file), names))
    except CaptureError as error:
        text = str(error)
        raise CaptureError(text if text.startswith(str(file)) else f"{file}: {text}") from error
