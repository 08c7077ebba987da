"""`handsim label` of captures with two hands, one and none, and `handsim evaluate` of what it writes."""

from __future__ import annotations

import dataclasses
import json
import signal

import ezc3d
import numpy as np
import pytest

from gloves import Capture, load_layout, read_capture, write_capture
from handsim.cli.main import main
from track.kinematics import pose_solver
from train import load_labeler, simulate_take

FRAMES = 40
NAMES = load_layout("dense19").names


@pytest.fixture(scope="module")
def take():
    return simulate_take(num_frames=FRAMES)


def label(folder, capture, capsys):
    """The labeled capture, and what the command said."""
    write_capture(folder / "in.c3d", capture)
    assert main(["label", str(folder / "in.c3d"), "--out", str(folder / "out.trc")]) == 0
    return read_capture(folder / "out.trc"), capsys.readouterr()


def test_two_hands_have_columns_of_their_own_and_are_evaluated_each(take, tmp_path, capsys):
    labeled, said = label(tmp_path, take.capture(), capsys)
    columns = [f"{side}:{name}" for side in ("right", "left") for name in NAMES]
    assert list(labeled.names[:38]) == columns
    assert f"two hands in {FRAMES} frames" in said.out and "no hand" not in said.err
    for first, side in ((0, "right"), (19, "left")):
        (number,) = (n for n, hand in enumerate(take.hands) if hand.side == side)
        truth = take.observed(take.hand_labels[number])
        given = labeled.positions[:, first : first + 19]
        same = np.isclose(given, truth, atol=1e-5, equal_nan=True).all(axis=-1)
        assert same.mean() > 0.97
    figures = tmp_path / "figures.json"
    assert main(["evaluate", str(tmp_path / "out.trc"), "--json", str(figures)]) == 0
    found = json.loads(figures.read_text())
    assert found["frames"] == 2 * FRAMES and found["figures"]["slot_accuracy"] > 0.97


def test_labels_in_a_file_are_counted_against_the_truth(take, tmp_path, capsys):
    take.save(tmp_path / "take.truth.npz")
    label(tmp_path, take.capture(), capsys)
    figures = tmp_path / "figures.json"
    command = ["evaluate", str(tmp_path / "out.trc"), "--truth", str(tmp_path / "take.truth.npz")]
    assert main([*command, "--json", str(figures)]) == 0
    found, said = json.loads(figures.read_text()), capsys.readouterr().out
    assert found["frames"] == FRAMES and 0.97 < found["figures"]["slot_accuracy"] <= 1.0
    assert found["numbers"]["points_of_truth_alone"] == found["numbers"]["points_of_capture_alone"] == 0
    assert found["slot_accuracy_interval"] is None  # the capture is shorter than a second
    assert "right:ThumbTip" in said and "all" in said
    assert main(["evaluate", str(tmp_path / "in.c3d"), *command[2:]]) == 1
    assert "no columns of markers" in capsys.readouterr().err


def test_one_hand_has_the_names_of_the_markers(take, tmp_path, capsys):
    (left,) = (n for n, hand in enumerate(take.hands) if hand.side == "left")
    positions = take.observed(take.hand_labels[left]).copy()
    positions[30:] = np.nan
    labeled, said = label(tmp_path, Capture(NAMES[::-1], positions[:, ::-1], take.rate), capsys)
    assert labeled.names[:19] == NAMES
    assert "a left hand in 30 frames, no hand in 10 frames" in said.out
    assert np.isclose(labeled.positions[:30, :19], positions[:30], atol=1e-5, equal_nan=True).mean() > 0.97


def test_a_folder_is_labeled_by_one_labeler_past_a_capture_that_cannot_be_read(
    take, tmp_path, capsys, monkeypatch
):
    loaded = []
    monkeypatch.setattr("track.user.load_labeler", lambda *of: loaded.append(of) or load_labeler(*of))
    captures, out = tmp_path / "captures", tmp_path / "captures" / "labeled"
    short = dataclasses.replace(take.capture(), positions=take.capture().positions[:4])
    for name in ("a.c3d", "b.trc", "day/a.c3d"):
        write_capture(captures / name, short)
    (captures / "b.trc").write_text("no marker file")
    for count in (2, 0):  # what is labeled already is neither a capture nor labeled the second time
        loaded.clear()
        assert main(["label", str(captures), "--out", str(out)]) == 1
        said = capsys.readouterr()
        assert len([line for line in said.out.splitlines() if "two hands in 4 frames" in line]) == count
        assert f"{captures / 'b.trc'}: not labeled: not a TRC file" in said.err
        last = said.err.splitlines()[-1]
        assert last == f"handsim label: 1 of 3 files were not labeled: {captures / 'b.trc'}"
        assert len({id(of[1]) for of in loaded if hasattr(of[1], "label_frames")}) == bool(count)
        assert len([of for of in loaded if of[1] is None]) == bool(count)
    files = {path.relative_to(out).as_posix() for path in out.rglob("*.*")}
    assert files == {"a.c3d", "day/a.c3d", "study.json"}
    assert read_capture(out / "day" / "a.c3d").names[0] == f"right:{NAMES[0]}"


@pytest.mark.parametrize("side", ["right", "left"])
def test_one_of_two_hands_is_labeled_where_it_is_named(side, take, tmp_path, capsys):
    write_capture(tmp_path / "in.c3d", take.capture())
    command = ["label", str(tmp_path / "in.c3d"), "--hands", side, "--out", str(tmp_path / "out.trc")]
    assert main(command) == 0
    assert f"a {side} hand in {FRAMES} frames" in capsys.readouterr().out
    truth, given = take.observed(side), read_capture(tmp_path / "out.trc").positions[:, :19]
    assert np.isclose(given, truth, atol=1e-5, equal_nan=True).all(axis=-1).mean() > 0.95


def test_a_capture_without_a_hand_is_told(take, tmp_path, capsys, rng):
    body = rng.uniform(-0.9, 0.9, size=(40, 3)) + np.zeros((10, 1, 1))
    capture = Capture(tuple(f"*{number}" for number in range(40)), body, take.rate)
    empty = dataclasses.replace(capture, positions=np.full_like(body, np.nan))
    for given, words in (
        (capture, "expected hands in glove 'dense19'"),
        (empty, "no point is in any of the 10 frames"),
    ):
        labeled, said = label(tmp_path, given, capsys)
        assert not np.isfinite(labeled.positions[:, :19]).any()
        assert f"0 of {np.isfinite(given.positions[..., 0]).sum()} points labeled; no hand in 10 frames" in (
            said.out
        )
        assert words in said.err


def test_ctrl_c_in_compiled_code_is_no_mistake_of_ours(take, tmp_path, capsys, monkeypatch):
    """Compiled code that is interrupted returns a SystemError."""
    wrapped: list[SystemError] = []
    compiled = pose_solver._fit_frames

    def interrupted(*args: object) -> object:
        signal.setitimer(signal.ITIMER_REAL, 1e-4)
        try:
            return compiled(*args)
        except SystemError as error:
            wrapped.append(error)
            raise

    monkeypatch.setattr(pose_solver, "_fit_frames", interrupted)
    write_capture(tmp_path / "in.c3d", take.capture())
    before = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        for _ in range(50):  # a busy machine may interrupt Python instead
            assert main(["label", str(tmp_path / "in.c3d"), "--out", str(tmp_path / "out.trc")]) == 130
            assert capsys.readouterr().err == "handsim label: interrupted\n"
            if wrapped:
                break
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert wrapped and not (tmp_path / "out.trc").exists()


def test_a_labeled_c3d_keeps_what_its_source_has_beside_points(tmp_path, rng):
    source, out = tmp_path / "in.c3d", tmp_path / "out.c3d"
    content = ezc3d.c3d()
    content["header"]["points"]["first_frame"] = 41
    parameters, data = content["parameters"], content["data"]
    parameters["POINT"]["RATE"]["value"], parameters["POINT"]["UNITS"]["value"] = [100.0], ["mm"]
    parameters["POINT"]["LABELS"]["value"] = [f"*{number}" for number in range(40)]
    data["points"] = np.ones((4, 40, 10))
    data["points"][:3] = rng.uniform(-900.0, 900.0, size=(3, 40, 1))
    parameters["ANALOG"]["RATE"]["value"], parameters["ANALOG"]["LABELS"]["value"] = [1000.0], ["EMG"]
    data["analogs"] = rng.normal(size=(1, 1, 100))
    content.write(str(source))
    assert main(["label", str(source), "--out", str(out)]) == 0
    before, after = ezc3d.c3d(str(source)), ezc3d.c3d(str(out))
    assert after["header"]["points"]["first_frame"] == before["header"]["points"]["first_frame"] == 41
    np.testing.assert_array_equal(after["data"]["analogs"], before["data"]["analogs"])


@pytest.mark.parametrize(
    "arguments",
    [
        "label gone.c3d --out out.c3d",
        "label gone.c3d lost.c3d --out labeled",
        "label empty.c3d --out out.c3d",
        "track gone.c3d --out out.npz",
        "track gone.npz --out out.npz",
        "track empty.c3d --out out.npz --calibrate",
        "calibrate gone.trc --out user.json",
        "evaluate gone.c3d",
        "evaluate there.c3d gone.c3d",
    ],
)
def test_a_capture_is_read_before_a_glove_is_learned(arguments, take, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    layout = load_layout("dense19")
    dataclasses.replace(layout, name="mine", markers=layout.markers[:-1]).save("mine.toml")
    write_capture("there.c3d", take.capture())
    (tmp_path / "empty.c3d").touch()
    before = {*tmp_path.iterdir()}
    assert main([*arguments.split(), "--glove", "mine.toml"]) == 1
    said = capsys.readouterr().err
    assert "cannot be read" in said or "is empty" in said or "not labeled" in said
    assert "learns it now" not in said and {*tmp_path.iterdir()} == before
