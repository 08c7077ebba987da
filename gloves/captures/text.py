"""Parsing shared by the formats: lines, cells, units of length, tables of numbers, times of frames.

Every text is read as lines of UTF-8 whose cells are separated by tabs, whatever it was written as:
`split_lines` reads UTF-16, `plain_lines` other separators and quotes, and `parse_table` decimal commas.

Rate, times and numbers of the frames have to agree. A gap in the numbers or in the times becomes frames
without a point, and is told. What cannot agree is refused in a sentence that says both values.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

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
    """Cells of a plain header line without outer blanks; what is not UTF-8 is taken as Windows-1252."""
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
    """The number in a cell, which may have a decimal comma; NaN for a blank cell."""
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


def marker_titles(leading: Sequence[str], names: Sequence[str]) -> list[str]:
    """What messages call the columns of a table with three cells per marker."""
    return [*leading, *(f"{name} {axis}" for name in names for axis in "XYZ")]


def parse_table(
    lines: list[bytes],
    *,
    start: int,
    ended: bool,
    titles: Sequence[str],
    text_columns: frozenset[int] = frozenset(),
) -> Float[np.ndarray, "T columns"]:
    """Numbers of a table, row by row; a blank or absent cell is NaN, a blank line is not a row.

    Numbers have decimal points, or commas if no number of the table has a point. A row may lack cells at its
    end, because some writers leave out what was not seen, and may have blank cells too many. Only the last
    line of a file can have been cut: it counts as cut if it has no line end and fewer cells than
    `titles` or than the first row, which tells whether rows end in a separator, or if its last number
    alone has fewer decimals. (A cut inside the last cell of a row whose numbers have as many decimals as it
    happens leaves no trace and is not noticed.)
    """
    num_columns = len(titles)
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
            table[row, : len(cells)] = _parse_cells(cells, number, titles)
    _check_finite(table, rows, titles)
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


def _parse_cells(cells: list[bytes], number: int, titles: Sequence[str]) -> list[float]:
    """The slow parser for one row: cells may hold blanks, and a cell that is not a number is named."""
    values = []
    for column, cell in enumerate(cells):
        text = cell.decode("utf-8", "replace").strip()
        try:
            values.append(_BLANK if text in _BLANKS else float(text))
        except ValueError:
            mixed = "," in text and "." not in text and text.count(",") == 1
            raise CaptureError(
                f"line {number}, column {column + 1} ({titles[column]}): '{shortened(text)}' is not a "
                f"number{', since others have decimal points' if mixed else ''}"
            ) from None
    return values


def _check_finite(
    table: Float[np.ndarray, "T columns"],
    rows: list[int],
    titles: Sequence[str],
) -> None:
    infinite = np.argwhere(np.isinf(table))
    if len(infinite):
        row, column = (int(index) for index in infinite[0])
        raise CaptureError(
            f"line {rows[row] + 1}, column {column + 1} ({titles[column]}): infinite, expected a "
            "finite number or a blank cell"
        )


LOWEST_RATE: Final = 1.0
HIGHEST_RATE: Final = 5000.0
"""Frames per second of any optical system [Hz]."""
_SAME_RATE: Final = 0.02  # by which two rates may differ: 119.88 is called 120, 29.97 is called 30
_COARSEST: Final = 1  # decimals of times, at least; whole seconds are no times of frames
_FINEST: Final = 9  # decimals
_UNEVEN: Final = 0.1  # of the step between two frames, by which times without a stated rate may differ
_JITTER: Final = 0.25  # of a frame's time, which times vary by where nothing is missing
_MOST_MISSING: Final = 10  # times as many frames as are there
_MOST_DIGITS: Final = 12  # of a count
_SHOWN: Final = 3  # gaps that a sentence names


@dataclass(frozen=True, slots=True)
class StatedTimes:
    """What a file states of the times of its T frames."""

    rate: str
    """The frame rate, as it is written."""
    rate_name: str
    """What the file calls it."""
    numbers: Float[np.ndarray, "T"] | None = None
    """Number of each frame; None, or NaN anywhere, where there is none."""
    times: Float[np.ndarray, "T"] | None = None
    """Time of each frame [s]; None, or NaN anywhere, where there is none."""
    count: str = ""
    """Number of frames, as it is written."""
    count_name: str = ""
    """What the file calls it."""
    count_is_reliable: bool = True
    """Whether fewer frames mean that the file is cut; many programs and people shorten a TRC as it is."""


def check_rate(rate: float, name: str = "the rate") -> None:
    """Raise a `CaptureError` unless a frame rate [Hz] is that of an optical system."""
    if not LOWEST_RATE <= rate <= HIGHEST_RATE:
        raise CaptureError(
            f"{name} is {rate:g} Hz, expected {LOWEST_RATE:g} to {HIGHEST_RATE:g} frames per second"
        )


def check_same_rate(name: str, rate: float, other_name: str, other: float) -> None:
    """Refuse two stated rates [Hz] of the same frames that differ; one that is none does not count."""
    if 0.0 < other < np.inf and abs(rate - other) > _SAME_RATE * other:
        raise CaptureError(
            f"{name} is {rate:g} Hz and {other_name} {other:g} Hz; correct the one that is wrong"
        )


def timed_positions(
    positions: Float[np.ndarray, "R N 3"], stated: StatedTimes, tell: Callable[[str], None]
) -> tuple[Float[np.ndarray, "T N 3"], float]:
    """Positions of all frames from the first to the last [m], and their rate [Hz]."""
    numbers, times = _increasing_numbers(stated.numbers), _increasing_times(stated)
    steps, stride = np.ones(len(positions) - 1, dtype=np.int64), 1
    if numbers is not None and len(numbers) > 1:
        steps = np.diff(numbers)
        stride = int(np.gcd.reduce(steps))  # some programs keep the cameras' numbers of every other frame
        steps //= stride
    rate = _stated_rate(stated.rate)
    if rate is None:
        rate = _rate_of_times(stated, steps, times, tell)
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
    _check_missing(num_frames, steps, first + stride * frames, times)
    _check_count(stated, len(positions), num_frames, tell)
    if num_frames == len(positions):
        return positions, rate
    tell(_missing_sentence(steps, first + stride * frames, stride, num_frames))
    filled = np.full((num_frames, *positions.shape[1:]), np.nan)
    filled[frames] = positions
    return filled, rate


@dataclass(frozen=True, slots=True)
class _Ticks:
    """Times of frames, beside the rate that is stated."""

    times: Float[np.ndarray, "T"]
    """[s]"""
    stated: float
    """[Hz]"""
    rounding: float
    """The step to which times were rounded [s]."""
    window: int
    """Frames between two times whose distance shows the rate."""

    @staticmethod
    def of(times: Float[np.ndarray, "T"], rate: float) -> _Ticks:
        rounding = 10.0**-_FINEST
        for decimals in range(_COARSEST, _FINEST):
            scaled = times * 10.0**decimals
            if np.abs(scaled - np.round(scaled)).max() < 1e-3:
                rounding = 10.0**-decimals
                break
        window = min(len(times) - 1, math.ceil(max(1.0, rounding * rate / _SAME_RATE)))
        return _Ticks(times, rate, rounding, window)

    def rate(self, steps: Int[np.ndarray, "T-1"]) -> float:
        """The usual rate of the times [Hz]."""
        frames = np.concatenate([[0], np.cumsum(steps)])
        spans = self.times[self.window :] - self.times[: -self.window]
        interval = float(np.median(spans / (frames[self.window :] - frames[: -self.window])))
        return 1.0 / interval if interval > 0.0 else np.inf

    def agree(self, steps: Int[np.ndarray, "T-1"]) -> bool:
        """Whether the rate of the times is the stated one, as far as they are rounded."""
        tolerance = _SAME_RATE + self.rounding * self.stated / self.window
        rate = self.rate(steps)
        return rate < np.inf and abs(self.stated / rate - 1.0) <= tolerance


def _stated_rate(text: str) -> float | None:
    """The rate that a header states [Hz]; None where that is no positive number."""
    try:
        rate = cell_number(text)
    except ValueError:
        return None
    return rate if 0.0 < rate < np.inf else None


def _increasing_numbers(numbers: Float[np.ndarray, "T"] | None) -> Int[np.ndarray, "T"] | None:
    """The numbers of the frames, if all have one; a `CaptureError` unless they are whole and increase."""
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
    """The times of the frames [s], if all have one; a `CaptureError` unless they increase."""
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
    tell: Callable[[str], None],
) -> float:
    """The rate of evenly spaced times [Hz], where none is stated."""
    text = f"{stated.rate_name} is '{stated.rate.strip()[:40]}', expected a positive number"
    intervals = np.empty(0) if times is None else np.diff(times) / steps
    if len(intervals) < 2 or np.ptp(intervals) > _UNEVEN * intervals.mean():
        raise CaptureError(f"{text} of frames per second")
    rate = float(1.0 / intervals.mean())
    tell(f"{text}; by the column of times it is {rate:.6g} Hz")
    return rate


def _with_gaps_in_time(steps: Int[np.ndarray, "T-1"], ticks: _Ticks) -> Int[np.ndarray, "T-1"]:
    """Frames from each row to the next, with those that are missing by the times alone.

    A time that is late and made up for by the next one is no gap: clocks jitter. Numbers that go on by more
    frames than times are a `CaptureError`.
    """
    interval = 1.0 / ticks.rate(steps)
    excess = np.diff(ticks.times) / interval - steps
    slack = ticks.rounding / interval + 0.5 * _SAME_RATE * steps
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


def _check_missing(
    num_frames: int,
    steps: Int[np.ndarray, "T-1"],
    numbers: Int[np.ndarray, "T"],
    times: Float[np.ndarray, "T"] | None,
) -> None:
    """Refuse a jump that leaves almost nothing of a capture."""
    there = len(numbers)
    if num_frames - there <= _MOST_MISSING * there:
        return
    row = int(np.argmax(steps))
    at = "" if times is None else f", from {times[row]:g} s to {times[row + 1]:g} s"
    raise CaptureError(
        f"{steps[row] - 1} frames are missing behind frame {numbers[row]}{at}, and {there} are there; "
        "correct the numbers or the times, or cut the capture there"
    )


def _check_count(stated: StatedTimes, there: int, spanned: int, tell: Callable[[str], None]) -> None:
    """Whether there are as many frames as stated, with those that are missing between others."""
    text = stated.count.strip()
    if not text.isdecimal():
        return
    count = int(text[:_MOST_DIGITS])
    if count > spanned and stated.count_is_reliable:
        raise CaptureError(
            f"truncated: {stated.count_name} is {count}, and {spanned} frames are there; export the file "
            "again, or correct that number if they are all"
        )
    if count < there or count > spanned:
        tell(f"{stated.count_name} is {count}, and {there} frames are there; all are read")


def _missing_sentence(
    steps: Int[np.ndarray, "T-1"], numbers: NDArray[np.int64], stride: int, num_frames: int
) -> str:
    gaps = np.flatnonzero(steps > 1)
    spans = [(numbers[row] + stride, numbers[row + 1] - stride) for row in gaps[:_SHOWN]]
    shown = ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in spans)
    more = f" and {len(gaps) - _SHOWN} more gaps" if len(gaps) > _SHOWN else ""
    missing = int((steps - 1).sum())
    return f"{missing} of {num_frames} frames are missing ({shown}{more}); they are read without points"
