"""The tracker on simulated captures whose truth is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import GloveFit, Status, Take, load_layout
from gloves.fit import nominal_fit
from handsim import HandModel, HandSimError
from handsim.errors import ArgumentError
from tests.sentences import error_names
from track import TrackedFrame, Tracker
from train import load_labeler, simulate_take


@pytest.fixture(scope="module")
def labeler():
    return load_labeler("dense19")


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=240)


def users(take: Take) -> list[GloveFit]:
    return list(take.hands)


def seen(take: Take, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, IDs and true labels of one frame; the object's markers are nobody's."""
    here = np.isfinite(take.points[frame, :, 0])
    labels = take.labels[frame, here].astype(int)
    labels[labels >= take.hand_labels[-1].stop] = -1
    return take.points[frame, here], take.ids[frame, here], labels


def run(tracker: Tracker, take: Take, frames: range) -> list[TrackedFrame]:
    return [tracker.step(*seen(take, frame)[:2], frame / take.rate) for frame in frames]


def test_hands_are_initialized_and_tracked(take, labeler):
    frames = range(take.num_frames)
    tracked = run(Tracker(users(take), labeler), take, frames)
    assert [hand.status for hand in tracked[0].hands] == [Status.INITIALIZED, Status.INITIALIZED]
    assert all(hand.status is Status.TRACKED for frame in tracked[1:] for hand in frame.hands)
    right = [np.array_equal(frame.labels, seen(take, number)[2]) for number, frame in enumerate(tracked)]
    assert np.mean(right) >= 0.98
    for number, hand in enumerate(take.moving_hands()):
        model = HandModel(hand.shape)
        poses = np.array([frame.hands[number].qpos for frame in tracked])
        bones = [model.forward_kinematics(qpos)[..., :3, 3] for qpos in (poses, hand.qpos)]
        assert np.linalg.norm(bones[0] - bones[1], axis=-1).mean() <= 0.0005
        assert np.rad2deg(np.abs(poses[:, 7:] - hand.qpos[:, 7:])).mean() <= 1.0


def test_the_rms_is_the_distance_from_the_given_hand_in_the_first_frames_too(take, labeler):
    """Biases are learned there, and a frame's own must not count as known before it."""
    tracker = Tracker([nominal_fit(hand.layout, "M", hand.side) for hand in users(take)], labeler)
    for number, frame in enumerate(run(tracker, take, range(12))):
        points = seen(take, number)[0]
        for index, (fit, hand) in enumerate(zip(tracker.hands, frame.hands, strict=True)):
            count = fit.layout.num_markers
            own = (frame.labels >= index * count) & (frame.labels < (index + 1) * count)
            markers = fit.markers(hand.qpos[None])[0][0][frame.labels[own] - index * count]
            distances = np.linalg.norm(points[own] - markers, axis=1)
            assert hand.rms == pytest.approx(np.sqrt((distances**2).mean()), abs=2e-5)


@pytest.mark.parametrize("seed", [0, 2])
def test_gloves_with_few_markers_far_apart_are_tracked(seed):
    """Large hands in the sparse glove: stretched fingers are over 85 mm from the markers on the back."""
    kind = "single-hand" if seed == 0 else "hand-hand"
    take = simulate_take(kind=kind, num_frames=60, glove="sparse13", seed=seed)
    tracked = run(Tracker(users(take), load_labeler("sparse13")), take, range(60))
    right = [np.array_equal(frame.labels, seen(take, number)[2]) for number, frame in enumerate(tracked)]
    assert np.mean(right) > 0.95


def test_hands_are_initialized_again_after_a_second_without_points(take, labeler):
    tracker = Tracker(users(take), labeler)
    run(tracker, take, range(60))
    dark = [tracker.step(np.zeros((0, 3)), np.zeros(0, dtype=int), (60 + n) / 120) for n in range(120)]
    assert [hand.status for hand in dark[0].hands] == [Status.COASTING] * 2
    assert [hand.status for hand in dark[-1].hands] == [Status.LOST] * 2
    assert np.isnan(dark[-1].hands[0].qpos).all()
    after = run(tracker, take, range(180, 183))
    assert all(hand.status is not Status.LOST for hand in after[-1].hands)
    assert np.array_equal(after[-1].labels, seen(take, 182)[2])


def test_points_without_ids_are_labeled_by_their_positions(take, labeler):
    nameless = dataclasses.replace(take, ids=np.full_like(take.ids, -1))
    tracked = run(Tracker(users(take), labeler), nameless, range(20))
    right = [np.array_equal(frame.labels, seen(take, number)[2]) for number, frame in enumerate(tracked)]
    assert np.mean(right) >= 0.9


def test_an_id_that_goes_over_to_another_marker_loses_its_label(take, labeler):
    tracker = Tracker(users(take), labeler)
    run(tracker, take, range(10))
    points, ids, labels = seen(take, 10)
    one, two = np.flatnonzero(labels == 6)[0], np.flatnonzero(labels == 9)[0]
    ids = ids.copy()
    ids[[one, two]] = ids[[two, one]]
    assert np.array_equal(tracker.step(points, ids, 10 / 120).labels, labels)


def test_points_without_ids_are_linked_from_frame_to_frame(take, labeler):
    tracker, right = Tracker(users(take), labeler), []
    for frame in range(40):
        points, _, labels = seen(take, frame)
        tracked = tracker.step(points, time=frame / take.rate)
        right.append(np.array_equal(tracked.labels, labels))
    assert np.mean(right) > 0.9
    assert all(hand.status is Status.TRACKED for hand in tracked.hands)


def test_a_labeler_may_be_named_or_left_to_the_glove(take):
    points, ids, labels = seen(take, 0)
    designed = [nominal_fit(load_layout("dense19"), "M", hand.side) for hand in take.hands]
    assert np.array_equal(Tracker(users(take), "dense19").step(points, ids, 0.0).labels, labels)
    named, left = (Tracker(designed, *name).step(points, ids, 0.0) for name in (("dense19",), ()))
    np.testing.assert_array_equal(named.labels, left.labels)


@pytest.mark.parametrize(
    ("points", "ids", "time", "sentence"),
    [
        ("cloud", None, 0.0, "points is 'cloud', expected an array of numbers"),
        (np.zeros((2, 3)), ["a", "b"], 0.0, "ids is ['a', 'b'], expected an array of numbers"),
        (np.zeros((2, 3)), 7, 0.0, "points have shape (2, 3), expected (1, 3) for 1 IDs"),
        (np.zeros(3), None, 0.0, "points have shape (3,), expected (3, 3) for 3 IDs"),
        (np.zeros((2, 3)), [1, 2], None, "time is None, expected the time of the frame in seconds"),
        (np.zeros((2, 3)), [1, 2], "now", "time is 'now', expected the time of the frame in seconds"),
    ],
)
def test_a_frame_of_another_type_is_refused_in_one_sentence(take, labeler, points, ids, time, sentence):
    with pytest.raises(ArgumentError) as error:
        Tracker(users(take), labeler).step(points, ids, time)
    assert str(error.value) == sentence


def test_hands_labelers_and_settings_of_another_type_are_refused(take, labeler):
    hands = users(take)
    for given, sentence in (
        ((3, labeler), "hands is 3, expected a User, hands in their gloves"),
        (("right", labeler), "right: cannot be read"),
        (([], labeler), "hands are [], expected a left hand"),
        (([hands[0]] * 2, labeler), "expected a left hand, a right hand, or one of each"),
        ((hands, 3), "labeler is 3, expected a MarkerLayout, the name or path of one, a Labeler"),
        ((hands, labeler, (), {}), "config is {}, expected a TrackerConfig"),
    ):
        with error_names(HandSimError, sentence):
            Tracker(*given)


def test_bodies_are_given_by_name_too():
    tracker = Tracker([nominal_fit(load_layout("dense19"), "M", "right")], bodies=["mug"])
    assert [body.name for body in tracker.bodies] == ["mug"]
