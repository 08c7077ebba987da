"""Random takes come back from files and from recordings that were cut at any byte."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gloves import RigidBody, Status, Take, load_layout, load_take
from gloves.fit import nominal_fit
from gloves.takes.archives import CutOffWarning
from gloves.takes.take import LOST, STATUSES, TRACKED
from handsim import join_qpos
from handsim.errors import ArgumentError, CaptureError
from track import Recorder, RigidTemplate, StreamedFrame, TrackedBody, TrackedFrame, TrackedHand, Tracker
from train import load_labeler

PEN = RigidBody("pen", ("Pen1", "Pen2", "Pen3"), np.diag([0.03, 0.05, 0.08]))


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
