"""The fit of a digit's four hinges to a hypothesis, against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from gloves.fit import attach
from gloves.layout import load_layout
from handsim.hand.model import HandModel
from track.association.digit_fit import fit_hypothesis
from track.kinematics.marker_kinematics import HandArrays, compute_markers, hand_arrays, workspace
from track.kinematics.starting_poses import RESTING

INDEX, MARKERS, SPREAD = 1, np.array([4, 5, 6]), 0.001
OWN = slice(4 * INDEX, 4 * INDEX + 4)
MEAN, PRECISION = RESTING[OWN].copy(), np.diag(np.deg2rad([5.0, 15.0, 15.0, 10.0]) ** -2)


@pytest.fixture(scope="module")
def hand() -> HandArrays:
    return hand_arrays(attach(load_layout("dense19"), HandModel.named("M")))


def markers_at(hand: HandArrays, angles: np.ndarray) -> np.ndarray:
    """The index finger's markers in the wrist's frame [m]."""
    work, all_angles = workspace(19), RESTING.copy()
    all_angles[OWN] = angles
    compute_markers(hand, all_angles, work)
    return work.markers[MARKERS].copy()


def fitted(hand, points, hypothesis, start=MEAN, cutoff=np.inf):
    """Cost, complexity and hinges."""
    work, angles, variance = workspace(19), np.array(start), np.full(19, SPREAD**2)
    compute_markers(hand, RESTING, work)
    cost, complexity = fit_hypothesis(
        hand, INDEX, MARKERS, points, variance, np.array(hypothesis), MEAN, PRECISION, cutoff, angles, work
    )
    return cost, complexity, angles


def by_hand(hand, points, hypothesis) -> float:
    """The least cost that SciPy finds: markers, robust prior and soft limits."""
    low, high = hand.ranges[OWN].T

    def cost(angles):
        found = markers_at(hand, angles)
        off = sum(((found[n] - points[p]) ** 2).sum() for n, p in enumerate(hypothesis) if p >= 0)
        square = (angles - MEAN) @ PRECISION @ (angles - MEAN)
        beyond = np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)
        return 0.5 * (
            off / SPREAD**2 + 20.0 * np.log1p(square / 20.0) + (beyond**2).sum() / np.deg2rad(2.0) ** 2
        )

    starts = (MEAN, fitted(hand, points, hypothesis)[2])
    return min(minimize(cost, start, method="BFGS", options={"gtol": 1e-4}).fun for start in starts)


@pytest.mark.parametrize("seed", range(6))
def test_no_other_angles_cost_less(hand, seed):
    rng = np.random.default_rng(seed)
    points = markers_at(hand, MEAN + np.deg2rad(12.0) * rng.standard_normal(4))
    points += 0.001 * rng.standard_normal(points.shape)
    order = rng.permutation(3).tolist()
    hypothesis = [order.index(n) for n in range(3)] if seed % 2 else [order.index(0), -1, order.index(2)]
    cost, _, _ = fitted(hand, points[order], hypothesis)
    assert cost == pytest.approx(by_hand(hand, points[order], hypothesis), abs=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_exact_points_give_their_angles(hand, seed):
    rng = np.random.default_rng(seed)
    low, high = hand.ranges[OWN].T
    true = np.clip(MEAN + np.deg2rad(10.0) * rng.standard_normal(4), low, high)
    cost, _, angles = fitted(hand, markers_at(hand, true), [0, 1, 2])
    np.testing.assert_allclose(angles[:3], true[:3], atol=np.deg2rad(4.0))
    assert cost < 5.0
    wrong, _, _ = fitted(hand, markers_at(hand, true), [2, 1, 0])
    assert wrong > cost + 50.0


def test_without_points_the_prior_holds_and_costs_nothing(hand):
    cost, complexity, angles = fitted(hand, np.zeros((1, 3)), [-1, -1, -1])
    np.testing.assert_allclose(angles, MEAN)
    assert cost == pytest.approx(0.0) and complexity == pytest.approx(0.0, abs=1e-9)


def test_more_points_leave_less_to_the_prior(hand):
    points = markers_at(hand, MEAN)
    complexities = [fitted(hand, points, chosen)[1] for chosen in ([0, -1, -1], [0, 1, -1], [0, 1, 2])]
    assert 0.0 < complexities[0] < complexities[1] < complexities[2]


def test_a_hinge_stays_near_its_range(hand):
    """Points of a finger that is bent backwards by 60 degrees."""
    low, bent = hand.ranges[OWN, 0], MEAN.copy()
    bent[1] = low[1] - np.deg2rad(60.0)
    _, _, angles = fitted(hand, markers_at(hand, bent), [0, 1, 2])
    assert bent[1] + np.deg2rad(15.0) < angles[1] < low[1]


def test_a_fit_that_would_end_beyond_the_cutoff_stops_early(hand):
    points = markers_at(hand, MEAN) + [0.02, 0.0, 0.0]
    whole, _, _ = fitted(hand, points, [0, 1, 2])
    stopped, _, angles = fitted(hand, points, [0, 1, 2], cutoff=1.0)
    assert stopped > 1.0 and whole > 1.0
    np.testing.assert_array_equal(angles, MEAN)
