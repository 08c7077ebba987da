"""Parsing of text formats: lines, cells, units of length, tables of numbers, times of frames.

Every text is converted to lines of UTF-8 with tabs between cells: `split_lines` decodes UTF-16, `plain_lines`
replaces other separators and quotes, and `parse_table` reads decimal commas.

Rate, times and numbers of the frames must agree. A gap in the numbers or the times is filled with frames
without points, with a warning. If two values contradict each other, the file is refused, and the error names
both.
"""

from __future__ import annotations

import bisect
import codecs
import contextlib
import csv
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.captures.pieces import Trajectories, packed_trajectories
from handsim._checks import shown_value
from handsim.errors import CaptureError, HandSimWarning, shortened
from handsim.files.inputs import text_encoding

METERS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_UNIT_WORDS: Final = {
    f"{prefix}{word}": METERS[unit]
    for prefix, unit in (("milli", "mm"), ("centi", "cm"), ("", "m"))
    for word in ("meters", "metres")
}
_MIN_UNIT_LETTERS: Final = 4  # least length of a truncated unit; 'mil' may also be a thousandth of an inch
MAX_CELLS: Final = 400_000
"""Largest number of cells in a row: twice as many as the largest C3D would need."""
TAB: Final = b"\t"
_BLANK: Final = math.nan
_BLANK_CELL: Final = re.compile(r"(null|none|na|n/a|#n/a|<na>|--?|-?nan\(\w+\)|-?1\.#([qs]nan|ind)0*)?", re.I)
"""What programs write for no number: Qualisys NULL, older programs of Windows -1.#IND00."""
_MISWRITTEN_CELLS: Final = {  # forms of cells that are no numbers, and why
    r"[^.,]*,[^.,]*": ", since others have decimal points",
    r"\d+[-. ]+[A-Z]\w\w\.?|[A-Z]\w\w[- ]\d+": ", but a date that a spreadsheet made of one; export it again",
}
_SEPARATOR_LINE: Final = re.compile(rb'"?sep=.?"?', re.I)  # Excel's first line
_TIME_CODE: Final = re.compile(rb"\d+:[\d:.;]+")
_DECIMAL_COMMA: Final = re.compile(rb",0\d")  # This comma is decimal: no whole number begins with a zero.
_NUMBERS_ONLY: Final = re.compile(rb"\d[-+\d.,eE \t]*")
_SAMPLED_ROWS: Final = 50  # number of rows from which the format of numbers is inferred
_MANY_NUMBERS: Final = 60  # least count of numbers that shows whether a writer drops trailing zeros
LEADING: Final = 2  # number of cells before the positions of a row: frame and time, or frame and sub-frame
_MAX_BLANK_CELLS: Final = 4_000_000  # largest number of cells that may be absent from the rows of a table
_MAX_DENSE_CELLS: Final = 8_000_000  # A larger table is read sparsely.

Warn = Callable[[str], None]
"""Called with a sentence on something suspicious in a file that is read nevertheless."""
MIN_RATE: Final = 1.0
MAX_RATE: Final = 5000.0
"""Highest frame rate of an optical system [Hz]."""
_RATE_TOLERANCE: Final = 0.02  # relative difference of equal rates: 119.88 is called 120, 29.97 is called 30
_MIN_DECIMALS: Final = 1  # least number of decimals of times; no frame is timed in whole seconds
_MAX_DECIMALS: Final = 9  # largest number of decimals of times
_INTERVAL_TOLERANCE: Final = 0.1  # largest relative spread of the intervals when no rate is stated
_JITTER: Final = 0.25  # A frame that is late by a smaller share of the interval shows no gap.
_MAX_MISSING: Final = 10  # largest number of missing frames for each frame that is present
MAX_DIGITS: Final = 12  # number of digits to which counts are cut
_SHOWN_GAPS: Final = 3  # number of gaps that a warning lists


def emit_warning(text: str) -> None:
    """Emit a `HandSimWarning`, without the name of the file."""
    warnings.warn(text, HandSimWarning, stacklevel=3)


def meters_per(unit: str) -> float:
    """Meters per unit of length; the unit may be upper-case, cut off ("Mete") or in the singular."""
    word = unit.strip(" .\t\0()[]").lower()
    scale = METERS.get(word)
    if scale is None and len(word) >= _MIN_UNIT_LETTERS:
        scale = next((scale for name, scale in _UNIT_WORDS.items() if name.startswith(word)), None)
    if scale is None:
        raise CaptureError(f"unknown unit of length {shortened(unit.strip())!r}; valid units: mm, cm, m")
    return scale


def header_cells(line: bytes, number: int) -> list[str]:
    """Stripped cells of a header line, which is read as Windows-1252 if it is not UTF-8."""
    check_width(line.count(TAB) + 1, number)
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        text = line.decode("cp1252", "replace")
    return [cell.strip() for cell in text.split(TAB.decode())]


def check_width(num_cells: int, number: int) -> None:
    """Refuse a line with more cells than a marker file has, before it is split."""
    if num_cells > MAX_CELLS:
        raise CaptureError(f"damaged: line {number} has {num_cells} cells, expected at most {MAX_CELLS}")


def cell_number(text: str) -> float:
    """The number in a cell, which may have a decimal comma; NaN for a blank cell."""
    text = text.strip()
    return _BLANK if _BLANK_CELL.fullmatch(text) else float(text.replace(",", "."))


def split_lines(data: bytes) -> tuple[list[bytes], bool]:
    """Lines of a file in UTF-8, and whether the last one has a line end."""
    if (encoding := text_encoding(data)) != "utf-8-sig":
        data = data.decode(encoding, "replace").encode()
    data = data.removeprefix(codecs.BOM_UTF8)
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    lines = data.split(b"\n")
    if len(lines) > 1 and _SEPARATOR_LINE.fullmatch(lines[0]):
        del lines[0]
    ended = not lines[-1].strip(b" ")
    return (lines[:-1] if ended and len(lines) > 1 else lines), ended


def separator_behind(words: Sequence[bytes], line: bytes) -> bytes | None:
    """The tab, comma or semicolon after one of the words, quoted or not, at the beginning of a line."""
    begin = re.match(rb'\s*("?)(?:' + b"|".join(words) + rb")\1 *([\t,;])", line, re.I)
    return None if begin is None else begin[2]


def plain_lines(lines: list[bytes], separator: bytes, *, first: int = 1, wider: bool = False) -> list[bytes]:
    """Put tabs between the cells of a list of lines, remove quotes, and return the list.

    In a file with tabs, quotes are quotes only if its first cell is quoted. Among an odd number of them, such
    as in a note of inches, they are so only in a line that begins with one. `first` is the number of the
    first line in the file. With `wider`, rows may have more cells than the line above them.
    """
    if separator == TAB and not lines[0].startswith(b'"'):
        return lines
    if separator == b",":
        _check_decimals(lines, first, wider)
    table = bytes.maketrans(TAB + separator, b" " + TAB)
    for index, line in enumerate(lines):  # in place: large files would be held twice
        number = first + index
        if b'"' not in line or (line.count(b'"') % 2 and not line.lstrip().startswith(b'"')):
            lines[index] = line.translate(table)
            continue
        check_width(line.count(separator) + 1, number)
        try:
            row = next(csv.reader([line.decode("latin-1")], delimiter=separator.decode()), [])
        except csv.Error as error:
            raise CaptureError(f"line {number} cannot be read: {error}") from error
        lines[index] = TAB.join(cell.replace("\t", " ").encode("latin-1") for cell in row)
    return lines


def _check_decimals(lines: list[bytes], first: int, wider: bool) -> None:
    """Refuse rows of numbers without decimal points that have more cells than the line above them."""
    rows: list[int] = []
    decimals = False
    for index, line in enumerate(lines):
        numbers = _TIME_CODE.sub(b"", line)
        # a row of numbers without quotes
        if numbers.count(b",") > LEADING and _NUMBERS_ONLY.fullmatch(numbers) is not None:
            if b"." in numbers:
                return
            rows.append(index)
            decimals = decimals or _DECIMAL_COMMA.search(numbers) is not None
        if len(rows) == _SAMPLED_ROWS:
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


class TableColumns(NamedTuple):
    """What the columns of a table are."""

    titles: Sequence[str]
    """Titles of all columns, for messages."""
    names: Sequence[str]
    """Names of the N trajectories."""
    first: Int[np.ndarray, "N"]
    """The first of the three columns of each trajectory."""
    scales: Float[np.ndarray, "N"]
    """Meters per unit of each trajectory."""
    texts: frozenset[int] = frozenset()
    """Columns without numbers."""

    @classmethod
    def of_triples(cls, leading: Sequence[str], names: Sequence[str], scale: float) -> TableColumns:
        """The columns of a table with these leading columns, then three per marker."""
        titles = [*leading, *(f"{name} {axis}" for name in names for axis in "XYZ")]
        first = len(leading) + 3 * np.arange(len(names))
        return cls(titles, names, first, np.full(len(names), scale))


def parse_table(
    lines: list[bytes], columns: TableColumns, *, start: int, ended: bool
) -> tuple[Float[np.ndarray, "T 2"], Trajectories]:
    """The first two numbers of each row, and the trajectories.

    A blank or absent cell is NaN, a blank line is not a row. Numbers have decimal points, or commas if no
    number of the table has a point. A row may lack cells at its end, because some writers omit missing
    markers, or have extra blank cells.
    """
    titles, text_columns = columns.titles, columns.texts
    num_columns = len(titles)
    rows = [index for index in range(start, len(lines)) if lines[index].strip()]
    if not rows:
        raise CaptureError("no frames: nothing follows the header")
    if _decimal_commas((lines[index] for index in rows), text_columns):
        lines = [line.replace(b",", b".") for line in lines]
    if not ended and rows[-1] == len(lines) - 1:
        _check_last_line([lines[index] for index in rows], len(lines), num_columns)
    written = sum(map(len, lines))  # a cell takes at least one byte, its separator
    if len(rows) * num_columns > written + _MAX_BLANK_CELLS:  # before the table is allocated
        raise CaptureError(
            f"damaged: {len(rows)} rows of {num_columns} columns are more than {written} bytes can hold"
        )
    if len(rows) * num_columns > _MAX_DENSE_CELLS:
        return _parse_wide([lines[index] for index in rows], columns, [index + 1 for index in rows])
    table = np.full((len(rows), num_columns), np.nan)
    for row, index in enumerate(rows):
        cells = lines[index].split(TAB)
        if len(cells) > num_columns:
            _check_blank(cells[num_columns:], len(cells), num_columns, index + 1)
            del cells[num_columns:]
        for column in text_columns:
            if column < len(cells):
                cells[column] = b""
        table[row, : len(cells)] = _parse_cells(cells, index + 1, titles, range(len(cells)))
    triples = table[:, columns.first[:, None] + np.arange(3)] * columns.scales[:, None]
    return table[:, :LEADING], Trajectories(tuple(columns.names), triples)


def _parse_wide(
    rows: list[bytes], columns: TableColumns, numbers: Sequence[int]
) -> tuple[Float[np.ndarray, "T 2"], Trajectories]:
    """`parse_table` of a table that is too large for an array, most of whose cells are blank."""
    num_columns, found = len(columns.titles), []
    for row, number in zip(rows, numbers, strict=True):
        blank = np.frombuffer(TAB + row + TAB, dtype=np.uint8) == TAB[0]
        begins, ends = np.flatnonzero(blank[1:] != blank[:-1]).reshape(-1, 2).T
        filled = (ends + np.cumsum(begins - ends)).tolist()  # the number of tabs before each cell
        spans = zip(filled, begins.tolist(), ends.tolist(), strict=True)
        cells = [b"" if column in columns.texts else row[begin:end] for column, begin, end in spans]
        inside = bisect.bisect_left(filled, num_columns)
        if inside < len(filled):
            _check_blank(cells[inside:], row.count(TAB) + 1, num_columns, number)
            del filled[inside:], cells[inside:]
        found.append((filled, _parse_cells(cells, number, columns.titles, filled)))
    frames = np.repeat(np.arange(len(rows)), [len(filled) for filled, _ in found])
    cells_at = np.concatenate([filled for filled, _ in found])
    values = np.concatenate([values for _, values in found])
    leading = np.full((len(rows), LEADING), np.nan)
    leads = cells_at < LEADING
    leading[frames[leads], cells_at[leads]] = values[leads]

    num_names = len(columns.names)
    places = np.full((num_columns, 2), -1)  # trajectory and axis of each column
    for axis in range(3):
        places[columns.first + axis] = np.stack([np.arange(num_names), np.full(num_names, axis)], axis=1)
    there = (places[cells_at, 0] >= 0) & np.isfinite(values)
    frames, values, places = frames[there], values[there], places[cells_at[there]]
    keys, inverse = np.unique(frames * num_names + places[:, 0], return_inverse=True)
    points = np.full((len(keys), 3), np.nan)
    points[inverse, places[:, 1]] = values
    frames, tracks = np.divmod(keys, num_names)
    points *= columns.scales[tracks, None]
    return leading, packed_trajectories(columns.names, len(rows), frames, tracks, points)


def _check_blank(cells: Sequence[bytes], width: int, expected: int, number: int) -> None:
    """Refuse a row with content beyond the last column."""
    if any(cell.strip() for cell in cells):
        raise CaptureError(f"line {number} has {width} cells, expected {expected}")


def _decimal_commas(rows: Iterable[bytes], text_columns: frozenset[int]) -> bool:
    """Whether the numbers of a table have decimal commas: some have a comma, and none has a point."""
    found = False
    for row in rows:
        cells = [row]
        if text_columns:
            cells = [cell for column, cell in enumerate(row.split(TAB)) if column not in text_columns]
        if any(b"." in cell for cell in cells):
            return False
        found = found or any(b"," in cell for cell in cells)
    return found


def _check_last_line(rows: list[bytes], number: int, num_columns: int) -> None:
    """Refuse a last line, which has no line end, if it lacks cells or decimals of its last number."""
    *others, last = rows[-1].split(TAB)
    # A separator may end a row, so one blank cell beyond the table counts.
    usual = min(rows[0].count(TAB) + 1, num_columns + 1)
    expected, got = max(usual, num_columns), len(others) + 1
    if got < expected:
        raise CaptureError(
            f"truncated: line {number}, the last, has {got} of {expected} cells and no line end"
        )
    cells = [cell for row in rows[:-1][:_SAMPLED_ROWS] for cell in row.split(TAB)[LEADING:]]
    numbers = [cell.strip() for cell in (*cells, *others[LEADING:]) if cell.strip()]
    decimals = {len(cell.partition(b".")[2]) for cell in numbers}
    # numbers of a writer that drops zeros at the end may agree in length by chance
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


def _parse_cells(
    cells: list[bytes], number: int, titles: Sequence[str], columns: Sequence[int]
) -> NDArray[np.float64]:
    """The numbers of a row, NaN for a blank; an error names the cell that is not a finite number."""
    with contextlib.suppress(ValueError):
        values = np.array([float(cell) if cell else _BLANK for cell in cells])
        if not np.isinf(values).any() and b"_" not in b"".join(cells):
            return values
    return np.array([_cell_value(cell, number, titles, columns[n]) for n, cell in enumerate(cells)])


def _cell_value(cell: bytes, number: int, titles: Sequence[str], column: int) -> float:
    """The number of a cell that may hold blanks."""
    text = cell.decode("utf-8", "replace").strip().replace("\u2212", "-")  # a typographic minus
    try:
        value = _BLANK if _BLANK_CELL.fullmatch(text) else float(text.replace("_", "x"))  # Python reads 1_000
        fault = "infinite, expected a finite number or a blank cell" if math.isinf(value) else ""
    except ValueError:
        reason = next((why for form, why in _MISWRITTEN_CELLS.items() if re.fullmatch(form, text)), "")
        fault = f"'{shortened(text)}' is not a number{reason}"
    if fault:
        raise CaptureError(f"line {number}, column {column + 1} ({titles[column]}): {fault}")
    return value


@dataclass(frozen=True, slots=True)
class StatedTimes:
    """Rate, times and numbers of the T frames in a file."""

    rate: str
    """Text of the frame rate."""
    rate_name: str
    """Name of the rate in the file."""
    numbers: Float[np.ndarray, "T"] | None = None
    """Frame numbers; ignored if any is NaN."""
    times: Float[np.ndarray, "T"] | None = None
    """Times of the frames [s]; ignored if any is NaN."""
    count: str = ""
    """Text of the number of frames."""
    count_name: str = ""
    """Name of that number in the file."""
    count_is_reliable: bool = True
    """Whether a larger count means that the file is cut; people shorten TRC files without changing it."""


def check_rate(rate: float, name: str = "the rate") -> None:
    """Raise a `CaptureError` unless a frame rate [Hz] is that of an optical system."""
    if not isinstance(rate, Real) or not MIN_RATE <= rate <= MAX_RATE:
        given = f"{rate:g} Hz" if isinstance(rate, Real) else shown_value(rate)
        raise CaptureError(f"{name} is {given}, expected {MIN_RATE:g} to {MAX_RATE:g} frames per second")


def check_same_rate(name: str, rate: float, other_name: str, other: float) -> None:
    """Refuse two different rates [Hz] of the same frames; an `other` that is no rate is ignored."""
    if 0.0 < other < np.inf and abs(rate - other) > _RATE_TOLERANCE * other:
        raise CaptureError(
            f"{name} is {rate:g} Hz and {other_name} {other:g} Hz; correct the one that is wrong"
        )


def timed_positions(
    positions: Float[np.ndarray, "R N 3"], stated: StatedTimes, warn: Warn
) -> tuple[Float[np.ndarray, "T N 3"], float]:
    """Positions of all frames from the first to the last [m], NaN in gaps, and their rate [Hz]."""
    numbers, times = _increasing_numbers(stated.numbers), _increasing_times(stated)
    steps, stride = np.ones(len(positions) - 1, dtype=np.int64), 1
    if numbers is not None and len(numbers) > 1:
        steps = np.diff(numbers)
        stride = int(np.gcd.reduce(steps))  # some programs number every n-th frame of the cameras
        steps //= stride
    try:
        rate = cell_number(stated.rate)
    except ValueError:
        rate = math.nan
    if not 0.0 < rate < np.inf:
        rate = _rate_of_times(stated, steps, times, warn)
    check_rate(rate, stated.rate_name)
    if times is not None and len(times) > 1:
        ticks = _Ticks.of(times, rate)
        if stride > 1 and not ticks.agree(steps):
            steps, stride = steps * stride, 1
        if not ticks.agree(steps):
            raise CaptureError(
                f"{stated.rate_name} is {rate:g} Hz, and by their times the frames are at "
                f"{ticks.rate(steps):.6g} Hz; correct the one that is wrong"
            )
        steps = _with_gaps_in_time(steps, ticks)
    frames = np.concatenate([[0], np.cumsum(steps)])
    num_frames = int(frames[-1]) + 1
    first = 0 if numbers is None else int(numbers[0])
    places, there = first + stride * frames, len(positions)
    if num_frames - there > _MAX_MISSING * there:
        row = int(np.argmax(steps))
        at = "" if times is None else f", from {times[row]:g} s to {times[row + 1]:g} s"
        raise CaptureError(
            f"{steps[row] - 1} frames are missing behind frame {places[row]}{at}, and {there} are there; "
            "correct the numbers or the times, or cut the capture there"
        )
    if stated.count.strip().isdecimal():
        count = int(stated.count.strip()[:MAX_DIGITS])
        if count > num_frames and stated.count_is_reliable:
            raise CaptureError(
                f"truncated: {stated.count_name} is {count}, and {num_frames} frames are there; export the "
                "file again, or correct that number if they are all"
            )
        if count < there or count > num_frames:
            warn(f"{stated.count_name} is {count}, and {there} frames are there; all are read")
    if num_frames == there:
        return positions, rate
    warn(_missing_sentence(steps, places, stride, num_frames))
    filled = np.full((num_frames, *positions.shape[1:]), np.nan)
    filled[frames] = positions
    return filled, rate


@dataclass(frozen=True, slots=True)
class _Ticks:
    """Times of frames [s], and the stated rate [Hz]."""

    times: Float[np.ndarray, "T"]
    stated: float
    rounding: float
    """Rounding step of the times [s]."""
    window: int
    """Number of frames between two times that the rate is measured on."""

    @staticmethod
    def of(times: Float[np.ndarray, "T"], rate: float) -> _Ticks:
        rounding = 10.0**-_MAX_DECIMALS
        for decimals in range(_MIN_DECIMALS, _MAX_DECIMALS):
            scaled = times * 10.0**decimals
            if np.abs(scaled - np.round(scaled)).max() < 1e-3:
                rounding = 10.0**-decimals
                break
        window = min(len(times) - 1, math.ceil(max(1.0, rounding * rate / _RATE_TOLERANCE)))
        return _Ticks(times, rate, rounding, window)

    def rate(self, steps: Int[np.ndarray, "T-1"]) -> float:
        """Median rate of the times [Hz]."""
        frames = np.concatenate([[0], np.cumsum(steps)])
        spans = self.times[self.window :] - self.times[: -self.window]
        interval = float(np.median(spans / (frames[self.window :] - frames[: -self.window])))
        return 1.0 / interval if interval > 0.0 else np.inf

    def agree(self, steps: Int[np.ndarray, "T-1"]) -> bool:
        """Whether the times have the stated rate, within their rounding."""
        tolerance = _RATE_TOLERANCE + self.rounding * self.stated / self.window
        rate = self.rate(steps)
        return rate < np.inf and abs(self.stated / rate - 1.0) <= tolerance


def _increasing_numbers(numbers: Float[np.ndarray, "T"] | None) -> Int[np.ndarray, "T"] | None:
    """Frame numbers if every frame has one; refuse numbers that are not whole or do not increase."""
    if numbers is None or np.isnan(numbers).any():
        return None
    odd = np.flatnonzero((numbers != np.round(numbers)) | (np.abs(numbers) > 2.0**52))
    if len(odd):
        raise CaptureError(f"a frame has the number {numbers[odd[0]]:g}, expected a whole one")
    back = np.flatnonzero(np.diff(numbers) <= 0)
    if len(back):
        first, second = numbers[back[0] : back[0] + 2]
        raise CaptureError(f"frame {second:.0f} follows frame {first:.0f}, expected numbers that increase")
    return numbers.astype(np.int64)


def _increasing_times(stated: StatedTimes) -> Float[np.ndarray, "T"] | None:
    """Times of the frames [s] if every frame has one; refuse times that decrease."""
    times = stated.times
    if times is None or np.isnan(times).any():
        return None
    back = np.flatnonzero(np.diff(times) < 0.0)
    if len(back):
        first, second = times[back[0] : back[0] + 2]
        raise CaptureError(f"the time goes back from {first:g} s to {second:g} s (row {back[0] + 2})")
    if len(times) > 1 and times[0] == times[-1]:
        raise CaptureError(
            f"all {len(times)} frames have the time {times[0]:g} s, and {stated.rate_name} is "
            f"{stated.rate.strip() or 'not stated'}"
        )
    return times


def _rate_of_times(
    stated: StatedTimes,
    steps: Int[np.ndarray, "T-1"],
    times: Float[np.ndarray, "T"] | None,
    warn: Warn,
) -> float:
    """The rate of evenly spaced times [Hz], for a file without a stated rate."""
    value = stated.rate.strip()[:40]
    text = f"{stated.rate_name} is '{value}'" if value else f"{stated.rate_name} is not stated"
    intervals = np.empty(0) if times is None else np.diff(times) / steps
    if len(intervals) < 2 or np.ptp(intervals) > _INTERVAL_TOLERANCE * intervals.mean():
        raise CaptureError(f"{text}, expected a positive number of frames per second")
    rate = float(1.0 / intervals.mean())
    warn(f"{text}; by the column of times it is {rate:.6g} Hz")
    return rate


def _with_gaps_in_time(steps: Int[np.ndarray, "T-1"], ticks: _Ticks) -> Int[np.ndarray, "T-1"]:
    """Number of frames from each row to the next, increased where the times show a gap.

    A late time that the next one makes up for is jitter and no gap. Numbers that advance by more frames than
    the times do are refused.
    """
    interval = 1.0 / ticks.rate(steps)
    excess = np.diff(ticks.times) / interval - steps
    slack = ticks.rounding / interval + 0.5 * _RATE_TOLERANCE * steps
    excess = np.sign(excess) * np.maximum(np.abs(excess) - slack, 0.0)
    around = np.concatenate([[0.0], excess, [0.0]])
    made_up = np.minimum(around[:-2], 0.0) + np.minimum(around[2:], 0.0)
    late = np.maximum(around[:-2], 0.0) + np.maximum(around[2:], 0.0)
    together = np.diff(ticks.times) == 0.0
    behind = np.flatnonzero((excess + late < -0.5) & ((steps > 1) | together))
    if len(behind):
        row = int(behind[0])
        first, second = ticks.times[row : row + 2]
        raise CaptureError(
            f"from row {row + 1} to row {row + 2} the frame's number goes on by {steps[row]}, and its time, "
            f"from {first:g} s to {second:g} s, by {(second - first) / interval:.3g} frames"
        )
    gaps = np.where(excess > 0.0, np.maximum(np.round(excess + made_up - _JITTER), 0.0), 0.0)
    return steps + gaps.astype(np.int64)


def _missing_sentence(
    steps: Int[np.ndarray, "T-1"], numbers: NDArray[np.int64], stride: int, num_frames: int
) -> str:
    gaps = np.flatnonzero(steps > 1)
    spans = [(numbers[row] + stride, numbers[row + 1] - stride) for row in gaps[:_SHOWN_GAPS]]
    shown = ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in spans)
    more = f" and {len(gaps) - _SHOWN_GAPS} more gaps" if len(gaps) > _SHOWN_GAPS else ""
    missing = int((steps - 1).sum())
    return f"{missing} of {num_frames} frames are missing ({shown}{more}); they are read without points"
