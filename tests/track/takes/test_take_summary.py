"""What a tracked take tells of a wrong glove, a hand too many or too few, and hands that do not fit."""

from __future__ import annotations

import csv
import dataclasses

import numpy as np
import pytest

from gloves import Capture, MarkerLayout, Take, attach, load_layout, write_capture
from gloves.takes.take import LOST
from handsim import HandModel
from handsim.cli.main import main
from handsim.hand.shape import JOINT_NAMES
from poses import sample_poses
from track import find_suspect_spans, track_capture
from track.takes import take_summary
from track.takes.take_faults import SuspectSpan
from track.takes.take_figures import hand_figures
from track.takes.take_page import write_take_page
from track.takes.take_summary import frame_confidence, runs_of, summarize, suspicions
from train import simulate_take

FRAMES = 40
LITTLE = "no marker is on the little finger: its angles are guesses"


@pytest.fixture(scope="module")
def truth() -> Take:
    return simulate_take(kind="single-hand", num_frames=FRAMES)


@pytest.fixture(scope="module")
def tracked(truth) -> Take:
    return track_capture(truth, hands=truth.hands, labeler="dense19")


def test_a_good_take_tells_nothing(tracked):
    assert suspicions(tracked) == []


def test_of_the_faults_of_several_people_those_of_the_last_hands_are_told(tracked, monkeypatch):
    last = tracked.num_frames - 1
    faults = [
        SuspectSpan(*frames, frames[0], of, "slips", "glue it")
        for frames, of in (((0, 9), "right:A"), ((10, last), "right:B"))
    ]
    monkeypatch.setattr(take_summary, "find_faults", lambda take: faults)
    assert suspicions(tracked) == [
        "right:B slips; glue it",
        "faults of the hands of earlier frames, which the report lists as doubtful: 1",
    ]


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
    far = np.full((FRAMES, count, 3), 3.0) + 0.1 * np.arange(count)[:, None]
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
    options = ["--glove", "sparse13", "--size", "M", "--out", out]
    assert main(["track", str(tmp_path / "take.c3d"), *options]) == 0
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


def test_doubtful_frames_are_listed_by_the_stored_confidence_where_there_are_no_poses(tracked):
    assert runs_of(np.array([True, False, False, True, True])) == [(0, 0), (3, 4)]
    assert runs_of(np.zeros(3, dtype=bool)) == [] == runs_of(np.zeros(0, dtype=bool))
    confidence = np.where(np.isfinite(tracked.points[..., 0]), 0.99, np.nan)
    columns = np.flatnonzero((tracked.labels[4:7] >= 0).all(axis=0) & (tracked.labels[28] >= 0))[:2]
    confidence[4:7, columns[0]], confidence[5, columns[1]], confidence[28, columns[0]] = 0.5, 0.3, 0.1
    confidence[11, columns[0]], confidence[34, columns[0]] = 0.55, 0.9
    take = dataclasses.replace(
        tracked,
        rate=200.0,  # spans of less than ten frames from each other are one
        status=np.full(tracked.status.shape, LOST, dtype=np.int8),
        qpos=np.full(tracked.qpos.shape, np.nan),
        confidence=confidence,
    )
    doubts = find_suspect_spans(take)
    assert [doubt[:3] for doubt in doubts] == [(4, 11, 5), (28, 28, 28)], "more of the first is wrong"
    assert doubts[0].words == f"{take.label_names[take.labels[5, columns[1]]]} labeled, 30 %"
    assert find_suspect_spans(take, most=1) == doubts[:1]
    assert frame_confidence(take)[[5, 28, 34, 35]].tolist() == [0.3, 0.1, 0.9, 0.99]


def test_doubtful_frames_of_a_tracked_take(tracked):
    assert find_suspect_spans(tracked) == (), "nothing is wrong"
    column = int(np.flatnonzero((tracked.labels[10:20] == 3).all(axis=0))[0])
    labels, status, qpos = tracked.labels.copy(), tracked.status.copy(), tracked.qpos.copy()
    labels[10:16, column] = -1
    (missed,) = find_suspect_spans(dataclasses.replace(tracked, labels=labels))
    assert missed.first <= 10 and missed.last >= 15 and 10 <= missed.worst <= 15
    assert missed.words.startswith(f"{tracked.label_names[3]} without a label, ")
    labels = np.where(
        np.arange(FRAMES)[:, None] < 20, tracked.labels, np.where(tracked.labels < 19, -1, tracked.labels)
    )
    status[20:, 0], qpos[20:, 0] = LOST, np.nan
    (lost,) = find_suspect_spans(dataclasses.replace(tracked, labels=labels, status=status, qpos=qpos))
    assert lost.first >= 15 and lost.last == FRAMES - 1
    known = np.where(np.isfinite(tracked.points[..., 0]), 1.0, np.nan)
    assert find_suspect_spans(dataclasses.replace(tracked, labels=labels, confidence=known)) == (), (
        "it was corrected"
    )


def without(*bones: str, sides: tuple[str, ...] = ("left", "right")) -> MarkerLayout:
    """dense19 without the markers of some bones."""
    dense = load_layout("dense19")
    kept = tuple(marker for marker in dense.markers if not marker.bone.startswith(bones))
    return dataclasses.replace(dense, name="part", markers=kept, sides=sides)


GLOVES = {
    "no little finger": (without("little"), [16, 17, 18, 19], LITTLE),
    "no index tip": (
        without("index_distal"),
        [7],
        "no marker is beyond the DIP of the index finger: its angles from there on are guesses",
    ),
    "half a ring finger": (
        without("ring_distal", "ring_middle"),
        [14, 15],
        "no marker is beyond the PIP of the ring finger: its angles from there on are guesses",
    ),
    "no thumb": (without("thumb"), [0, 1, 2, 3], "no marker is on the thumb: its angles are guesses"),
    "half a thumb": (
        without("thumb_distal", "thumb_proximal"),
        [3],  # ThumbMCP lies beyond the end of its bone
        "no marker is beyond the IP of the thumb: its angles from there on are guesses",
    ),
    "starter6": (
        load_layout("starter6"),
        [*range(12, 20)],
        f"no marker is on the ring finger: its angles are guesses; {LITTLE}",
    ),
    "a left glove": (without("little", sides=("left",)), [16, 17, 18, 19], LITTLE),
    "dense19": (load_layout("dense19"), [], ""),
}


@pytest.mark.parametrize("glove", GLOVES)
def test_joints_that_no_marker_can_show_are_guesses_and_never_measured(glove, tmp_path):
    layout, joints, sentence = GLOVES[glove]
    hands = [HandModel.named("M", side=side) for side in layout.sides]
    qpos = np.stack([sample_poses(hand, 6, rng=np.random.default_rng(0)) for hand in hands], axis=1)
    qpos[:, :, 0] += np.arange(len(hands))
    fits = [attach(layout, hand) for hand in hands]
    points = np.concatenate([fit.markers(qpos[:, at])[0] for at, fit in enumerate(fits)], axis=1)
    labels = np.tile(np.arange(points.shape[1]), (6, 1))
    truth = Take.of_truth(fits, qpos, points, labels, labels, rate=100.0)
    settings = {**truth.settings, "tracker": {}, "user": "M"}
    take = dataclasses.replace(truth, rms=np.zeros(truth.rms.shape), settings=settings)
    told = [line for line in summarize(take) if "guesses" in line]
    assert told == [f"{side} hand: {sentence}" for side in layout.sides if sentence]
    for figures in hand_figures(take):
        unmeasured = np.flatnonzero(~figures.measured.any(axis=0))
        assert unmeasured.tolist() == joints and np.isnan(figures.joints()[joints, :5]).all()
    write_take_page(tmp_path / "page.html", take)
    assert (tmp_path / "page.html").read_text().count(sentence) >= len(told)
    take.export(tmp_path / "angles.csv")
    for name, unit in (("page.frames.csv", "deg"), ("angles.csv", "rad")):
        with (tmp_path / name).open() as file:
            for row in csv.DictReader(file):
                blank = [number for number, joint in enumerate(JOINT_NAMES) if not row[f"{joint}_{unit}"]]
                assert blank == joints
    assert not any("guesses" in line for line in summarize(truth)), "its angles are known"
