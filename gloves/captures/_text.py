"""Parsing shared by the formats: lines, cells, units of length, and a table of numbers with holes.

Every text is read as lines of UTF-8 whose cells are separated by tabs, whatever it was written as:
`split_lines` reads UTF-16, `plain_lines` other separators and quotes, and `parse_table` decimal commas.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from handsim.errors import CaptureError, HandSimWarning, shortened

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
TAB: Final = b"\t"
_BLANK: Final = math.nan
_BLANKS: Final = ("", "NULL")  # Qualisys writes this word for what was not seen
_TIME_CODE: Final = re.compile(rb"\d+:[\d:.;]+")
_DECIMALS: Final = re.compile(rb",0\d")  # no whole number begins with a zero
_NUMBERS: Final = re.compile(rb"\d[-+\d.,eE \t]*")
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
    """Meters per unit of length of a file, in any case; a word may be cut ("Mete") or in the singular."""
    word = unit.strip(" .\t\0").lower()
    scale = METERS.get(word)
    if scale is None and len(word) >= _SHORTEST:
        scale = next((scale for name, scale in _WORDS.items() if name.startswith(word)), None)
    if scale is None:
        raise CaptureError(f"unknown unit of length {shortened(unit.strip())!r}; valid units: mm, cm, m")
    return scale


def header_cells(line: bytes, number: int) -> list[str]:
    """Cells of a plain header line without outer blanks; what is not UTF-8 is taken as Windows-1252.

    Raises:
        CaptureError: There are more than a marker file has.
    """
    check_width(line.count(TAB) + 1, number)
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        text = line.decode("cp1252", "replace")
    return [cell.strip() for cell in text.split(TAB.decode())]


def check_width(num_cells: int, number: int) -> None:
    """Refuse a line with more cells than a marker file has, before they are made."""
    if num_cells > MOST_CELLS:
        raise CaptureError(f"damaged: line {number} has {num_cells} cells, expected at most {MOST_CELLS}")


def cell_number(text: str) -> float:
    """The number in a cell, which may have a decimal comma; NaN for a blank cell.

    Raises:
        ValueError: It is not a number.
    """
    text = text.strip()
    return _BLANK if text in _BLANKS else float(text.replace(",", "."))


def split_lines(data: bytes) -> tuple[list[bytes], bool]:
    """Lines of a file with any kind of line ends, in UTF-8, and whether the last one has its line end."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16", "replace").encode()
    data = data.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    lines = data.split(b"\n")
    ended = not lines[-1].strip(b" ")
    return (lines[:-1] if ended and len(lines) > 1 else lines), ended


def separator_behind(words: Sequence[bytes], line: bytes) -> bytes | None:
    """The tab, comma or semicolon behind the word, in quotes or not, that a line begins with."""
    begin = re.match(rb'\s*("?)(?:' + b"|".join(words) + rb")\1 *([\t,;])", line)
    return None if begin is None else begin[2]


def plain_lines(lines: list[bytes], separator: bytes, *, first: int = 1, wider: bool = False) -> list[bytes]:
    """The same lines with tabs between their cells, and without quotes around them.

    Quotes in a file with tabs count only where the first cell of the file is quoted. `first` is the number of
    the first line in the file; where `wider`, rows may have more cells than the line above them.

    Raises:
        CaptureError: A line has more cells than a marker file has, its quotes are damaged, or commas are both
            between cells and in numbers.
    """
    if separator == TAB and not lines[0].startswith(b'"'):
        return lines
    if separator == b",":
        _check_decimals(lines, first, wider)
    return [
        _unquoted(line, separator, number)
        if b'"' in line
        else line.replace(TAB, b" ").replace(separator, TAB)
        for number, line in enumerate(lines, first)
    ]


def _unquoted(line: bytes, separator: bytes, number: int) -> bytes:
    """A line with tabs between its cells, some of which are quoted."""
    check_width(line.count(separator) + 1, number)
    try:
        row = next(csv.reader([line.decode("latin-1")], delimiter=separator.decode()), [])
    except csv.Error as error:
        raise CaptureError(f"line {number} cannot be read: {error}") from error
    return TAB.join(" ".join(cell.split("\t")).encode("latin-1") for cell in row)


def _check_decimals(lines: list[bytes], first: int, wider: bool) -> None:
    """Refuse rows of numbers without decimal points that have more cells than the line above them."""
    rows: list[int] = []
    decimals = False
    for index, line in enumerate(lines):
        numbers = _TIME_CODE.sub(b"", line)
        # A row of a frame and a position, with decimal points or commas and without quotes.
        if numbers.count(b",") > _LEADING and _NUMBERS.fullmatch(numbers) is not None:
            if b"." in numbers:
                return
            rows.append(index)
            decimals = decimals or _DECIMALS.search(numbers) is not None
        if len(rows) == _LOOKED_AT:
            break
    if not rows or (wider and not decimals):
        return
    above = next((line for line in reversed(lines[: rows[0]]) if line.strip(b" \t,")), b"")
    expected = above.rstrip(b" \t,").count(b",") + 1
    for index in rows:
        width = lines[index].rstrip(b" \t,").count(b",") + 1
        if width > expected:
            raise CaptureError(
                f"line {first + index} has {width} cells where {expected} are expected: commas are both "
                "between cells and in numbers; export it with decimal points, or with semicolons or tabs"
            )


def parse_table(
    lines: list[bytes],
    *,
    start: int,
    ended: bool,
    num_columns: int,
    column_name: Callable[[int], str],
    text_columns: frozenset[int] = frozenset(),
) -> Float[np.ndarray, "T columns"]:
    """Numbers of a table, row by row; a blank or absent cell is NaN, a blank line is not a row.

    Numbers have decimal points, or commas if no number of the table has a point. A row may lack cells at its
    end, because some writers leave out what was not seen, and may have blank cells too many. Only the last
    line of a file can have been cut: it counts as cut if it has no line end and fewer cells than
    `num_columns` or than the first row, which tells whether rows end in a separator, or if its last number
    alone has fewer decimals. (A cut inside the last cell of a row whose numbers have as many decimals as it
    happens leaves no trace and is not noticed.)

    Args:
        lines: All lines of the file, plain.
        start: Index of the first line of the table.
        ended: Whether the last line has its line end.
        num_columns: Number of cells of a whole row.
        column_name: Name of a column in messages.
        text_columns: Columns that hold no numbers; they are returned as NaN.
    """
    rows = [index for index in range(start, len(lines)) if lines[index].strip()]
    if not rows:
        raise CaptureError("no frames: nothing follows the header")
    if _decimal_commas((lines[index] for index in rows), text_columns):
        lines = [line.replace(b",", b".") for line in lines]
    if not ended and rows[-1] == len(lines) - 1:
        _check_whole(lines[rows[0]], lines[-1], len(lines), num_columns)
        _check_last_number([lines[index] for index in rows], len(lines))
    _check_size(lines, len(rows), num_columns)
    table = np.full((len(rows), num_columns), np.nan)
    for row, index in enumerate(rows):
        number, line = index + 1, lines[index]
        cells = line.split(TAB)
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


def _decimal_commas(rows: Iterable[bytes], text_columns: frozenset[int]) -> bool:
    """Whether the numbers of a table have decimal commas: some have one, and none has a point."""
    found = False
    for row in rows:
        cells = [row]
        if text_columns:
            cells = [cell for column, cell in enumerate(row.split(TAB)) if column not in text_columns]
        if any(b"." in cell for cell in cells):
            return False
        found = found or any(b"," in cell for cell in cells)
    return found


def _check_size(lines: list[bytes], num_rows: int, num_columns: int) -> None:
    """Refuse a table whose cells are mostly absent before it is allocated."""
    written = sum(map(len, lines))  # a cell takes one byte at least, its separator
    if num_rows * num_columns > written + _MOST_BLANKS:
        raise CaptureError(
            f"damaged: {num_rows} rows of {num_columns} columns are more than {written} bytes can hold"
        )


def _check_whole(first: bytes, line: bytes, number: int, num_columns: int) -> None:
    """Whether the last line, which has no line end, is as long as the first row of the table."""
    # At most one blank cell beyond the table counts: the separator that may end a row.
    usual = min(first.count(TAB) + 1, num_columns + 1)
    expected, got = max(usual, num_columns), line.count(TAB) + 1
    if got < expected:
        raise CaptureError(
            f"truncated: line {number}, the last, has {got} of {expected} cells and no line end"
        )


def _check_last_number(lines: list[bytes], number: int) -> None:
    """Whether the last number of a file without a line end has as many decimals as all others."""
    *others, last = lines[-1].split(TAB)
    cells = [cell for line in lines[:-1][:_LOOKED_AT] for cell in line.split(TAB)[_LEADING:]]
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
            values.append(_BLANK if text in _BLANKS else float(text))
        except ValueError:
            mixed = "," in text and "." not in text and text.count(",") == 1
            raise CaptureError(
                f"line {number}, column {column + 1} ({column_name(column)}): '{shortened(text)}' is not a "
                f"number{', since others have decimal points' if mixed else ''}"
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
