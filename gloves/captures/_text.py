"""Parsing shared by the formats: lines, units of length, and a table of numbers with holes."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Float

from handsim.errors import CaptureError, HandSimWarning

METERS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_WORDS: Final = {
    "millimeters": 1e-3,
    "millimetres": 1e-3,
    "centimeters": 1e-2,
    "centimetres": 1e-2,
    "meters": 1.0,
    "metres": 1.0,
}
_SHORTEST: Final = 4  # letters that a cut word needs; 'mil' is a thousandth of an inch, too
MOST_CELLS: Final = 400_000
"""Of a row: twice what the largest number of trajectories of a C3D would take."""
_BLANK: Final = math.nan
_LOOKED_AT: Final = 50  # rows that show how a writer formats numbers
_MANY_NUMBERS: Final = 60
_LEADING: Final = 2  # cells of a row before its positions: frame and time, or frame and sub-frame
_MOST_BLANKS: Final = 4_000_000  # cells of a table that may be absent from its rows

Tell = Callable[[str], None]
"""What a reader calls with a sentence about something suspicious in a file that it reads nevertheless."""


def warn(text: str) -> None:
    """Warn of something suspicious in a file whose name is not known here."""
    warnings.warn(text, HandSimWarning, stacklevel=3)


def meters_per(unit: str) -> float:
    """Meters per unit of length of a file, in any case; a word may be cut ("Mete") or in the singular.

    Raises:
        CaptureError: It is not millimeters, centimeters or meters.
    """
    word = unit.strip(" .\t\0").lower()
    scale = METERS.get(word)
    if scale is None and len(word) >= _SHORTEST:
        scale = next((scale for name, scale in _WORDS.items() if name.startswith(word)), None)
    if scale is None:
        raise CaptureError(f"unknown unit of length {unit.strip()[:20]!r}; valid units: mm, cm, m")
    return scale


def header_cells(line: bytes, delimiter: bytes, number: int) -> list[str]:
    """Cells of a header line without outer blanks.

    Raises:
        CaptureError: There are more than a marker file has.
    """
    check_width(line.count(delimiter) + 1, number)
    return [cell.strip() for cell in line.decode("utf-8", "replace").split(delimiter.decode())]


def csv_cells(line: bytes, number: int, delimiter: str = ",") -> list[str]:
    """Cells of a header line without outer blanks, where names may be quoted.

    Raises:
        CaptureError: There are more than a marker file has, or they cannot be told apart.
    """
    check_width(line.count(delimiter.encode()) + 1, number)
    try:
        row = next(csv.reader([line.decode("utf-8", "replace")], delimiter=delimiter), [])
    except csv.Error as error:
        raise CaptureError(f"line {number}, of the header, cannot be read: {error}") from error
    return [cell.strip() for cell in row]


def check_width(num_cells: int, number: int) -> None:
    """Refuse a line with more cells than a marker file has, before they are made."""
    if num_cells > MOST_CELLS:
        raise CaptureError(f"damaged: line {number} has {num_cells} cells, expected at most {MOST_CELLS}")


def split_lines(data: bytes) -> tuple[list[bytes], bool]:
    """Lines of a file with any kind of line ends, and whether the last one has its line end."""
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    lines = data.split(b"\n")
    ended = not lines[-1].strip(b" ")
    return (lines[:-1] if ended and len(lines) > 1 else lines), ended


def parse_table(
    lines: list[bytes],
    *,
    start: int,
    ended: bool,
    delimiter: bytes,
    num_columns: int,
    column_name: Callable[[int], str],
    text_columns: frozenset[int] = frozenset(),
) -> Float[np.ndarray, "T columns"]:
    """Numbers of a table, row by row; a blank or absent cell is NaN, a blank line is not a row.

    A row may lack cells at its end, because some writers leave out what was not seen, and may have blank
    cells too many. Only the last line of a file can have been cut: it counts as cut if it has no line end and
    fewer cells than `num_columns` or than the first row, which tells whether rows end in a delimiter, or if
    its last number alone has fewer decimals. (A cut inside the last cell of a row whose numbers have as many
    decimals as it happens leaves no trace and is not noticed.)

    Args:
        lines: All lines of the file.
        start: Index of the first line of the table.
        ended: Whether the last line has its line end.
        delimiter: The separator of cells.
        num_columns: Number of cells of a whole row.
        column_name: Name of a column in messages.
        text_columns: Columns that hold no numbers; they are returned as NaN.

    Raises:
        CaptureError: No rows, a cut last row, a cell that is not a number, or a row that is too long.
    """
    blanks = b" \t\f\v" + delimiter
    rows = [index for index in range(start, len(lines)) if lines[index].strip(blanks)]
    if not rows:
        raise CaptureError("no frames: nothing follows the header")
    if not ended and rows[-1] == len(lines) - 1:
        _check_whole(lines[rows[0]], lines[-1], len(lines), delimiter, num_columns)
        _check_last_number([lines[index] for index in rows], len(lines), delimiter)
    _check_size(lines, len(rows), num_columns)
    table = np.full((len(rows), num_columns), np.nan)
    for row, index in enumerate(rows):
        number, line = index + 1, lines[index]
        cells = line.split(delimiter)
        if len(cells) > num_columns:
            if any(cell.strip() for cell in cells[num_columns:]):
                raise CaptureError(f"line {number} has {len(cells)} cells, expected {num_columns}")
            del cells[num_columns:]
        for column in text_columns:
            if column < len(cells):
                cells[column] = b""
        try:
            table[row, : len(cells)] = [float(cell) if cell else _BLANK for cell in cells]
        except ValueError:
            table[row, : len(cells)] = _parse_cells(cells, number, column_name)
    _check_finite(table, rows, column_name)
    return table


def _check_size(lines: list[bytes], num_rows: int, num_columns: int) -> None:
    """Refuse a table whose cells are mostly absent before it is allocated."""
    written = sum(map(len, lines))  # a cell takes one byte at least, its delimiter
    if num_rows * num_columns > written + _MOST_BLANKS:
        raise CaptureError(
            f"damaged: {num_rows} rows of {num_columns} columns are more than {written} bytes can hold"
        )


def _check_whole(first: bytes, line: bytes, number: int, delimiter: bytes, num_columns: int) -> None:
    """Whether the last line, which has no line end, is as long as the first row of the table."""
    # At most one blank cell beyond the table counts: the delimiter that may end a row.
    usual = min(first.count(delimiter) + 1, num_columns + 1)
    expected, got = max(usual, num_columns), line.count(delimiter) + 1
    if got < expected:
        raise CaptureError(
            f"truncated: line {number}, the last, has {got} of {expected} cells and no line end"
        )


def _check_last_number(lines: list[bytes], number: int, delimiter: bytes) -> None:
    """Whether the last number of a file without a line end has as many decimals as all others."""
    *others, last = lines[-1].split(delimiter)
    cells = [cell for line in lines[:-1][:_LOOKED_AT] for cell in line.split(delimiter)[_LEADING:]]
    cells += others[_LEADING:]
    numbers = [cell.strip() for cell in cells if cell.strip()]
    decimals = {len(cell.partition(b".")[2]) for cell in numbers}
    # A writer that drops zeros at the end has numbers of all lengths, even if the first few have the same.
    fixed = any(cell.endswith(b"0") for cell in numbers) or len(numbers) >= _MANY_NUMBERS
    if (
        len(decimals) == 1
        and fixed
        and last.strip()
        and len(last.strip().partition(b".")[2]) < decimals.pop()
    ):
        raise CaptureError(
            f"truncated: line {number}, the last, ends inside its last number and has no line end"
        )


def _parse_cells(cells: list[bytes], number: int, column_name: Callable[[int], str]) -> list[float]:
    """The slow parser for one row: cells may hold blanks, and a cell that is not a number is named."""
    values = []
    for column, cell in enumerate(cells):
        text = cell.decode("utf-8", "replace").strip()
        try:
            values.append(float(text) if text else _BLANK)
        except ValueError:
            raise CaptureError(
                f"line {number}, column {column + 1} ({column_name(column)}): '{text[:40]}' is not a number"
            ) from None
    return values


def _check_finite(
    table: Float[np.ndarray, "T columns"],
    rows: list[int],
    column_name: Callable[[int], str],
) -> None:
    infinite = np.argwhere(np.isinf(table))
    if len(infinite):
        row, column = (int(index) for index in infinite[0])
        raise CaptureError(
            f"line {rows[row] + 1}, column {column + 1} ({column_name(column)}): infinite, expected a "
            "finite number or a blank cell"
        )
