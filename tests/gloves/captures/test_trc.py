"""TRC: what real files do, and where exactly a broken one breaks."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture, write_capture
from gloves.captures.text_formats import read_trc
from handsim.errors import CaptureError

SIG18 = Path(os.environ.get("HANDSIM_SIG18", Path(__file__).resolve().parents[3].parent / "shared" / "sig18"))


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


ROW = "0\t0\t1\t2\t3\t4\t5\t6"
POINTS = np.array([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]])


@pytest.mark.parametrize(
    ("unit", "meters"),
    [("mm", 1e-3), ("MM", 1e-3), ("cm", 1e-2), ("m", 1.0), ("Meters", 1.0), (" Millimeters ", 1e-3)],
)
def test_units(unit: str, meters: float) -> None:
    capture = read_trc(trc(ROW, units=unit))
    np.testing.assert_allclose(capture.positions, POINTS * meters)
    assert (capture.names, capture.rate) == (("a", "b"), 120.0)


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
    sentence = f"DataRate is '{rate}', expected a positive number; by the column of times it is 89.9743 Hz"
    assert told == [sentence]


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
    "not TRC": b"Frame,Time\n1,2\n",
    "header only": trc(),
    "header cut after line 3": b"\n".join(trc(ROW).split(b"\n")[:3]) + b"\n",
    "header cut in line 4": trc(ROW)[:130],
    "header cut in line 5": trc(end=""),
    "unknown unit": trc(ROW, units="inches"),
    "no unit": trc(ROW, units=""),
    "rate is a word": trc(ROW, rate="fast"),
    "rate is zero": trc(ROW, rate="0"),
    "rate is missing": trc(ROW, rate=""),
    "no markers": trc("0\t0", names="Frame#\tTime\t\t"),
    "line 4 holds no names": trc(ROW, names="1\t0\t1\t2\t3"),
    "names and axes differ": trc(ROW, names="Frame#\tTime\ta\tb\tc"),
    "a word": trc(ROW, "1\t0\t1\t2\t3\t4\tfive\t6"),
    "a decimal comma": trc(ROW, "1\t0\t1,5\t2.5\t3\t4\t5\t6"),
    "a word for a frame number": trc("first" + ROW),
    "infinite": trc(ROW, ROW.replace("6", "inf")),
    "too many cells": trc(ROW, ROW + "\t\t7"),
    "last row cut between cells": trc(ROW, "1\t0\t1\t2\t3\t4", end=""),
    "last row cut in its frame number": trc(ROW, "1", end=""),
    "last row cut in its last cell": trc(ROW + "\t", ROW, end=""),
    "only row cut": trc(ROW[:-4], end=""),
}


def test_error_sentences(tmp_path: Path, golden: Callable[[str, dict[str, str]], None]) -> None:
    path = tmp_path / "take.trc"
    actual = {}
    for case, data in BAD.items():
        path.write_bytes(data)
        with pytest.raises(CaptureError) as caught:
            read_capture(path)
        actual[case] = str(caught.value).replace(str(path), "take.trc")
    golden("trc_errors", actual)


@pytest.mark.skipif(
    not SIG18.is_dir(), reason=f"the SIGGRAPH 2018 captures are not at {SIG18} (HANDSIM_SIG18)"
)
@pytest.mark.filterwarnings("ignore:.*frames are missing")
def test_all_published_captures_read() -> None:
    paths = sorted(SIG18.rglob("*.trc"))
    assert len(paths) == 336
    num_frames = 0
    for path in paths:
        capture = read_capture(path)
        assert capture.positions.shape[1:] == (19, 3)
        assert capture.names[0] == "ThumbCMC"
        assert capture.names[-1] == "BackHand3"
        assert capture.rate == 120.0
        there = np.isfinite(capture.positions).all(axis=(1, 2))
        assert np.isnan(capture.positions[~there]).all()  # numbers of frames jump in some files
        assert np.abs(capture.positions[there]).max() < 3.0, "meters"
        num_frames += there.sum()
    assert num_frames == 61_941
