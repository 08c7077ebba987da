"""`handsim simulate` and `handsim evaluate` of a take, through the command line."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.held_out import held_out_markers
from gloves import Capture, load_layout, load_take, read_capture, write_capture
from handsim.cli.main import main

FRAMES = 60


def test_the_capture_and_its_truth_agree(capture):
    assert sorted(path.name for path in capture.parent.iterdir()) == ["take.c3d", "take.truth.npz"]
    written, truth = read_capture(capture), load_take(capture.with_suffix(".truth.npz"))
    assert written.positions.shape == truth.points.shape == (FRAMES, truth.points.shape[1], 3)
    assert written.rate == truth.rate == 120.0
    np.testing.assert_array_equal(np.isnan(written.positions), np.isnan(truth.points))
    np.testing.assert_allclose(written.positions, truth.points, rtol=2e-7, atol=2e-7)
    assert all(name.startswith("Unlabeled") for name in written.names), "no name tells a marker"
    assert truth.settings["kind"] == "hand-controller" and truth.settings["seed"] == 0
    json.dumps(truth.settings)


def test_the_same_command_writes_the_same_bytes_and_tells_what(capture, tmp_path, capsys):
    out = tmp_path / "again" / "take.c3d"
    assert (
        main(["simulate", "--kind", "hand-controller", "--num-frames", str(FRAMES), "--out", str(out)]) == 0
    )
    said = capsys.readouterr().out
    assert f"{out}: {FRAMES} frames, " in said and str(out.with_suffix(".truth.npz")) in said
    assert out.read_bytes() == capture.read_bytes()
    assert main(["simulate", "--num-frames", "20", "--out", str(tmp_path / "text.trc"), "--seed", "4"]) == 0
    trc, truth = read_capture(tmp_path / "text.trc"), load_take(tmp_path / "text.truth.npz")
    np.testing.assert_allclose(trc.positions, truth.points, atol=1e-6)
    assert (tmp_path / "text.trc").read_text().startswith("PathFileType\t4\t(X/Y/Z)\ttext.trc\n")
    assert main(["simulate", "--num-frames", "20", "--out", str(tmp_path / "text.csv"), "--seed", "4"]) == 0
    motive = read_capture(tmp_path / "text.csv")
    np.testing.assert_allclose(motive.positions, truth.points, atol=1e-8)
    assert ",Take Name,text," in (tmp_path / "text.csv").read_text().splitlines()[0]
    present = truth.markers_present()
    assert present.shape == (20, 38) and present.mean() > 0.8


def test_the_optics_are_options_of_the_command(tmp_path):
    out = tmp_path / "take.c3d"
    command = ["simulate", "--num-frames", "20", "--out", str(out)]
    assert main([*command, "--optics.blob-loss", "0.9"]) == 0
    truth = load_take(out.with_suffix(".truth.npz"))
    assert truth.settings["room"]["optics"]["blob_loss"] == 0.9
    assert truth.markers_present().mean() < 0.8


def test_a_take_is_evaluated_with_its_own_gaps_and_ghosts(capture, tmp_path, capsys):
    truth, figures = capture.with_suffix(".truth.npz"), tmp_path / "figures.json"
    assert main(["evaluate", str(truth), "--json", str(figures)]) == 0
    assert "120 hands in frames" in capsys.readouterr().out
    found = json.loads(figures.read_text())
    assert found["frames"] == 2 * FRAMES
    assert found["figures"]["slot_accuracy"] > 0.8
    assert set(found["slot_accuracy_by_marker"]) == set(load_take(truth).hands[0].layout.names)
    assert main(["evaluate", str(truth), str(truth)]) == 0
    assert "240 hands in frames" in capsys.readouterr().out


def test_a_take_is_evaluated_with_the_glove_that_it_names(tmp_path, capsys):
    out = tmp_path / "take.c3d"
    assert main(["simulate", "--glove", "sparse13", "--num-frames", "30", "--out", str(out)]) == 0
    assert main(["evaluate", str(out.with_suffix(".truth.npz"))]) == 0
    assert "60 hands in frames" in capsys.readouterr().out


def test_every_nth_frame_of_a_capture_is_evaluated(tmp_path):
    capture, figures = tmp_path / "capture.trc", tmp_path / "figures.json"
    markers = held_out_markers("dense19", 40, seed=0)
    write_capture(capture, Capture(load_layout("dense19").names, markers, 100.0))
    assert main(["evaluate", str(capture), "--every", "15", "--json", str(figures)]) == 0
    found = json.loads(figures.read_text())
    assert (found["every"], found["frames"]) == (15, 3)


def test_a_glove_that_the_labeler_does_not_know_is_told(tmp_path, capsys):
    out = tmp_path / "take.c3d"
    assert main(["simulate", "--num-frames", "5", "--glove", "sparse13", "--out", str(out)]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(out.with_suffix(".truth.npz")), "--glove", "dense19"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "the labeler knows" in said


def test_a_capture_like_a_trial_says_what_came_from_it(capture, tmp_path, capsys):
    out = tmp_path / "like.c3d"
    command = ["simulate", "--kind", "free", "--num-frames", "60", "--like", str(capture), "--out", str(out)]
    assert main([*command, "--optics.noise", "0.3"]) == 0
    said = capsys.readouterr().out
    assert "found" in said and "markers missing [%]" in said
    line = next(one for one in said.splitlines() if one.startswith("from the trial: "))
    optics = load_take(out.with_suffix(".truth.npz")).settings["room"]["optics"]
    assert optics["noise"] == 0.3 and "optics.noise" not in line
    assert f"optics.dropout {optics['dropout']:g}" in line
    assert "the trial does not tell " in said


def test_a_trial_with_one_marker_is_refused_in_one_sentence(tmp_path, capsys):
    trial, path = tmp_path / "one.trc", np.zeros((50, 1, 3)) + [0.1, 0.2, 1.0]
    write_capture(trial, Capture(("RH1",), path, 100.0))
    assert main(["simulate", "--like", str(trial), "--out", str(tmp_path / "out.c3d")]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.endswith("only one marker stays for half of the frames, expected the markers of a hand")
    assert not (tmp_path / "out.c3d").exists()


def test_a_training_set_like_a_trial_keeps_the_options_that_are_given(capture, tmp_path, capsys):
    out = tmp_path / "set"
    command = ["generate", "--like", str(capture), "--num-frames", "64", "--workers", "1", "--out", str(out)]
    assert main([*command, "--blob-loss", "0.0", "0.15"]) == 0  # the default, but given
    said = capsys.readouterr().out
    config = json.loads((out / "config.json").read_text())
    assert config["blob_loss"] == [0.0, 0.15] and "blob_loss" not in said
    assert f"optics.noise {config['optics']['noise']:g}" in said
