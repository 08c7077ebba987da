"""Reviews of a hand's labels by the labeler."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim.hand.model import join_qpos
from poses.shapes import resting_angles
from track.association.frame_state import FrameState, targets_of
from track.association.hand_state import HandState, HandTrack
from track.association.labeler_review import LabelerReview
from track.config import TrackerConfig
from train.labelers.protocol import Labeling
from train.labelers.storage import load_labeler

TIP, OTHER_TIP = 6, 9  # of the index and the middle finger
KNUCKLE = 4  # of the index finger
RATE = 120.0


class CountingLabeler:
    """The shipped labeler, which counts the times it is asked."""

    def __init__(self):
        self._labeler = load_labeler("dense19")
        self.marker_names = self._labeler.marker_names
        self.times = 0

    def label_frames(self, frames) -> list[Labeling]:
        self.times += 1
        return self._labeler.label_frames(frames)


@pytest.fixture
def state(followed) -> HandState:
    return followed()


def reviewed(review: LabelerReview, state: HandState, frame: FrameState):
    """The frame and the hand after a review; None where both stay as they are."""
    prediction = state.predict(frame.time)
    targets = targets_of(frame.points, frame.labels, 19)
    hand = HandTrack(0, state, prediction, state.fit(targets, prediction.qpos, prediction))
    after = review.review(frame, hand)
    return None if after[0] is frame and after[1] is hand else after


def test_exchanged_labels_are_found_and_right_ones_stay(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    labeler = CountingLabeler()
    review = LabelerReview(labeler, 1, TrackerConfig())
    assert reviewed(review, state, frame_of(points, np.arange(19), 0.5)) is None
    assert labeler.times == 1
    wrong = np.arange(19)
    wrong[[TIP, OTHER_TIP]] = OTHER_TIP, TIP
    frame, hand = reviewed(review, state, frame_of(points, wrong, 1.0))
    np.testing.assert_array_equal(frame.labels, np.arange(19))
    np.testing.assert_allclose(hand.estimate.positions, points, atol=0.002)
    assert 0.5 < frame.confidence[[TIP, OTHER_TIP]].max() < 1.0 and frame.confidence[KNUCKLE] == 1.0


def test_a_marker_that_waits_gets_its_label_and_a_ghost_does_not(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    labels = np.arange(19)
    labels[TIP] = -1
    review = LabelerReview(CountingLabeler(), 1, TrackerConfig())
    frame, _ = reviewed(review, state, frame_of(points, labels, 0.5))
    np.testing.assert_array_equal(frame.labels, np.arange(19))
    ghost = points.copy()
    ghost[TIP] += [0.0, 0.0, 0.03]
    again = LabelerReview(CountingLabeler(), 1, TrackerConfig())
    assert reviewed(again, state, frame_of(ghost, labels, 0.5, first_seen=0.5)) is None


def test_reviews_become_rarer_until_a_new_point_comes(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    labeler = CountingLabeler()
    review = LabelerReview(labeler, 1, TrackerConfig())
    for frame in range(240):
        reviewed(review, state, frame_of(points, np.arange(19), 0.5 + frame / RATE))
    assert 8 <= labeler.times <= 20
    labels = np.arange(19)
    labels[TIP] = -1
    ghost, before = points.copy(), labeler.times
    ghost[TIP] += [0.0, 0.0, 0.03]
    for number, new in ((100, True), (100, False), (101, True)):
        ids = np.where(labels < 0, number, np.arange(19))
        reviewed(review, state, frame_of(ghost, labels, 2.5, ids=ids))
        assert (labeler.times > before) == new
        before = labeler.times


def test_a_hand_in_a_crowd_of_strays_is_not_reviewed(state, frame_of):
    """No labeler takes so many points."""
    points, rng = state.solver.marker_positions(state.qpos), np.random.default_rng(1)
    labels = np.concatenate([np.arange(19), np.full(700, -1)])
    labels[TIP] = -1
    crowd = np.concatenate([points, points[TIP] + rng.uniform(-0.03, 0.03, (700, 3))])
    labeler = CountingLabeler()
    assert reviewed(LabelerReview(labeler, 1, TrackerConfig()), state, frame_of(crowd, labels, 0.5)) is None
    assert labeler.times == 0


def test_a_hand_that_was_initialized_is_reviewed_in_the_next_frame(state, frame_of):
    points, labeler = state.solver.marker_positions(state.qpos), CountingLabeler()
    review = LabelerReview(labeler, 1, TrackerConfig())
    for frame in range(120):
        reviewed(review, state, frame_of(points, np.arange(19), 0.5 + frame / RATE))
    before = labeler.times
    review.restart(0, 1.5)
    reviewed(review, state, frame_of(points, np.arange(19), 1.5))
    assert labeler.times == before
    reviewed(review, state, frame_of(points, np.arange(19), 1.5 + 2 / RATE))
    assert labeler.times == before + 1


@pytest.mark.parametrize("age", [0.0, 0.4])
def test_a_bias_that_was_learned_from_a_ghost_yields_to_a_point_that_lasts(age, followed, frame_of):
    """The true marker was hidden, and a ghost beside it had its label."""
    off = np.zeros((19, 3))
    off[KNUCKLE] = 0.0, 0.01, 0.01
    state = followed(off=off)
    user = nominal_fit(load_layout("dense19"), "M", "right")
    points = HandState(user).solver.marker_positions(join_qpos(resting_angles(user.model)[None])[0])
    labels = np.arange(19)
    labels[KNUCKLE] = -1
    frame = frame_of(points, labels, 1.0, first_seen=1.0 - age)
    found = reviewed(LabelerReview(CountingLabeler(), 1, TrackerConfig()), state, frame)
    if age == 0.0:
        assert found is None
    else:
        np.testing.assert_array_equal(found[0].labels, np.arange(19))
