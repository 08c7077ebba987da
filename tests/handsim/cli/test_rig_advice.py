"""`handsim rig score` and `handsim rig plan`, as they are typed."""

from __future__ import annotations

import json

import pytest

from handsim.cli.main import main
from handsim.space.rig import load_rig
from train.rig_advice import planning
from train.simulation.takes import simulate_take


def test_a_score_is_printed_drawn_and_written(tmp_path, capsys):
    page, figures = tmp_path / "six.html", tmp_path / "six.json"
    options = ["--glove", "tips8", "--frames", "60", "--out", str(page), "--json", str(figures)]
    assert main(["rig", "score", "six", *options]) == 0
    told = capsys.readouterr().out
    assert "hand-pen" in told and "matters most" in told and "Error of points" in told
    assert "What to do" in page.read_text("utf-8")
    assert json.loads(figures.read_text("utf-8"))["cameras"] == 6


def test_hands_of_a_take_are_scored_where_they_are(tmp_path, capsys):
    take, page = tmp_path / "take.truth.npz", tmp_path / "page.html"
    simulate_take("single-hand", num_frames=60, glove="tips8").save(take)
    assert main(["rig", "score", "eight", "--take", str(take), "--out", str(page), "--frames", "60"]) == 0
    assert "960 marker-frames of the take take.truth.npz" in page.read_text("utf-8")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--out", "page.pdf"], "--out is page.pdf, expected a file name that ends in .html"),
        (["--frames", "1"], "frames is 1, expected at least 60"),
        (["--volume", "1", "0", "1"], "volume is 1 0 1, expected three lengths in meters"),
        (["--center", "nan", "0", "1"], "center holds NaN or infinite values, expected finite numbers"),
        (["--center", "0", "0", "1100"], "center is 0 0 1100, expected meters, each below 50"),
        (["--seed", "-1"], "seed is -1, expected 0 or more"),
        (["--json", "figures.html"], "--json is figures.html, expected a file name that ends in .json"),
    ],
)
def test_mistakes_are_told(options, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["rig", "score", "six", *options]) == 1
    assert sentence in capsys.readouterr().err


def test_a_planned_rig_is_written_and_told(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(planning, "_PEOPLE", 1)
    monkeypatch.setattr(planning, "_FRAMES", 120)
    monkeypatch.setattr(planning, "_JUDGED", 120)
    out = tmp_path / "mine.toml"
    options = ["--cameras", "2", "--room", "2.4", "1.8", "2.2", "--mounts", "truss", "--glove", "tips8"]
    assert main(["rig", "plan", *options, "--out", str(out)]) == 0
    rig = load_rig(out)
    assert rig.name == "mine" and len(rig.positions) == 2
    told = capsys.readouterr().out
    assert "looks at [m]" in told and "after:  two cameras see" in told and "before" not in told


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--cameras", "1", "--room", "4", "4", "3"], "cameras is 1, expected 2 to 32"),
        (["--cameras", "6", "--room", "4", "4", "3", "--keep", "six"], "cameras is 6, expected 7 to 32"),
        (["--cameras", "6", "--room", "4", "0", "3"], "room is 4 0 3, expected three lengths"),
        (
            ["--cameras", "6", "--room", "4", "4", "3", "--field-of-view", "180"],
            "field of view is 180 degrees, expected 1 to 170",
        ),
        (
            ["--cameras", "6", "--room", "0.8", "0.8", "1.5", "--mounts", "walls", "--volume", "2", "2", "3"],
            "expected a larger room",
        ),
    ],
)
def test_plans_that_cannot_be_are_told(options, sentence, tmp_path, capsys):
    assert main(["rig", "plan", *options, "--out", str(tmp_path / "mine.toml")]) == 1
    assert sentence in capsys.readouterr().err
