"""The TSV that Qualisys Track Manager exports of 3D data.

Lines of a key and its values (NO_OF_FRAMES, FREQUENCY, MARKER_NAMES, ...), then, if it was asked for, a line
of column names, then one line per frame: frame number and time, if they were asked for, and three cells per
marker in millimeters. Newer exports begin with FILE_VERSION.
"""

from __future__ import annotations

import re
from typing import Final

from gloves.captures._text import (
    MOST_CELLS,
    Tell,
    cell_number,
    header_cells,
    meters_per,
    parse_table,
    plain_lines,
    separator_behind,
    split_lines,
    warn,
)
from gloves.captures.capture import Capture
from gloves.captures.frame_times import StatedTimes, timed_positions
from handsim.errors import CaptureError, shortened

_BEGINS: Final = (b"NO_OF_FRAMES", b"FILE_VERSION")
_KEY: Final = re.compile(rb"(?!NULL\t)[A-Z][A-Z0-9_]*(\t|$)")
_LEADING: Final = ("frame", "time")
_MOST_DIGITS: Final = 12  # of a count
_UNIT: Final = "mm"  # the only one that QTM writes


def read_qtm_tsv(data: bytes, tell: Tell = warn) -> Capture:
    """The markers in the bytes of a Qualisys TSV with 3D data; frames missing or too many are told."""
    lines, ended = split_lines(data)
    separator = separator_behind(_BEGINS, lines[0])
    if separator is None:
        raise CaptureError(
            "not a Qualisys TSV export: line 1 does not begin with 'NO_OF_FRAMES' or 'FILE_VERSION'"
        )
    lines = plain_lines(lines, separator, wider=True)
    start = next((index for index, line in enumerate(lines) if not _KEY.match(line)), len(lines))
    if start == len(lines) and not ended:
        raise CaptureError("the header is cut: no line of column names or numbers follows it")
    stated = {
        cells[0]: cells[1:]
        for number, line in enumerate(lines[:start], 1)
        for cells in [header_cells(line, number)]
    }
    included = _first(stated, "DATA_INCLUDED") or "3D"
    if included != "3D":
        raise CaptureError(f"DATA_INCLUDED is '{shortened(included)}', expected '3D'; export the 3D data")
    if "MARKER_NAMES" not in stated:
        raise CaptureError("the header states no MARKER_NAMES")
    names = _names(stated)
    start, leading = _begin_of_rows(lines, start, 3 * len(names))

    def column_name(column: int) -> str:
        if column < leading:
            return _LEADING[column]
        marker, axis = divmod(column - leading, 3)
        return f"{names[marker]} {'XYZ'[axis]}"

    table = parse_table(
        lines,
        start=start,
        ended=ended,
        num_columns=leading + 3 * len(names),
        column_name=column_name,
    )
    positions = table[:, leading:].reshape(len(table), len(names), 3) * meters_per(_UNIT)
    times = StatedTimes(
        _first(stated, "FREQUENCY"),
        "FREQUENCY",
        numbers=table[:, 0] if leading > 0 else None,
        times=table[:, 1] if leading > 1 else None,
        count=_first(stated, "NO_OF_FRAMES"),
        count_name="NO_OF_FRAMES",
    )
    return Capture(names, *timed_positions(positions, times, tell))


def _first(stated: dict[str, list[str]], key: str) -> str:
    """The first value of a key, blank if there is none."""
    return next(iter(stated.get(key, ())), "")


def _names(stated: dict[str, list[str]]) -> tuple[str, ...]:
    """One name per marker; one without a name becomes '*n'."""
    names = stated["MARKER_NAMES"]
    while names and not names[-1]:
        names = names[:-1]
    text = _first(stated, "NO_OF_MARKERS")
    count = int(text[:_MOST_DIGITS]) if text.isdecimal() else len(names)
    if count < len(names) or count > MOST_CELLS // 3:
        raise CaptureError(f"MARKER_NAMES holds {len(names)} names, and NO_OF_MARKERS states {count}")
    if not count:
        raise CaptureError("no markers: MARKER_NAMES holds no name")
    names = names + [""] * (count - len(names))
    return tuple(name or f"*{number}" for number, name in enumerate(names, 1))


def _begin_of_rows(lines: list[bytes], start: int, width: int) -> tuple[int, int]:
    """Index of the first row of numbers, and how many of its cells precede the positions (`width` cells)."""
    while start < len(lines) and not lines[start].strip():
        start += 1
    if start == len(lines):
        raise CaptureError("no frames: nothing follows the header")
    cells = header_cells(lines[start], start + 1)
    if cells[0].lower() == _LEADING[0]:
        return start + 1, 2 if cells[1:2] and cells[1].lower() == _LEADING[1] else 1
    try:
        cell_number(cells[0])
    except ValueError:  # names of columns, without frame and time
        return start + 1, 0
    while cells and not cells[-1]:
        cells.pop()
    leading = {width: 0, width + 2: 2}.get(len(cells))
    if leading is None:
        raise CaptureError(
            f"line {start + 1} has {len(cells)} cells, expected {width}, or {width + 2} with frame and time"
        )
    return start, leading
