"""Results of participants: for each capture one file of any of these forms.

- `NAME.csv`: columns `frame,point,label`, as the capture's `.trc` names frames and points.
- `NAME.npz`: arrays like those of the truth (`answers`).
- `NAME.npz`: a take of `handsim track`.
- `NAME.trc`, `.c3d` or Motive's `.csv`: labeled points, as `handsim label` and `handsim track` write them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int

from benchmarks.public.answers import (
    SIDES,
    Answers,
    BenchmarkError,
    check_labels,
    load_arrays,
    poses_of,
    unpack_answers,
)
from gloves import Capture, load_take, read_capture
from gloves.captures.capture import UNLABELED
from gloves.captures.formats import MOTIVE_BEGIN
from handsim import HandSimError
from handsim.errors import choices, shortened
from handsim.files.inputs import check_regular, read_bytes

SUFFIXES: Final = (".npz", ".csv", ".trc", ".c3d")
"""Endings of results' files."""
COLUMNS: Final = ("frame", "point", "label")
"""Columns of a result as `.csv`."""
NO_LABEL: Final = ("", "none")
"""What a `.csv` may hold for a point of no marker."""
_MOST_CSV: Final = 1 << 26  # bytes; half an hour of two hands takes as many
_GRID: Final = 1e5  # steps per meter on which points are written
_MOST_SHOWN: Final = 60  # characters of a cell


def find_results(folder: Path, names: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    """The files of results by the name of their capture, and the names of files of no capture.

    Raises:
        BenchmarkError: No such folder, nothing in it, or two files for one capture.
    """
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: no such folder, expected one with a file for every capture")
    found: dict[str, Path] = {}
    unknown: list[str] = []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
            continue
        if path.stem not in names:
            unknown.append(path.name)
        elif path.stem in found:
            raise BenchmarkError(
                f"{folder} has {found[path.stem].name} and {path.name}, expected one of them"
            )
        else:
            found[path.stem] = path
    if not found:
        raise BenchmarkError(
            f"{folder} holds no results, expected {names[0]}.csv and so on; endings: {', '.join(SUFFIXES)}"
        )
    return found, unknown


def read_result(path: Path, capture: Capture, label_names: tuple[str, ...]) -> Answers:
    """Labels, and joints [m] and joint angles [rad] if there are any, of one capture.

    Args:
        path: The file; its ending and its content decide the form.
        capture: The capture's points.
        label_names: Names of the labels.

    Raises:
        BenchmarkError: It cannot be read, or does not fit the capture: one sentence with the first fault.
    """
    try:
        check_regular(path, error=BenchmarkError)
        answers = _read(path, capture, label_names)
        check_labels(answers.labels, np.isfinite(capture.positions[..., 0]), label_names)
    except HandSimError as error:
        words = str(error)
        raise BenchmarkError(words if words.startswith(str(path)) else f"{path}: {words}") from error
    return answers


def _read(path: Path, capture: Capture, label_names: tuple[str, ...]) -> Answers:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        arrays = load_arrays(path)
        if "header" in arrays:
            return _of_tracked_take(path, capture, label_names)
        return unpack_answers(arrays)
    if suffix == ".csv":
        data = read_bytes(path, error=BenchmarkError, most=_MOST_CSV)
        if not data.startswith(MOTIVE_BEGIN):
            return Answers(_labels_of_table(data, capture, label_names))
    return Answers(_labels_of_points(read_capture(path), capture, label_names))


def _labels_of_table(data: bytes, capture: Capture, label_names: tuple[str, ...]) -> Int[np.ndarray, "T N"]:
    """Labels (T, N) of a table with the columns `frame,point,label`; points that are not listed have none."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BenchmarkError("not UTF-8 text, expected a table of frame,point,label") from error
    columns = {name: number for number, name in enumerate(capture.names)}
    numbers = {name: number for number, name in enumerate(label_names)}
    numbers |= dict.fromkeys(NO_LABEL, -1)
    labels = np.full(capture.positions.shape[:2], -1)
    seen = np.zeros(labels.shape, dtype=bool)
    rows = csv.reader(io.StringIO(text, newline=""))
    try:
        head = [cell.strip().lower() for cell in next(rows, [])]
        if tuple(head) != COLUMNS:
            raise BenchmarkError(
                f"line 1 is '{_shown(','.join(head))}', expected the columns {','.join(COLUMNS)}"
            )
        for row in rows:
            if not row:
                continue
            frame, column, label = _cells(row, rows.line_num, len(labels), columns, numbers)
            if seen[frame, column]:
                raise BenchmarkError(
                    f"line {rows.line_num} labels {row[1].strip()} of frame {row[0].strip()} once more, "
                    "expected each point of a frame once"
                )
            seen[frame, column] = True
            labels[frame, column] = label
    except csv.Error as error:
        raise BenchmarkError(f"line {rows.line_num} is not a line of a table: {error}") from error
    return labels


def _cells(
    row: list[str], line: int, frames: int, columns: Mapping[str, int], numbers: Mapping[str, int]
) -> tuple[int, int, int]:
    """Frame and column counted from 0, and label, of one line."""
    if len(row) != len(COLUMNS):
        raise BenchmarkError(f"line {line} has {len(row)} cells, expected {','.join(COLUMNS)}")
    frame, point, label = (cell.strip() for cell in row)
    number = int(frame) if frame.isascii() and frame.isdecimal() and len(frame) < 10 else 0
    if not 1 <= number <= frames:
        raise BenchmarkError(f"line {line} is of frame '{_shown(frame)}', expected 1 to {frames}")
    if point not in columns:
        raise BenchmarkError(f"line {line}: {choices(_shown(point), columns, noun='point')}")
    if label not in numbers:
        valid = [name for name in numbers if name]
        raise BenchmarkError(f"line {line}: {choices(_shown(label), valid, noun='label')}")
    return number - 1, columns[point], numbers[label]


def _labels_of_points(
    labeled: Capture, capture: Capture, label_names: tuple[str, ...]
) -> Int[np.ndarray, "T N"]:
    """Labels (T, N) of a capture's points, by the columns of a marker file that hold the same points."""
    _check_frames(labeled.num_frames, capture)
    labels = np.full(capture.positions.shape[:2], -1)
    places = {place: column for place, column in zip(*_grid(capture), strict=True)}
    given = [_label_of(name, label_names) for name in labeled.names]
    for place, column in zip(*_grid(labeled), strict=True):
        if given[column] < 0:
            continue
        if place not in places:
            raise BenchmarkError(
                f"frame {place[0] + 1} has {labeled.names[column]} where the capture has no point, expected "
                "its points unchanged"
            )
        labels[place[0], places[place]] = given[column]
    return labels


def _grid(capture: Capture) -> tuple[list[tuple[int, ...]], list[int]]:
    """Frame and place on the grid of every point, and its column."""
    frames, columns = np.nonzero(np.isfinite(capture.positions[..., 0]))
    places = np.rint(capture.positions[frames, columns] * _GRID).astype(np.int64)
    return list(map(tuple, np.column_stack([frames, places]).tolist())), columns.tolist()


def _label_of(column: str, label_names: tuple[str, ...]) -> int:
    """The label that the name of a column stands for; -1 for unlabeled points and markers of rigid bodies."""
    if column in label_names:
        return label_names.index(column)
    side, colon, _ = column.partition(":")
    if column.startswith((UNLABELED, "*")) or (colon and side not in SIDES):
        return -1
    raise BenchmarkError(choices(_shown(column), label_names, noun="label"))


def _of_tracked_take(path: Path, capture: Capture, label_names: tuple[str, ...]) -> Answers:
    """Labels and poses of a take of `handsim track`."""
    take = load_take(path)
    _check_frames(take.num_frames, capture)
    if take.points.shape != capture.positions.shape:
        raise BenchmarkError(
            f"has {take.points.shape[1]} columns of points, expected the capture's "
            f"{capture.positions.shape[1]}"
        )
    numbers = np.array([*(_label_of(name, label_names) for name in take.label_names), -1])
    return Answers(numbers[take.labels], *poses_of(take.hands, take.qpos))


def _check_frames(frames: int, capture: Capture) -> None:
    if frames != capture.num_frames:
        raise BenchmarkError(f"has {frames} frames, expected the capture's {capture.num_frames}")


def _shown(text: str) -> str:
    return shortened("".join(sign if sign.isprintable() else "?" for sign in text), _MOST_SHOWN)
