"""Hands that are measured beside their tracker: when, how the size is taken over, and what is told."""

from __future__ import annotations

import dataclasses
from concurrent.futures import Future
from functools import cache

import numpy as np
import pytest

from gloves import MarkerLayout, load_layout
from gloves.optics.reconstruction import number_runs
from gloves.takes.take import keypoints_of
from handsim.errors import ArgumentError, HandSimWarning
from handsim.hand.model import join_qpos
from handsim.hand.shape import NUM_QPOS
from track import Status, StreamedFrame, TrackedFrame, TrackedHand
from track.live import live_sizing
from track.live.live_sizing import LiveSizing
from track.settings import TrackerSetup, TrackSettings
from train import simulate_take

RATE = 120


class AtOnce:
    """Calls what a process would call."""

    def __init__(self, workers):
        pass

    def submit(self, function, *arguments, **options):
        done = Future()
        try:
            done.set_result(function(*arguments, **options))
        except ArgumentError as error:
            done.set_exception(error)
        return done

    def shutdown(self, *, wait):
        pass

    end = shutdown


@pytest.fixture(autouse=True)
def _here(monkeypatch):
    monkeypatch.setattr(live_sizing, "LocalProcesses", AtOnce)
    monkeypatch.setattr(live_sizing, "_NICENESS", 0)


@cache
def a_take():
    return simulate_take("single-hand", num_frames=1300, seed=4, hands=["right"])


def frames_of(take, begin=0.0):
    """The frames of a take, that begins at a time [s]."""
    seen = np.isfinite(take.points[..., 0])
    ids = number_runs(seen)
    for number, (points, there) in enumerate(zip(take.points, seen, strict=True)):
        time = begin + number / RATE
        yield StreamedFrame(number, time, points[there], ids[number, there])


def test_a_hand_is_measured_twice_and_no_joint_jumps():
    take, setup = a_take(), TrackerSetup.of(TrackSettings(hands="right"))
    tracker, sizing = setup.tracker(), LiveSizing(setup)
    truth, sizes, changes, last = keypoints_of(take.hands, take.qpos)[:, 0], [], [], None
    for frame in frames_of(take, begin=60.0):
        tracked = sizing.eased(tracker.step(frame.points, frame.ids, frame.time), tracker)
        assert tracked.hands[0].has_pose
        off = keypoints_of(tracker.hands, tracked.hands[0].qpos[None, None])[0, 0] - truth[frame.number]
        if sizes and sizes[-1][0] > frame.number - 6:
            changes.append(np.linalg.norm(off - last, axis=1).max())
        last = off
        if sizing.step(frame, tracked, tracker):
            sizes.append((frame.number, tracker.hands[0].shape.length))
    numbers, lengths = map(np.array, zip(*sizes, strict=True))
    assert set(np.diff(numbers)) - {1} and np.sum(np.diff(numbers) > 1) == 1, "two times, a step a frame"
    assert 0.2 * RATE < numbers[0] < 0.4 * RATE and 9.9 * RATE < numbers[numbers > 2 * RATE][0] < 10.1 * RATE
    assert max(changes) < 0.005
    assert abs(lengths[-1] - take.hands[0].shape.length) < 0.006 < abs(0.187 - take.hands[0].shape.length)
    assert tracker.user.notes.startswith("auto, ") and tracker.user.origin("right") == "measured"


def test_labels_of_a_glove_with_markers_elsewhere_change_when_it_is_known(tmp_path):
    """Two markers of the back are 3 cm from where the layout has them."""
    take, designed = a_take(), load_layout("dense19")
    moved = {"BackHand1": (0.2, 0.2), "BackHand2": (-0.25, -0.2)}
    places = []
    for one in designed.markers:
        along, across = moved.get(one.name, (0.0, 0.0))
        places.append(dataclasses.replace(one, along=one.along + along, across=one.across + across))
    MarkerLayout("guessed", tuple(places), designed.radius).save(tmp_path / "guessed.toml")
    setup = TrackerSetup.of(TrackSettings(glove=tmp_path / "guessed.toml", hands="right", labeler="dense19"))
    tracker, sizing = setup.tracker(), LiveSizing(setup)
    wrong = []
    with pytest.warns(HandSimWarning) as told:
        for frame in frames_of(take):
            tracked = tracker.step(frame.points, frame.ids, frame.time)
            sizing.step(frame, tracked, tracker)
            true = take.labels[frame.number][np.isfinite(take.points[frame.number, :, 0])]
            wrong.append((tracked.labels != true).mean())
    change, *places = [str(one.message) for one in told]
    assert change.startswith("the labels change for the right hand: ") and "BackHand1" in change
    assert all("mm from where the layout has it" in one for one in places) and len(places) == 2
    assert np.mean(wrong[:1200]) > 0.05 and np.mean(wrong[-60:]) < 0.002


def live(**size):
    """What measures a right hand beside its tracker, and a tracker that notes its sizes."""
    setup = TrackerSetup.of(TrackSettings(hands="right", **size))
    return LiveSizing(setup), FakeTracker(setup.user)


def found(monkeypatch, length):
    """Let measurements find a hand of a length [m]; the frame in which each one begins [s]."""

    def measure(settings, frames, before, *, judges):
        calls.append(frames[0].time)
        user = TrackerSetup.of(TrackSettings(hands="right", size="M" if length < 0.19 else "XL")).user
        user = dataclasses.replace(user, notes="auto, measured")
        return live_sizing._Measured([user])

    calls = []
    monkeypatch.setattr(live_sizing, "_measure", measure)
    return calls


class FakeTracker:
    """Notes the sizes that it is given."""

    def __init__(self, user):
        self.user, self.hands, self.sizes = user, user.hands, []

    def resize(self, user, keep):
        self.user = user
        self.sizes.append((user, keep))


def shown(sizing, tracker, begin, seconds, *, there=True, points=20, rms=0.001):
    """Show a stream of points, in which a hand is tracked or not."""
    status = Status.TRACKED if there else Status.LOST
    hand = TrackedHand("right", status, np.zeros(NUM_QPOS), rms, np.zeros((19, 3)), np.arange(0))
    for number in range(round(seconds * RATE)):
        time = begin + number / RATE
        frame = StreamedFrame(number, time, np.zeros((points, 3)), np.arange(points))
        tracked = TrackedFrame(time, (hand,), np.full(points, -1), np.ones(points))
        sizing.step(frame, tracked, tracker)


def test_hands_are_measured_again_after_a_pause_and_another_user_is_taken_over_at_once(monkeypatch):
    sizing, tracker = live()
    calls = found(monkeypatch, 0.187)
    shown(sizing, tracker, 0.0, 5.0, there=False, points=3)
    assert not calls, "nothing can be measured"
    shown(sizing, tracker, 5.0, 30.0)
    assert len(calls) == len(tracker.sizes) == 2, "after 0.3 seconds, and for good after ten"
    shown(sizing, tracker, 35.0, 0.5, there=False, points=3)
    shown(sizing, tracker, 35.5, 20.0)
    assert len(calls) == 2, "half a second is no pause"
    shown(sizing, tracker, 55.5, 3.0, there=False, points=3)
    shown(sizing, tracker, 58.5, 5.0)
    assert len(calls) == 3 and len(tracker.sizes) == 2, "a brief look shows the same hand"
    shown(sizing, tracker, 63.5, 10.0)
    assert len(calls) == 4 and len(tracker.sizes) == 3
    calls = found(monkeypatch, 0.205)
    shown(sizing, tracker, 73.5, 3.0, there=False, points=3)
    shown(sizing, tracker, 76.5, 1.5)
    assert len(calls) == 1 and tracker.user[0].shape.length > 0.19, "another hand"


def test_a_hand_that_jumps_while_a_size_is_taken_over_is_shown_on_its_way(monkeypatch):
    """The wrist moves at 0.5 m/s; from the take-over on the pose is 20 mm and 0.2 rad away from it."""
    sizing, tracker = live()
    found(monkeypatch, 0.187)
    velocity, nobody = np.zeros(26), np.zeros((20, 3))
    velocity[0] = 0.5
    places, jumped = [], None
    for number in range(round(1.3 * RATE)):
        time, far = number / RATE, 0.0 if jumped is None else 1.0
        qpos = join_qpos(np.full((1, 20), 0.2 * far), position=np.array([0.5 * time, 0.02 * far, 0.0]))[0]
        hand = TrackedHand("right", Status.TRACKED, qpos, 0.001, nobody, np.arange(0), velocity=velocity)
        tracked = TrackedFrame(time, (hand,), np.full(20, -1), np.ones(20))
        shown = sizing.eased(tracked, tracker)
        places.append(keypoints_of(tracker.hands, shown.hands[0].qpos[None, None])[0, 0])
        if sizing.step(StreamedFrame(number, time, nobody, np.arange(20)), tracked, tracker):
            jumped = number
    moved = np.diff(places, axis=0) - [0.5 / RATE, 0.0, 0.0]
    largest = np.linalg.norm(moved, axis=-1).max(axis=1)
    assert jumped is not None and 0.0024 < largest.max() < 0.0026
    assert (largest[:jumped] < 1e-9).all() and (largest[jumped + 30 :] < 1e-9).all(), "it arrives"
    assert shown is tracked and abs(places[-1][0, 1] - 0.02) < 1e-9


def test_a_hand_that_turns_back_while_a_size_is_taken_over_is_not_lost(monkeypatch):
    """It swings at up to 1.3 m/s, faster than the shown hand may come nearer."""
    sizing, tracker = live()
    found(monkeypatch, 0.187)
    nobody, resized, away = np.zeros((20, 3)), [], []
    for number in range(round(2.0 * RATE)):
        time = number / RATE
        swing = 4.0 * np.pi * (time - 0.9)  # [rad] fastest about when the size is taken over
        place, speed = 0.1 * np.sin(swing), 0.4 * np.pi * np.cos(swing)
        qpos = join_qpos(np.zeros((1, 20)), position=np.array([place, 0.02 * bool(resized), 0.0]))[0]
        velocity = speed * np.eye(26)[0]
        hand = TrackedHand("right", Status.TRACKED, qpos, 0.001, nobody, np.arange(0), velocity=velocity)
        tracked = TrackedFrame(time, (hand,), np.full(20, -1), np.ones(20))
        shown = sizing.eased(tracked, tracker)
        away.append(np.linalg.norm(shown.hands[0].qpos[:3] - qpos[:3]))
        if sizing.step(StreamedFrame(number, time, nobody, np.arange(20)), tracked, tracker):
            resized.append(number)
    assert 0.015 < max(away) < 0.021 and not any(away[resized[-1] + 30 :])


def test_another_user_is_noticed_by_the_residual_without_a_pause(monkeypatch):
    sizing, tracker = live()
    calls = found(monkeypatch, 0.187)
    shown(sizing, tracker, 0.0, 30.0)
    shown(sizing, tracker, 30.0, 20.0, rms=0.0013)
    assert len(calls) == 2, "poses differ by so much"
    shown(sizing, tracker, 50.0, 0.1, rms=0.003)
    shown(sizing, tracker, 50.1, 5.0)
    assert len(calls) == 2, "some wrong labels"
    calls = found(monkeypatch, 0.205)
    shown(sizing, tracker, 55.1, 3.0, rms=0.003)
    assert len(calls) == 1 and tracker.user[0].shape.length > 0.19
    shown(sizing, tracker, 58.1, 30.0, rms=0.003)
    assert len(calls) == 2, "this is the usual residual of this user"


def test_points_that_are_no_hand_are_measured_less_and_less_often(monkeypatch):
    sizing, tracker, calls = *live(), []

    def measure(settings, frames, before, *, judges):
        calls.append(len(frames))
        if len(calls) == 1:
            raise ArgumentError("the points fit hands at 0.001 of their size")
        return live_sizing._Measured(warnings=["the points fit another glove better"])

    monkeypatch.setattr(live_sizing, "_measure", measure)
    with pytest.warns(HandSimWarning) as told:
        shown(sizing, tracker, 0.0, 70.0, there=False)
    assert len(calls) == 8 and not tracker.sizes  # after 0.3 s, and after twice as long each time
    assert {str(one.message) for one in told} == {
        "the points fit hands at 0.001 of their size",
        "the points fit another glove better",
    }
    assert max(calls) <= 8 * 16


def test_hands_of_a_known_size_are_not_measured(monkeypatch):
    sizing, tracker = live(size="L")
    calls = found(monkeypatch, 0.187)
    shown(sizing, tracker, 0.0, 15.0)
    assert not calls and sizing.is_settled


def test_why_hands_are_not_measured_is_known(monkeypatch):
    sizing, tracker, clock = *live(), [0.0]
    monkeypatch.setattr(live_sizing, "monotonic", lambda: clock[0])
    shown(sizing, tracker, 0.0, 0.1)
    assert sizing.state == "not measured yet: seen for 0.2 of 0.3 s"
    nobody = TrackedFrame(0.1, (), np.zeros(0, dtype=int), np.zeros(0))
    assert sizing.eased(nobody, tracker).size_state == sizing.state
    pending = Future()
    monkeypatch.setattr(AtOnce, "submit", lambda *given, **options: pending)
    shown(sizing, tracker, 0.1, 1.0)
    assert sizing.state == "being measured"
    clock[0] = 5.0
    assert sizing.state == "not measured yet: no processor time"
    pending.set_result(live_sizing._Measured())
    shown(sizing, tracker, 1.5, 0.1)
    assert sizing.state == "not measured yet: no hand was found"
    pending = Future()
    shown(sizing, tracker, 1.6, 10.0)
    pending.set_result(live_sizing._Measured([dataclasses.replace(tracker.user, notes="auto, measured")]))
    shown(sizing, tracker, 11.6, 0.1)
    assert sizing.state == ""
    shown(sizing, tracker, 11.7, 3.0, there=False, points=3)
    assert sizing.state == "", "the last hands were measured"
    shown(sizing, tracker, 20.0, 0.1)
    assert sizing.state.startswith("not measured yet: seen for"), "somebody else may have come"
    assert LiveSizing(TrackerSetup.of(TrackSettings(hands="right", size="L"))).state == ""


def test_another_user_without_a_pause_is_noticed_before_the_last_measurement(monkeypatch):
    sizing, tracker = live()
    found(monkeypatch, 0.187)
    shown(sizing, tracker, 0.0, 7.0)
    calls = found(monkeypatch, 0.205)
    shown(sizing, tracker, 7.0, 3.0, rms=0.003)
    assert len(calls) == 1 and tracker.user[0].shape.length > 0.19


def test_a_second_measurement_goes_on_from_the_first(monkeypatch):
    """The first one has so little processor time that the second follows at once."""
    sizing, tracker, asked, pending = *live(), [], [Future(), Future()]
    larger = TrackerSetup.of(TrackSettings(hands="right", size="XL")).user

    def submit(self, function, settings, frames, before, **options):
        asked.append(before)
        return pending[len(asked) - 1]

    monkeypatch.setattr(AtOnce, "submit", submit)
    shown(sizing, tracker, 0.0, 12.0)
    assert asked == [tracker.user]
    pending[0].set_result(live_sizing._Measured([dataclasses.replace(larger, notes="auto, measured")]))
    shown(sizing, tracker, 12.0, 0.1)
    assert len(asked) == 2 and asked[1].hands == larger.hands


def test_hands_that_come_before_the_last_measurement_are_measured_by_themselves(monkeypatch):
    """They differ so much that the tracker does not find them."""
    sizing, tracker = live()
    begins = found(monkeypatch, 0.205)
    shown(sizing, tracker, 0.0, 5.0)
    shown(sizing, tracker, 5.0, 2.0, there=False, points=3)
    shown(sizing, tracker, 7.0, 0.8, there=False)
    assert begins == [0.0, 7.0]


def test_a_measurement_of_those_who_have_left_does_not_count_for_others(monkeypatch):
    sizing, tracker, pending = *live(), Future()
    monkeypatch.setattr(AtOnce, "submit", lambda *given, **options: pending)
    shown(sizing, tracker, 0.0, 3.0)
    shown(sizing, tracker, 3.0, 2.0, there=False, points=3)
    shown(sizing, tracker, 5.0, 0.05)
    pending.set_result(live_sizing._Measured([dataclasses.replace(tracker.user, notes="auto, measured")]))
    shown(sizing, tracker, 5.05, 0.05)
    assert sizing.is_settled and sizing.state == "not measured yet: seen for 0.2 of 0.3 s"
