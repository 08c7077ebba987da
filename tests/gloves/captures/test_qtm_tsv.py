"""Qualisys TSV: with and without frame, time and names of columns; and what is no 3D export."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gloves.captures.formats import read_capture
from gloves.captures.text_formats import read_qtm_tsv
from handsim.errors import CaptureError


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
def test_every_setting_of_the_export(
    version: bool, columns: bool, leading: bool, ends: str, line_end: str
) -> None:
    text = qtm(version=version, columns=columns, leading=leading, ends=ends, events=("Start", "Stop"))
    capture = read_qtm_tsv(text.replace("\n", line_end).encode())
    assert (capture.names, capture.rate) == (("ThumbTip", "New 0001"), 100.0)
    np.testing.assert_allclose(capture.positions, wanted(2))


def test_blank_cells_and_zeros_are_gaps(tmp_path: Path) -> None:
    text = (
        qtm()
        .replace("10.500\t11.500\t12.500", "\t\t")
        .replace("23.500\t24.500\t25.500", "0.000\t0.000\t0.000")
    )
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


GOOD = qtm()
BAD = {
    "not Qualisys": "a\tb\tc\n1\t2\t3\n",
    "angles": GOOD.replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\tAngle"),
    "no names": GOOD.replace("MARKER_NAMES", "MARKERS"),
    "no name": qtm(names=(), columns=False),
    "fewer markers than names": qtm(markers="1"),
    "no number of hertz": qtm(frequency="EXT", leading=False, columns=False),
    "fewer frames than stated": qtm(stated="4"),
    "no frames": qtm(rows=0),
    "header cut": GOOD[: GOOD.index("MARKER_NAMES") + 15],
    "header cut before its rows": GOOD[: GOOD.index("Frame\t")],
    "a word": GOOD.replace("13.500", "thirteen"),
    "row too long": GOOD.rstrip() + "\t5\n",
    "too few columns": qtm(columns=False).replace("\t5.500", ""),
    "last row cut": GOOD[: GOOD.rindex("\t")],
    "last number cut": GOOD[: GOOD.rindex("0")],
    "far too many markers": GOOD.replace("NO_OF_MARKERS\t2", "NO_OF_MARKERS\t999999999"),
}


def test_error_sentences(tmp_path: Path, golden: Callable[[str, dict[str, str]], None]) -> None:
    path = tmp_path / "take.tsv"
    actual = {}
    for case, text in BAD.items():
        path.write_text(text)
        with pytest.raises(CaptureError) as caught:
            read_capture(path)
        actual[case] = str(caught.value).replace(str(path), "take.tsv")
    golden("qtm_tsv_errors", actual)
