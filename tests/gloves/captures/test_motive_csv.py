"""Motive CSV: laid out as Motive 1.x to 3.x lay it out, with everything but markers in the way."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture, write_capture
from gloves.captures.text_formats import read_motive_csv
from handsim.errors import CaptureError

# Type, name, quantities and axes of each asset; a number a column counts up from the left.
BODY = ("Rigid Body", "Cube", ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"], [*"XYZWXYZ", ""])
BODY_MARKER = ("Rigid Body Marker", "Cube:Marker1", ["Position"] * 3 + ["Marker Quality"], [*"XYZ", ""])
LABELED = ("Marker", "Glove:ThumbTip", ["Position"] * 3, [*"XYZ"])
UNLABELED = ("Marker", "Unlabeled 2379", ["Position"] * 3, [*"XYZ"])
QUOTED = ("Marker", "Glove, left:1", ["Position"] * 3, [*"XYZ"])


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


@pytest.mark.parametrize(
    ("unit", "meters"),
    [("Meters", 1.0), ("Centimeters", 1e-2), ("Millimeters", 1e-3), (None, 1.0), ("", 1.0)],
)
def test_units(unit: str | None, meters: float) -> None:
    capture = read_motive_csv(motive(UNLABELED, unit=unit, rows=1).encode(), [].append)
    np.testing.assert_allclose(capture.positions, [[[0.0, 0.01 * meters, 0.02 * meters]]])


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


GOOD = motive(LABELED, UNLABELED)
BAD = {
    "not Motive": "a,b,c\n1,2,3\n",
    "only rigid bodies": motive(BODY, BODY_MARKER),
    "no columns": motive(),
    "unknown unit": motive(LABELED, unit="Feet"),
    "no rate": motive(LABELED, rows=2, first="Format Version,1.23").replace(
        "Export Frame Rate,120.000000", "x,y"
    ),
    "no frames": motive(LABELED, rows=0),
    "header cut": GOOD[: GOOD.index("Frame,")],
    "header cut in its last row": GOOD[: GOOD.index("Frame,") + 12],
    "no Type row": GOOD.replace(",Type,", ",Kind,"),
    "axes out of order": GOOD.replace("X,Y,Z", "X,Z,Y"),
    "a word": GOOD.replace("1.010000", "one"),
    "row too long": GOOD.rstrip() + ",5\n",
    "last row cut": GOOD[: GOOD.rindex(",")],
}


def test_error_sentences(tmp_path: Path, golden: Callable[[str, dict[str, str]], None]) -> None:
    path = tmp_path / "take.csv"
    actual = {}
    for case, text in BAD.items():
        path.write_text(text)
        with pytest.raises(CaptureError) as caught:
            read_capture(path)
        actual[case] = str(caught.value).replace(str(path), "take.csv")
    golden("motive_csv_errors", actual)
