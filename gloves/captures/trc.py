"""TRC, the tab-separated text of marker trajectories.

Five header lines (file type, keys, their values, marker names, axes), then one line per frame: number, time,
and three cells per marker. Frame counts and frame numbers are often wrong in practice, so only names, units,
rate and the rows themselves are used.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from gloves.captures._text import meters_per, parse_table, positive_rate, split_lines
from gloves.captures.capture import Capture
from handsim.errors import CaptureError

_HEADER_LINES: Final = 5
_LEADING: Final = 2  # frame number and time
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


def read_trc(data: bytes) -> Capture:
    """The capture in the bytes of a TRC file.

    Raises:
        CaptureError: Not a TRC, header or last row cut, unknown units, or a cell that is not a number.
    """
    lines, ended = split_lines(data)
    if not lines[0].lstrip().startswith(b"PathFileType"):
        raise CaptureError("not a TRC file: line 1 does not begin with 'PathFileType'")
    # A header line counts only with its line end: what precedes a cut may be incomplete.
    whole = len(lines) if ended else len(lines) - 1
    if whole < _HEADER_LINES:
        raise CaptureError(f"the header is cut: expected {_HEADER_LINES} whole lines, got {whole}")
    keys, values, titles, axes = (_cells(line) for line in lines[1:_HEADER_LINES])
    stated = {key.lower(): value for key, value in zip(keys, values, strict=False)}
    for key in ("DataRate", "Units"):
        if not stated.get(key.lower()):
            raise CaptureError(f"the header (lines 2 and 3) states no {key}")
    rate = positive_rate(stated["datarate"], name="DataRate")
    scale = meters_per(stated["units"])
    names = _marker_names(titles, sum(bool(cell) for cell in axes))

    def column_name(column: int) -> str:
        if column < _LEADING:
            return ("frame number", "time")[column]
        marker, axis = divmod(column - _LEADING, 3)
        return f"{names[marker]} {'XYZ'[axis]}"

    table = parse_table(
        lines,
        start=_HEADER_LINES,
        ended=ended,
        delimiter=b"\t",
        num_columns=_LEADING + 3 * len(names),
        column_name=column_name,
    )
    return Capture(names, table[:, _LEADING:].reshape(len(table), len(names), 3) * scale, rate)


def write_trc(path: Path, capture: Capture, *, title: str) -> None:
    """Write millimeters with five decimals; a marker that was not seen gets three blank cells.

    Args:
        path: Where to write.
        capture: What to write.
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
        "Frame#\tTime\t" + "".join(f"{name}\t\t\t" for name in capture.names),
        "\t\t" + "".join(f"X{number}\tY{number}\tZ{number}\t" for number in range(1, num_markers + 1)),
    )
    row_format = "%d\t%.6f\t" + "%.5f\t" * (3 * num_markers)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n\n")
        for frame, row in enumerate(capture.positions.reshape(num_frames, -1) * 1e3):
            text = row_format % (frame + 1, frame / capture.rate, *row.tolist())
            file.write((text.replace("nan", "") if np.isnan(row).any() else text) + "\n")


def _marker_names(titles: list[str], num_axes: int) -> tuple[str, ...]:
    """Names of line 4, one in every three cells; a blank one becomes '*n'.

    Some writers put a name in every cell instead; that is accepted only if line 5 has three axes per name.
    """
    cells = titles[_LEADING:]
    while cells and not cells[-1]:
        cells.pop()
    if not titles[0].lower().startswith("frame") or not cells:
        raise CaptureError("no markers: line 4 should read 'Frame#', 'Time', then the marker names")
    if not any(cell for index, cell in enumerate(cells) if index % 3):
        return tuple(cell or f"*{number}" for number, cell in enumerate(cells[::3], 1))
    names = tuple(cell for cell in cells if cell)
    if num_axes != 3 * len(names):
        raise CaptureError(
            f"line 4 has {len(names)} marker names and line 5 {num_axes} axes, expected three per name"
        )
    return names


def _cells(line: bytes) -> list[str]:
    return [cell.strip() for cell in line.decode("utf-8", "replace").split("\t")]
