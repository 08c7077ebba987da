"""What a tracked take tells of a wrong glove, a hand too many or too few, and hands that do not fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.captures.capture import Capture
from gloves.captures.formats import write_capture
from gloves.takes.take import COASTING, LOST, TRACKED, Take
from handsim.cli.main import main
from track.capture_tracking import track_capture
from track.take_summary import doubts_of, frame_confidence, runs_of, summarize, suspicions
from train.simulation.takes import simulate_take

FRAMES = 40


@pytest.fixture(scope="module")
def truth() -> Take:
    return simulate_take(kind="single-hand", num_frames=FRAMES)


@pytest.fixture(scope="module")
def tracked(truth) -> Take:
    return track_capture(truth, hands=truth.hands, labeler="dense19")


def test_a_good_take_tells_nothing(tracked):
    assert suspicions(tracked) == []


def test_a_hand_that_is_not_there(tracked):
    status, qpos, rms = tracked.status.copy(), tracked.qpos.copy(), tracked.rms.copy()
    status[:, 0], qpos[:, 0], rms[:, 0] = LOST, np.nan, np.nan
    take = dataclasses.replace(tracked, status=status, qpos=qpos, rms=rms)
    side, other = tracked.sides
    assert suspicions(take) == [], "one hand is there"
    assert summarize(take)[0] == f"{side} hand: not there"
    status[:, 1], qpos[:, 1], rms[:, 1] = LOST, np.nan, np.nan
    assert suspicions(dataclasses.replace(take, status=status, qpos=qpos, rms=rms)) == [
        f"the {one} hand was seen in 0.0 % of the frames; name the glove worn (--glove) and the hands "
        "(--hands)"
        for one in (side, other)
    ]


def test_points_of_others_are_counted_apart(tracked):
    count = tracked.points.shape[1]
    far = np.full((FRAMES, count, 3), 3.0) + np.arange(count)[:, None]
    blank = np.full((FRAMES, count), -1)
    take = dataclasses.replace(
        tracked,
        points=np.concatenate([tracked.points, far], axis=1),
        labels=np.concatenate([tracked.labels, blank], axis=1),
        ids=np.concatenate([tracked.ids, blank], axis=1),
        confidence=np.concatenate([tracked.confidence, np.ones(blank.shape)], axis=1),
    )
    assert suspicions(take) == []
    assert summarize(take)[-1].endswith("points are not markers, 0 of them at the hands")


def test_markers_that_were_not_seen_and_markers_off_the_pose(tracked):
    rms, first = tracked.rms.copy(), (tracked.labels >= 0) & (tracked.labels < 10)
    rms[:, 1] = 0.0061
    labels, points = tracked.labels.copy(), tracked.points.copy()
    labels[first], points[first] = -1, np.nan
    told = suspicions(dataclasses.replace(tracked, labels=labels, points=points, rms=rms))
    assert [sentence.split(";")[0] for sentence in told] == [
        f"52.6 % of the {tracked.sides[0]} hand's markers were not seen and are filled in from its pose",
        f"the {tracked.sides[1]} hand's markers are 6.1 mm off its pose",
    ]


def test_the_command_tells_of_a_wrong_glove(truth, tmp_path, capsys):
    names = tuple(f"*{column}" for column in range(truth.points.shape[1]))
    write_capture(tmp_path / "take.c3d", Capture(names, truth.points, truth.rate))
    out = str(tmp_path / "take.npz")
    assert main(["track", str(tmp_path / "take.c3d"), "--glove", "sparse13", "--out", out]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert told and all(line.startswith("handsim track: warning: ") for line in told)
    assert any(" of the points at the hands are not markers of what was tracked" in line for line in told)


def test_points_that_are_none_are_told_alone(tracked):
    nothing = np.full(tracked.points.shape, np.nan)
    sentences = {
        "no point is in any of the 40 frames": nothing,
        "all points are at the origin": 0.0 * tracked.points,
    }
    sentences["the points of a frame span"] = 1e3 * tracked.points
    for sentence, points in sentences.items():
        (told,) = suspicions(dataclasses.replace(tracked, points=points))
        assert told.startswith(sentence) and "--glove" not in told


def test_a_truth_is_summed_up_without_residuals(truth):
    told = summarize(truth)
    assert told[0].startswith(f"{truth.sides[0]} hand: tracked 100.0 %, ")
    assert "never found" not in " ".join(told) and "RMS" not in " ".join(told)


def test_doubtful_frames_are_the_worst_of_their_runs(tracked):
    assert runs_of(np.array([True, False, False, True, True])) == [(0, 0), (3, 4)]
    assert runs_of(np.zeros(3, dtype=bool)) == [] == runs_of(np.zeros(0, dtype=bool))
    status = np.full(tracked.status.shape, TRACKED, dtype=np.int8)
    status[10, 0], status[12:14, 1], status[-5:, 1], status[0, 1] = COASTING, COASTING, LOST, LOST
    confidence = np.where(np.isfinite(tracked.points[..., 0]), 0.99, np.nan)
    columns = np.flatnonzero((tracked.labels[4:7] >= 0).all(axis=0) & (tracked.labels[20] >= 0))[:2]
    confidence[4:7, columns[0]], confidence[5, columns[1]], confidence[20, columns[0]] = 0.8, 0.7, 0.4
    qpos = np.where((status == LOST)[..., None], np.nan, tracked.qpos)
    take = dataclasses.replace(tracked, status=status, qpos=qpos, confidence=confidence)
    doubts = doubts_of(take)
    assert [doubt[:3] for doubt in doubts] == [
        (35, 39, 35), (12, 13, 12), (10, 10, 10), (20, 20, 20), (4, 6, 5)
    ], "the longest loss first; not there yet is not lost"  # fmt: skip
    first, second = take.sides
    worst = take.label_names[take.labels[5, columns[1]]]
    assert [doubt.words for doubt in doubts[:3]] == [
        f"{second} lost",
        f"{second} coasting",
        f"{first} coasting",
    ]
    assert (doubts[4].of, doubts[4].why, doubts[4].words) == (worst, "70 %", f"{worst} 70 %")
    assert doubts_of(take, most=2) == doubts[:2]
    certain = frame_confidence(take)
    assert certain[10] == certain[35] == 0.0 and certain[20] == 0.4
    assert (certain[36:] == 0.99).all(), "lost for long is no news"
