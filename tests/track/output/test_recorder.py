"""Recordings of a stream: the take in memory and that on disk are one, also when it was cut at any byte."""

from __future__ import annotations

import csv
import dataclasses
import functools
import os
import shutil
import signal
import threading
import warnings
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gloves import RigidBody, Status, Take, load_layout, load_take, read_capture
from gloves.fit import nominal_fit
from gloves.takes import points
from gloves.takes.archives import CutOffWarning
from gloves.takes.take import LOST, STATUSES, TRACKED, keypoints_of, usual_rate
from handsim import HandSimWarning, join_qpos
from handsim.errors import ArgumentError, CaptureError
from handsim.hand.model import KEYPOINT_NAMES
from handsim.space.objects import named_object
from handsim.space.transforms import file_axes
from render.subject import subject_of
from tests.handsim.motion_files.test_scenes import Glb
from track import (
    Recorder,
    ReplayServer,
    RigidTemplate,
    StreamedFrame,
    TrackedBody,
    TrackedFrame,
    TrackedHand,
    Tracker,
    open_source,
)
from track.frames import capture_frames
from track.output import recorder as module
from track.output.recorder import frame_values
from track.settings import TrackerSetup, TrackSettings
from train import load_labeler, simulate_take

FRAMES = 24
COUNTS = {"missing_frames": 2}
PEN = RigidBody("pen", ("Pen1", "Pen2", "Pen3"), np.diag([0.03, 0.05, 0.08]))


@functools.cache
def tracked():
    """A tracker and the frames that it made of a capture."""
    take = simulate_take(kind="hand-controller", num_frames=FRAMES)
    hands = [nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left")]
    tracker = Tracker(hands, load_labeler("dense19"), (RigidTemplate.of(named_object("controller")),))
    return tracker, [
        (frame, tracker.step(frame.points, frame.ids, frame.time)) for frame in capture_frames(take.capture())
    ]


def recorded(folder, *, frames: int = FRAMES) -> Recorder:
    tracker, pairs = tracked()
    recorder = Recorder(folder / "new" / "take.npz", tracker, {"capture": "natnet://here"})
    for frame, one in pairs[:frames]:
        recorder.add(frame, one)
        recorder.add(dataclasses.replace(frame, silent=True), one)
    return recorder


def in_memory() -> Take:
    tracker, pairs = tracked()
    rows = [frame_values(*pair) for pair in pairs]
    arrays = {
        column.name: np.array([row[column.name] for row in rows])
        for column in (*points.FRAMES, points.NUMBERS, *points.SPREADS)
    }
    entries = {column.name: np.concatenate([row[column.name] for row in rows]) for column in points.POINTS}
    return Take(
        rate=usual_rate(arrays["times"], arrays["numbers"]),
        hands=tracker.hands,
        bodies=tracker.bodies,
        settings={},
        point_list=points.PointList.in_order(np.array([len(row["points"]) for row in rows]), **entries),
        **arrays,
    )


def assert_equal(one: Take, other: Take) -> None:
    for field in dataclasses.fields(Take):
        ours, theirs = getattr(one, field.name), getattr(other, field.name)
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs)
    assert one.rate == other.rate and one.sides == other.sides and one.label_names == other.label_names


def test_the_take_on_disk_is_that_in_memory(tmp_path):
    recorder = recorded(tmp_path)
    assert recorder.num_frames == FRAMES and recorder.duration == pytest.approx((FRAMES - 1) / 120.0)
    summarized, step = recorder.finish(COUNTS)
    out = tmp_path / "new" / "take.npz"
    assert os.listdir(out.parent) == ["take.npz"], "the recording became the take"
    take = load_take(out)
    assert step == 1
    for one in (take, summarized):
        assert_equal(one, in_memory())
        np.testing.assert_array_equal(one.numbers, np.arange(FRAMES))
        assert one.settings["stream"] == COUNTS and one.settings["capture"] == "natnet://here"
        assert one.settings["tracker"] == dataclasses.asdict(tracked()[0].config)
    take.save(tmp_path / "again.npz")
    assert_equal(load_take(tmp_path / "again.npz"), take)


@functools.cache
def resized():
    """Frames of hands that change their size twice, and the size of each frame."""
    _, pairs = tracked()
    users = [TrackerSetup.of(TrackSettings(size=size)).user for size in ("S", "M", "L")]
    sizes = np.repeat([0, 1, 2], [5, 1, FRAMES - 6])
    expected = [
        keypoints_of(users[size].hands, np.array([[hand.qpos for hand in one.hands]]))[0]
        for size, (_, one) in zip(sizes, pairs, strict=True)
    ]
    return users, sizes, np.array(expected)


def record_sizes(folder) -> Recorder:
    (users, sizes, _), (tracker, pairs) = resized(), tracked()
    before = tracker.user
    tracker.resize(users[0])
    recorder = Recorder(folder / "new" / "take.npz", tracker)
    for size, (frame, one) in zip(sizes, pairs, strict=True):
        if tracker.user is not users[size]:
            tracker.resize(users[size])
        recorder.add(frame, one)
    tracker.resize(before)
    return recorder


@pytest.fixture
def sized(tmp_path):
    return record_sizes(tmp_path)


def lengths(hands) -> list[float]:
    return [hand.shape.length for hand in hands]


@pytest.mark.filterwarnings("ignore::gloves.takes.archives.CutOffWarning")
def test_every_frame_keeps_its_hands(sized, tmp_path):
    users, sizes, expected = resized()
    sized._archive.flush()
    growing = load_take(sized.part)
    sized.finish(COUNTS)
    take = load_take(tmp_path / "new" / "take.npz")
    take.save(tmp_path / "again.npz")
    for one in (take, growing, load_take(tmp_path / "again.npz")):
        assert [former.stop for former in one.former] == [5, 6]
        assert [former.notes for former in one.former] == ["S", "M"]
        for frame, size in enumerate(sizes):
            assert lengths(one.hands_at(frame)) == lengths(users[size].hands)
        np.testing.assert_allclose(one.keypoints(), expected, atol=1e-9)
    with np.load(tmp_path / "new" / "take.npz") as stored:
        np.testing.assert_array_equal(stored["keypoints"], take.keypoints())
    for first, last in ((0, 5), (0, 6), (3, 9), (4, FRAMES), (6, 10), (2, 4)):
        part = take.cut(first, last)
        np.testing.assert_allclose(part.keypoints(), expected[first:last], atol=1e-9)
        assert part.settings["user"] == "SML"[sizes[last - 1]]
        assert lengths(part.hands) == lengths(users[sizes[last - 1]].hands)
    with pytest.raises(ArgumentError, match="former hands end at frames"):
        dataclasses.replace(take, former=take.former[::-1])
    with pytest.raises(ArgumentError, match="other sides or gloves"):
        dataclasses.replace(take, former=[take.former[0]._replace(hands=take.hands[:1])])


def test_markers_and_offsets_are_those_of_each_frame_s_hands(sized, tmp_path):
    users, sizes, _ = resized()
    sized.finish(COUNTS)
    take = load_take(tmp_path / "new" / "take.npz")
    there = np.flatnonzero(take.status[:, 0] != LOST)
    assert len(there) > FRAMES // 2
    markers, offsets = take.pose_markers(take.sides[0], there), take.marker_offsets(take.sides[0], there)
    for row, frame in enumerate(there):
        worn, alone = users[sizes[frame]].hands[0], take.cut(frame, frame + 1)
        np.testing.assert_allclose(markers[row], worn.markers(take.qpos[frame, :1])[0][0], atol=1e-9)
        np.testing.assert_array_equal(offsets[row], alone.marker_offsets(take.sides[0], np.array([0]))[0])


def test_exports_have_the_keypoints_that_were_sent(sized, tmp_path):
    _, _, expected = resized()
    sized.finish(COUNTS)
    take = load_take(tmp_path / "new" / "take.npz")
    there = take.status[:, 0] != LOST
    take.export(tmp_path / "hands.trc")
    take.export(tmp_path / "hands.csv")
    take.export(tmp_path / "hands.glb")
    capture = read_capture(tmp_path / "hands.trc")
    right = [name.startswith(f"{take.sides[0]}_") for name in capture.names]
    positions = capture.positions[:, right] @ file_axes("z")
    np.testing.assert_allclose(positions[there], expected[there, 0], atol=1e-4)
    rows = list(csv.DictReader((tmp_path / "hands.csv").open()))
    tips = [[float(row[f"index_tip_{axis}_m"] or "nan") for axis in "xyz"] for row in rows]
    hands = [row["hand"] == take.sides[0] for row in rows]
    tip = KEYPOINT_NAMES.index("index_tip")
    np.testing.assert_allclose(np.array(tips)[hands][there], expected[there, 0, tip], atol=1e-6)
    glb = Glb(tmp_path / "hands.glb")
    for frame in np.flatnonzero(there):
        places = glb.worlds(take.times[frame] - take.times[0])
        joint = places[glb.named(f"{take.sides[0]}_index_distal")][:3, 3]
        shown = file_axes("z") @ expected[frame, 0, KEYPOINT_NAMES.index("index_DIP")]
        np.testing.assert_allclose(joint, shown, atol=5e-4)


def test_a_recording_of_several_sizes_may_be_cut_at_any_byte(sized, tmp_path):
    sized.close()
    whole, (_, _, expected) = sized.part.read_bytes(), resized()
    for end in np.linspace(len(whole) - 40_000, len(whole) - 1, 40, dtype=int):
        sized.part.write_bytes(whole[:end])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CutOffWarning)
            try:
                take = load_take(sized.part)
            except CaptureError:
                continue
        np.testing.assert_allclose(take.keypoints()[:5], expected[: take.num_frames][:5], atol=1e-9)


def test_a_recording_that_was_cut_off_is_read(tmp_path):
    recorder = recorded(tmp_path)
    recorder.close()
    with recorder.part.open("ab") as file:
        file.write(b"blk\n and no more")
    with pytest.warns(CutOffWarning, match=r"take\.npz\.part: a recording that was cut off .* 24 frames"):
        assert_equal(load_take(recorder.part), in_memory())
    with pytest.warns(CutOffWarning):
        assert subject_of(recorder.part, seed=0).take.num_frames == FRAMES
    with pytest.raises(CaptureError, match=r"take\.npz: no such file, but .*take\.npz\.part is a recording"):
        load_take(tmp_path / "new" / "take.npz")
    with pytest.raises(CaptureError, match="exists: a recording that was cut off"):
        recorded(tmp_path)


@pytest.mark.parametrize("frames", [0, 1])
def test_too_few_frames_leave_nothing(frames, tmp_path):
    recorder = recorded(tmp_path, frames=frames)
    recorder._archive.flush()
    with pytest.raises(CaptureError, match=f"{frames} frames, expected two or more"):
        load_take(recorder.part)
    with pytest.raises(CaptureError, match=f"{frames} frames came, expected two or more"):
        recorder.finish(COUNTS)
    assert not list((tmp_path / "new").iterdir())


def test_of_a_long_take_parts_are_read_for_its_summary(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_MOST_SUMMARIZED", 10)
    tracker, pairs = tracked()
    recorder = Recorder(tmp_path / "take.npz", tracker)
    for number, (frame, one) in enumerate(pairs):
        recorder.add(frame, one)
        if number % 4 == 3:
            recorder._archive.flush()
    take, step = recorder.finish(COUNTS)
    assert step == 3
    np.testing.assert_array_equal(take.numbers, [0, 1, 2, 3, 12, 13, 14, 15])
    assert load_take(tmp_path / "take.npz").num_frames == FRAMES


def test_what_is_said_to_be_kept_was_looked_at(tmp_path):
    recorder = recorded(tmp_path)
    recorder._archive.flush()
    assert recorder.kept() == f"the recording is kept in {recorder.part}"
    os.truncate(recorder.part, recorder.part.stat().st_size - 1)
    assert recorder.kept() == f"0 of its 24 frames are kept in {recorder.part}"
    shutil.rmtree(recorder.part.parent)
    assert recorder.kept() == f"nothing of it is kept in {recorder.part}"
    with pytest.warns(HandSimWarning) as told:
        recorder.close()
    cut, gone = (str(one.message) for one in told)
    assert "24 of its 24 frames are lost" in cut and "was removed or replaced" in gone


def test_a_recording_that_is_overwritten_stays_and_its_loss_is_told(tmp_path):
    recorder = recorded(tmp_path, frames=20)
    recorder._archive.flush()
    end = recorder.part.stat().st_size
    for frame, one in tracked()[1][20:]:
        recorder.add(frame, one)
    recorder._archive.flush()
    with recorder.part.open("r+b") as file:
        file.seek(end + 200)
        file.write(b"another program's bytes")
    with pytest.warns(HandSimWarning, match=r"take\.npz has 20 of its 24 frames"):
        recorder.finish(COUNTS)
    assert load_take(tmp_path / "new" / "take.npz").num_frames == 20 and recorder.part.exists()


def test_a_take_that_cannot_be_written_keeps_the_recording(tmp_path):
    recorder = recorded(tmp_path)
    (tmp_path / "new" / "take.npz").mkdir()
    with pytest.raises(CaptureError, match=r"cannot be written .*; the recording is kept in .*\.part"):
        recorder.finish(COUNTS)
    with pytest.warns(CutOffWarning):
        assert load_take(recorder.part).num_frames == FRAMES


def test_ctrl_c_in_a_loop_of_one_s_own_writes_the_take(tmp_path):
    tracker = tracked()[0]
    with (
        pytest.raises(KeyboardInterrupt),
        ReplayServer(simulate_take(kind="hand-controller", num_frames=FRAMES), loop=True) as server,
        open_source(server.url) as source,
        Recorder(tmp_path / "take.npz", tracker) as recorder,
    ):
        for frame in source:
            recorder.add(frame, tracker.step(frame.points, frame.ids, frame.time))
            if recorder.num_frames == FRAMES:
                threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert os.listdir(tmp_path) == ["take.npz"]
    assert load_take(tmp_path / "take.npz").num_frames >= FRAMES


def test_ctrl_c_in_compiled_code_writes_the_take(tmp_path):
    with pytest.raises(KeyboardInterrupt), recorded(tmp_path):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
    assert_equal(load_take(tmp_path / "new" / "take.npz"), in_memory())


@functools.cache
def tracker_of(sides: tuple[str, ...], *, with_pen: bool) -> Tracker:
    hands = [nominal_fit(load_layout("sparse13"), "M", side) for side in sides]
    pens = (RigidTemplate(PEN.name, PEN.marker_names, PEN.positions),) if with_pen else ()
    return Tracker(hands, load_labeler("sparse13"), pens)


@st.composite
def takes(draw) -> Take:
    """Hands that come and go, gaps, frames without points, and frames that are crowded."""
    sides = draw(st.sampled_from([("right",), ("left",), ("right", "left")]))
    tracker = tracker_of(sides, with_pen=draw(st.booleans()))
    frames, rng = draw(st.integers(2, 40)), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    counts = rng.integers(0, draw(st.sampled_from([1, 5, 40])), frames)
    if draw(st.booleans()):
        counts[rng.integers(frames)] = draw(st.integers(100, 8000))
    present = np.zeros((frames, counts.max(initial=0) + draw(st.integers(0, 2))), dtype=bool)
    for row, count in zip(present, counts, strict=True):
        row[rng.choice(len(row), count, replace=False) if draw(st.booleans()) else range(count)] = True
    absent = [rng.random((frames, number)) < rng.random() for number in (len(sides), len(tracker.bodies))]
    status = [np.where(gone, LOST, rng.integers(1, len(STATUSES), gone.shape)) for gone in absent]
    poses = [
        join_qpos(rng.uniform(0.0, 0.4, (frames, 20)), position=rng.normal(size=(frames, 3))) for _ in sides
    ]
    qpos = np.stack(poses, axis=1)
    pens = np.tile([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0], (frames, len(tracker.bodies), 1))
    labels = sum(hand.layout.num_markers for hand in tracker.hands) + 3 * len(tracker.bodies)
    return Take(
        rate=100.0,
        times=np.cumsum(rng.uniform(0.001, 0.1, frames)),
        hands=tracker.hands,
        qpos=np.where((status[0] == LOST)[..., None], np.nan, qpos),
        status=status[0],
        rms=np.where(status[0] == TRACKED, rng.random(status[0].shape), np.nan),
        points=np.where(present[..., None], rng.normal(size=(*present.shape, 3)), np.nan),
        ids=np.where(present, rng.integers(-1, 2**31 - 1, present.shape), -1),
        labels=np.where(present, rng.integers(-1, labels, present.shape), -1),
        confidence=np.where(present, rng.random(present.shape), np.nan),
        bodies=(PEN,) * len(tracker.bodies),
        body_poses=np.where((status[1] == LOST)[..., None], np.nan, pens),
        body_status=status[1],
        body_rms=np.where(status[1] == TRACKED, rng.random(status[1].shape), np.nan),
        settings={"seed": int(counts[0])},
        numbers=np.arange(frames),
    )


def pairs_of(take: Take) -> list[tuple[StreamedFrame, TrackedFrame]]:
    """The frames of a take as a stream delivers them and as a tracker gives them."""
    pairs, points = [], take.point_list
    for row, time in enumerate(take.times.tolist()):
        own = points.of(row)
        status, pens = (
            [Status(number) for number in numbers[row]] for numbers in (take.status, take.body_status)
        )
        hand = partial(TrackedHand, markers=np.empty((0, 3)), filled=np.empty(0, dtype=int))
        hands = tuple(map(hand, take.sides, status, take.qpos[row], take.rms[row]))
        names = [body.name for body in take.bodies]
        places, turns = take.body_poses[row, :, :3], take.body_poses[row, :, 3:]
        bodies = tuple(map(TrackedBody, names, pens, places, turns, take.body_rms[row]))
        frame = StreamedFrame(row, time, points.points[own], points.ids[own].astype(np.int64))
        pairs.append(
            (frame, TrackedFrame(time, hands, points.labels[own], points.confidence[own], bodies, (), 0.0))
        )
    return pairs


def assert_same(one: Take, other: Take, *, columns: bool = True) -> None:
    """The takes are equal; a recording has no columns of a capture."""
    for name in ("times", "qpos", "status", "rms", "body_poses", "body_status", "body_rms", "numbers"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("counts", "points", "ids", "labels", "confidence", *(["columns", "num_columns"] * columns)):
        np.testing.assert_array_equal(getattr(one.point_list, name), getattr(other.point_list, name))
    assert one.sides == other.sides and one.label_names == other.label_names


@pytest.mark.slow
@settings(max_examples=500, deadline=None, suppress_health_check=list(HealthCheck))
@given(takes(), st.data())
def test_random_takes_come_back(tmp_path_factory, take, data):
    folder = tmp_path_factory.mktemp("takes")
    take.save(folder / "saved.npz")
    assert_same(load_take(folder / "saved.npz"), take)
    recorder = Recorder(folder / "live.npz", tracker_of(take.sides, with_pen=bool(take.bodies)))
    every, written = data.draw(st.integers(1, 20)), [(0, 0)]
    for number, (frame, tracked) in enumerate(pairs_of(take), 1):
        recorder.add(frame, tracked)
        if number % every == 0:
            recorder._archive.flush()
            written.append((recorder.part.stat().st_size, number))
    recorder.close()
    content = recorder.part.read_bytes()
    recorder.finish()
    assert_same(load_take(folder / "live.npz"), take, columns=False)
    assert sorted(path.name for path in folder.iterdir()) == ["live.npz", "saved.npz"]
    length = data.draw(st.integers(0, len(content)))
    least = max(frames for size, frames in written if size <= length)
    (folder / "cut.npz.part").write_bytes(content[:length])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = load_take(folder / "cut.npz.part")
        except CaptureError as error:
            assert "not a take" in str(error) or "frames, expected two or more" in str(error)
            assert least < 2
            return
    assert [one.category for one in caught] == [CutOffWarning]
    assert found.num_frames >= least
    assert_same(found, take.cut(0, found.num_frames), columns=False)


def test_points_that_are_nowhere_are_left_out_of_a_recording(tmp_path):
    """A recording can be finished whatever a source of the user's own puts into a frame."""
    tracker = tracker_of(("right",), with_pen=False)
    wild = np.array(
        [[0.0, 0.0, 1.0], [np.nan, 0.0, 0.0], [np.inf, 1.0, 1.0], [1e300, 0.0, 0.0], [0.1, 0.0, 1.0]]
    )
    with Recorder(tmp_path / "live.npz", tracker) as recorder:
        for number in range(4):
            frame = StreamedFrame(number, 0.01 * number, wild, np.array([1, 2, 3, 4, 2**40 + 5]))
            recorder.add(frame, tracker.step(frame.points, frame.ids, frame.time))
    take = load_take(tmp_path / "live.npz")
    np.testing.assert_array_equal(take.points[3], wild[[0, 4]])
    np.testing.assert_array_equal(take.ids, [[1, 5]] * 4)


def test_a_frame_out_of_order_is_refused_and_the_recording_goes_on(tmp_path):
    tracker = tracker_of(("right",), with_pen=False)
    frame = StreamedFrame(0, 1.0, np.zeros((1, 3)), np.zeros(1, dtype=int))
    with Recorder(tmp_path / "live.npz", tracker) as recorder:
        for time in (1.0, 2.0, 1.5, np.nan, 3.0):
            one = dataclasses.replace(frame, time=time)
            try:
                recorder.add(one, tracker.step(one.points, one.ids, 5.0))
            except ArgumentError as error:
                assert "expected a time after that of the frame before, 2 s" in str(error)
    np.testing.assert_array_equal(load_take(tmp_path / "live.npz").times, [1.0, 2.0, 3.0])
