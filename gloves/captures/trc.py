"""TRC, the tab-separated text of marker trajectories.

Five header lines (file type, keys, their values, marker names, axes), then one line per frame: number, time,
and three cells per marker. Rows may hold more trajectories than line 4 names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from gloves.captures._text import (
    TAB,
    Tell,
    check_width,
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

_BEGIN: Final = b"PathFileType"
_HEADER_LINES: Final = 5
_LEADING: Final = 2  # frame number and time
_NO_MARKERS: Final = "no markers: line 4 should read 'Frame#', 'Time', then the marker names"
_KEYS: Final = (
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
)


def read_trc(data: bytes, tell: Tell = warn) -> Capture:
    """The capture in the bytes of a TRC file.

    Cells are separated by tabs, or by commas or semicolons where the first line is. Missing frames are told,
    and a rate that only the column of times states.
    """
    lines, ended = split_lines(data)
    if not lines[0].lstrip(b' \t"').startswith(_BEGIN):
        raise CaptureError("not a TRC file: line 1 does not begin with 'PathFileType'")
    lines = plain_lines(lines, separator_behind([_BEGIN], lines[0]) or TAB, wider=True)
    # A header line counts only with its line end: what precedes a cut may be incomplete.
    whole = len(lines) if ended else len(lines) - 1
    if whole < _HEADER_LINES:
        raise CaptureError(f"the header is cut: expected {_HEADER_LINES} whole lines, got {whole}")
    keys, values, titles, axes = (
        header_cells(line, number) for number, line in enumerate(lines[1:_HEADER_LINES], 2)
    )
    stated = _stated(keys, values)
    if not stated.get("units"):
        raise CaptureError("the header (lines 2 and 3) states no Units")
    scale = meters_per(stated["units"])
    names = _marker_names(titles, sum(bool(cell) for cell in axes))
    names += _unnamed(lines[_HEADER_LINES:], len(names))

    def column_name(column: int) -> str:
        if column < _LEADING:
            return ("frame number", "time")[column]
        marker, axis = divmod(column - _LEADING, 3)
        return f"{names[marker]} {'XYZ'[axis]}"

    table = parse_table(
        lines,
        start=_HEADER_LINES,
        ended=ended,
        num_columns=_LEADING + 3 * len(names),
        column_name=column_name,
    )
    positions = table[:, _LEADING:].reshape(len(table), len(names), 3) * scale
    times = StatedTimes(
        stated.get("datarate", ""),
        "DataRate",
        numbers=table[:, 0],
        times=table[:, 1],
        count=stated.get("numframes", ""),
        count_name="NumFrames",
        count_is_reliable=False,
    )
    return Capture(names, *timed_positions(positions, times, tell))


def write_trc(path: Path, capture: Capture, *, title: str) -> None:
    """Write millimeters with five decimals; a marker that was not seen gets three blank cells.

    A tab ends the rows, and the two header lines above them, as in the files of Cortex: OpenSim does not
    count a blank cell at the very end of a row, and refuses a row whose last marker is missing without it.

    Args:
        title: The file name that the first line states (`path` may be a temporary one).

    Raises:
        OSError: The file cannot be written.
    """
    num_frames, num_markers = capture.positions.shape[:2]
    rate = repr(capture.rate).removesuffix(".0")
    values = (rate, rate, str(num_frames), str(num_markers), "mm", rate, "1", str(num_frames))
    header = (
        f"PathFileType\t4\t(X/Y/Z)\t{title}",
        "\t".join(_KEYS),
        "\t".join(values),
        "\t".join(["Frame#", "Time", *(cell for name in capture.names for cell in (name, "", "")), ""]),
        "\t\t" + "".join(f"X{number}\tY{number}\tZ{number}\t" for number in range(1, num_markers + 1)),
    )
    row_format = "%d\t%.6f\t" + "%.5f\t" * (3 * num_markers)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n\n")
        for frame, row in enumerate(capture.positions.reshape(num_frames, -1) * 1e3):
            text = row_format % (frame + 1, frame / capture.rate, *row.tolist())
            file.write((text.replace("nan", "") if np.isnan(row).any() else text) + "\n")


def _stated(keys: list[str], values: list[str]) -> dict[str, str]:
    """Values of line 3 by the lower-case keys of line 2; some writers put two tabs between values."""
    if sum(map(bool, keys)) == sum(map(bool, values)):
        keys, values = list(filter(None, keys)), list(filter(None, values))
    return {key.lower(): value for key, value in zip(keys, values, strict=False)}


def _marker_names(titles: list[str], num_axes: int) -> tuple[str, ...]:
    """Names of line 4, one in every three cells; a blank one becomes '*n'. There may be none.

    Some writers put a name in every cell instead; that is accepted only if line 5 has three axes per name.
    """
    lower = [title.lower() for title in titles[: 2 * _LEADING]]
    if not lower[0].startswith("frame"):
        raise CaptureError(_NO_MARKERS)
    cells = titles[lower.index("time") + 1 if "time" in lower else _LEADING :]
    while cells and not cells[-1]:
        cells.pop()
    if not any(cell for index, cell in enumerate(cells) if index % 3):
        return tuple(cell or f"*{number}" for number, cell in enumerate(cells[::3], 1))
    names = tuple(cell for cell in cells if cell)
    if num_axes != 3 * len(names):
        raise CaptureError(
            f"line 4 has {len(names)} marker names and line 5 {num_axes} axes, expected three per name"
        )
    return names


def _unnamed(rows: list[bytes], num_named: int) -> tuple[str, ...]:
    """Names '*n' for the trajectories that rows hold behind those of line 4, as Cortex writes them."""
    expected = _LEADING + 3 * num_named
    widths = [row.rstrip(b" \t").count(TAB) + 1 for row in rows]
    width = max(widths, default=0)
    extra = max(0, width - expected)
    check_width(width, _HEADER_LINES + 1 + (widths.index(width) if widths else 0))
    if extra % 3:
        raise CaptureError(
            f"line {_HEADER_LINES + 1 + widths.index(width)} has {width} cells, expected {expected}, or "
            "three more for each trajectory without a name"
        )
    if not num_named and not extra and any(row.strip(b" \t") for row in rows):
        raise CaptureError(_NO_MARKERS)
    return tuple(f"*{num_named + number}" for number in range(1, extra // 3 + 1))
