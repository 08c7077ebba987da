"""The CSV that OptiTrack Motive exports (format versions 1.2x and 1.3x).

Line 1 is a list of keys and values; then rows led by a label (Type, Name, ID, in newer files Parent), a row
of quantities, a row of axes that begins with 'Frame', and one row per frame. Labels and types decide,
not positions: newer exports add rows and a TimeCode column.
"""

from __future__ import annotations

import csv
from typing import Final

import numpy as np

from gloves.captures._text import meters_per, parse_table, positive_rate, split_lines
from gloves.captures.capture import Capture
from handsim.errors import CaptureError

_MOST_HEADER_LINES: Final = 20
_AXES: Final = ["X", "Y", "Z"]


def read_motive_csv(data: bytes) -> Capture:
    """The markers, labeled or not, in the bytes of a Motive CSV; rigid bodies and bones are left out.

    Raises:
        CaptureError: Not a Motive export, without marker columns, cut, or with a cell that is not a number.
    """
    lines, ended = split_lines(data)
    if not lines[0].startswith(b"Format Version,"):
        raise CaptureError("not a Motive CSV export: line 1 does not begin with 'Format Version'")
    rows = [_cells(line) for line in lines[:_MOST_HEADER_LINES]]
    stated = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    rate_key = "Export Frame Rate" if stated.get("Export Frame Rate") else "Capture Frame Rate"
    rate = positive_rate(stated.get(rate_key, ""), name=rate_key)
    scale = meters_per(stated.get("Length Units") or "Meters")
    end = next((index for index, row in enumerate(rows) if row and row[0] == "Frame"), None)
    if end is None or (end == len(lines) - 1 and not ended):
        raise CaptureError("the header is cut: no whole row begins with 'Frame'")
    axes = rows[end]
    types, names = (_labeled_row(rows[1:end], label, len(axes)) for label in ("Type", "Name"))
    quantities = _quantities(rows[1:end], len(axes))
    columns = _marker_columns(types, quantities, axes)

    table = parse_table(
        lines,
        start=end + 1,
        ended=ended,
        delimiter=b",",
        num_columns=len(axes),
        column_name=lambda column: f"{names[column]} {axes[column]}".strip(),
        text_columns=frozenset(index for index, axis in enumerate(axes) if axis.lower() == "timecode"),
    )
    positions = table[:, np.array(columns)[:, None] + np.arange(3)]
    labels = tuple(names[column] or f"*{number}" for number, column in enumerate(columns, 1))
    return Capture(labels, positions * scale, rate)


def _cells(line: bytes) -> list[str]:
    """Cells of a header line, where names may be quoted."""
    try:
        return [cell.strip() for cell in next(csv.reader([line.decode("utf-8", "replace")]), [])]
    except csv.Error as error:
        raise CaptureError(f"a header line cannot be read: {error}") from error


def _labeled_row(rows: list[list[str]], label: str, width: int) -> list[str]:
    """The header row whose first cell with text is `label`, filled up to `width` cells."""
    for row in rows:
        if next((cell for cell in row if cell), "") == label:
            return row + [""] * (width - len(row))
    raise CaptureError(f"not a Motive CSV export: no header row is labeled '{label}'")


def _quantities(rows: list[list[str]], width: int) -> list[str]:
    """The row above the axes; it has no label, its first text is a quantity itself."""
    row = next((row for row in reversed(rows) if any(row)), [])
    return row + [""] * (width - len(row))


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
