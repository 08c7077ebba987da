"""A small file of each dialect that docs/marker_files.md lists: what it holds, or what is said of it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, read_capture
from handsim.errors import CaptureError
from tests.gloves.captures.test_c3d import DEC, INTEL, SGI, c3d
from tests.gloves.captures.test_formats import LABELED, UNLABELED, motive, nexus, qtm, trc
from tests.sentences import assert_names

ROWS = [f"{row}\t{row / 120:.6f}\t{row}.25\t-0.05\t3.00\t1.5\t{row}.5\t2.5" for row in range(4)]
TRC = trc(*ROWS, rate="120").decode()
SPACED = "\n".join(" ".join(line.split()) for line in TRC.split("\n"))
ALIGNED = "\n".join("  " + "   ".join(line.split()) for line in TRC.split("\n"))
ONLY_ROWS = "\n".join([*TRC.split("\n")[:5], *SPACED.split("\n")[5:]])
MOTIVE = motive(LABELED, UNLABELED)
KEYS = MOTIVE.split("\n")[0]
VALUES = {
    **{
        f"C3D of {kind} {numbers}": (".c3d", c3d(processor=number, scale=scale), (0.0015, -0.002, 0.003))
        for kind, number in (("Intel", INTEL), ("DEC", DEC), ("SGI", SGI))
        for numbers, scale in (("floats", -1.0), ("integers", 0.125))
    },
    "C3D in centimeters": (".c3d", c3d(units="cm"), (0.015, -0.02, 0.03)),
    "TRC in meters": (".trc", TRC.replace("mm", "m"), (0.25, -0.05, 3.0)),
    "Motive": (".csv", MOTIVE, None),
    "Vicon": (".csv", nexus(), (0.0005, 0.0015, 0.0025)),
    "Qualisys": (".tsv", qtm(), None),
}  # fmt: skip
REFUSED = {
    "blank cells between spaces": (
        ".trc",
        SPACED.replace("0.25 -0.05 3.00 ", "", 1),
        "line 7 has 8 cells and line 6 5 | spaces | nan in blank cells",
    ),
    "Motive's own": (".tak", b"x", "Motive | closed format | CSV or C3D"),
    "Vicon's own": (".x2d", b"x", "Vicon | export C3D"),
    "Cortex' own": (".trb", b"x", "Cortex | TRC or C3D"),
    "Qualisys' own": (".qtm", b"x", "Qualisys | C3D, or TSV"),
    "OpenSim's angles": (".mot", b"x", "OpenSim | TRC"),
    "a skeleton": (".bvh", b"x", "skeleton | export the markers | .c3d"),
    "a TRC by another ending": (".csv", TRC, "not a table of markers | the content of a TRC; name it .trc"),
    "Motive's by another ending": (".tsv", MOTIVE, "Motive's CSV; name it .csv"),
    "DeepLabCut": (".csv", "scorer,a,a,a\nbodyparts,x,x,x\n", "DeepLabCut | write a TRC"),
    "bodies of Vicon Tracker": (".csv", "Objects\n100\n,,A\nFrame,Sub Frame,RX\n", "Vicon Tracker | bodies"),
    "ROS": (".csv", "%time,field.header.seq\n", "a topic of ROS | gloves.Capture"),
    "D-Flow": (".tsv", "TimeStamp\tFrameNumber\tA.PosX\n", "D-Flow | C3D or TRC"),
    **{
        f"a pointer in place of a {suffix}": (
            suffix,
            "version https://git-lfs.github.com/spec/v1\n",
            "git lfs pull",
        )
        for suffix in (".c3d", ".csv", ".trc")
    },
    "compressed": (".gz", b"\x1f\x8b", "compressed; unpack it"),
    "a date of a spreadsheet": (
        ".trc",
        TRC.replace("1.25", "25. Jan", 1),
        "'25. Jan' | a date | spreadsheet",
    ),
    "a date in English": (".csv", MOTIVE.replace("1.010000", "25-Jan", 1), "'25-Jan' | a date | spreadsheet"),
    "a workbook": (".csv", b"PK\3\4" + bytes(40), "workbook of Excel | save it as text"),
}


def noted(name: str = "take", notes: str = "") -> str:
    """Motive's file of a take with this name and these notes."""
    first = f"Format Version,1.23,Take Name,{name},Take Notes,{notes},Capture Frame Rate,240.000000"
    return MOTIVE.replace(KEYS, first + KEYS.removeprefix("Format Version,1.23"))


assert KEYS.startswith("Format Version,1.23,")
SAME = {
    "spaces": (".trc", SPACED, TRC),
    "spaces that align": (".trc", ALIGNED, TRC),
    "spaces in the rows": (".trc", ONLY_ROWS, TRC),
    "spaces and decimal commas": (".trc", re.sub(r"(\d)\.(\d)", r"\1,\2", SPACED), TRC),
    "a comma in the notes": (".csv", noted(notes="left tight, right loose"), MOTIVE),
    "a comma in the name": (".csv", noted(name="one, two, three"), MOTIVE),
    "a quoted comma": (".csv", noted(notes='"left tight, right loose"'), MOTIVE),
    "a quoted line break": (".csv", noted(notes='"left tight\nright loose"'), MOTIVE),
    "a quoted line break and commas": (".csv", noted(notes='"left, tight\n\nright, loose"'), MOTIVE),
    "a line break": (".csv", noted(notes="left tight\nright loose"), MOTIVE),
    "a line break of Windows": (".csv", noted(notes='"left\r\nright"').replace("\n", "\r\n"), MOTIVE),
    "an open quote": (".csv", noted(notes='"left glove, 5'), MOTIVE),
    "inches": (".csv", noted(notes='5" ball'), MOTIVE),
    "Excel's first line": (".csv", "sep=,\n" + MOTIVE, MOTIVE),
    "UTF-16 without a mark": (".trc", TRC.encode("utf-16-le"), TRC),
    "a typographic minus": (".trc", TRC.replace("-", "\u2212"), TRC),
    "small letters": (".trc", TRC.replace("PathFileType", "pathfiletype"), TRC),
    "a unit in brackets": (".trc", TRC.replace("mm", "(mm)"), TRC),
    "a row of nan": (".trc", TRC.replace(ROWS[0], "nan\n" + ROWS[0]), TRC),
    **{
        f"{word} for none": (
            ".trc",
            TRC.replace("1.25\t-0.05\t3.00", f"{word}\t{word}\t{word}"),
            TRC.replace("1.25\t-0.05\t3.00", "\t\t"),
        )
        for word in ("N/A", "#N/A", "null", "None", "--", "<NA>", "1.#QNAN", "NaN")
    },
    "notes like a key": (".csv", noted(notes="Length Units"), MOTIVE),
    "semicolons and a semicolon": (".csv", noted(notes="a;b").replace(",", ";"), MOTIVE),
    "keys in small letters": (".csv", MOTIVE.replace(KEYS, KEYS.replace("Frame Rate", "frame rate")), MOTIVE),
}
"""Dialects: the ending, the file, and the plain file of the same values."""


def read(path: Path, content: bytes | str) -> tuple[Capture, list[str]]:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        capture = read_capture(path)
    return capture, [str(one.message) for one in told]


@pytest.mark.parametrize("dialect", SAME)
def test_the_same_values(tmp_path, dialect):
    suffix, content, plain = SAME[dialect]
    capture, told = read(tmp_path / f"take{suffix}", content)
    expected, _ = read(tmp_path / f"plain{suffix}", plain)
    assert (capture.names, capture.rate, told) == (expected.names, expected.rate, [])
    np.testing.assert_array_equal(capture.positions, expected.positions)


def test_local_coordinates_are_told(tmp_path):
    """Motive can export markers in the axes of their rigid bodies, where they stand still."""
    keys = KEYS.replace("Coordinate Space,Global", "Coordinate Space,Local")
    capture, told = read(tmp_path / "take.csv", MOTIVE.replace(KEYS, keys))
    assert capture.num_frames and len(told) == 1
    assert_names(told[0], "Coordinate Space is Local | export world coordinates")


def test_blanks_between_spaces(tmp_path):
    """A blank cell is written as nan; rows may lack cells at their end, and a blank line may be nan."""
    rows = SPACED.split("\n")
    rows[5] = rows[5].replace("0.25 -0.05 3.00", "nan nan nan")
    rows[6] = " ".join(rows[6].split()[:5])
    capture, told = read(tmp_path / "take.trc", "\n".join([*rows[:5], "nan", *rows[5:]]))
    assert (capture.num_frames, told) == (4, [])
    np.testing.assert_array_equal(np.argwhere(np.isnan(capture.positions[..., 0])), [[0, 0], [1, 1]])


@pytest.mark.parametrize("kind", VALUES)
def test_first_point(tmp_path, kind):
    suffix, content, point = VALUES[kind]
    capture, told = read(tmp_path / f"take{suffix}", content)
    assert not told and not capture.findings
    if point is not None:
        np.testing.assert_allclose(capture.positions[0, 0], point)


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_read_is_named(tmp_path, kind):
    suffix, content, words = REFUSED[kind]
    with pytest.raises(CaptureError) as caught:
        read(tmp_path / f"take{suffix}", content)
    assert_names(str(caught.value), words)
