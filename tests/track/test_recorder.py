"""Recordings of a stream: the take in memory and that on disk are one, also when it was cut off."""

from __future__ import annotations

import dataclasses
import functools
import os
import signal
import threading

import numpy as np
import pytest

from gloves import Take, load_layout, load_take
from gloves.fit import nominal_fit
from gloves.takes.archives import CutOffWarning
from handsim.errors import CaptureError
from handsim.space.objects import named_object
from render.subject import load_subject
from track import Recorder, ReplayServer, RigidTemplate, Tracker, open_source
from track import recorder as module
from track.frames import capture_frames
from track.recorder import TakeRecorder
from train import load_labeler, simulate_take

FRAMES = 24
COUNTS = {"missing_frames": 2}


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
    recorder = TakeRecorder(tracker)
    for frame, one in pairs:
        recorder.add(frame, one)
    return recorder.take()


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


def test_a_recording_that_was_cut_off_is_read(tmp_path):
    recorder = recorded(tmp_path)
    recorder.close()
    with recorder.part.open("ab") as file:
        file.write(b"blk\n and no more")
    with pytest.warns(CutOffWarning, match=r"take\.npz\.part: a recording that was cut off .* 24 frames"):
        assert_equal(load_take(recorder.part), in_memory())
    with pytest.warns(CutOffWarning):
        assert load_subject(recorder.part, seed=0).take.num_frames == FRAMES
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
    monkeypatch.setattr(module, "_SUMMARIZED", 10)
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


def test_a_disk_that_is_full_keeps_the_recording(tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("this machine has no /dev/full")
    recorder = recorded(tmp_path)
    recorder._archive.flush()
    recorder._archive._file.close()
    recorder._archive._file = open("/dev/full", "wb", buffering=0)
    frame, one = tracked()[1][-1]
    frame = dataclasses.replace(frame, time=frame.time + 1.0)
    recorder._archive._due = 0.0
    words = (
        r"the recording ended after 24 frames \(No space left on device\); they are kept in .*take\.npz\.part"
    )
    with pytest.raises(CaptureError, match=words):
        recorder.add(frame, one)
    recorder.close()
    with pytest.warns(CutOffWarning):
        assert_equal(load_take(recorder.part), in_memory())


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
