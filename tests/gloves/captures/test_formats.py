"""TRC: what real files do, and where exactly a broken one breaks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, read_capture, write_capture
from gloves.captures.capture import select_hands
from gloves.captures.formats import read_hands, read_motive_csv, read_qtm_tsv, read_trc, read_vicon_csv
from handsim.errors import CaptureError, HandSimWarning
from tests.sentences import error_names

ROW = "0\t0\t1\t2\t3\t4\t5\t6"
POINTS = np.array([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]])
# Type, name, quantities and axes of each asset; a number a column counts up from the left.
BODY = ("Rigid Body", "Cube", ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"], [*"XYZWXYZ", ""])
BODY_MARKER = ("Rigid Body Marker", "Cube:Marker1", ["Position"] * 3 + ["Marker Quality"], [*"XYZ", ""])
LABELED = ("Marker", "Glove:ThumbTip", ["Position"] * 3, [*"XYZ"])
UNLABELED = ("Marker", "Unlabeled 2379", ["Position"] * 3, [*"XYZ"])
QUOTED = ("Marker", "Glove, left:1", ["Position"] * 3, [*"XYZ"])
OF_TRC = {"mm": 1e-3, "MM": 1e-3, "cm": 1e-2, "m": 1.0, "Meters": 1.0, " Millimeters ": 1e-3}
OF_MOTIVE = {"Meters": 1.0, "Centimeters": 1e-2, "Millimeters": 1e-3, None: 1.0, "": 1.0}
UNITS = [("trc", *one) for one in OF_TRC.items()] + [("motive", *one) for one in OF_MOTIVE.items()]
DEVICES = """\
Devices
1000
,,Force Plate - Force,,
Frame,Sub Frame,Fx,Fy,Fz
,,N,N,N
1,0,1,2,3
1,1,Trajectories,5,6

"""
OUTPUTS = """\
Model Outputs
100
,,Anna:Angles,,
Frame,Sub Frame,X,Y,Z
,,deg,deg,deg
1,0,90,91,92
2,0,93,94,95

"""
WANTED = (10 * np.arange(3)[:, None] + np.arange(9) + 0.5).reshape(3, 3, 3) * 1e-3
NAMES = ("Anna:ThumbTip", "*2", "*12")
HAND = np.array([[12.5, 34.25, 56], [40, 30, 20], [60.5, 10, 15], [75, 0.5, 5], [90, 8, 1]])
MARKERS = ("ThumbTip", "IndexTip", "PinkyTip")


def trc(
    *rows: str,
    units: str = "mm",
    names: str = "Frame#\tTime\ta\t\t\tb\t\t\t",
    axes: str = "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\t",
    rate: str = "120",
    end: str = "\n",
) -> bytes:
    """A file of two markers; the header's marker count is wrong on purpose."""
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"
    values = f"{rate}\t120\t{len(rows)}\t7\t{units}"
    return ("\n".join(["PathFileType\t4\t(X/Y/Z)\tx.trc", keys, values, names, axes, *rows]) + end).encode()


def row(number: int, cells: str = ROW) -> str:
    """A row of some frame at 120 Hz."""
    return f"{number}\t{number / 120:.6f}\t" + cells.split("\t", 2)[2]


@pytest.mark.parametrize("columns", ["17\t", "\t", "\t17.5"])
def test_numbers_and_times_may_be_absent(columns: str) -> None:
    rows = (
        [ROW.replace("0\t0\t", columns + "\t", 1)] * 3
        if columns == "\t"
        else [columns + "\t" + ROW.split("\t", 2)[2], ROW.replace("0\t0\t", "\t\t", 1)]
    )
    positions = read_trc(trc(*rows)).positions
    np.testing.assert_allclose(positions, np.repeat(POINTS, len(rows), axis=0) * 1e-3)


@pytest.mark.parametrize(
    "cells",
    [
        "0\t0\t1\t2\t3\t\t\t",
        "0\t0\t1\t2\t3\t\t\t\t",
        "0\t0\t1\t2\t3\t \t \t ",
        "0\t0\t1\t2\t3",
        "0\t0\t1\t2\t3\tnan\tNaN\tNAN",
        "0\t0\t1\t2\t3\t4\t5",
    ],
)
def test_missing_cells(cells: str) -> None:
    positions = read_trc(trc(cells, row(1))).positions
    np.testing.assert_allclose(positions[0, 0], [1e-3, 2e-3, 3e-3])
    assert np.isnan(positions[0, 1]).all()
    np.testing.assert_allclose(positions[1], POINTS[0] * 1e-3)


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.replace(b"\n", b"\r\n"),
        lambda data: data.replace(b"\n", b"\r"),
        lambda data: b"\xef\xbb\xbf" + data,
        lambda data: data.replace(b"\n0\t", b"\n\n0\t", 1),
        lambda data: data.replace(b"\n0\t", b"\n\t\t\n \n0\t", 1),
        lambda data: data + b"\n \n\n",
        lambda data: data[:-1],
        lambda data: data[:-1] + b"\t\n",
        lambda data: data[:-1] + b"  ",
        lambda data: data.replace(b"\ta\t\t\tb\t\t\t", b"\ta\tb"),
        lambda data: data.replace(b"\ta\t\t\tb\t\t\t", b"\ta\t\t\tb"),
        lambda data: data.replace(b"\ta\t\t\tb\t\t\t", b"\ta\t\tb"),
        lambda data: data.replace(b"#\tTime\ta", b"#\t\tTime\t\ta").replace(b"\t\t\tb", b"\t\tb"),
        lambda data: data.replace(b"120\t120\t1\t7\tmm", b" 120.0\t\t120.0\t\t 1\t\t7\t\t mm"),
        lambda data: data.replace(b"PathFileType\t4\t", b"PathFileType  4\t"),
        lambda data: data.replace(b"\t", b","),
        lambda data: data.replace(b"\n0\t", b"\n\t\t\t\t\t\t\t\n0\t", 1).replace(b"\t", b","),
    ],
)
def test_dialects(change: Callable[[bytes], bytes]) -> None:
    capture = read_trc(change(trc(ROW)))
    np.testing.assert_allclose(capture.positions, POINTS * 1e-3)
    assert capture.names == ("a", "b")


def test_blank_name_in_the_middle() -> None:
    assert read_trc(trc(ROW, names="Frame#\tTime\t\t\t\tb\t\t\t")).names == ("*1", "b")


@pytest.mark.parametrize("delimiter", [b"\t", b","])
def test_trajectories_without_a_name_follow_those_with_one(delimiter: bytes) -> None:
    """Cortex writes them into rows of any length; line 4 and the header's count do not know of them."""
    rows = (ROW + "\t7\t8\t9\t\t\t\t10\t11\t12\t", row(1), row(2) + "\t1\t2\t3")
    capture = read_trc(trc(*rows).replace(b"\t", delimiter))
    assert capture.names == ("a", "b", "*3", "*4", "*5")
    np.testing.assert_allclose(capture.positions[:, :2], np.repeat(POINTS, 3, axis=0) * 1e-3)
    np.testing.assert_allclose(capture.positions[[0, 0, 2], [2, 4, 2], 0], [7e-3, 10e-3, 1e-3])
    assert np.isnan(capture.positions[[0, 1, 1, 2], [3, 2, 4, 4]]).all()


def test_no_trajectory_has_a_name() -> None:
    capture = read_trc(trc(ROW, names="Frame#\tTime\t", axes="\t\t"))
    assert capture.names == ("*1", "*2")
    np.testing.assert_allclose(capture.positions, POINTS * 1e-3)


@pytest.mark.parametrize("rate", ["0", "", "?"])
def test_a_rate_that_only_the_times_state_is_told(rate: str) -> None:
    told: list[str] = []
    rows = [ROW.replace("0\t0", f"{frame}\t{frame / 90.0:.4f}", 1) for frame in range(8)]
    capture = read_trc(trc(*rows, rate=rate), told.append)
    assert capture.rate == pytest.approx(90.0, rel=1e-3)
    found = f"'{rate}'" if rate else "not stated"
    assert told == [f"DataRate is {found}; by the column of times it is 89.9743 Hz"]


def test_what_we_write_ends_its_rows_and_their_header_in_a_tab(tmp_path: Path) -> None:
    """OpenSim drops a blank cell at the very end of a row; other programs count the cells of all lines."""
    positions = np.random.default_rng(5).normal(size=(3, 4, 3))
    positions[1, 3] = np.nan
    capture = Capture(("a", "b", "c d", "*4"), positions, 100.0)
    write_capture(tmp_path / "take.trc", capture)
    lines = (tmp_path / "take.trc").read_text().split("\n")
    assert [len(line.split("\t")) for line in lines] == [4, 8, 8, 15, 15, 1, 15, 15, 15, 1]
    for line in (*lines[3:5], *lines[6:9]):
        # What a reader sees that drops one blank cell at the end of a line, as OpenSim does.
        assert line.endswith("\t")
        assert len(line.removesuffix("\t").split("\t")) == 2 + 3 * 4
    np.testing.assert_allclose(read_capture(tmp_path / "take.trc").positions, positions, atol=1e-8)


def test_opensim_reads_a_row_whose_last_marker_is_missing(tmp_path: Path) -> None:
    opensim = pytest.importorskip("opensim")
    positions = np.random.default_rng(6).normal(size=(4, 3, 3))
    positions[1, 2] = positions[2] = positions[3, 0] = np.nan
    write_capture(tmp_path / "take.trc", Capture(("a", "b", "c"), positions, 100.0))
    table = opensim.TimeSeriesTableVec3(str(tmp_path / "take.trc"))
    assert table.getColumnLabels() == ("a", "b", "c")
    rows = [table.getRowAtIndex(row) for row in range(table.getNumRows())]
    read = np.array([[[row[column][axis] for axis in range(3)] for column in range(3)] for row in rows])
    np.testing.assert_allclose(read * 1e-3, positions, atol=1e-8)


def test_every_cut_is_told_or_harmless(tmp_path: Path) -> None:
    """Cut anywhere after the first row, a file of ours gives whole frames only, or an error."""
    positions = np.random.default_rng(1).normal(size=(3, 2, 3))
    positions[1, 1] = positions[2, 1] = np.nan
    path = tmp_path / "take.trc"
    write_capture(path, Capture(("a", "b"), positions, 120.0))
    data = path.read_bytes()
    first_row_ends = data.index(b"\n", data.index(b"\n1\t") + 1) + 1
    told = 0
    for length in range(1, len(data)):
        try:
            read = read_trc(data[:length]).positions
        except CaptureError:
            told += 1
        else:
            if length >= first_row_ends:
                np.testing.assert_allclose(read, positions[: len(read)], atol=1e-8)
    assert told > len(data) - first_row_ends - 6


BAD = {
    "not TRC": (b"Frame,Time\n1,2\n", "not a TRC file | line 1 | 'PathFileType'"),
    "header only": (trc(), "no frames"),
    "header cut after line 3": (
        trc(ROW)[: trc(ROW).index(b"Frame#")],
        "header is cut | 5 whole lines | got 3",
    ),
    "header cut in line 4": (trc(ROW)[:130], "header is cut | 5 whole lines | got 4"),
    "header cut in line 5": (trc(end=""), "header is cut | 5 whole lines | got 4"),
    "unknown unit": (trc(ROW, units="inches"), "'inches' | mm, cm, m"),
    "no unit": (trc(ROW, units=""), "lines 2 and 3 | Units"),
    "rate is a word": (trc(ROW, rate="fast"), "DataRate is 'fast' | positive number"),
    "rate is zero": (trc(ROW, rate="0"), "DataRate is '0' | positive number"),
    "rate is missing": (trc(ROW, rate=""), "DataRate is not stated | positive number"),
    "no markers": (trc("0\t0", names="Frame#\tTime\t\t"), "no markers | line 4 | 'Frame#', 'Time'"),
    "line 4 holds no names": (trc(ROW, names="1\t0\t1\t2\t3"), "no markers | line 4 | 'Frame#', 'Time'"),
    "names and axes differ": (trc(ROW, names="Frame#\tTime\ta\tb\tc"), "line 4 | 3 marker names | 6 axes"),
    "a word": (trc(ROW, "1\t0\t1\t2\t3\t4\tfive\t6"), "line 7, column 7 (b Y) | 'five'"),
    "a decimal comma": (
        trc(ROW, "1\t0\t1,5\t2.5\t3\t4\t5\t6"),
        "line 7, column 3 (a X) | '1,5' | decimal points",
    ),
    "a word for a frame number": (trc("first" + ROW), "line 6, column 1 (frame number) | 'first0'"),
    "infinite": (trc(ROW, ROW.replace("6", "inf")), "line 7, column 8 (b Z) | infinite | finite number"),
    "too many cells": (trc(ROW, ROW + "\t\t7"), "line 7 | 10 cells | expected 8"),
    "last row cut between cells": (trc(ROW, "1\t0\t1\t2\t3\t4", end=""), "truncated | line 7 | 6 of 8 cells"),
    "last row cut in its frame number": (trc(ROW, "1", end=""), "truncated | line 7 | 1 of 8 cells"),
    "last row cut in its last cell": (trc(ROW + "\t", ROW, end=""), "truncated | line 7 | 8 of 9 cells"),
    "only row cut": (trc(ROW[:-4], end=""), "truncated | line 6 | 6 of 8 cells"),
}


@pytest.mark.filterwarnings("ignore:.*frames are missing")
def test_all_published_captures_read(sig18):
    paths = sorted(sig18.rglob("*.trc"))
    assert len(paths) == 336
    num_frames = 0
    for path in paths:
        capture = read_capture(path)
        assert capture.positions.shape[1:] == (19, 3) and capture.rate == 120.0
        assert (capture.names[0], capture.names[-1]) == ("ThumbCMC", "BackHand3")
        there = np.isfinite(capture.positions).all(axis=(1, 2))
        assert np.isnan(capture.positions[~there]).all()  # numbers of frames jump in some files
        assert np.abs(capture.positions[there]).max() < 3.0, "meters"
        num_frames += there.sum()
    assert num_frames == 61_941


def motive(
    *assets: tuple[str, str, list[str], list[str]],
    parent: bool = False,
    timecode: bool = False,
    unit: str | None = "Meters",
    rows: int = 3,
    first: str = "Format Version,1.23,Take Name,take 1,Take Notes,,Capture Frame Rate,240.000000",
) -> str:
    lead = ["", ""] + [""] * timecode
    head = f"{first},Export Frame Rate,120.000000,Rotation Type,Quaternion"
    head += f",Length Units,{unit},Coordinate Space,Global" if unit else ""
    labels = ["Type", "Name", "ID"] + ["Parent"] * parent
    columns = [[], [], [], []]  # type, name, quantity, axis
    for kind, name, quantities, axes in assets:
        for quantity, axis in zip(quantities, axes, strict=True):
            quoted = f'"{name}"' if "," in name else name
            for column, value in zip(columns, (kind, quoted, quantity, axis), strict=True):
                column.append(value)
    width = len(columns[0])
    values = {"Type": columns[0], "Name": columns[1], "ID": ['"AB:12"'] * width, "Parent": ["Cube"] * width}
    lines = [head, ""]
    lines += [",".join(["", label, *lead[2:], *values[label]]) for label in labels]
    lines.append(",".join(lead + columns[2]))
    lines.append(",".join(["Frame", "Time (Seconds)", *["TimeCode"] * timecode, *columns[3]]))
    for row in range(rows):
        start = [str(72210 + row), f"{row / 120:.6f}"] + ["15:26:46:12.02"] * timecode
        lines.append(",".join(start + [f"{row + column / 100:.6f}" for column in range(width)]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("parent", [False, True])
@pytest.mark.parametrize("timecode", [False, True])
def test_markers_are_found_by_type_and_label(parent: bool, timecode: bool) -> None:
    text = motive(BODY, BODY_MARKER, LABELED, BODY, UNLABELED, QUOTED, parent=parent, timecode=timecode)
    capture = read_motive_csv(text.encode())
    assert capture.names == ("Glove:ThumbTip", "Unlabeled 2379", "Glove, left:1")
    assert capture.rate == 120.0
    starts = np.array([12, 23, 26])
    wanted = np.arange(3)[:, None, None] + (starts[:, None] + np.arange(3)) / 100
    np.testing.assert_allclose(capture.positions, wanted)


@pytest.mark.parametrize(("kind", "unit", "meters"), [*UNITS, ("vicon", "cm", 1e-2), ("vicon", "m", 1.0)])
def test_units(kind, unit, meters):
    if kind == "trc":
        read, expected = read_trc(trc(ROW, units=unit)), POINTS
    elif kind == "motive":
        text = motive(UNLABELED, unit=unit, rows=1).encode()
        read, expected = read_motive_csv(text, [].append), np.array([[[0.0, 0.01, 0.02]]])
    else:
        read, expected = read_vicon_csv(nexus(unit=unit).encode()), WANTED * 1e3
    np.testing.assert_allclose(read.positions, expected * meters)


def test_a_file_without_a_unit_is_told() -> None:
    told: list[str] = []
    read_motive_csv(motive(UNLABELED, unit=None).encode(), told.append)
    assert told == [
        "line 1 states no Length Units, read as meters, which Motive writes unless told otherwise"
    ]


@pytest.mark.parametrize("version", ["1.20", "1.21"])
def test_rows_without_labels(version: str) -> None:
    """Motive 1.x wrote the same rows, types first, without the labels Type, Name and ID."""
    text = motive(BODY, BODY_MARKER, LABELED, UNLABELED).replace("1.23", version)
    for label in ("Type", "Name", "ID"):
        text = text.replace(f"\n,{label},", "\n,,")
    capture = read_motive_csv(text.encode())
    assert capture.names == ("Glove:ThumbTip", "Unlabeled 2379")
    np.testing.assert_allclose(capture.positions[0], [[0.12, 0.13, 0.14], [0.15, 0.16, 0.17]])


def test_what_we_write_is_laid_out_as_motive_lays_it_out(tmp_path: Path) -> None:
    positions = np.array([[[0.1, -0.2, 0.3], [np.nan] * 3], [[0.4, 0.5, 0.6], [1e-7, 2.0, -3.0]]])
    write_capture(tmp_path / "my take.csv", Capture(("right:ThumbTip", 'a,"b'), positions, 100.0))
    lines = (tmp_path / "my take.csv").read_text().split("\n")
    stated = lines[0].split(",")
    assert dict(zip(stated[::2], stated[1::2], strict=True)) == {
        "Format Version": "1.23",
        "Take Name": "my take",
        "Take Notes": "",
        "Capture Frame Rate": "100.000000",
        "Export Frame Rate": "100.000000",
        "Capture Start Time": "",
        "Total Frames in Take": "2",
        "Total Exported Frames": "2",
        "Rotation Type": "Quaternion",
        "Length Units": "Millimeters",
        "Coordinate Space": "Global",
    }
    assert lines[1:] == [
        "",
        ",Type,Marker,Marker,Marker,Marker,Marker,Marker",
        ',Name,right:ThumbTip,right:ThumbTip,right:ThumbTip,"a,""b","a,""b","a,""b"',
        ",ID," + ",".join(3 * [31 * "0" + "1"] + 3 * [31 * "0" + "2"]),
        ",,Position,Position,Position,Position,Position,Position",
        "Frame,Time (Seconds),X,Y,Z,X,Y,Z",
        "0,0.000000,100.000000,-200.000000,300.000000,,,",
        "1,0.010000,400.000000,500.000000,600.000000,0.000100,2000.000000,-3000.000000",
        "",
    ]


def test_blank_cells_are_gaps() -> None:
    lines = motive(LABELED, UNLABELED).splitlines()
    lines[-3] = "1,0.000000,0.1,0.2,0.3,,,"
    lines[-2] = "2,0.008333,,,,0.4,0.5,0.6"
    lines[-1] = "3,0.016667,,,,,,"
    positions = read_motive_csv("\r\n".join(lines).encode()).positions
    nan = [np.nan] * 3
    np.testing.assert_allclose(positions, [[[0.1, 0.2, 0.3], nan], [nan, [0.4, 0.5, 0.6]], [nan, nan]])


MOTIVE = motive(LABELED, UNLABELED)
BAD_MOTIVE = {
    "only rigid bodies": (motive(BODY, BODY_MARKER), "no markers | 'Marker' | Rigid Body, Rigid Body Marker"),
    "no columns": (motive(), "no markers | 'Marker' | 'Position' | none"),
    "unknown unit": (motive(LABELED, unit="Feet"), "'Feet' | mm, cm, m"),
    "no rate": (
        motive(LABELED, rows=2, first="Format Version,1.23").replace("Export Frame Rate,120.000000", "x,y"),
        "Capture Frame Rate is not stated | positive number",
    ),
    "no frames": (motive(LABELED, rows=0), "no frames"),
    "header cut": (MOTIVE[: MOTIVE.index("Frame,")], "header is cut | 'Frame'"),
    "header cut in its last row": (MOTIVE[: MOTIVE.index("Frame,") + 12], "header is cut | 'Frame'"),
    "no Type row": (MOTIVE.replace(",Type,", ",Kind,"), "not a Motive CSV | 'Type'"),
    "axes out of order": (MOTIVE.replace("X,Y,Z", "X,Z,Y"), "column 3 | X, Y, Z | got X, Z, Y"),
    "a word": (MOTIVE.replace("1.010000", "one"), "line 9, column 4 (Glove:ThumbTip Y) | 'one'"),
    "row too long": (MOTIVE.rstrip() + ",5\n", "line 10 | 9 cells | expected 8"),
    "last row cut": (MOTIVE[: MOTIVE.rindex(",")], "truncated | line 10 | 7 of 8 cells"),
}


def nexus(
    *,
    names: tuple[str, ...] = ("Anna:ThumbTip", "", "*12"),
    unit: str | None = "mm",
    rate: str = "100",
    title: str = "Trajectories",
    rows: int = 3,
    first: tuple[str, ...] = ("Frame", "Sub Frame"),
) -> str:
    """Numbers count up from the left, row by row."""
    leads = ["", ""][: len(first)]
    lines = [title, rate, ",".join(leads + [cell for name in names for cell in (name, "", "")])]
    lines.append(",".join([*first, *"XYZ" * len(names)]))
    if unit is not None:
        lines.append(",".join(leads + [unit] * (3 * len(names))))
    for row in range(rows):
        start = [str(row + 71), "0"][: len(first)]
        lines.append(",".join(start + [f"{10 * row + column + 0.5}" for column in range(3 * len(names))]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("before", ["", "\n\n", DEVICES, OUTPUTS, DEVICES + OUTPUTS])
@pytest.mark.parametrize("behind", ["", "\n", "\n" + OUTPUTS, "\n" + DEVICES])
def test_the_section_is_found_among_others(tmp_path: Path, before: str, behind: str) -> None:
    path = tmp_path / "take.csv"
    path.write_text(before + nexus() + behind)
    capture = read_capture(path)
    assert (capture.names, capture.rate) == (NAMES, 100.0)
    np.testing.assert_allclose(capture.positions, WANTED)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace(",", ";"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", ",,,,\n"),
        lambda text: text.replace("Trajectories", '"Trajectories"'),
        lambda text: text.replace("Anna:ThumbTip", '"Anna:ThumbTip"'),
        lambda text: text[:-1],
    ],
)
def test_dialects_of_vicon(change: Callable[[str], str]) -> None:
    capture = read_vicon_csv(change(nexus()).encode())
    assert (capture.names, capture.rate) == (NAMES, 100.0)
    np.testing.assert_allclose(capture.positions, WANTED)


def test_workstation_states_no_unit() -> None:
    told: list[str] = []
    text = "Title\nNotes:,\n\n" + nexus(unit=None, rate="100,Hz", title="TRAJECTORIES", first=("Field #",))
    capture = read_vicon_csv(text.encode(), told.append)
    assert (capture.names, capture.rate) == (NAMES, 100.0)
    np.testing.assert_allclose(capture.positions, WANTED)
    assert told == ["the file states no unit of length, read as millimeters, which Vicon's programs write"]


def test_blank_cells_are_gaps_of_vicon() -> None:
    text = nexus().replace("10.5,11.5,12.5", ",,").replace("26.5,27.5,28.5", ",,")
    missing = np.isnan(read_vicon_csv(text.encode()).positions[..., 0])
    assert missing.tolist() == [[False] * 3, [True, False, False], [False, False, True]]


NEXUS = nexus()
BAD_NEXUS = {
    "other sections": (DEVICES + OUTPUTS, "'Trajectories' | Devices, Model Outputs"),
    "the word alone": (
        "Trajectories\n\n",
        "not a table of markers | 'Format Version' | 'Trajectories'",
    ),
    "header cut": (NEXUS[: NEXUS.index("Frame")], "header is cut | rate, names and axes | 'Trajectories'"),
    "header cut in its axes": (NEXUS[: NEXUS.index("Frame") + 20], "header is cut | rate, names and axes"),
    "no frame in the axes": (NEXUS.replace("Frame,Sub Frame", "Number,Other"), "line 4 | 'Number' | 'Frame'"),
    "no axes": (NEXUS.replace("X,Y,Z", "A,B,C"), "no markers | line 4 | X, Y, Z"),
    "unknown unit": (nexus(unit="deg"), "'deg' | mm, cm, m"),
    "no rate": (nexus(rate="0"), "'0' | positive number"),
    "no frames": (nexus(rows=0), "no frames"),
    "a word": (NEXUS.replace("11.5", "eleven"), "line 7, column 4 (Anna:ThumbTip Y) | 'eleven'"),
    "a decimal comma": (
        NEXUS.replace(",", ";").replace("11.5", "11,5"),
        "line 7, column 4 (Anna:ThumbTip Y) | '11,5' | decimal points",
    ),
    "row too long": (NEXUS.rstrip() + ",5\n", "line 8 | 12 cells | expected 11"),
    "last row cut": (NEXUS[: NEXUS.rindex(",")], "truncated | line 8 | 10 of 11 cells"),
}


def qtm(
    *,
    rows: int = 3,
    version: bool = False,
    columns: bool = True,
    leading: bool = True,
    ends: str = "",
    names: tuple[str, ...] = ("ThumbTip", "New 0001"),
    markers: str | None = None,
    stated: str | None = None,
    frequency: str = "100",
    included: str = "3D",
    events: tuple[str, ...] = (),
) -> str:
    """Numbers count up from the left, row by row."""
    width = 3 * (len(names) if markers is None else int(markers))
    lines = ["FILE_VERSION\t2.0.0"] * version
    lines += [f"NO_OF_FRAMES\t{rows if stated is None else stated}", "NO_OF_CAMERAS\t12"]
    lines += [f"NO_OF_MARKERS\t{len(names) if markers is None else markers}", f"FREQUENCY\t{frequency}"]
    lines += ["NO_OF_ANALOG\t0", "ANALOG_FREQUENCY\t0", "DESCRIPTION\t--"]
    lines += ["TIME_STAMP\t2025-01-19, 10:19:43.755\t2063631.96175450", f"DATA_INCLUDED\t{included}"]
    lines += [f"EVENT\t{event}\t1\t0.00000" for event in events]
    lines += [
        "\t".join(["MARKER_NAMES", *names]),
        "\t".join(["TRAJECTORY_TYPES", *["Measured"] * len(names)]),
    ]
    if columns:
        axes = [f"{name} {axis}" for name in names for axis in "XYZ"]
        lines.append("\t".join(["Frame", "Time"] * leading + axes))
    for row in range(rows):
        start = [str(row + 1), f"{row / 100:.5f}"] * leading
        lines.append("\t".join(start + [f"{10 * row + column + 0.5:.3f}" for column in range(width)]) + ends)
    return "\n".join(lines) + "\n"


def wanted(num_markers: int) -> np.ndarray:
    return (10 * np.arange(3)[:, None] + np.arange(3 * num_markers) + 0.5).reshape(3, -1, 3) * 1e-3


@pytest.mark.parametrize("version", [False, True])
@pytest.mark.parametrize("columns", [False, True])
@pytest.mark.parametrize("leading", [False, True])
@pytest.mark.parametrize("ends", ["", "\t"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_every_setting_of_the_export(version, columns, leading, ends, line_end):
    text = qtm(version=version, columns=columns, leading=leading, ends=ends, events=("Start", "Stop"))
    capture = read_qtm_tsv(text.replace("\n", line_end).encode())
    assert (capture.names, capture.rate) == (("ThumbTip", "New 0001"), 100.0)
    np.testing.assert_allclose(capture.positions, wanted(2))


def test_blank_cells_and_zeros_are_gaps(tmp_path: Path) -> None:
    text = qtm().replace("10.500\t11.500\t12.500", "\t\t")
    text = text.replace("23.500\t24.500\t25.500", "0.000\t0.000\t0.000")
    text = text.replace("3.500\t4.500\t5.500", "0.000\t0.000\t0.000", 1)
    (tmp_path / "take.tsv").write_text(text)
    with pytest.warns(match="2 points at exactly"):
        positions = read_capture(tmp_path / "take.tsv").positions
    assert np.isnan(positions[..., 0]).tolist() == [[False, True], [True, False], [False, True]]


def test_a_marker_without_a_name_gets_one() -> None:
    capture = read_qtm_tsv(qtm(names=("a", "", "c"), markers="4", columns=False).encode())
    assert capture.names == ("a", "*2", "c", "*4")
    np.testing.assert_allclose(capture.positions, wanted(4))


def test_more_frames_than_stated_are_told() -> None:
    told: list[str] = []
    assert read_qtm_tsv(qtm(stated="2").encode(), told.append).num_frames == 3
    assert told == ["NO_OF_FRAMES is 2, and 3 frames are there; all are read"]


def table(titles: Sequence[str], behind: str = "", scale: float = 1.0, separator: str = ",") -> str:
    """A hand that moves along x in a table with this line of names, and another line behind it."""
    rows = [[0.01 * n, *(scale * (HAND + [n, 0.0, 0.0])).ravel()] for n in range(20)]
    lines = [separator.join(f"{value:.6g}" for value in row) for row in rows]
    return "\n".join([separator.join(["Time (s)", *titles]), *([behind] if behind else []), *lines, ""])


def titled(*ends: str) -> list[str]:
    return [f"{name}{end}" for name in ("RH1", "Index", "RIF2", "RIF3", "RIF4") for end in ends]


@pytest.mark.parametrize("scale", [1e-3, 0.1, 1.0])
@pytest.mark.parametrize(
    ("titles", "behind", "separator"),
    [
        (titled("", "", ""), "", ","),
        (titled("", "", ""), "," + ",".join("xyz" * 5), ","),
        (titled("", ".1", ".2"), "", ";"),
        (titled("_X", "_Y", "_Z"), "", "\t"),
    ],
    ids=["one name", "axes below", "as pandas numbers them", "axes behind"],
)
def test_a_table_has_three_columns_a_marker(tmp_path, titles, behind, separator, scale) -> None:
    path = tmp_path / ("take.tsv" if separator == "\t" else "take.csv")
    path.write_text(table(titles, behind, scale, separator))
    with pytest.warns(HandSimWarning, match="no unit of length, read as") as told:
        capture = read_capture(path)
    assert capture.names == ("RH1", "Index", "RIF2", "RIF3", "RIF4")
    assert capture.rate == pytest.approx(100.0)
    np.testing.assert_allclose(capture.positions[0], 1e-3 * HAND, atol=1e-6)
    unit = {1e-3: "meters", 0.1: "centimeters", 1.0: "millimeters"}[scale]
    assert any(str(one.message).endswith(unit) for one in told)


BAD_TABLES = {
    "no markers": (
        "a,b,c\n1,2,3\n",
        "not a table of markers | 'time' | RH1_x | 'Format Version' | 'Trajectories' | 'NO_OF_FRAMES'",
    ),
    "no times": ("Frame,X,Y,Z\n1,2,3,4\n", "not a table of markers | 'time'"),
    "two columns of a marker": (table(titled("_x", "_y")), "not a table of markers | three for each"),
    "no rows": ("time,A_x,A_y,A_z\n", "no frames"),
    "uneven times": (
        table(titled("", "", "")).replace("0.05,", "0.0566,").replace("0.06,", "0.069,"),
        "the rate is not stated | positive number",
    ),
}

QTM = qtm()
BAD_QTM = {
    "angles": (QTM.replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\tAngle"), "DATA_INCLUDED is 'Angle' | '3D'"),
    "no names": (QTM.replace("MARKER_NAMES", "MARKERS"), "MARKER_NAMES"),
    "no name": (qtm(names=(), columns=False), "no markers | MARKER_NAMES"),
    "fewer markers than names": (qtm(markers="1"), "MARKER_NAMES holds 2 | NO_OF_MARKERS states 1"),
    "no hertz": (qtm(frequency="EXT", leading=False, columns=False), "FREQUENCY is 'EXT' | positive number"),
    "fewer frames than stated": (qtm(stated="4"), "truncated | NO_OF_FRAMES is 4 | 3 frames"),
    "no frames": (qtm(rows=0), "no frames"),
    "header cut": (QTM[: QTM.index("MARKER_NAMES") + 15], "header is cut | column names"),
    "header cut before its rows": (QTM[: QTM.index("Frame\t")], "no frames"),
    "a word": (QTM.replace("13.500", "thirteen"), "line 14, column 6 (New 0001 X) | 'thirteen'"),
    "row too long": (QTM.rstrip() + "\t5\n", "line 15 | 9 cells | expected 8"),
    "too few columns": (qtm(columns=False).replace("\t5.500", ""), "line 12 | 7 cells | expected 6, or 8"),
    "last row cut": (QTM[: QTM.rindex("\t")], "truncated | line 15 | 7 of 8 cells"),
    "last number cut": (QTM[: QTM.rindex("0")], "truncated | line 15 | last number"),
    "far too many markers": (
        QTM.replace("NO_OF_MARKERS\t2", "NO_OF_MARKERS\t999999999"),
        "MARKER_NAMES holds 2 | NO_OF_MARKERS states 999999999",
    ),
}
DAMAGED = [
    pytest.param(suffix, content, words, id=f"{kind}, {case}")
    for kind, suffix, cases in (
        ("OpenSim", ".trc", BAD),
        ("Motive", ".csv", BAD_MOTIVE),
        ("Vicon", ".csv", BAD_NEXUS),
        ("Qualisys", ".tsv", BAD_QTM),
        ("a table", ".csv", BAD_TABLES),
    )
    for case, (content, words) in cases.items()
]


@pytest.mark.parametrize(("suffix", "content", "words"), DAMAGED)
def test_damage_is_told(tmp_path: Path, suffix: str, content: bytes | str, words: str) -> None:
    path = tmp_path / f"take{suffix}"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with error_names(CaptureError, f"{path} | {words}"):
        read_capture(path)


@pytest.fixture
def two_hands(rng):
    positions = rng.uniform(size=(4, 7, 3))
    positions[2, :3] = np.nan  # the right hand was not there
    return positions


def test_two_hands_are_counted_each_by_itself(tmp_path, two_hands):
    columns = [f"{side}:{name}" for side in ("right", "left") for name in MARKERS]
    write_capture(tmp_path / "two.trc", Capture((*columns, "Unlabeled1"), two_hands, 120.0))
    markers = np.concatenate(read_hands(tmp_path / "two.trc", MARKERS)[0])
    expected = np.concatenate([two_hands[[0, 1, 3], :3], two_hands[:, 3:6]])
    np.testing.assert_allclose(markers, expected, atol=1e-6)


def test_one_hand_counts_while_it_is_there_in_a_file_and_in_memory(tmp_path, two_hands):
    capture = Capture(MARKERS, two_hands[:, :3], 120.0)
    write_capture(tmp_path / "one.trc", capture)
    for (markers,) in (select_hands(capture, MARKERS), read_hands(tmp_path / "one.trc", MARKERS)[0]):
        np.testing.assert_allclose(markers, two_hands[[0, 1, 3], :3], atol=1e-6)


def test_a_hand_that_lacks_a_marker_is_named(tmp_path, two_hands):
    columns = [f"{side}:{name}" for side in ("right", "left") for name in MARKERS]
    write_capture(tmp_path / "two.trc", Capture(tuple(columns[:5]), two_hands[:, :5], 120.0))
    with pytest.raises(CaptureError, match=r"two\.trc: columns 'left:\.\.\.': .*PinkyTip"):
        read_hands(tmp_path / "two.trc", MARKERS)
