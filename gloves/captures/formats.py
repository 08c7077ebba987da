"""Marker files by suffix: TRC, C3D and Motive CSV (read and written); Vicon CSV, Qualisys TSV, tables (read).

A TRC is tab-separated, with five header lines (file type, keys, their values, marker names, axes) and one
line per frame: number, time, and three cells per marker. Rows may hold more trajectories than line 4 names.

OptiTrack Motive's CSV is read in format versions 1.2x and 1.3x, and written in 1.23. Line 1 lists keys and
values. Rows with a label follow (Type, Name, ID, in newer files Parent), a row of quantities, a row of axes
that begins with 'Frame', and one row per frame. Rows and columns are found by labels and types, since newer
exports add some. Motive 1.9 and before (versions 1.20, 1.21) write rows of types and names without labels.

Vicon Nexus and Vicon Workstation write sections: a title, a rate, a row of names (one in three cells), a row
of axes that begins with 'Frame' (Workstation: 'Field #'), in Nexus a row of units, one row per frame, and a
blank line. Other sections (Devices, Model Outputs, ...) may precede and follow the trajectories.

Qualisys Track Manager's TSV of 3D data has lines of keys and values (NO_OF_FRAMES, FREQUENCY, MARKER_NAMES,
...; newer exports begin with FILE_VERSION), optionally a line of column names, and one line per frame:
optionally frame number and time, then three cells per marker in millimeters.

Other tables (.csv, .tsv) have a line of column names, a column of times [s], and three columns per marker.
"""

from __future__ import annotations

import codecs
import csv
import itertools
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TextIO

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.captures.c3d import read_c3d, write_c3d
from gloves.captures.capture import (
    AT_ORIGIN,
    OF_ARRAYS,
    Capture,
    all_at_origin,
    select_hands,
    unit_fault,
    unlabeled_frames,
)
from gloves.captures.coordinates import OUTPUTS, PIECES, findings_sentence, settled
from gloves.captures.pieces import Trajectories
from gloves.captures.text import (
    LEADING,
    MAX_CELLS,
    MAX_DIGITS,
    TAB,
    StatedTimes,
    TableColumns,
    Warn,
    cell_number,
    check_width,
    emit_warning,
    header_cells,
    meters_per,
    parse_table,
    plain_lines,
    separator_behind,
    split_lines,
    timed_positions,
)
from handsim._checks import check_type
from handsim.errors import CaptureError, HandSimWarning, choices, errors_of, shortened
from handsim.files.inputs import read_bytes
from handsim.files.outputs import as_text, atomic_write, writing

_TRC_BEGIN: Final = b"PathFileType"
_HEADER_LINES: Final = 5
_NO_MARKERS: Final = "no markers: line 4 should read 'Frame#', 'Time', then the marker names"
_TRC_KEYS: Final = (
    "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
)
MOTIVE_BEGIN: Final = b"Format Version"
_COUNT_KEY: Final = "Total Exported Frames"
_UNIT_KEY: Final = "Length Units"
_SPACE_KEY: Final = "Coordinate Space"
_RATE_KEYS: Final = ("Export Frame Rate", "Capture Frame Rate")
_MOTIVE_KEYS: Final = {
    key.lower(): key
    for key in ("Format Version", "Take Name", "Take Notes", *_RATE_KEYS, _COUNT_KEY, _UNIT_KEY, _SPACE_KEY)
}
_XYZ: Final = ["X", "Y", "Z"]
_MOTIVE_TYPES: Final = {"Marker", "Rigid Body", "Rigid Body Marker", "Bone", "Bone Marker"}
_TRAJECTORIES: Final = "Trajectories"
_SECTIONS: Final = (_TRAJECTORIES, "Devices", "Model Outputs", "Joints", "Segments")
_FRAME_TITLES: Final = ("frame", "field #")
_OUTPUT_UNITS: Final = {"deg", "rad", "n", "nmm", "n.mm", "nm", "n.m", "w", "kg", "v", "mv"}
"""Units of angles, forces, moments, powers and signals, in lower case."""
_BLANK_BYTES: Final = b' \t",;'
_QTM_BEGINS: Final = (b"NO_OF_FRAMES", b"FILE_VERSION")
_QTM_KEY: Final = re.compile(rb"(?!NULL\t)[A-Z][A-Z0-9_]*(\t|$)")
_QTM_LEADING: Final = ("frame", "time")
_LEADING_TITLE: Final = re.compile(r"frame|time|#|$", re.I)
_AXIS_TITLE: Final = re.compile(r"(.+?)[ ._:-]?([xyz])", re.I)
_COPY_TITLE: Final = re.compile(r"(.+)\.[12]")  # pandas numbers columns of the same name
_FIRST_BYTES: Final = 200  # number of bytes that show which program wrote a CSV
_SKELETON_HINT: Final = "the motion of a skeleton without its markers; export the markers where it was made"
_VICON_HINT: Final = "a file of Vicon's own; export C3D or ASCII with trajectories from Nexus"
_CORTEX_HINT: Final = "a binary file of Cortex; export TRC or C3D from there"
_OPENSIM_HINT: Final = "angles or forces of OpenSim and no markers; give the TRC that they were made of"
_FOREIGN_ENDINGS: Final = {
    ".tak": "a take of Motive, a closed format; export CSV or C3D with unlabeled markers from Motive",
    ".qtm": "a file of Qualisys' own; export C3D, or TSV of 3D data, from QTM",
    **dict.fromkeys((".gz", ".zip", ".7z", ".rar"), "compressed; unpack it"),
    ".mat": f"a file of MATLAB; export C3D, or TSV of 3D data, from the program that wrote it; {OF_ARRAYS}",
    ".npy": f"an array of NumPy; {OF_ARRAYS}",
    ".npz": "an archive of NumPy; if it is a take, load_take reads it, and its capture() has the points; "
    f"{OF_ARRAYS}",
    **dict.fromkeys((".x1d", ".x2d", ".v", ".vsk", ".enf", ".system"), _VICON_HINT),
    **dict.fromkeys((".trb", ".cap"), _CORTEX_HINT),
    **dict.fromkeys((".mot", ".sto", ".osim"), _OPENSIM_HINT),
    **dict.fromkeys((".bvh", ".fbx", ".amc", ".asf", ".htr", ".mvnx", ".glb"), _SKELETON_HINT),
}
"""Descriptions of other programs' files and their replacements, by ending."""
_FOREIGN_BEGINS: Final = {
    _TRC_BEGIN.lower(): "the content of a TRC; name it .trc",
    MOTIVE_BEGIN.lower(): "the content of Motive's CSV; name it .csv",
    **{word.lower(): "the content of a TSV of Qualisys; name it .tsv" for word in _QTM_BEGINS},
    b"comment,this file was exported from": "a CSV of Tracking Tools; export its take from Motive",
    b"objects": "a CSV of Vicon Tracker with bodies and no markers",
    b"%time,": "a topic of ROS",
    b"timestamp\tframenumber": "a text of D-Flow; export C3D or TRC from where it was captured",
    b"version https://git-lfs": "a pointer of Git LFS to the file; git lfs pull brings it",
    b"scorer,": "a CSV of DeepLabCut with points of pictures; triangulate them and write a TRC",
    b"pk\3\4": "a workbook of Excel or another archive; save it as text",
    b"<": "XML or a page of the web",
    b"{": "JSON",
}
"""Descriptions of files, by the lower-case bytes that they begin with."""
WRITABLE: Final = (".trc", ".c3d", ".csv")


def read_trc(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the bytes of a TRC file."""
    lines, ended = split_lines(data)
    if not lines[0].lstrip(b' \t"').lower().startswith(_TRC_BEGIN.lower()):
        raise CaptureError("not a TRC file: line 1 does not begin with 'PathFileType'")
    lines = plain_lines(lines, separator_behind([_TRC_BEGIN], lines[0]) or TAB, wider=True)
    lines = _tabs_for_spaces(lines)
    # A header line without a line end may be truncated.
    whole = len(lines) if ended else len(lines) - 1
    if whole < _HEADER_LINES:
        raise CaptureError(f"the header is cut: expected {_HEADER_LINES} whole lines, got {whole}")
    keys, values, titles, axes = (
        header_cells(line, number) for number, line in enumerate(lines[1:_HEADER_LINES], 2)
    )
    if sum(map(bool, keys)) == sum(map(bool, values)):  # some writers put two tabs between values
        keys, values = list(filter(None, keys)), list(filter(None, values))
    stated = {key.lower(): value for key, value in zip(keys, values, strict=False)}
    if not stated.get("units"):
        raise CaptureError("the header (lines 2 and 3) states no Units")
    scale = meters_per(stated["units"])
    names = _marker_names(titles, sum(bool(cell) for cell in axes))
    names += _unnamed_names(lines[_HEADER_LINES:], len(names))

    columns = TableColumns.of_triples(("frame number", "time"), names, scale)
    leading, read = parse_table(lines, columns, start=_HEADER_LINES, ended=ended)
    stated |= {key: stated.get(key.lower(), "") for key in ("DataRate", "NumFrames")}
    return _timed_capture(read, leading, stated, ("DataRate", "NumFrames"), warn, count_is_reliable=False)


def _timed_capture(
    read: Trajectories,
    leading: Float[np.ndarray, "T 2"],
    stated: Mapping[str, str],
    keys: tuple[str, str],
    warn: Warn,
    *,
    count_is_reliable: bool = True,
    outputs: int = 0,
) -> Capture:
    """Make a capture of trajectories, the numbers and times of its rows, and the stated rate and count."""
    (rate, count), (numbers, times) = keys, leading.T
    values = stated.get(rate, ""), rate, numbers, times, stated.get(count, ""), count, count_is_reliable
    timed = timed_positions(read.positions, StatedTimes(*values), warn)
    return Capture(read.names, *timed, findings={PIECES: read.pieces, OUTPUTS: outputs})


def _tabs_for_spaces(lines: list[bytes]) -> list[bytes]:
    """Replace spaces between cells by tabs; refuse rows in which spaces may hide blank cells."""
    spaced = [index for index, line in enumerate(lines) if TAB not in line and b" " in line.strip()]
    lines = list(lines)
    for index in spaced:
        lines[index] = TAB.join(lines[index].split())
    rows = [index for index in spaced if index >= _HEADER_LINES]
    if rows and not any(b"nan" in lines[index].lower() for index in rows):
        widths = [lines[index].count(TAB) + 1 for index in rows]
        other = next((row for row, width in enumerate(widths) if width != widths[0]), None)
        if other is not None:
            raise CaptureError(
                f"line {rows[other] + 1} has {widths[other]} cells and line {rows[0] + 1} {widths[0]}, all "
                "parted by spaces, so that blank cells do not show; write tabs, or nan in blank cells"
            )
    # The blank line after the header may also hold nan.
    return [b"" if line.strip().lower() == b"nan" else line for line in lines]


def write_trc(path: Path, capture: Capture, *, title: str) -> None:
    """Write millimeters with five decimals; a missing marker gets three blank cells.

    Rows, and the two header lines above them, end with a tab, as in the files of Cortex: without it OpenSim
    refuses rows whose last marker is missing.
    """
    num_frames, num_markers = capture.positions.shape[:2]
    rate = repr(capture.rate).removesuffix(".0")
    values = (rate, rate, str(num_frames), str(num_markers), "mm", rate, "1", str(num_frames))
    header = (
        f"PathFileType\t4\t(X/Y/Z)\t{title}",
        _TRC_KEYS.replace(" ", "\t"),
        "\t".join(values),
        "\t".join(["Frame#", "Time", *(cell for name in capture.names for cell in (name, "", "")), ""]),
        "\t\t" + "".join(f"X{number}\tY{number}\tZ{number}\t" for number in range(1, num_markers + 1)),
    )
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n\n")
        _write_rows(file, capture, "%d\t%.6f\t" + "%.5f\t" * (3 * num_markers), first=1)


def _write_rows(file: TextIO, capture: Capture, row_format: str, *, first: int) -> None:
    """Write number, time and positions [mm] of each frame; a missing marker gets three blank cells."""
    for frame, row in enumerate(capture.positions.reshape(capture.num_frames, -1) * 1e3):
        text = row_format % (first + frame, frame / capture.rate, *row.tolist())
        file.write((text.replace("nan", "") if np.isnan(row).any() else text) + "\n")


def _marker_names(titles: list[str], num_axes: int) -> tuple[str, ...]:
    """Names of line 4, one in three cells; a blank name becomes '*n'. There may be none."""
    lower = [title.lower() for title in titles[: 2 * LEADING]]
    if not lower[0].startswith("frame"):
        raise CaptureError(_NO_MARKERS)
    cells = titles[lower.index("time") + 1 if "time" in lower else LEADING :]
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


def _unnamed_names(rows: list[bytes], num_named: int) -> tuple[str, ...]:
    """Names '*n' for trajectories without a name in line 4, which Cortex writes at the ends of rows."""
    expected = LEADING + 3 * num_named
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


def read_motive_csv(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the markers, labeled or not, in the bytes of a Motive CSV; rigid bodies and bones are ignored."""
    lines, ended = split_lines(data)
    separator = separator_behind([MOTIVE_BEGIN], lines[0])
    if separator is None:
        raise CaptureError("not a Motive CSV export: line 1 does not begin with 'Format Version'")
    lines = plain_lines(lines, separator)
    rows = [header_cells(line, number) for number, line in enumerate(lines[:20], 1)]
    end = next((index for index, row in enumerate(rows) if row and row[0] == "Frame"), None)
    if end is None or (end == len(lines) - 1 and not ended):
        raise CaptureError("the header is cut: no whole row begins with 'Frame'")
    # A comma or a line break in the take's name or notes moves the keys after it.
    keyed = [index for index, row in enumerate(rows[:end]) for cell in row if cell.lower() in _MOTIVE_KEYS]
    keyed = keyed or [0]
    stated = {
        _MOTIVE_KEYS[key.lower()]: value
        for row in rows[: keyed[-1] + 1]
        for key, value in itertools.pairwise(row)
        if key.lower() in _MOTIVE_KEYS
    }
    rate_key = next((key for key in _RATE_KEYS if stated.get(key)), _RATE_KEYS[-1])
    if not stated.get(_UNIT_KEY):
        warn("line 1 states no Length Units, read as meters, which Motive writes unless told otherwise")
    scale = meters_per(stated.get(_UNIT_KEY) or "Meters")
    if stated.get(_SPACE_KEY) == "Local":
        warn("Coordinate Space is Local: markers stand still in their bodies; export world coordinates")
    axes = rows[end]
    header = [row for row in rows[keyed[-1] + 1 : end] if any(row)]
    # Files without labels begin with the types, after two blank cells.
    if len(header) > 2 and not any(header[0][:2]) and set(header[0]) & _MOTIVE_TYPES:
        types, names = header[:2]
    else:
        types, names = (_labeled_row(header, label) for label in ("Type", "Name"))
    names = names + [""] * (len(axes) - len(names))
    columns = _marker_columns(types, header[-1], axes)

    table = TableColumns(
        titles=[f"{name} {axis}".strip() for name, axis in zip(names, axes, strict=False)],
        names=[names[column] or f"*{number}" for number, column in enumerate(columns, 1)],
        first=np.array(columns),
        scales=np.full(len(columns), scale),
        texts=frozenset(index for index, axis in enumerate(axes) if axis.lower() == "timecode"),
    )
    leading, read = parse_table(lines, table, start=end + 1, ended=ended)
    if not re.match(r"time( \(|$)", axes[1], re.I):
        leading[:, 1] = np.nan
    return _timed_capture(read, leading, stated, (rate_key, _COUNT_KEY), warn)


def write_motive_csv(path: Path, capture: Capture, *, title: str) -> None:
    """Write format version 1.23 in millimeters with six decimals; a missing marker gets three blank cells."""
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
            writer.writerow(["", label, *(value for value in values for _ in _XYZ)])
        writer.writerow(["", "", *["Position"] * (3 * num_markers)])
        writer.writerow(["Frame", "Time (Seconds)", *_XYZ * num_markers])
        _write_rows(file, capture, "%d,%.6f" + ",%.6f" * (3 * num_markers), first=0)


def _labeled_row(rows: list[list[str]], label: str) -> list[str]:
    """The header row whose first text is `label`."""
    for row in rows:
        if next(cell for cell in row if cell) == label:
            return row
    raise CaptureError(f"not a Motive CSV export: no header row is labeled '{label}'")


def _marker_columns(types: list[str], quantities: list[str], axes: list[str]) -> list[int]:
    """First column of the position of each marker."""
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
        if axes[index : index + 3] != _XYZ:
            raise CaptureError(
                f"column {index + 1}: expected the axes X, Y, Z, got {', '.join(axes[index : index + 3])}"
            )
    return columns


def vicon_sections(lines: list[bytes]) -> dict[str, int]:
    """Index of the title line of each section of a Vicon export."""
    titles = {name.lower().encode(): name for name in _SECTIONS}
    found: dict[str, int] = {}
    for index, line in enumerate(lines):
        if line[:1].isalpha() or line[:1] == b'"':
            title = titles.get(line.strip(_BLANK_BYTES).lower())
            # The word is a title only if the next line is a rate.
            if title and index + 1 < len(lines) and lines[index + 1].lstrip(_BLANK_BYTES)[:1].isdigit():
                found.setdefault(title, index)
    return found


def read_vicon_csv(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the trajectories, labeled or not, in the bytes of a Vicon CSV."""
    lines, ended = split_lines(data)
    sections = vicon_sections(lines)
    if _TRAJECTORIES not in sections:
        raise CaptureError(
            "not a Vicon CSV export with trajectories: no line reads 'Trajectories'; sections in the file: "
            f"{', '.join(sections) or 'none'}"
        )
    at = sections[_TRAJECTORIES]
    end = next((row for row in range(at, len(lines)) if not lines[row].strip(_BLANK_BYTES)), len(lines))
    if end < at + 4 or (end == at + 4 == len(lines) and not ended):
        raise CaptureError("the header is cut: expected rate, names and axes behind the line 'Trajectories'")
    separator = max(b",", b";", b"\t", key=lines[at + 3].count)
    lines = [*lines[:at], *plain_lines(lines[at:end], separator, first=at + 1), *lines[end:]]
    rates, names, axes = (header_cells(lines[row], row + 1) for row in range(at + 1, at + 4))
    if axes[0].lower() not in _FRAME_TITLES:
        raise CaptureError(f"line {at + 4} begins with '{shortened(axes[0])}', expected 'Frame'")
    columns = np.array([index for index in range(len(axes) - 2) if axes[index : index + 3] == _XYZ])
    if not len(columns):
        raise CaptureError(f"no markers: line {at + 4} has no axes X, Y, Z")
    num_columns = len(columns)
    start, columns, scales = _vicon_units(lines[:end], at + 4, columns, warn)
    names += [""] * (len(axes) - len(names))
    # A name stands above the first of its three columns.
    above = [next(filter(None, names[max(0, n - 2) : n + 1][::-1]), "") for n in range(len(axes))]
    table = TableColumns(
        titles=[f"{name} {axis}".strip() for name, axis in zip(above, axes, strict=False)],
        names=[names[column] or f"*{number}" for number, column in enumerate(columns.tolist(), 1)],
        first=columns,
        scales=scales,
    )
    leading, read = parse_table(lines[:end], table, start=start, ended=ended or end < len(lines))
    leading[:, 1] = np.nan  # sub-frames are no times
    key = "the rate of the trajectories"
    return _timed_capture(read, leading, {key: rates[0]}, (key, ""), warn, outputs=num_columns - len(columns))


def _vicon_units(
    lines: list[bytes], row: int, columns: Int[np.ndarray, "N"], warn: Warn
) -> tuple[int, NDArray[np.int64], NDArray[np.float64]]:
    """Index of the first row of numbers, the trajectories in units of length, and meters per unit of each."""
    cells = header_cells(lines[row], row + 1) if row < len(lines) else []
    if cells and cells[0]:  # a frame number: there is no row of units
        warn("the file states no unit of length, read as millimeters, which Vicon's programs write")
        return row, columns, np.full(len(columns), meters_per("mm"))
    units = np.array([cells[column] if column < len(cells) else "" for column in columns])
    lengths = np.array([unit.lower() not in _OUTPUT_UNITS for unit in units])
    if lengths.any():
        units, columns = units[lengths], columns[lengths]
    scales = {unit: meters_per(str(unit)) for unit in np.unique(units)}
    return row + 1, columns, np.array([scales[unit] for unit in units])


def read_qtm_tsv(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the markers in the bytes of a Qualisys TSV with 3D data."""
    lines, ended = split_lines(data)
    separator = separator_behind(_QTM_BEGINS, lines[0])
    if separator is None:
        raise CaptureError(
            "not a Qualisys TSV export: line 1 does not begin with 'NO_OF_FRAMES' or 'FILE_VERSION'"
        )
    lines = plain_lines(lines, separator, wider=True)
    start = next((index for index, line in enumerate(lines) if not _QTM_KEY.match(line)), len(lines))
    if start == len(lines) and not ended:
        raise CaptureError("the header is cut: no line of column names or numbers follows it")
    stated = {
        cells[0]: cells[1:]
        for number, line in enumerate(lines[:start], 1)
        for cells in [header_cells(line, number)]
    }
    firsts = {key: next(iter(values), "") for key, values in stated.items()}
    included = firsts.get("DATA_INCLUDED") or "3D"
    if included != "3D":
        raise CaptureError(f"DATA_INCLUDED is '{shortened(included)}', expected '3D'; export the 3D data")
    if "MARKER_NAMES" not in stated:
        raise CaptureError("the header states no MARKER_NAMES")
    names = _qtm_names(stated["MARKER_NAMES"], firsts.get("NO_OF_MARKERS", ""))
    start, num_leading = _begin_of_rows(lines, start, 3 * len(names))

    columns = TableColumns.of_triples(_QTM_LEADING[:num_leading], names, meters_per("mm"))
    leading, read = parse_table(lines, columns, start=start, ended=ended)
    leading[:, num_leading:] = np.nan
    return _timed_capture(read, leading, firsts, ("FREQUENCY", "NO_OF_FRAMES"), warn)


def _qtm_names(names: list[str], text: str) -> tuple[str, ...]:
    """The names of all markers, whose number a text states; a missing name becomes '*n'."""
    while names and not names[-1]:
        names = names[:-1]
    count = int(text[:MAX_DIGITS]) if text.isdecimal() else len(names)
    if count < len(names) or count > MAX_CELLS // 3:
        raise CaptureError(f"MARKER_NAMES holds {len(names)} names, and NO_OF_MARKERS states {count}")
    if not count:
        raise CaptureError("no markers: MARKER_NAMES holds no name")
    names = names + [""] * (count - len(names))
    return tuple(name or f"*{number}" for number, name in enumerate(names, 1))


def _begin_of_rows(lines: list[bytes], start: int, width: int) -> tuple[int, int]:
    """Index of the first row of numbers, and its number of cells before the positions (`width` cells)."""
    while start < len(lines) and not lines[start].strip():
        start += 1
    if start == len(lines):
        raise CaptureError("no frames: nothing follows the header")
    cells = header_cells(lines[start], start + 1)
    if cells[0].lower() == _QTM_LEADING[0]:
        return start + 1, 2 if cells[1:2] and cells[1].lower() == _QTM_LEADING[1] else 1
    try:
        cell_number(cells[0])
    except ValueError:  # column names without frame and time
        return start + 1, 0
    while cells and not cells[-1]:
        cells.pop()
    leading = {width: 0, width + 2: 2}.get(len(cells))
    if leading is None:
        raise CaptureError(
            f"line {start + 1} has {len(cells)} cells, expected {width}, or {width + 2} with frame and time"
        )
    return start, leading


def read_table(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the markers in the bytes of a table with times [s] and three columns for each marker.

    The three columns have one name, or names that end with x, y and z. The unit of length is inferred from
    the extent of the points of a frame.
    """
    lines, ended = split_lines(data)
    lines = plain_lines(lines, max(b",", b";", TAB, key=lines[0].count))
    titles = header_cells(lines[0], 1)
    num_leading = next((n for n, title in enumerate(titles) if not _LEADING_TITLE.match(title)), len(titles))
    timed = next((n for n in range(num_leading) if titles[n].lower().startswith("time")), None)
    names = [_marker_name(titles[n : n + 3]) for n in range(num_leading, len(titles), 3)]
    if timed is None or not names or "" in names:
        raise CaptureError(
            "not a table of markers: expected a line of column names, one of them 'time' (in seconds) and "
            "three for each marker (RH1_x, RH1_y, RH1_z), or the export of a program: a CSV of Motive begins "
            "with 'Format Version', one of Vicon has a line 'Trajectories', a TSV of Qualisys begins with "
            "'NO_OF_FRAMES' or 'FILE_VERSION'; arrays become a gloves.Capture"
        )
    axes = len(lines) > 1 and {cell.lower() for cell in header_cells(lines[1], 2)[num_leading:]} <= set("xyz")
    first = num_leading + 3 * np.arange(len(names))
    columns = TableColumns(titles, names, first, np.ones(len(names)))
    rows, read = parse_table(lines, columns, start=1 + axes, ended=ended)
    leading = np.stack([np.full(len(rows), np.nan), rows[:, timed]], axis=1)
    capture = _timed_capture(read, leading, {}, ("the rate", "the number of frames"), warn)
    fault = unit_fault(unlabeled_frames(capture))
    unit = "meters" if fault is None else fault.guess
    warn(f"the table states no unit of length, read as {unit}")
    return replace(capture, positions=capture.positions * meters_per(unit))


def _marker_name(titles: list[str]) -> str:
    """Name of the marker whose coordinates have these titles; empty if it is not one marker."""
    axes = [found for title in titles if (found := _AXIS_TITLE.fullmatch(title))]
    if [axis[2].lower() for axis in axes] == ["x", "y", "z"]:
        titles = [axis[1] for axis in axes]
    titles = [copy[1] if (copy := _COPY_TITLE.fullmatch(title)) else title for title in titles]
    return titles[0] if len(titles) == 3 and len(set(titles)) == 1 else ""


def _read_tsv(data: bytes, warn: Warn) -> Capture:
    """Read a TSV of Qualisys or another table, depending on its content."""
    qualisys = separator_behind(_QTM_BEGINS, split_lines(data[:_FIRST_BYTES])[0][0]) is not None
    return read_qtm_tsv(data, warn) if qualisys else read_table(data, warn)


def _read_csv(data: bytes, warn: Warn) -> Capture:
    """Read a CSV of Motive or of Vicon, or another table, depending on its content."""
    if separator_behind([MOTIVE_BEGIN], split_lines(data[:_FIRST_BYTES])[0][0]) is not None:
        return read_motive_csv(data, warn)
    if vicon_sections(split_lines(data)[0]):
        return read_vicon_csv(data, warn)
    return read_table(data, warn)


_READERS: Final = {".trc": read_trc, ".c3d": read_c3d, ".csv": _read_csv, ".tsv": _read_tsv}
_TEXT_WRITERS: Final = {".trc": write_trc, ".csv": write_motive_csv}
READABLE: Final = tuple(_READERS)


def read_capture(capture: Capture | str | Path) -> Capture:
    """Read a `.trc` or `.c3d` file, a `.csv` of Motive or Vicon, a `.tsv` of Qualisys, or another table.

    Args:
        capture: The file, whose suffix decides the format; a `Capture` is returned as it is.

    Returns:
        Positions (T, N, 3) in [m], whatever the file's unit, with one trajectory per column, and the rate
        [Hz].

    Raises:
        ArgumentError: `capture` is neither a path nor a capture.
        CaptureError: The suffix is unknown, the file is missing, cut or damaged, or its unit is unknown or
            cannot be that of its positions.

    Warns:
        HandSimWarning: Points at exactly (0, 0, 0) were taken as missing, or the file states no unit or rate,
            or contradicts itself.
    """
    if isinstance(capture, Capture):
        return capture
    check_type("capture", capture, (str, Path), "a Capture or the path of a file", READABLE)
    path = Path(capture)
    if path.suffix.lower() in _FOREIGN_ENDINGS:
        raise CaptureError(f"{path}: {_FOREIGN_ENDINGS[path.suffix.lower()]}; expected {', '.join(READABLE)}")
    check_suffix(path, READABLE)
    data = read_bytes(path, error=CaptureError)
    if not data:
        raise CaptureError(f"{path}: the file is empty")

    def warn(text: str) -> None:
        warnings.warn(f"{path}: {text}", HandSimWarning, stacklevel=3)

    try:
        return _checked_capture(path, _READERS[path.suffix.lower()](data, warn))
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}{_content_hint(data, str(error))}") from error
    except MemoryError as error:
        raise CaptureError(
            f"{path}: the {len(data) / 1e6:.0f} MB of the file do not fit in memory; export a part of the "
            "take, or fewer columns"
        ) from error


def _content_hint(data: bytes, error: str) -> str:
    """A clause that names the format of the content, if an error states that it is another one."""
    begin = data[:_FIRST_BYTES].removeprefix(codecs.BOM_UTF8).lstrip(_BLANK_BYTES).lower()
    found = next((text for word, text in _FOREIGN_BEGINS.items() if begin.startswith(word)), None)
    return f"; this is {found}" if found and error.startswith("not a ") else ""


def _checked_capture(path: Path, capture: Capture) -> Capture:
    """Keep the measured points of a capture; refuse positions that cannot be in the unit of the file."""
    capture = settled(capture)
    if capture.findings:
        warnings.warn(f"{path}: {findings_sentence(capture.findings)}", HandSimWarning, stacklevel=3)
    clouds = unlabeled_frames(capture)
    if all_at_origin(clouds):
        raise CaptureError(f"{AT_ORIGIN}, expected positions of markers")
    fault = unit_fault(clouds)
    if fault is not None:
        raise CaptureError(
            f"by the unit of length that the file states, {fault.found}; correct that unit, probably "
            f"to {fault.guess}"
        )
    return capture


def write_capture(path: str | Path, capture: Capture, *, source: str | Path | None = None) -> None:
    """Write a `.trc`, `.c3d` or Motive `.csv` file in millimeters, whole or not at all.

    A TRC keeps positions to 5e-9 m, a CSV to 5e-10 m; a C3D keeps single precision (6e-8 of the value).

    Args:
        path: The file; its suffix decides the format.
        capture: Positions (T, N, 3) [m] at a rate [Hz].
        source: The file the points came from; of a C3D, another C3D keeps analogs, events and parameters.

    Raises:
        ArgumentError: An argument is of another type.
        CaptureError: The suffix is unknown, a name cannot be written to the file, or writing fails.
    """
    check_type("path", path, (str, Path), "the path of a file", WRITABLE)
    expected = "a Capture, as read_capture, Take.capture() or Take.labeled_capture() give it"
    check_type("capture", capture, Capture, expected)
    path = Path(path)
    check_suffix(path, WRITABLE)
    kept = None
    if source is not None:
        check_type("source", source, (str, Path), "the path of a file")
        if Path(source).suffix.lower() == ".c3d":
            kept = read_bytes(Path(source), error=CaptureError)
    for name in capture.names:
        if not name or name != name.strip() or not name.isprintable():
            raise CaptureError(
                f"{path}: marker name {name!r} cannot be written; expected printable characters without "
                "tabs, line ends or outer blanks"
            )
    with writing(path, CaptureError), errors_of(path, CaptureError), atomic_write(path) as temporary:
        if path.suffix.lower() in _TEXT_WRITERS:
            _TEXT_WRITERS[path.suffix.lower()](temporary, capture, title=as_text(path.name))
        else:
            write_c3d(temporary, capture, kept)


def check_suffix(path: Path, valid: tuple[str, ...]) -> None:
    """Refuse a folder, and a path without one of the valid suffixes."""
    if path.is_dir():
        raise CaptureError(f"{path}: this is a folder, expected a file ({', '.join(valid)})")
    if path.suffix.lower() not in valid:
        raise CaptureError(f"{path}: {choices(path.suffix, valid, noun='file type')}")


def find_captures(paths: Sequence[Path], endings: Sequence[str] = READABLE) -> list[Path]:
    """The given capture files, and those in the given folders, whose names have one of the endings."""
    files = []
    for path in paths:
        inside = [path]
        if path.is_dir():
            inside = sorted(file for file in path.rglob("[!.]*") if file.suffix.lower() in endings)
        if not inside:
            raise CaptureError(f"{path} holds no capture; expected files {', '.join(endings)}")
        files += inside
    return files


def read_hands(file: Path, names: Sequence[str]) -> tuple[list[Float[np.ndarray, "T M 3"]], float]:
    """The `select_hands` of a labeled capture [m], and its rate [Hz]."""
    capture = read_capture(file)
    with errors_of(file, CaptureError):
        return select_hands(capture, names), capture.rate
