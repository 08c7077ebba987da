"""The CSV that OptiTrack Motive exports: format versions 1.2x and 1.3x are read, 1.23 is written.

Line 1 is a list of keys and values; then rows led by a label (Type, Name, ID, in newer files Parent), a row
of quantities, a row of axes that begins with 'Frame', and one row per frame. Labels and types decide,
not positions: newer exports add rows and a TimeCode column. Exports of Motive 1.9 and before (1.20, 1.21)
have the same rows without labels: types first, then names.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Final

import numpy as np

from gloves.captures._text import (
    Tell,
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
from handsim.errors import CaptureError

_MOST_HEADER_LINES: Final = 20
MOTIVE_BEGIN: Final = b"Format Version"
_COUNT: Final = "Total Exported Frames"
_AXES: Final = ["X", "Y", "Z"]
_TYPES: Final = {"Marker", "Rigid Body", "Rigid Body Marker", "Bone", "Bone Marker"}


def read_motive_csv(data: bytes, tell: Tell = warn) -> Capture:
    """The markers, labeled or not, in the bytes of a Motive CSV; rigid bodies and bones are left out.

    Cells are separated by commas, semicolons or tabs. A missing unit of length, or missing frames, are told.
    """
    lines, ended = split_lines(data)
    separator = separator_behind([MOTIVE_BEGIN], lines[0])
    if separator is None:
        raise CaptureError("not a Motive CSV export: line 1 does not begin with 'Format Version'")
    lines = plain_lines(lines, separator)
    rows = [header_cells(line, number) for number, line in enumerate(lines[:_MOST_HEADER_LINES], 1)]
    stated = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    rate_key = "Export Frame Rate" if stated.get("Export Frame Rate") else "Capture Frame Rate"
    if not stated.get("Length Units"):
        tell("line 1 states no Length Units, read as meters, which Motive writes unless told otherwise")
    scale = meters_per(stated.get("Length Units") or "Meters")
    end = next((index for index, row in enumerate(rows) if row and row[0] == "Frame"), None)
    if end is None or (end == len(lines) - 1 and not ended):
        raise CaptureError("the header is cut: no whole row begins with 'Frame'")
    axes = rows[end]
    types, names = _types_and_names(rows[1:end], len(axes))
    header = rows[1:end]
    row = next((row for row in reversed(header) if any(row)), [])
    quantities = row + [""] * (len(axes) - len(row))
    columns = _marker_columns(types, quantities, axes)

    table = parse_table(
        lines,
        start=end + 1,
        ended=ended,
        num_columns=len(axes),
        column_name=lambda column: f"{names[column]} {axes[column]}".strip(),
        text_columns=frozenset(index for index, axis in enumerate(axes) if axis.lower() == "timecode"),
    )
    positions = table[:, np.array(columns)[:, None] + np.arange(3)]
    labels = tuple(names[column] or f"*{number}" for number, column in enumerate(columns, 1))
    times = StatedTimes(
        stated.get(rate_key, ""),
        rate_key,
        numbers=table[:, 0],
        times=table[:, 1] if axes[1].lower().startswith("time (") or axes[1].lower() == "time" else None,
        count=stated.get(_COUNT, ""),
        count_name=_COUNT,
    )
    return Capture(labels, *timed_positions(positions * scale, times, tell))


def write_motive_csv(path: Path, capture: Capture, *, title: str) -> None:
    """Write format version 1.23 in millimeters with six decimals; a missing marker gets three blank cells.

    The take is named after the stem of `title`, since `path` may be a temporary one; an `OSError` if it
    cannot be written.
    """
    num_frames, num_markers = capture.positions.shape[:2]
    rate = f"{capture.rate:.6f}"
    stated = {
        "Format Version": "1.23",
        "Take Name": Path(title).stem,
        "Take Notes": "",
        "Capture Frame Rate": rate,
        "Export Frame Rate": rate,
        "Capture Start Time": "",
        "Total Frames in Take": str(num_frames),
        "Total Exported Frames": str(num_frames),
        "Rotation Type": "Quaternion",
        "Length Units": "Millimeters",
        "Coordinate Space": "Global",
    }
    ids = [f"{number:032X}" for number in range(1, num_markers + 1)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([cell for pair in stated.items() for cell in pair])
        writer.writerow([])
        writer.writerow(["", "Type", *["Marker"] * (3 * num_markers)])
        for label, values in (("Name", capture.names), ("ID", ids)):
            writer.writerow(["", label, *(value for value in values for _ in _AXES)])
        writer.writerow(["", "", *["Position"] * (3 * num_markers)])
        writer.writerow(["Frame", "Time (Seconds)", *_AXES * num_markers])
        row_format = "%d,%.6f" + ",%.6f" * (3 * num_markers)
        for frame, row in enumerate(capture.positions.reshape(num_frames, -1) * 1e3):
            text = row_format % (frame, frame / capture.rate, *row.tolist())
            file.write((text.replace("nan", "") if np.isnan(row).any() else text) + "\n")


def _types_and_names(rows: list[list[str]], width: int) -> tuple[list[str], list[str]]:
    """Type and name of each column, from the header rows between line 1 and the axes."""
    filled = [row for row in rows if any(row)]
    # Without labels the first row says 'Marker' itself, behind two blank cells.
    if len(filled) > 2 and not any(filled[0][:2]) and set(filled[0]) & _TYPES:
        types, names = filled[:2]
    else:
        types, names = (_labeled_row(filled, label) for label in ("Type", "Name"))
    return types + [""] * (width - len(types)), names + [""] * (width - len(names))


def _labeled_row(rows: list[list[str]], label: str) -> list[str]:
    """The header row whose first cell with text is `label`."""
    for row in rows:
        if next(cell for cell in row if cell) == label:
            return row
    raise CaptureError(f"not a Motive CSV export: no header row is labeled '{label}'")


def _marker_columns(types: list[str], quantities: list[str], axes: list[str]) -> list[int]:
    """Where the position of each marker begins."""
    columns = [
        index
        for index, (kind, quantity, axis) in enumerate(zip(types, quantities, axes, strict=False))
        if kind == "Marker" and quantity == "Position" and axis == "X"
    ]
    if not columns:
        kinds = sorted({kind for kind in types if kind not in {"", "Type"}})
        raise CaptureError(
            "no markers: no column has type 'Marker' and quantity 'Position'; types in the file: "
            f"{', '.join(kinds) or 'none'} (export it with markers and unlabeled markers)"
        )
    for index in columns:
        if axes[index : index + 3] != _AXES:
            raise CaptureError(
                f"column {index + 1}: expected the axes X, Y, Z, got {', '.join(axes[index : index + 3])}"
            )
    return columns
