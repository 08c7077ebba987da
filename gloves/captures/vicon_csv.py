"""The CSV that Vicon Nexus exports, and Vicon Workstation before it: its section of trajectories.

A section is a line with its title, a line with its rate, a row of names (one in three cells), a row that
begins with 'Frame' (in Workstation 'Field #') and holds the axes, in Nexus a row of units, one row per frame,
and a blank line. Sections of other data (Devices, Model Outputs, ...) may precede and follow it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from gloves.captures._text import (
    Tell,
    header_cells,
    meters_per,
    parse_table,
    plain_lines,
    split_lines,
    warn,
)
from gloves.captures.capture import Capture
from gloves.captures.frame_times import StatedTimes, timed_positions
from handsim.errors import CaptureError, shortened

_TITLE: Final = "Trajectories"
_SECTIONS: Final = (_TITLE, "Devices", "Model Outputs", "Joints", "Segments")
_FIRST_CELLS: Final = ("frame", "field #")
_BLANKS: Final = b' \t",;'
_AXES: Final = ["X", "Y", "Z"]


def vicon_sections(lines: list[bytes]) -> dict[str, int]:
    """Where the sections of a Vicon export begin: index of the title's line by title."""
    titles = {name.lower().encode(): name for name in _SECTIONS}
    found: dict[str, int] = {}
    for index, line in enumerate(lines):
        if line[:1].isalpha() or line[:1] == b'"':
            title = titles.get(line.strip(_BLANKS).lower())
            # Such a word may stand anywhere: the next line has to be the section's rate.
            if title and index + 1 < len(lines) and lines[index + 1].lstrip(_BLANKS)[:1].isdigit():
                found.setdefault(title, index)
    return found


def read_vicon_csv(data: bytes, tell: Tell = warn) -> Capture:
    """The trajectories in the bytes of a Vicon CSV, labeled or not.

    Cells are separated by commas, semicolons or tabs. A missing unit of length, or missing frames, are told.
    """
    lines, ended = split_lines(data)
    sections = vicon_sections(lines)
    if _TITLE not in sections:
        raise CaptureError(
            "not a Vicon CSV export with trajectories: no line reads 'Trajectories'; sections in the file: "
            f"{', '.join(sections) or 'none'}"
        )
    at = sections[_TITLE]
    end = next((row for row in range(at, len(lines)) if not lines[row].strip(_BLANKS)), len(lines))
    if end < at + 4 or (end == at + 4 == len(lines) and not ended):
        raise CaptureError("the header is cut: expected rate, names and axes behind the line 'Trajectories'")
    separator = max(b",", b";", b"\t", key=lines[at + 3].count)
    lines = [*lines[:at], *plain_lines(lines[at:end], separator, first=at + 1), *lines[end:]]
    rates, names, axes = (header_cells(lines[row], row + 1) for row in range(at + 1, at + 4))
    columns = _marker_columns(axes, at + 4)
    start, scales = _scales(lines[:end], at + 4, columns, tell)
    names += [""] * (len(axes) - len(names))
    table = parse_table(
        lines[:end],
        start=start,
        ended=ended or end < len(lines),
        num_columns=len(axes),
        column_name=lambda column: f"{_name_of(names, column)} {axes[column]}".strip(),
    )
    positions = table[:, columns[:, None] + np.arange(3)] * scales[:, None]
    labels = tuple(names[column] or f"*{number}" for number, column in enumerate(columns.tolist(), 1))
    times = StatedTimes(rates[0], "the rate of the trajectories", numbers=table[:, 0])
    return Capture(labels, *timed_positions(positions, times, tell))


def _marker_columns(axes: list[str], number: int) -> Int[np.ndarray, "N"]:
    """Where the position of each trajectory begins, by the row of axes."""
    if axes[0].lower() not in _FIRST_CELLS:
        raise CaptureError(f"line {number} begins with '{shortened(axes[0])}', expected 'Frame'")
    columns = [index for index in range(len(axes) - 2) if axes[index : index + 3] == _AXES]
    if not columns:
        raise CaptureError(f"no markers: line {number} has no axes X, Y, Z")
    return np.array(columns)


def _scales(
    lines: list[bytes], row: int, columns: Int[np.ndarray, "N"], tell: Tell
) -> tuple[int, Float[np.ndarray, "N"]]:
    """Index of the first row of numbers, and meters per unit of each trajectory."""
    cells = header_cells(lines[row], row + 1) if row < len(lines) else []
    if cells and cells[0]:  # a frame's number
        tell("the file states no unit of length, read as millimeters, which Vicon's programs write")
        return row, np.full(len(columns), meters_per("mm"))
    units = [cells[column] if column < len(cells) else "" for column in columns]
    scales = {unit: meters_per(unit) for unit in set(units)}
    return row + 1, np.array([scales[unit] for unit in units])


def _name_of(names: list[str], column: int) -> str:
    """The name over a column, or over one of the two columns before it."""
    return next((name for name in reversed(names[max(0, column - 2) : column + 1]) if name), "")
