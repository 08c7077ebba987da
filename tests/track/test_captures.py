"""Captures that are labeled and tracked: the labels and poses are those of their truth."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from gloves import Capture, GloveFit, Status, Take, load_take, read_capture, write_capture
from gloves.takes.take import LOST, STATUSES, TRACKED
from handsim.space.objects import named_object
from handsim.space.transforms import quaternion_matrix
from tests.programs import run_python
from track import (
    ReplayServer,
    RigidTemplate,
    Tracker,
    TrackerConfig,
    label_capture,
    open_source,
    track_capture,
)
from track.output.recorder import Recorder
from train import evaluate_labeler, load_labeler, simulate_take

FRAMES, RATE = 60, 120.0
TRACKED_FRAMES = 60


def capture_of(frames):
    """Points of each frame as a capture; columns go on from frame to frame."""
    positions = np.full((len(frames), max(map(len, frames)), 3), np.nan)
    for row, points in zip(positions, frames, strict=True):
        row[: len(points)] = points
    return Capture(tuple(f"*{column}" for column in range(positions.shape[1])), positions, RATE)


def right_slots(truth, labels, count):
    """Share of the slots of all frames that have their point, or rightly none."""
    right = [
        np.array_equal(np.flatnonzero(row == marker), np.flatnonzero(mine == marker))
        for row, mine in zip(truth, labels, strict=True)
        for marker in range(count)
    ]
    return np.mean(right)


def sides_there(take):
    """Whether each frame has labels of the right hand, and of the left one."""
    count = take.hands[0].layout.num_markers
    return [(bool(((row >= 0) & (row < count)).any()), bool((row >= count).any())) for row in take.labels]


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand"])
def test_two_hands_are_labeled_better_than_frame_by_frame_and_as_by_the_tracker(kind):
    """Means over two people; the labeler alone and the tracker mislabel some of their frames."""
    slots = []
    for seed in (0, 4):
        take = simulate_take(kind=kind, num_frames=FRAMES, seed=seed)
        alone = evaluate_labeler(load_labeler("dense19"), [take]).figures["slot_accuracy"]
        labels = label_capture(take.capture()).labels
        tracked = track_capture(take.capture()).labels
        ours, theirs = (right_slots(take.labels, one, len(take.label_names)) for one in (labels, tracked))
        slots.append((ours, theirs, alone))
    ours, theirs, alone = np.mean(slots, axis=0)
    assert ours >= max(alone, theirs) - 0.001


def test_one_hand_none_and_a_body(rng):
    take = simulate_take(num_frames=30)
    left = take.observed(take.hand_labels[1])
    body = rng.uniform(-0.9, 0.9, size=(40, 3)) + [0.0, 0.0, 5.0]
    frames = []
    for number, markers in enumerate(left):
        seen = markers[np.isfinite(markers[:, 0])]
        frames.append(np.concatenate([body, seen]) if number < 20 else body)
    labeled = label_capture(capture_of(frames))
    assert sides_there(labeled) == [(False, True)] * 20 + [(False, False)] * 10
    assert (labeled.labels[:, : len(body)] < 0).all()
    hands = [row[len(body) : len(points)] for row, points in zip(labeled.labels[:20], frames, strict=False)]
    assert np.mean([(row >= 0).mean() for row in hands]) > 0.98


@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_random_points_are_no_hand(spread, rng):
    walk = np.cumsum(rng.normal(scale=0.001, size=(8, 1, 3)), axis=0)
    labeled = label_capture(capture_of(list(walk + rng.normal(scale=spread, size=(30, 3)))))
    assert (labeled.labels >= 0).mean() < 0.01


def test_frames_without_order_are_labeled_as_the_labeler_does():
    """Poses that follow from nothing, a right hand in each with drops and ghosts."""
    rng = np.random.default_rng(1)
    take = simulate_take(num_frames=600)
    part = take.hand_labels[0]
    frames, truth = [], []
    for number in rng.permutation(600)[:60]:
        here = np.flatnonzero((take.labels[number] >= part.start) & (take.labels[number] < part.stop))
        kept = rng.permutation(here)[3:]
        center = take.points[number, kept].mean(axis=0)
        ghosts = center + rng.uniform(-0.08, 0.08, size=(2, 3))
        frames.append(np.concatenate([take.points[number, kept], ghosts]))
        truth.append(np.append(take.labels[number, kept] - part.start, [-1, -1]))
    given = [one.labels for one in load_labeler("dense19").label_frames(frames)]
    labeled = label_capture(capture_of(frames))
    ours = [row[: len(points)] for row, points in zip(labeled.labels, frames, strict=True)]
    assert np.mean([right for right, _ in sides_there(labeled)]) > 0.95
    count = part.stop - part.start
    assert right_slots(truth, ours, count) >= right_slots(truth, given, count) - 0.005


def test_a_mirrored_capture_has_the_other_sides():
    take = simulate_take(num_frames=30)
    points = take.points
    names = tuple(f"*{column}" for column in range(points.shape[1]))
    straight = label_capture(Capture(names, points, RATE))
    mirrored = label_capture(Capture(names, points * [-1.0, 1.0, 1.0], RATE))
    count = straight.hands[0].layout.num_markers
    swapped = np.where(mirrored.labels >= 0, (mirrored.labels + count) % (2 * count), -1)
    assert (straight.labels == swapped).mean() > 0.99


@pytest.fixture(scope="module")
def labeler():
    return load_labeler("dense19")


@pytest.fixture(scope="module")
def truth() -> Take:
    return simulate_take(kind="hand-controller", num_frames=TRACKED_FRAMES)


@pytest.fixture(scope="module")
def user(truth) -> list[GloveFit]:
    return list(truth.hands)


@pytest.fixture(scope="module")
def capture(truth) -> Capture:
    return Capture(tuple(f"*{n}" for n in range(truth.points.shape[1])), truth.points, truth.rate)


@pytest.fixture(scope="module")
def tracked(capture, user, labeler) -> Take:
    return track_capture(capture, hands=user, labeler=labeler, smooth=False)


def mostly_right(take: Take, labels: np.ndarray, last: int) -> bool:
    """Whether nearly all points of the hands have their true labels; others are nobody's."""
    true = np.where(labels < last, labels, -1)
    return np.mean(take.labels == true) > 0.99


def test_a_capture_is_tracked_as_its_truth_says(tracked, truth, user, tmp_path):
    assert tracked.sides == tuple(hand.shape.side for hand in truth.hands)
    assert (tracked.num_frames, tracked.rate) == (TRACKED_FRAMES, truth.rate)
    np.testing.assert_array_equal(tracked.points, truth.points)
    np.testing.assert_array_equal(tracked.ids < 0, np.isnan(truth.points[..., 0]))
    assert mostly_right(tracked, truth.labels, truth.hand_labels[-1].stop)
    assert (tracked.status[1:] == TRACKED).all() and (tracked.status[0] == STATUSES.index("found")).all()
    assert np.nanmedian(tracked.rms) < 0.0005
    for hand, true in enumerate(truth.moving_hands()):
        assert np.linalg.norm(tracked.qpos[:, hand, :3] - true.qpos[:, :3], axis=1).mean() < 0.0005
        seen, labels = tracked.observed(true.shape.side), truth.hand_labels[hand]
        there = np.isfinite(seen[..., 0])
        wanted = truth.observed(labels)
        assert np.mean(there == np.isfinite(wanted[..., 0])) > 0.99
        assert np.nanmax(np.abs(seen - wanted)[there & np.isfinite(wanted[..., 0])]) < 1e-9
        assert tracked.hands[hand].attachment is user[hand].attachment
    path = tmp_path / "take.npz"
    tracked.save(path)
    again = load_take(path)
    np.testing.assert_array_equal(again.markers("right"), tracked.markers("right"))
    assert again.settings["tracker"] == dataclasses.asdict(TrackerConfig())
    assert again.labels.dtype == tracked.labels.dtype and again.ids.dtype == tracked.ids.dtype


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_file_formats_change_nothing(suffix, tracked, capture, user, labeler, tmp_path):
    path = tmp_path / f"take{suffix}"
    write_capture(path, capture)
    again = track_capture(read_capture(path), hands=user, labeler=labeler, smooth=False)
    np.testing.assert_array_equal(again.labels, tracked.labels)
    np.testing.assert_allclose(again.qpos, tracked.qpos, atol=1e-4)


def test_progress_is_told_frame_by_frame(capture, user, labeler):
    short = Capture(capture.names, capture.positions[:5], capture.rate)
    told = []
    track_capture(short, hands=user, labeler=labeler, progress=lambda *done: told.append(done))
    assert told == [(n, 5) for n in range(1, 6)]


def test_another_process_that_labels_backward_changes_nothing(capture, user, labeler, monkeypatch):
    class Own:
        """A labeler that no other process can be given."""

        def __getattr__(self, name):
            return getattr(labeler, name)

    told = []
    alone = label_capture(capture, hands=user, labeler=labeler)
    monkeypatch.setattr("track.captures._WORTH_A_PROCESS", 1)
    monkeypatch.setattr("handsim.app.workers.usable_cores", lambda: 2)
    for one in (labeler, Own()):
        shared = label_capture(capture, hands=user, labeler=one, progress=lambda *done: told.append(done))
        np.testing.assert_array_equal(shared.labels, alone.labels)
        np.testing.assert_array_equal(shared.confidence, alone.confidence)
        assert told == sorted(told) and told[-1] == (len(capture.positions), len(capture.positions))
        told.clear()


def test_empty_frames_and_frames_without_hands_are_lost_not_wrong(user, labeler, rng):
    positions = np.full((4, 3, 3), np.nan)
    positions[2] = rng.normal(size=(3, 3))
    take = track_capture(Capture(("a", "b", "c"), positions, 120.0), hands=user, labeler=labeler)
    assert (take.status == LOST).all() and (take.labels == -1).all()
    assert np.isnan(take.qpos).all() and np.isnan(take.markers("left")).all()
    empty = Capture(("a",), np.full((2, 1, 3), np.nan), 120.0)
    assert track_capture(empty, hands=user, labeler=labeler).num_frames == 2
    assert (label_capture(empty).labels == -1).all()


def test_a_live_stream_gives_the_capture_s_take(truth, tracked, user, labeler, tmp_path):
    tracker = Tracker(user, labeler)
    recorder = Recorder(tmp_path / "take.npz", tracker)
    with ReplayServer(truth) as server, open_source(server.url, silence=0.4) as stream:
        stream.forgiven_until = math.inf  # nothing is dropped, however busy the machine
        for frame in stream:
            one = tracker.step(frame.points, frame.ids, frame.time)
            recorder.add(frame, one)
            if frame.silent:
                break
    assert [hand.status for hand in one.hands] == [Status.LOST] * 2, "nothing came for too long to go on"
    take, _ = recorder.finish({})
    assert take.num_frames == TRACKED_FRAMES, "a silence is no frame"
    assert take.rate == pytest.approx(truth.rate, rel=1e-3)
    assert take.points.shape[1] == np.isfinite(truth.points[..., 0]).sum(axis=1).max()
    for frame in range(TRACKED_FRAMES):
        ours, theirs = take.labels[frame], tracked.labels[frame]
        assert sorted(ours[ours >= 0]) == sorted(theirs[theirs >= 0])
    np.testing.assert_allclose(take.qpos, tracked.qpos, atol=1e-3)
    there = np.isfinite(take.points[..., 0])
    assert (take.ids[there] >= 0).all() and (take.ids[~there] == -1).all()


def test_bodies_are_kept_beside_the_hands(user, labeler, capture, truth):
    thing = RigidTemplate.of(named_object("controller"))
    positions = capture.positions.copy()
    first = truth.hand_labels[-1].stop
    positions[:2][truth.labels[:2] >= first] = np.nan
    part = Capture(capture.names, positions, capture.rate)
    take = track_capture(part, hands=user, labeler=labeler, bodies=[thing])
    names = [STATUSES[status] for status in take.body_status[:, 0]]
    assert names == ["lost"] * 2 + ["found"] + ["tracked"] * (TRACKED_FRAMES - 3)
    assert np.isnan(take.body_poses[:2]).all() and np.isnan(take.body_rms[:2]).all()
    assert np.nanmedian(take.body_rms) < 0.001
    away = np.linalg.norm(take.body_poses[2:, 0, :3] - truth.body_poses[2:, 0, :3], axis=1)
    turned = quaternion_matrix(take.body_poses[2:, 0, 3:]) - quaternion_matrix(truth.body_poses[2:, 0, 3:])
    assert np.median(away) < 0.0005 and np.median(np.abs(turned)) < 0.01
    assert take.label_names[first:] == tuple(f"controller:{name}" for name in thing.marker_names)
    there = truth.labels[2:] >= first
    assert np.mean(take.labels[2:][there] == truth.labels[2:][there]) > 0.99
    assert (take.labels[2:][~there] < first).all()


@pytest.mark.slow
def test_after_the_warm_up_no_kernel_is_compiled_any_more():
    """A live stream would wait for it: also the kernels of unsure labels are there."""
    run = """
import gc

import numpy as np
from numba.core.registry import CPUDispatcher

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from track.captures import track_capture
from track.takes.label_confidence import label_confidence
from track.tracker import Tracker
from track.frames import checked_frames
from train.labelers.storage import load_labeler
from train.simulation.takes import simulate_take

def ready():
    kernels = [one for one in gc.get_objects() if isinstance(one, CPUDispatcher)]
    return {(one.py_func.__qualname__, str(known)) for one in kernels for known in one.signatures}

take = simulate_take(kind="hand-hand", num_frames=40)
hands = [nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left")]
labeler = load_labeler("dense19")
Tracker(hands, labeler).warm_up()
checked_frames(take.capture())  # of a whole capture alone, as the next; a stream has neither
label_confidence(take)
before = ready()
track_capture(take, hands=hands, labeler=labeler, smooth=False)  # as a stream is tracked
for cloud in np.random.default_rng(1).uniform(0.0, 0.1, (20, 19, 3)):
    labeler.label_frames([cloud])
assert before and ready() == before, ready() - before
"""
    run_python(run)
