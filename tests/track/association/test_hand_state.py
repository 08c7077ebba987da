"""The filter of one hand: its motion goes on, its markers' biases are learned, forgotten and recalled."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos
from poses.shapes import resting_angles
from track.association.hand_state import (
    MOST_AGE_LOG_ODDS,
    SEEN_ELSEWHERE,
    STRAY_LIFETIME,
    HandState,
    _learn_bias,
)

RATE, KNUCKLE, TIP = 120.0, 4, 6


@pytest.fixture
def moving() -> HandState:
    """A hand that has moved at 0.6 m/s for a quarter of a second, every marker being seen."""
    user = nominal_fit(load_layout("dense19"), "M", "right")
    state = HandState(user)
    for frame in range(30):
        place = np.array([[0.6 * frame / RATE, 0.0, 1.0]])
        qpos = join_qpos(resting_angles(user.model)[None], position=place)[0]
        target = state.solver.marker_positions(qpos)
        if frame == 0:
            state.initialize(qpos, target, 0.0)
            continue
        prediction = state.predict(frame / RATE)
        state.update(state.fit(target, prediction.qpos, prediction), np.ones(19, dtype=bool), frame / RATE)
    return state


def test_a_motion_goes_on_for_a_while_and_then_the_hand_is_predicted_to_stand(moving):
    x = moving.qpos[0]
    ahead = [moving.predict(29 / RATE + span).qpos[0] - x for span in (1 / RATE, 0.05, 0.5)]
    np.testing.assert_allclose(ahead, [0.6 / RATE, 0.03, 0.03], atol=1e-3)


def test_predictions_grow_less_certain(moving):
    near, far = moving.predict(30 / RATE), moving.predict(0.5)
    assert (far.joint_prior.spread > near.joint_prior.spread).all()
    assert far.wrist_spread[0] > near.wrist_spread[0] and far.wrist_spread[1] > near.wrist_spread[1]


def test_three_markers_are_no_pose(moving):
    prediction, target = moving.predict(30 / RATE), np.full((19, 3), np.nan)
    target[:3] = prediction.positions[:3] + 0.05
    estimate = moving.fit(target, prediction.qpos, prediction)
    np.testing.assert_array_equal(estimate.qpos[:7], prediction.qpos[:7])
    assert np.isnan(estimate.rms) and np.isnan(estimate.residuals).all()


def test_a_marker_that_is_missing_is_less_certain_than_its_neighbors(moving):
    prediction = moving.predict(30 / RATE)
    target = prediction.positions.copy()
    target[TIP] = np.nan
    spread = np.trace(moving.fit(target, prediction.qpos, prediction).predicted.covariances, axis1=1, axis2=2)
    assert spread.argmax() == TIP


def test_a_marker_without_a_point_at_the_start_may_be_any_point_that_is_there(moving):
    target = moving.positions.copy()
    target[TIP] = np.nan
    moving.initialize(moving.qpos, target, 1.0)
    moving.predict(1.0)
    odds = moving.presence_log_odds(np.array([1.0 - STRAY_LIFETIME]), np.ones(1), np.array([-1]))[0]
    assert odds[KNUCKLE] == SEEN_ELSEWHERE + 1.0 < SEEN_ELSEWHERE + MOST_AGE_LOG_ODDS < odds[TIP]


def test_a_marker_that_the_first_fit_left_out_may_be_far_off_and_the_others_stay_certain():
    user = nominal_fit(load_layout("dense19"), "M", "right")
    state, others = HandState(user), np.delete(np.arange(19), KNUCKLE)
    qpos = join_qpos(resting_angles(user.model)[None])[0]
    seen = state.solver.marker_positions(qpos)
    state.initialize(qpos, np.where(np.arange(19)[:, None] == KNUCKLE, np.nan, seen), 0.0)
    state.predict(1 / RATE)
    assert state.variance[KNUCKLE] < 0.0016**2  # The start may be wrong, and is about to be reviewed.
    state.predict(0.2)
    assert state.variance[KNUCKLE] >= 0.004**2 > 4 * state.variance[others].max()
    seen[KNUCKLE, 1] += 0.008
    for start in (0.2, 1.2):  # It is lost in between, and found again with all of its markers.
        for time in start + np.arange(1, 40) / RATE:
            prediction = state.predict(time)
            state.update(state.fit(seen, qpos, prediction), np.ones(19, dtype=bool), time)
        state.predict(start + 1.0)
        assert state.variance.max() < 0.0015**2
        state.initialize(qpos, seen, start + 1.0)


def test_the_bias_of_a_marker_is_learned_and_its_designed_position_is_known(followed):
    off = np.zeros((19, 3))
    off[KNUCKLE] = 0.0, 0.004, 0.004
    state = followed(off=off)
    designed = HandState(state.hand).solver.marker_positions(state.qpos)
    shifted = state.solver.marker_positions(state.qpos) - designed
    np.testing.assert_allclose(shifted[KNUCKLE], off[KNUCKLE], atol=0.0025)
    assert np.linalg.norm(np.delete(shifted, KNUCKLE, axis=0), axis=1).max() < 0.002
    prediction = state.predict(61 / RATE)
    estimate = state.fit(prediction.positions, prediction.qpos, prediction)
    designed = HandState(state.hand).solver.marker_positions(estimate.qpos)
    np.testing.assert_allclose(state.unbiased_positions(estimate), designed, atol=1e-6)
    assert state.rms_from_design(estimate) > 3.0 * estimate.rms


def test_a_small_bias_is_forgotten_and_a_large_one_stays(followed):
    """Of what nothing confirms 0.02 mm go in a second, whatever there is."""
    off = np.zeros((19, 3))
    off[KNUCKLE] = 0.0, 0.004, 0.004
    state = followed(off=off)
    before = np.linalg.norm(state.biases.bias, axis=1)
    none, turned = np.zeros((19, 3)), np.tile(np.eye(3), (19, 1, 1))
    bias, frames = state.biases.bias, np.full(19, 120.0)
    for _ in range(120):
        _learn_bias(
            none,
            turned,
            np.ones(19, dtype=bool),
            state.digits,
            np.ones(5, dtype=bool),
            frames,
            bias,
            np.ones(19),
        )
    gone = before - np.linalg.norm(bias, axis=1)
    np.testing.assert_allclose(gone, np.minimum(before, 2e-5 + 0.049 * before), atol=2e-6)
    assert np.isfinite(bias).all()


def test_only_settled_labels_teach_a_bias(moving):
    before = moving.solver.hand.positions.copy()
    prediction = moving.predict(30 / RATE)
    target = prediction.positions.copy()
    target[KNUCKLE] += 0.003
    estimate = moving.fit(target, prediction.qpos, prediction)
    moving.update(estimate, np.arange(19) != KNUCKLE, 30 / RATE)
    np.testing.assert_array_equal(moving.solver.hand.positions[KNUCKLE], before[KNUCKLE])
    assert (moving.solver.hand.positions != before).any()


def test_a_marker_alone_on_its_digit_keeps_its_spread():
    user = nominal_fit(load_layout("tips8"), "M", "right")
    state, qpos = HandState(user), join_qpos(resting_angles(user.model)[None])[0]
    target = state.solver.marker_positions(qpos)
    state.initialize(qpos, target, 0.0)
    first = state.biases.learned_variance
    for frame in range(1, 30):
        prediction = state.predict(frame / RATE)
        state.update(state.fit(target, prediction.qpos, prediction), np.ones(8, dtype=bool), frame / RATE)
    is_tip, learned = state.digits >= 0, state.biases.learned_variance
    np.testing.assert_array_equal(learned[is_tip], first[is_tip])
    assert (learned[~is_tip] < first[~is_tip]).all()


def test_biases_are_forgotten_and_recalled(followed):
    off = np.zeros((19, 3))
    off[KNUCKLE] = 0.0, 0.01, 0.01
    state = followed(off=off)
    designed = HandState(state.hand).solver.hand.positions
    biased, variance, biases = state.solver.hand.positions.copy(), state.variance.copy(), state.biases
    state.forget(np.array([KNUCKLE]))
    np.testing.assert_array_equal(state.solver.hand.positions[KNUCKLE], designed[KNUCKLE])
    others = np.delete(np.arange(19), KNUCKLE)
    np.testing.assert_array_equal(state.solver.hand.positions[others], biased[others])
    assert state.variance[KNUCKLE] > variance[KNUCKLE]
    state.recall(biases)
    np.testing.assert_array_equal(state.solver.hand.positions, biased)
    np.testing.assert_array_equal(state.variance, variance)
    assert np.linalg.norm(biased[KNUCKLE, 0] - designed[KNUCKLE, 0]) > 0.003


@pytest.mark.parametrize("same", [True, False])
def test_a_hand_that_comes_back_keeps_its_biases_if_they_still_fit(followed, same):
    off = np.random.default_rng(1).uniform(-0.004, 0.004, (19, 3))
    state = followed(off=off)
    qpos, biased = state.qpos, state.solver.hand.positions.copy()
    target = (
        state.solver.marker_positions(qpos)
        if same
        else HandState(state.hand).solver.marker_positions(qpos) - 2 * off
    )
    state.initialize(qpos, target, 2.0)
    assert np.array_equal(state.solver.hand.positions, biased) == same
    assert (state.spread is None) != same and not state.confirmed.any()


def test_a_marker_comes_back_soon_or_hardly_and_never_while_it_is_seen_elsewhere(moving):
    prediction = moving.predict(30 / RATE)
    target = prediction.positions.copy()
    target[TIP] = np.nan
    moving.update(moving.fit(target, prediction.qpos, prediction), np.ones(19, dtype=bool), 30 / RATE)
    moving.predict(0.5)
    unlabeled, now = np.full(3, -1), np.full(3, 0.5)
    log_odds = moving.presence_log_odds(np.array([0.1, 30 / RATE + 1e-3, 0.5]), now, unlabeled)
    assert log_odds[0, TIP] == pytest.approx(
        SEEN_ELSEWHERE + MOST_AGE_LOG_ODDS
    )  # it was seen after the point
    assert (log_odds[1, KNUCKLE] > log_odds[2, KNUCKLE] - MOST_AGE_LOG_ODDS).all()
    age = (0.5 - 30 / RATE - 1e-3) / STRAY_LIFETIME
    soon = log_odds[1] - age
    assert soon[KNUCKLE] == pytest.approx(np.log(0.65)) and log_odds[2, TIP] < soon[TIP]


def test_a_point_that_was_beside_a_seen_marker_is_hardly_that_marker_while_it_is_hidden(moving):
    moving.predict(0.5)  # the markers were last seen at 0.25 s
    hidden, held = (
        moving.presence_log_odds(np.zeros(1), np.zeros(1), np.array([marker]))[0] for marker in (-1, KNUCKLE)
    )
    assert held[KNUCKLE] == SEEN_ELSEWHERE + MOST_AGE_LOG_ODDS > hidden[KNUCKLE] + 15.0
    assert held[TIP] == hidden[TIP]
