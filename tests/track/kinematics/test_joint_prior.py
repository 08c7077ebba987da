"""Priors of hinges: how they change with time, and how digits inform each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track.kinematics.joint_prior import digit_prior, predict_joints, resting_angles, resting_covariance
from track.kinematics.marker_prediction import empty_prediction

SEEDS = st.integers(0, 1000)
SPANS = st.floats(0.0, 5.0)
LEAST = np.deg2rad(0.5) ** 2 * np.eye(20)


def draw_prior(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and a covariance of hinges known to a few degrees."""
    rng = np.random.default_rng(seed)
    half = np.deg2rad(5.0) * rng.normal(size=(20, 20)) / np.sqrt(20.0)
    return rng.normal(scale=0.5, size=20), half @ half.T + 1e-6 * np.eye(20)


@settings(deadline=None)
@given(SEEDS, st.floats(-3.0, 0.0))
def test_at_once_they_are_as_they_were(seed, span):
    angles, known = draw_prior(seed)
    prior = predict_joints(angles, known, span)
    np.testing.assert_array_equal(prior.angles, angles)
    np.testing.assert_allclose(prior.covariance, known + LEAST, atol=1e-15)


@settings(deadline=None)
@given(SEEDS)
def test_in_the_end_they_are_as_hands_rest(seed):
    prior = predict_joints(*draw_prior(seed), 100.0)
    np.testing.assert_allclose(prior.covariance, resting_covariance() + LEAST, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(prior.angles, resting_angles())


@settings(deadline=None)
@given(SEEDS, SPANS)
def test_precision_is_the_inverse_and_spread_the_root_of_the_diagonal(seed, span):
    prior = predict_joints(*draw_prior(seed), span)
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(20), atol=1e-7)
    np.testing.assert_allclose(prior.spread**2, np.diag(prior.covariance))
    assert np.linalg.eigvalsh(prior.covariance).min() > 0.0


@settings(deadline=None)
@given(SEEDS, SPANS, SPANS)
def test_two_spans_are_as_good_as_one(seed, first, second):
    angles, known = draw_prior(seed)
    soon = predict_joints(angles, known, first)
    then = predict_joints(soon.angles, soon.covariance - LEAST, second)
    at_once = predict_joints(angles, known, first + second)
    np.testing.assert_allclose(then.angles, at_once.angles, atol=1e-12)
    np.testing.assert_allclose(then.covariance, at_once.covariance, atol=1e-12)


@settings(deadline=None)
@given(SEEDS, SPANS, SPANS)
def test_less_is_known_of_well_known_hinges_the_longer_nobody_looks(seed, first, second):
    spans = sorted([first, second])
    angles, known = draw_prior(seed)
    known *= 0.5 * np.linalg.eigvalsh(resting_covariance()).min() / np.linalg.eigvalsh(known).max()
    soon, late = (predict_joints(angles, known, span).covariance for span in spans)
    assert np.linalg.eigvalsh(late - soon).min() > -1e-12


def test_neighboring_fingers_rest_alike():
    covariance = resting_covariance()
    spread = np.sqrt(np.diag(covariance))
    together = covariance / np.outer(spread, spread)
    assert (np.diag(together[5:20:4, 9:20:4]) > 0.4).all(), "fingers flex with their neighbors"


def conditioned(prior, seen, digit):
    angles, precision = np.empty(4), np.empty((4, 4))
    digit_prior(prior, seen.information_matrix, seen.information_vector, digit, angles, precision)
    return angles, precision


def nothing_seen():
    seen = empty_prediction(19)
    seen.information_matrix[:], seen.information_vector[:] = 0.0, 0.0
    return seen


@pytest.mark.parametrize("digit", range(5))
def test_with_nothing_seen_a_digit_has_its_prior(digit):
    prior = predict_joints(*draw_prior(3), 0.4)
    mine = slice(4 * digit, 4 * digit + 4)
    angles, precision = conditioned(prior, nothing_seen(), digit)
    np.testing.assert_allclose(angles, prior.angles[mine])
    np.testing.assert_allclose(precision @ prior.covariance[mine, mine], np.eye(4), atol=1e-8)


@settings(deadline=None)
@given(SEEDS, st.integers(0, 4), st.floats(0.1, 3.0))
def test_a_digit_is_informed_by_the_others_and_not_by_itself(seed, digit, span):
    """As a normal distribution is, some of whose variables have been measured."""
    prior = predict_joints(*draw_prior(seed), span)
    rng = np.random.default_rng(seed)
    seen, noise = nothing_seen(), np.deg2rad(rng.uniform(0.5, 5.0, size=20)) ** 2
    found = prior.angles + rng.normal(scale=0.3, size=20)
    seen.information_matrix[:] = np.diag(1.0 / noise)
    seen.information_vector[:] = found / noise
    mine = np.arange(4 * digit, 4 * digit + 4)
    others = np.setdiff1d(np.arange(20), mine)
    between, among = prior.covariance[np.ix_(mine, others)], prior.covariance[np.ix_(others, others)]
    gain = between @ np.linalg.inv(among + np.diag(noise[others]))
    wanted = prior.angles[mine] + gain @ (found - prior.angles)[others]
    left = prior.covariance[np.ix_(mine, mine)] - gain @ between.T
    angles, precision = conditioned(prior, seen, digit)
    np.testing.assert_allclose(angles, wanted, atol=1e-7)
    np.testing.assert_allclose(precision @ left, np.eye(4), atol=1e-5)
