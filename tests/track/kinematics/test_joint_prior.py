"""Beliefs of hinges: what time does to them, and what digits tell of each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track.kinematics.joint_prior import believe_digit, foresee, resting_covariance
from track.kinematics.marker_prediction import expectation

SEEDS = st.integers(0, 1000)
SPANS = st.floats(0.0, 5.0)
LEAST = np.deg2rad(0.5) ** 2 * np.eye(20)


def draw_belief(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and a covariance of hinges known to a few degrees."""
    rng = np.random.default_rng(seed)
    half = np.deg2rad(5.0) * rng.normal(size=(20, 20)) / np.sqrt(20.0)
    return rng.normal(scale=0.5, size=20), half @ half.T + 1e-6 * np.eye(20)


@settings(deadline=None)
@given(SEEDS, st.floats(-3.0, 0.0))
def test_at_once_they_are_as_they_were(seed, span):
    angles, known = draw_belief(seed)
    belief = foresee(angles, known, span)
    np.testing.assert_array_equal(belief.angles, angles)
    np.testing.assert_allclose(belief.covariance, known + LEAST, atol=1e-15)


@settings(deadline=None)
@given(SEEDS)
def test_in_the_end_they_are_as_hands_rest(seed):
    belief = foresee(*draw_belief(seed), 100.0)
    np.testing.assert_allclose(belief.covariance, resting_covariance() + LEAST, rtol=1e-9, atol=1e-12)


@settings(deadline=None)
@given(SEEDS, SPANS)
def test_precision_is_the_inverse_and_spread_the_root_of_the_diagonal(seed, span):
    belief = foresee(*draw_belief(seed), span)
    np.testing.assert_allclose(belief.precision @ belief.covariance, np.eye(20), atol=1e-7)
    np.testing.assert_allclose(belief.spread**2, np.diag(belief.covariance))
    assert np.linalg.eigvalsh(belief.covariance).min() > 0.0


@settings(deadline=None)
@given(SEEDS, SPANS, SPANS)
def test_two_spans_are_as_good_as_one(seed, first, second):
    angles, known = draw_belief(seed)
    then = foresee(angles, foresee(angles, known, first).covariance - LEAST, second)
    at_once = foresee(angles, known, first + second)
    np.testing.assert_allclose(then.covariance, at_once.covariance, atol=1e-12)


@settings(deadline=None)
@given(SEEDS, SPANS, SPANS)
def test_less_is_known_of_well_known_hinges_the_longer_nobody_looks(seed, first, second):
    spans = sorted([first, second])
    angles, known = draw_belief(seed)
    known *= 0.5 * np.linalg.eigvalsh(resting_covariance()).min() / np.linalg.eigvalsh(known).max()
    soon, late = (foresee(angles, known, span).covariance for span in spans)
    assert np.linalg.eigvalsh(late - soon).min() > -1e-12


def test_neighboring_fingers_rest_alike():
    covariance = resting_covariance()
    spread = np.sqrt(np.diag(covariance))
    together = covariance / np.outer(spread, spread)
    assert (np.diag(together[5:20:4, 9:20:4]) > 0.4).all(), "fingers flex with their neighbors"


def belief_of_digit(belief, seen, digit):
    angles, precision = np.empty(4), np.empty((4, 4))
    believe_digit(belief, seen.told, seen.pull, digit, angles, precision)
    return angles, precision


def nothing_seen():
    seen = expectation(19)
    seen.told[:], seen.pull[:] = 0.0, 0.0
    return seen


@pytest.mark.parametrize("digit", range(5))
def test_with_nothing_seen_a_digit_is_as_it_was_believed(digit):
    belief = foresee(*draw_belief(3), 0.4)
    mine = slice(4 * digit, 4 * digit + 4)
    angles, precision = belief_of_digit(belief, nothing_seen(), digit)
    np.testing.assert_allclose(angles, belief.angles[mine])
    np.testing.assert_allclose(precision @ belief.covariance[mine, mine], np.eye(4), atol=1e-8)


@settings(deadline=None)
@given(SEEDS, st.integers(0, 4), st.floats(0.1, 3.0))
def test_a_digit_is_told_of_by_the_others_and_not_by_itself(seed, digit, span):
    """As a normal distribution is, some of whose variables have been measured."""
    belief = foresee(*draw_belief(seed), span)
    rng = np.random.default_rng(seed)
    seen, noise = nothing_seen(), np.deg2rad(rng.uniform(0.5, 5.0, size=20)) ** 2
    found = belief.angles + rng.normal(scale=0.3, size=20)
    seen.told[:] = np.diag(1.0 / noise)
    seen.pull[:] = found / noise
    mine = np.arange(4 * digit, 4 * digit + 4)
    others = np.setdiff1d(np.arange(20), mine)
    between, among = belief.covariance[np.ix_(mine, others)], belief.covariance[np.ix_(others, others)]
    gain = between @ np.linalg.inv(among + np.diag(noise[others]))
    wanted = belief.angles[mine] + gain @ (found - belief.angles)[others]
    left = belief.covariance[np.ix_(mine, mine)] - gain @ between.T
    angles, precision = belief_of_digit(belief, seen, digit)
    np.testing.assert_allclose(angles, wanted, atol=1e-7)
    np.testing.assert_allclose(precision @ left, np.eye(4), atol=1e-5)
