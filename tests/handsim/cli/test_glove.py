from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from gloves import load_layout, load_take
from gloves.layout import list_layouts, starter_layout
from handsim.cli.main import main
from train.labelers.storage import shipped_labelers


def test_list_and_show_name_every_layout_marker_and_labeler(capsys):
    assert main(["glove", "list"]) == 0
    out = capsys.readouterr().out
    for name in list_layouts():
        assert f"{name} " in out and str(load_layout(name).num_markers) in out
    assert "doi.org/10.1145/3197517.3201399" in out.replace("\n", "")
    having = tuple(line.split()[0] for line in out.splitlines() if "comes with it" in line)
    assert having == shipped_labelers()
    assert main(["glove", "show", "dense19"]) == 0
    out = capsys.readouterr().out  # of 80 columns
    assert all(marker.name in out and marker.bone in out for marker in load_layout("dense19").markers)


@pytest.fixture
def mine(tmp_path):
    assert main(["glove", "new", str(tmp_path / "mine.toml")]) == 0
    return tmp_path / "mine.toml"


@pytest.mark.slow
def test_list_draws_all(tmp_path: Path) -> None:
    assert main(["glove", "list", "--out", str(tmp_path / "gloves.png")]) == 0
    picture = cv2.imread(str(tmp_path / "gloves.png"))
    assert picture.shape[1] == 2000
    assert (picture.min(axis=(1, 2)) < 120).mean() > 0.6


def test_show_and_check_a_left_glove_with_a_stalk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "left.toml"
    stalk = starter_layout().replace("radius_mm", 'sides = ["left"]\nradius_mm', 1) + "height_mm = 12.5\n"
    file.write_text(stalk)
    assert main(["glove", "show", str(file)]) == 0
    out = capsys.readouterr().out
    assert "12.5" in out and "For a left hand only." in out
    assert main(["glove", "check", str(file)]) == 0
    assert main(["hand", "--glove", str(file), "--side", "right", "--out", str(tmp_path / "x.xml")]) == 1
    assert "is for a left hand only" in capsys.readouterr().err
    simulate = ["simulate", "--glove", str(file), "--num-frames", "3", "--out", str(tmp_path / "x.c3d")]
    assert main([*simulate, "--kind", "hand-hand"]) == 1
    said = capsys.readouterr().err
    assert "is for a left hand only" in said and "for one hand: single-hand, calibration, free" in said
    assert main(simulate) == 0
    assert load_take(tmp_path / "x.truth.npz").sides == ("left",)


def test_new_writes_a_file_that_checks_and_keeps_what_is_there(mine, capsys):
    before = mine.read_bytes()
    assert main(["glove", "new", str(mine)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert mine.read_bytes() == before
    assert main(["glove", "check", str(mine)]) == 0
    assert "my_glove: 8 markers" in capsys.readouterr().out
    picture = cv2.imread(str(mine.with_suffix(".png")))
    assert picture.shape[1] > picture.shape[0] > 800
    assert (picture.min(axis=(1, 2)) < 120).mean() > 0.6


def test_check_tells_markers_that_overlap(mine, tmp_path, capsys):
    again = '\n[[marker]]\nname = "Again"\nbone = "palm"\nalong = 0.56\naround = 0.0\nacross = -0.17\n'
    mine.write_text(mine.read_text() + again)
    assert main(["glove", "check", str(mine), "--out", str(tmp_path / "x.png")]) == 1
    assert "BackHand1 and Again on size XS" in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


def test_check_and_simulate_take_a_layout_that_a_small_hand_wears_elsewhere(mine, tmp_path, capsys):
    mine.write_text(
        mine.read_text() + '\n[[marker]]\nname = "Side"\nbone = "ring_proximal"\nalong = 0.6\naround = 100\n'
    )
    assert main(["glove", "check", str(mine)]) == 0
    assert "Side would be off its digit on size XS" in capsys.readouterr().err
    command = ["simulate", "--glove", str(mine), "--num-frames", "3", "--out", str(tmp_path / "x.c3d")]
    assert main(command) == 0
    assert main(["hand", "--glove", str(mine), "--size", "XS", "--out", str(tmp_path / "x.xml")]) == 0


@pytest.mark.slow
def test_a_score_is_printed_and_drawn(mine, capsys):
    assert main(["glove", "score", str(mine), "--frames", "120", "--rig", "six", "--captures", "1"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("labels are wrong throughout a capture with a probability of ")
    assert "% of the slots right as the rig sees them" in told
    assert all(f"{work} " in told for work in ("two apart", "two touching", "real-like"))
    page = mine.with_suffix(".html").read_text("utf-8")
    assert page.count("data:image/svg+xml") >= 2 and "What to do" in page and "ThumbTip" in page


def test_an_improved_layout_is_written(mine, tmp_path, capsys):
    out = tmp_path / "better.toml"
    options = "--minutes 0 --markers 7 --captures 0".split()
    assert main(["glove", "improve", str(mine), "--out", str(out), *options]) == 0
    assert load_layout(out).num_markers == 7
    told = capsys.readouterr().out
    assert "before: 8 markers" in told and "after:  7 markers" in told and "drop " in told
