from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gloves.layout import list_layouts, load_layout
from handsim.app.cli import main
from render.commands.glove import nearest_pair


def test_list_names_every_layout(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["glove", "list"]) == 0
    out = capsys.readouterr().out
    for name in list_layouts():
        assert f"{name} " in out
        assert str(load_layout(name).num_markers) in out


def test_show_lists_every_marker(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["glove", "show", "sparse13"]) == 0
    out = capsys.readouterr().out
    assert all(marker.name in out and marker.bone in out for marker in load_layout("sparse13").markers)


def test_new_writes_a_file_that_checks_and_keeps_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    assert main(["glove", "new", str(file)]) == 0
    before = file.read_bytes()
    assert main(["glove", "new", str(file)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert file.read_bytes() == before
    assert main(["glove", "check", str(file)]) == 0
    assert "my_glove: 8 markers" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "mine.png"))
    assert picture.shape[1] > picture.shape[0] > 800
    assert (picture.min(axis=(1, 2)) < 120).mean() > 0.6


def test_new_wants_toml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["glove", "new", str(tmp_path / "mine.txt")]) == 1
    assert "ends in .toml" in capsys.readouterr().err


def test_check_tells_markers_that_overlap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    assert main(["glove", "new", str(file)]) == 0
    file.write_text(
        file.read_text()
        + '\n[[marker]]\nname = "Again"\nbone = "palm"\nalong = 0.56\naround = 0.0\nacross = -0.17\n'
    )
    assert main(["glove", "check", str(file), "--out", str(tmp_path / "x.png")]) == 1
    assert "BackHand1 and Again on size XS" in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


def test_check_tells_a_wrong_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["glove", "check", str(tmp_path / "gone.toml")]) == 1
    assert "gone.toml: cannot be read" in capsys.readouterr().err


def test_nearest_pair(rng: np.random.Generator) -> None:
    points = rng.standard_normal((9, 3))
    points[7] = points[2] + [0.0, 0.003, 0.004]
    first, second, distance = nearest_pair(points)
    assert (first, second) == (2, 7)
    assert distance == pytest.approx(0.005)
