"""Labels that go along with IDs, tested against the predicted pose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import GloveFit, load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos
from poses import sample_motion
from poses.shapes import resting_angles
from tests.labelers import CountingLabeler
from track import TrackerConfig
from track.association.frame_state import FrameState, Numbering, targets_of
from track.association.hand_state import HandState, HandTrack, Prediction
from track.association.label_consistency import (
    ID_EXCHANGE_DISTANCE,
    LabelerReview,
    exchange_labels,
    fit_labels,
    gate_labels,
)

RATE = 120.0
TIP, OTHER_TIP = 6, 9  # of the index and the middle finger
KNUCKLE = 4  # of the index finger


def frame_of(points: np.ndarray, labels: np.ndarray) -> FrameState:
    count = len(points)
    ones, numbers = np.ones(count), np.arange(count)
    return FrameState(points, numbers, labels, 4.0 * ones, ones, 0.0 * ones, 0.0 * ones, 0.0, Numbering([19]))


def gated(state, points, labels, prediction) -> np.ndarray:
    return gate_labels(frame_of(points, labels), 0, state, prediction).labels


def fitted(state, points, labels, prediction):
    frame, estimate = fit_labels(frame_of(points, labels), 0, state, prediction)
    return frame.labels, estimate


def exchanged(points, labels, positions) -> tuple[list[int], np.ndarray]:
    """The points whose label is new, and all labels."""
    frame = exchange_labels(frame_of(points, labels), positions)
    np.testing.assert_array_equal(frame.evidence == 0.0, frame.labels != labels)
    return np.flatnonzero(frame.labels != labels).tolist(), frame.labels


@dataclasses.dataclass(frozen=True, repr=False)
class Motion:
    """A hand that moves, and its markers."""

    hand: GloveFit
    qpos: np.ndarray
    markers: np.ndarray

    def followed(self, frames: int) -> tuple[HandState, Prediction]:
        """The hand after some frames in which all of its markers were seen, and its prediction."""
        state = HandState(self.hand)
        state.initialize(self.qpos[0], self.markers[0], 0.0)
        for frame in range(1, frames):
            prediction = state.predict(frame / RATE)
            estimate = state.fit(self.markers[frame], prediction.qpos, prediction)
            state.update(estimate, np.ones(state.num_markers, dtype=bool), frame / RATE)
        return state, state.predict(frames / RATE)


@pytest.fixture(scope="module")
def motion() -> Motion:
    hand = nominal_fit(load_layout("dense19"), "M", "right")
    angles = sample_motion(hand.model, 2.0, rng=np.random.default_rng(3)).qpos[:, 7:]
    qpos = join_qpos(angles, position=np.tile([0.1, 0.2, 1.0], (len(angles), 1)))
    return Motion(hand, qpos, hand.markers(qpos)[0])


@pytest.mark.parametrize("frames", [1, 20, 150])
def test_right_labels_stay_and_give_the_pose(motion, frames):
    state, prediction = motion.followed(frames)
    labels = gated(state, motion.markers[frames], np.arange(19), prediction)
    labels, estimate = fitted(state, motion.markers[frames], labels, prediction)
    np.testing.assert_array_equal(labels, np.arange(19))
    assert estimate.rms < 1e-4
    np.testing.assert_allclose(estimate.positions, motion.markers[frames], atol=1e-3)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 18), st.integers(0, 500), st.floats(0.025, 0.2), st.sampled_from([1, 20]))
def test_a_label_far_from_its_predicted_marker_is_dropped(motion, wrong, seed, off, frames):
    state, prediction = motion.followed(frames)
    labels = gated(state, planted(motion.markers[frames], wrong, off, seed), np.arange(19), prediction)
    assert np.flatnonzero(labels < 0).tolist() == [wrong]
    assert np.flatnonzero(labels != np.arange(19)).tolist() == [wrong]


def test_a_hand_that_is_elsewhere_keeps_its_labels(motion):
    """Then the prediction is wrong."""
    state, prediction = motion.followed(20)
    points = motion.markers[20] + [0.05, 0.0, 0.0]
    labels = gated(state, points, np.arange(19), prediction)
    np.testing.assert_array_equal(labels, np.arange(19))
    labels, estimate = fitted(state, points, labels, prediction)
    np.testing.assert_array_equal(labels, np.arange(19))
    np.testing.assert_allclose(estimate.positions, points, atol=1e-3)


def test_few_labels_may_be_dropped_at_once(motion):
    state, prediction = motion.followed(20)
    for many, gone in ((5, 5), (6, 0)):  # of 19 labels, at most 30 %
        points = motion.markers[20].copy()
        points[:many] += [0.0, 0.0, 0.06]
        labels = gated(state, points, np.arange(19), prediction)
        assert (labels < 0).sum() == gone


def test_the_gate_is_as_wide_as_the_whole_hand_is_off(motion):
    """A hand that speeds up is no reason to drop labels."""
    state, prediction = motion.followed(20)
    points = motion.markers[20] + [0.012, 0.0, 0.0]
    points[[4, 5, 6]] += [0.02, 0.0, 0.0]  # and a finger with it
    labels = gated(state, points, np.arange(19), prediction)
    np.testing.assert_array_equal(labels, np.arange(19))
    points[6] += [0.15, 0.0, 0.0]
    labels = gated(state, points, labels, prediction)
    assert np.flatnonzero(labels < 0).tolist() == [6]


@pytest.mark.parametrize("moved", [0.0, 0.02])
@pytest.mark.parametrize("pair", [(3, 6), (6, 9), (9, 12), (5, 8), (0, 1)])
def test_exchanged_labels_are_exchanged_back_also_while_the_hand_speeds_up(motion, pair, moved):
    _, prediction = motion.followed(20)
    points = motion.markers[20] + [0.0, moved, 0.0]
    assigned = np.arange(19)
    assert exchanged(points, assigned, prediction.positions)[0] == []
    near = np.linalg.norm(points[pair[0]] - points[pair[1]]) < ID_EXCHANGE_DISTANCE
    assigned[list(pair)] = pair[::-1]
    changed, labels = exchanged(points, assigned, prediction.positions)
    assert changed == (list(pair) if near else [])
    if near:
        np.testing.assert_array_equal(labels, np.arange(19))


def test_exchanges_need_two_labels(motion):
    _, prediction = motion.followed(20)
    for assigned in (np.full(19, -1), np.where(np.arange(19) == 3, 3, -1)):
        assert exchanged(motion.markers[20], assigned, prediction.positions)[0] == []


def planted(points: np.ndarray, wrong: int, off: float, seed: int) -> np.ndarray:
    """Points of which one lies elsewhere."""
    way, points = np.random.default_rng(seed).normal(size=3), points.copy()
    points[wrong] += off * way / np.linalg.norm(way)
    return points


@settings(deadline=None, max_examples=40)
@given(st.sampled_from([0, 4, 7, 10, 13, 16, 17, 18]), st.integers(0, 500), st.floats(0.03, 0.1))
def test_a_planted_wrong_label_is_dropped_and_the_right_ones_stay(motion, wrong, seed, off):
    """On the palm and at the knuckles, where no bent finger explains it."""
    state, prediction = motion.followed(20)
    points = planted(motion.markers[20], wrong, off, seed)
    labels, estimate = fitted(state, points, np.arange(19), prediction)
    assert np.flatnonzero(labels < 0).tolist() == [wrong]
    np.testing.assert_allclose(estimate.positions, motion.markers[20], atol=0.004)


def test_a_wrong_label_on_a_finger_seldom_drops_others(motion):
    """The worst goes first: where a bent finger explains the wrong one, that may be a right one."""
    state, prediction = motion.followed(20)
    found = []
    for number, wrong in enumerate([*range(1, 16)] * 20):
        points = planted(motion.markers[20], wrong, (0.03, 0.05, 0.09)[number % 3], number)
        labels, _ = fitted(state, points, np.arange(19), prediction)
        found.append(np.flatnonzero(labels < 0).tolist() == [wrong])
    assert np.mean(found) >= 0.95


@pytest.mark.parametrize("pair", [(3, 6), (6, 9), (9, 12), (5, 8), (0, 17)])
def test_of_two_swapped_labels_both_are_dropped(motion, pair):
    state, prediction = motion.followed(20)
    labels = np.arange(19)
    labels[list(pair)] = pair[::-1]
    labels, estimate = fitted(state, motion.markers[20], labels, prediction)
    assert set(np.flatnonzero(labels < 0)) == set(pair)
    np.testing.assert_allclose(estimate.positions, motion.markers[20], atol=0.004)


def test_without_labels_the_pose_is_the_predicted_one(motion):
    state, prediction = motion.followed(20)
    labels, estimate = fitted(state, motion.markers[20], np.full(19, -1), prediction)
    assert np.isnan(estimate.rms) and (labels == -1).all()
    np.testing.assert_array_equal(estimate.qpos[:7], prediction.qpos[:7])
    np.testing.assert_allclose(estimate.qpos[7:], prediction.joint_prior.angles, atol=1e-9)
    assert gated(state, np.zeros((0, 3)), np.zeros(0, dtype=int), prediction).shape == (0,)


def test_with_a_sure_prediction_most_labels_being_wrong_is_told_by_one_fit(motion):
    state, prediction = motion.followed(20)
    shuffled = np.roll(np.arange(19), 5)
    frame, estimate = fit_labels(frame_of(motion.markers[20], shuffled), 0, state, prediction, is_sure=True)
    assert np.isnan(estimate.rms)
    np.testing.assert_array_equal(frame.labels, shuffled)
    one_off = planted(motion.markers[20], 6, 0.1, 0)
    sure = fit_labels(frame_of(one_off, np.arange(19)), 0, state, prediction, is_sure=True)
    assert sure[0].labels[6] == -1 and sure[1].rms < 0.001


@pytest.fixture
def state(followed) -> HandState:
    return followed()


def a_review(labeler: CountingLabeler | None = None) -> LabelerReview:
    return LabelerReview(labeler or CountingLabeler(), 1, TrackerConfig())


def reviewed(review: LabelerReview, state: HandState, frame: FrameState):
    """The frame and the hand after a review; None where both stay as they are."""
    prediction = state.predict(frame.time)
    targets = targets_of(frame.points, frame.labels, 19)
    hand = HandTrack(0, state, prediction, state.fit(targets, prediction.qpos, prediction))
    after = review.review(frame, hand)
    return None if after[0] is frame and after[1] is hand else after


def test_exchanged_labels_are_found_and_right_ones_stay(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    review = a_review(labeler := CountingLabeler())
    assert reviewed(review, state, frame_of(points, np.arange(19), 0.5)) is None
    assert len(labeler.calls) == 1
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
    review = a_review()
    frame, _ = reviewed(review, state, frame_of(points, labels, 0.5))
    np.testing.assert_array_equal(frame.labels, np.arange(19))
    ghost = points.copy()
    ghost[TIP] += [0.0, 0.0, 0.03]
    again = a_review()
    assert reviewed(again, state, frame_of(ghost, labels, 0.5, first_seen=0.5)) is None


def test_a_point_that_was_long_beside_a_marker_does_not_replace_it(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    labels = np.arange(19)
    labels[TIP] = -1
    for free_since, replaces in ((0.45, True), (0.2, False)):
        review = a_review()
        after = reviewed(review, state, frame_of(points, labels, 0.5, free_since=free_since))
        assert (after is not None) == replaces


def test_reviews_become_rarer_until_a_new_point_comes(state, frame_of):
    points = state.solver.marker_positions(state.qpos)
    review = a_review(labeler := CountingLabeler())
    for frame in range(240):
        reviewed(review, state, frame_of(points, np.arange(19), 0.5 + frame / RATE))
    assert 8 <= len(labeler.calls) <= 20
    labels = np.arange(19)
    labels[TIP] = -1
    ghost, before = points.copy(), len(labeler.calls)
    ghost[TIP] += [0.0, 0.0, 0.03]
    for number, new in ((100, True), (100, False), (101, True)):
        ids = np.where(labels < 0, number, np.arange(19))
        reviewed(review, state, frame_of(ghost, labels, 2.5, ids=ids))
        assert (len(labeler.calls) > before) == new
        before = len(labeler.calls)


def test_a_hand_in_a_crowd_of_strays_is_not_reviewed(state, frame_of):
    """No labeler takes so many points."""
    points, rng = state.solver.marker_positions(state.qpos), np.random.default_rng(1)
    labels = np.concatenate([np.arange(19), np.full(700, -1)])
    labels[TIP] = -1
    crowd = np.concatenate([points, points[TIP] + rng.uniform(-0.03, 0.03, (700, 3))])
    labeler = CountingLabeler()
    assert reviewed(a_review(labeler), state, frame_of(crowd, labels, 0.5)) is None
    assert labeler.calls == []


def test_a_hand_that_was_initialized_is_reviewed_in_the_next_frame(state, frame_of):
    points, labeler = state.solver.marker_positions(state.qpos), CountingLabeler()
    review = a_review(labeler)
    for frame in range(120):
        reviewed(review, state, frame_of(points, np.arange(19), 0.5 + frame / RATE))
    before = len(labeler.calls)
    review.restart(0, 1.5)
    reviewed(review, state, frame_of(points, np.arange(19), 1.5))
    assert len(labeler.calls) == before
    reviewed(review, state, frame_of(points, np.arange(19), 1.5 + 2 / RATE))
    assert len(labeler.calls) == before + 1


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
    found = reviewed(a_review(), state, frame)
    if age == 0.0:
        assert found is None
    else:
        np.testing.assert_array_equal(found[0].labels, np.arange(19))
