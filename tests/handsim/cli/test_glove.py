from __future__ import annotations

import dataclasses
import json
from datetime import date
from pathlib import Path

import cv2
import numpy as np
import pytest

from gloves import Capture, load_layout, load_take, write_capture
from gloves.captures.capture import select_markers
from gloves.layout import list_layouts, starter_layout
from handsim.cli.main import main
from tests.track.gloves.trials import OTHERS, lab_trial
from track import load_user
from train import Labeling
from train.labelers.storage import shipped_labelers

LEARNED = {
    "trial.c3d --start missing.toml --out mine.toml": "missing.toml: cannot be read",
    "trial.c3d --start guess.toml --out guess.toml": "is the input",
    "--radius-mm 3 --out mine.toml": "no capture was given, expected one labeled marker file or more",
    "three.trc --radius-mm 3 --out mine.toml": "no hand is in the captures",
}


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


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """A labeled capture with names of a lab's own, and dense19 as a layout with these names."""
    folder = tmp_path_factory.mktemp("trial")
    capture, truth = lab_trial("calibration", 300, 4)
    write_capture(folder / "trial.c3d", capture)
    known = {marker.name: marker for marker in load_layout("dense19").markers}
    markers = tuple(dataclasses.replace(known[marker], name=name) for name, marker in truth.items())
    dataclasses.replace(load_layout("dense19"), markers=markers).save(folder / "guess.toml")
    return folder


def learn(folder: Path, words: str) -> int:
    return main(["glove", "learn", *(str(folder / one) if "." in one else one for one in words.split())])


def test_a_guess_is_corrected_and_written_with_page_and_users(trial, tmp_path, capsys):
    out, users = tmp_path / "mine.toml", tmp_path / "people"
    options = ["--out", str(out), "--users", str(users), "--hands", "right"]
    captures = [str(trial / "trial.c3d"), "--start", str(trial / "guess.toml")]
    assert main(["glove", "learn", *captures, *options]) == 0
    told = capsys.readouterr().out
    layout = load_layout(out)
    assert (layout.name, layout.num_markers, layout.sides) == ("mine", 19, ("right",))
    assert all(f"{marker.name} " in told and marker.bone in told for marker in layout.markers)
    assert not any(name in layout.names for name in OTHERS)
    assert f"handsim label NEXT.c3d --glove {out} --out" in told.splitlines()[-1]
    text = out.read_text("utf-8")
    assert f'source = "handsim glove learn, {date.today()}, from trial.c3d"' in text
    assert 'description = "19 markers, learned from one hand in labeled captures"' in text
    page = out.with_suffix(".html").read_text("utf-8")
    assert "trial.c3d" in page and "data:image/svg+xml" in page
    (hand,) = load_user(users / "trial.json")
    assert hand.side == "right" and set(hand.layout.names) == set(layout.names)
    assert f"a right hand of {1e3 * hand.model.shape.length:.0f} x" in told


@pytest.mark.parametrize("words", LEARNED)
def test_what_cannot_be_learned_from_is_refused(words, trial, capsys):
    points = np.random.default_rng(0).uniform(0.0, 0.1, (12, 3, 3))
    write_capture(trial / "three.trc", Capture(tuple("ABC"), points, 120.0))
    assert learn(trial, words) == 1
    *_, said = capsys.readouterr().err.splitlines()
    assert said.startswith("handsim glove learn: ") and LEARNED[words] in said
    assert not (trial / "mine.toml").exists() and not (trial / "mine.html").exists()


class KnowingLabeler:
    """A labeler that knows the points of the trial: it labels right what it gets as the file has it."""

    marker_names = tuple(f"A{number}" for number in range(19))

    def __init__(self) -> None:
        capture = lab_trial("calibration", 300, 4)[0]
        points = select_markers(capture, self.marker_names)
        self._known, self._labels = points.reshape(-1, 3), np.tile(np.arange(19), len(points))

    def label_frames(self, frames):
        apart = [np.linalg.norm(one[:, None] - self._known, axis=2) for one in frames]
        return [Labeling(self._labels[np.nanargmin(one, axis=1)], np.ones(len(one))) for one in apart]


def test_a_capture_of_own_names_with_other_columns_is_a_truth_to_evaluate(trial, tmp_path):
    labeler = "tests.handsim.cli.test_glove:KnowingLabeler"
    command = ["evaluate", str(trial / "trial.c3d"), "--glove", str(trial / "guess.toml"), "--every", "10"]
    assert main([*command, "--labeler", labeler, "--json", str(tmp_path / "x.json")]) == 0
    found = json.loads((tmp_path / "x.json").read_text())
    assert found["frames"] == 30 and set(found["slot_accuracy_by_marker"]) == {f"A{one}" for one in range(19)}
    assert found["figures"]["slot_accuracy"] == 1.0
