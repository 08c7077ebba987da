"""Results of participants: for each capture one file of any of these forms.

- `NAME.csv`: columns `frame,point,label`, as the capture's `.trc` names frames and points.
- `NAME.npz`: arrays like those of the truth (`answers`).
- `NAME.npz`: a take of `handsim track`.
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
    Answers,
    BenchmarkError,
    check_labels,
    load_arrays,
    poses_of,
    unpack_answers,
)
from gloves import Capture, load_take
from handsim import HandSimError
from handsim.errors import choices, shortened
from handsim.files.inputs import check_regular, read_bytes

SUFFIXES: Final = (".npz", ".csv")
"""Endings of results' files."""
COLUMNS: Final = ("frame", "point", "label")
"""Columns of a result as `.csv`."""
NO_LABEL: Final = ("", "none")
"""What a `.csv` may hold for a point of no marker."""
_MOST_CSV: Final = 1 << 26  # bytes; half an hour of two hands takes as many
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

    The ending and the content of the file decide its form.

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
    if path.suffix.lower() == ".csv":
        data = read_bytes(path, error=BenchmarkError, max_bytes=_MOST_CSV)
        return Answers(_labels_of_table(data, capture, label_names))
    arrays = load_arrays(path)
    return _of_tracked_take(path, capture, label_names) if "header" in arrays else unpack_answers(arrays)


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


def _of_tracked_take(path: Path, capture: Capture, label_names: tuple[str, ...]) -> Answers:
    """Labels and poses of a take of `handsim track`; markers of bodies are no labels."""
    take = load_take(path)
    if take.points.shape != capture.positions.shape:
        frames, columns = capture.positions.shape[:2]
        raise BenchmarkError(
            f"has {take.num_frames} frames of {take.points.shape[1]} columns, expected the capture's "
            f"{frames} of {columns}"
        )
    numbers = {name: number for number, name in enumerate(label_names)}
    table = np.array([*(numbers.get(name, -1) for name in take.label_names), -1])
    return Answers(table[take.labels], *poses_of(take.hands, take.qpos))


def _shown(text: str) -> str:
    return shortened("".join(sign if sign.isprintable() else "?" for sign in text), _MOST_SHOWN)
