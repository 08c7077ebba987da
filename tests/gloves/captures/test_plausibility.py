"""Captures in a wrong unit, far from the origin, and with zeros for what was not seen."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from gloves.captures.capture import Capture, check_place, unit_fault, zeros_as_missing
from gloves.captures.formats import read_capture, write_capture
from handsim.errors import CaptureError, HandSimWarning

NAMES = tuple(f"marker{number}" for number in range(19))


@pytest.fixture
def hand(rng) -> Capture:
    """Markers on something of a hand's size that moves through a room."""
    path = np.linspace([0.5, 0.5, 1.0], [0.6, 0.7, 1.1], 30)[:, None]
    return Capture(NAMES, path + rng.uniform(0.0, 0.15, size=(30, 19, 3)), 120.0)


def scaled(capture: Capture, scale: float) -> Capture:
    return Capture(capture.names, capture.positions * scale, capture.rate)


@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        (1e-3, r"the points of a frame span 0\.1\d mm; correct that unit, probably to meters"),
        (1e3, r"the points of a frame span 1\d\d m; correct that unit, probably to millimeters"),
        (1e2, r"the points of a frame are \d\.\d m apart; correct that unit, probably to centimeters"),
    ],
)
def test_a_wrong_unit_is_told(hand, tmp_path, suffix, scale, sentence):
    path = tmp_path / f"take{suffix}"
    write_capture(path, scaled(hand, scale))
    with pytest.raises(CaptureError, match=rf"take\{suffix}: by the unit of length .* states, {sentence}"):
        read_capture(path)


def test_hands_bodies_and_strays_are_no_fault(hand, rng):
    assert unit_fault(list(hand.positions)) is None
    body = rng.uniform(0.0, 1.9, size=(30, 40, 3))
    assert unit_fault(list(body)) is None
    strays = np.concatenate([hand.positions, rng.uniform(-200.0, 200.0, size=(30, 1, 3))], axis=1)
    strays[::3, 19] = strays[::3, 0]
    few = [cloud[:4] * 1e-3 for cloud in hand.positions]
    assert unit_fault(few) is None, "four points may be strays"
    assert unit_fault(list(strays[::3])) is None


@pytest.mark.parametrize("suffix", [".trc", ".c3d", ".csv"])
def test_recurring_zeros_are_missing_and_counted(hand, tmp_path, suffix):
    positions = hand.positions.copy()
    positions[3:9, 4] = 0.0
    positions[:, 7] = 0.0  # a marker that was never seen
    path = tmp_path / f"take{suffix}"
    if suffix == ".csv":
        path.write_text(motive(positions))
    else:
        write_capture(path, Capture(NAMES, positions, 120.0))
    with pytest.warns(HandSimWarning, match=r"36 points at exactly \(0, 0, 0\) are read as missing"):
        capture = read_capture(path)
    missing = np.isnan(capture.positions[..., 0])
    expected = np.zeros_like(missing)
    expected[3:9, 4] = expected[:, 7] = True
    np.testing.assert_array_equal(missing, expected)


def motive(positions: np.ndarray) -> str:
    """A Motive export in meters."""
    columns = [name for name in NAMES for _ in "XYZ"]
    rows = [
        "Format Version,1.23,Export Frame Rate,120,Length Units,Meters",
        ",,Type" + ",Marker" * len(columns),
        ",,Name," + ",".join(columns),
        ",,," + ",".join(["Position"] * len(columns)),
        "Frame,Time (Seconds),," + ",".join("XYZ" * len(NAMES)),
    ]
    for number, row in enumerate(positions.reshape(len(positions), -1)):
        rows.append(f"{number},{number / 120.0},," + ",".join(f"{value:.6f}" for value in row))
    return "\n".join(rows) + "\n"


def test_a_single_zero_and_what_stands_still_stay(hand):
    positions = hand.positions.copy()
    positions[3, 4] = 0.0
    assert zeros_as_missing(Capture(NAMES, positions, 120.0))[1] == 0
    still = np.zeros((5, 3, 3))
    still[:, 1] = 1.0
    assert zeros_as_missing(Capture(NAMES[:3], still, 120.0))[1] == 0


def test_nothing_is_told_of_a_good_capture(hand, tmp_path):
    write_capture(tmp_path / "take.c3d", hand)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(read_capture(tmp_path / "take.c3d").positions, hand.positions, atol=1e-6)
        check_place(hand, 1e3)


def test_points_far_away_are_counted(hand):
    positions = hand.positions.copy()
    positions[:, 0] += 1500.0
    with pytest.warns(HandSimWarning, match=r"30 of 570 points lie 1000 m or more from the origin"):
        check_place(Capture(NAMES, positions, 120.0), 1e3)
    far = Capture(NAMES, hand.positions + 1500.0, 120.0)
    with pytest.raises(CaptureError, match=r"570 of 570 points lie 1000 m or more .*; move the origin"):
        check_place(far, 1e3)


def test_a_path_with_brackets_is_told_as_it_is(hand, tmp_path, capsys):
    from handsim.cli.main import main

    folder = tmp_path / "[bold]take[red]"
    folder.mkdir()
    assert main(["hand", "--out", str(folder / "hand.xml")]) == 0
    assert capsys.readouterr().out.startswith(f"{folder / 'hand.xml'}: ")


def test_warnings_of_a_capture_are_lines_of_the_command(hand, tmp_path, capsys):
    from handsim.app.messages import told_warnings

    positions = hand.positions.copy()
    positions[2:5, 0] = 0.0
    path = Path(tmp_path / "take.trc")
    write_capture(path, Capture(NAMES, positions, 120.0))
    with told_warnings("handsim label"):
        read_capture(path)
    expected = f"handsim label: warning: {path}: 3 points at exactly (0, 0, 0) are read as missing"
    said = capsys.readouterr().err
    assert said.startswith(expected) and said.count("\n") == 1


def test_all_points_at_the_origin_are_told(tmp_path):
    path = tmp_path / "take.trc"
    write_capture(path, Capture(("a", "b"), np.zeros((20, 2, 3)), 120.0))
    with pytest.raises(CaptureError, match=r"all points are at the origin, \(0, 0, 0\), expected positions"):
        read_capture(path)
