"""Vicon CSV: Nexus's and Workstation's section of trajectories, among others or alone."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gloves.captures.formats import read_capture
from gloves.captures.text_formats import read_vicon_csv
from handsim.errors import CaptureError

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


WANTED = (10 * np.arange(3)[:, None] + np.arange(9) + 0.5).reshape(3, 3, 3) * 1e-3
NAMES = ("Anna:ThumbTip", "*2", "*12")


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
def test_dialects(change: Callable[[str], str]) -> None:
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


@pytest.mark.parametrize(("unit", "meters"), [("cm", 1e-2), ("m", 1.0)])
def test_units(unit: str, meters: float) -> None:
    np.testing.assert_allclose(read_vicon_csv(nexus(unit=unit).encode()).positions, WANTED * 1e3 * meters)


def test_blank_cells_are_gaps() -> None:
    text = nexus().replace("10.5,11.5,12.5", ",,").replace("26.5,27.5,28.5", ",,")
    missing = np.isnan(read_vicon_csv(text.encode()).positions[..., 0])
    assert missing.tolist() == [[False] * 3, [True, False, False], [False, False, True]]


GOOD = nexus()
BAD = {
    "neither Motive nor Vicon": "Frame,X,Y,Z\n1,2,3,4\n",
    "other sections": DEVICES + OUTPUTS,
    "the word alone": "Trajectories\n\n",
    "header cut": GOOD[: GOOD.index("Frame")],
    "header cut in its axes": GOOD[: GOOD.index("Frame") + 20],
    "no frame in the axes": GOOD.replace("Frame,Sub Frame", "Number,Other"),
    "no axes": GOOD.replace("X,Y,Z", "A,B,C"),
    "unknown unit": nexus(unit="deg"),
    "no rate": nexus(rate="0"),
    "no frames": nexus(rows=0),
    "a word": GOOD.replace("11.5", "eleven"),
    "a decimal comma": GOOD.replace(",", ";").replace("11.5", "11,5"),
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
    golden("vicon_csv_errors", actual)
