"""Hypotheses of a digit's points against all assignments fitted one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from gloves import attach, load_layout
from handsim import HandModel, join_qpos
from poses.shapes import resting_angles, sample_valid_angles
from track import TrackerConfig
from track.association.digit_hypotheses import (
    DigitHypotheses,
    DigitModel,
    DigitPoints,
    digit_ranges,
    empty_hypotheses,
    evaluate_digit,
    fit_hypothesis,
)
from track.association.frame_state import peak_log_odds
from track.kinematics.marker_kinematics import HandArrays, compute_markers, hand_arrays, workspace
from track.kinematics.pose_solver import RESTING, PoseSolver
from track.kinematics.pose_spread import digit_prior, predict_joints, predict_markers, resting_prior

INDEX = 1
MARKERS = np.array([4, 5, 6])
SPREAD = 0.001
STRAYS = TrackerConfig.stray_density
OWN = slice(4 * INDEX, 4 * INDEX + 4)
MEAN, PRECISION = RESTING[OWN].copy(), np.diag(np.deg2rad([5.0, 15.0, 15.0, 10.0]) ** -2)


@pytest.fixture(scope="module")
def hand():
    model = HandModel.named("M")
    return PoseSolver(attach(load_layout("dense19"), model)), model


def digit_model(solver, qpos, missing):
    """What a tracker knows in a pose whose index finger lacks some markers."""
    target = solver.marker_positions(qpos)
    target[missing] = np.nan
    prior = predict_joints(qpos[7:] + np.deg2rad(4.0), 0.1 * resting_prior().covariance, 0.05)
    variance = np.full(19, SPREAD**2)
    seen = predict_markers(solver.hand, solver.on_part, qpos, target, prior, (0.01, 0.1), variance, SPREAD)
    return DigitModel(
        prior,
        seen,
        variance,
        peak_log_odds(variance, STRAYS),
        np.zeros(19),
        digit_ranges(attach(load_layout("dense19"), HandModel.named("M"))),
    )


def search(solver, model_of_digit, points, log_odds):
    hypotheses = empty_hypotheses(1, len(points), len(MARKERS))
    evaluate_digit(
        solver.hand,
        model_of_digit,
        INDEX,
        MARKERS,
        points,
        np.arange(len(points)),
        log_odds,
        DigitHypotheses(*(row[0] for row in hypotheses)),
    )
    return hypotheses


@pytest.mark.parametrize("seed", range(4))
def test_every_set_of_points_has_the_assignment_that_fits_best(hand, seed):
    solver, model = hand
    rng = np.random.default_rng(seed)
    angles = sample_valid_angles(model, 1, rng=rng) if seed else resting_angles(model)[None]
    qpos = join_qpos(angles)[0]
    model_of_digit = digit_model(solver, qpos, MARKERS[1:])
    points = solver.marker_positions(qpos)[MARKERS] + 0.0005 * rng.standard_normal((3, 3))
    points = np.concatenate([points[rng.permutation(3)], points[:1] + 0.01 * rng.standard_normal((1, 3))])
    log_odds = np.zeros((len(points), 19))
    hypotheses = search(solver, model_of_digit, points, log_odds)
    best = hypotheses.scores[0].argmax()
    mine, theirs = hypotheses.assignments[0, best], by_hand(solver, model_of_digit, points)
    assert mine.tolist() == theirs[1]
    assert hypotheses.scores[0, best] == pytest.approx(theirs[0], abs=0.2)


def by_hand(solver, model_of_digit, points):
    """Score and labels of the best hypothesis, every one fitted with SciPy."""
    prediction, precision = np.empty(4), np.empty((4, 4))
    digit_prior(model_of_digit.joint_prior, model_of_digit.predicted, INDEX, prediction, precision)
    posed, root = model_of_digit.predicted.qpos.copy(), np.linalg.cholesky(precision).T
    place = slice(7 + 4 * INDEX, 11 + 4 * INDEX)

    def offs(angles, hypothesis):
        posed[place] = angles
        markers = solver.marker_positions(posed)[MARKERS]
        return [(markers[n] - points[point]) / SPREAD for n, point in enumerate(hypothesis) if point >= 0]

    def residuals(angles, hypothesis):
        away = root @ (angles - prediction)
        square = away @ away
        capped = away * np.sqrt(20.0 * np.log1p(square / 20.0) / max(square, 1e-12))
        return np.concatenate([*offs(angles, hypothesis), capped])

    found = []
    for hypothesis in itertools.product(range(-1, len(points)), repeat=3):
        used = [point for point in hypothesis if point >= 0]
        if len(set(used)) < len(used):
            continue
        fit = least_squares(residuals, prediction, args=(hypothesis,))
        jacobian = np.array(
            [
                (
                    np.concatenate(offs(fit.x + step, hypothesis))
                    - np.concatenate(offs(fit.x - step, hypothesis))
                )
                / 2e-5
                for step in 1e-5 * np.eye(4)
            ]
            if used
            else np.zeros((4, 1))
        )
        away = root @ (fit.x - prediction)
        normal = jacobian @ jacobian.T + precision / (1.0 + away @ away / 20.0)
        gap = 0.5 * (np.linalg.slogdet(normal)[1] - np.linalg.slogdet(precision)[1])
        found.append((len(used) * model_of_digit.peak_log_odds[0] - fit.cost - gap, list(hypothesis)))
    return max(found)


def test_odds_decide_between_points_that_fit_as_well(hand):
    solver, model = hand
    qpos = join_qpos(resting_angles(model)[None])[0]
    model_of_digit = digit_model(solver, qpos, MARKERS[2:])
    tip = solver.marker_positions(qpos)[6]
    points = np.array(
        [*solver.marker_positions(qpos)[MARKERS[:2]], tip + [0.0, 0.001, 0.0], tip - [0.0, 0.001, 0.0]]
    )
    for preferred in (2, 3):
        log_odds = np.zeros((4, 19))
        log_odds[preferred, 6] = 3.0
        hypotheses = search(solver, model_of_digit, points, log_odds)
        assert hypotheses.assignments[0, hypotheses.scores[0].argmax()].tolist() == [0, 1, preferred]


def test_ranges_hold_the_poses_of_the_hand(hand):
    solver, model = hand
    ranges = digit_ranges(attach(load_layout("dense19"), model))
    angles = sample_valid_angles(model, 50, rng=np.random.default_rng(1))
    for qpos in join_qpos(angles):
        markers = solver.marker_positions(qpos)[MARKERS]
        apart = np.linalg.norm(markers[:, None] - markers, axis=-1)
        block = np.ix_(MARKERS, MARKERS)
        assert (apart >= ranges.nearest[block] - 0.003).all() and (
            apart <= ranges.farthest[block] + 0.003
        ).all()


@pytest.fixture(scope="module")
def arrays() -> HandArrays:
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
    own = DigitPoints(hand, INDEX, MARKERS, points, variance, MEAN, PRECISION)
    cost, complexity = fit_hypothesis(own, np.array(hypothesis), cutoff, angles, work)
    return cost, complexity, angles


def least_cost(hand, points, hypothesis) -> float:
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
def test_no_other_angles_cost_less(arrays, seed):
    rng = np.random.default_rng(seed)
    points = markers_at(arrays, MEAN + np.deg2rad(12.0) * rng.standard_normal(4))
    points += 0.001 * rng.standard_normal(points.shape)
    order = rng.permutation(3).tolist()
    hypothesis = [order.index(n) for n in range(3)] if seed % 2 else [order.index(0), -1, order.index(2)]
    cost, _, _ = fitted(arrays, points[order], hypothesis)
    assert cost == pytest.approx(least_cost(arrays, points[order], hypothesis), abs=0.05)


def test_without_points_the_prior_holds_and_costs_nothing(arrays):
    cost, complexity, angles = fitted(arrays, np.zeros((1, 3)), [-1, -1, -1])
    np.testing.assert_allclose(angles, MEAN)
    assert cost == pytest.approx(0.0) and complexity == pytest.approx(0.0, abs=1e-9)


def test_a_hinge_stays_near_its_range(arrays):
    """Points of a finger that is bent backwards by 60 degrees."""
    low, bent = arrays.ranges[OWN, 0], MEAN.copy()
    bent[1] = low[1] - np.deg2rad(60.0)
    _, _, angles = fitted(arrays, markers_at(arrays, bent), [0, 1, 2])
    assert bent[1] + np.deg2rad(15.0) < angles[1] < low[1]


def test_a_fit_that_would_end_beyond_the_cutoff_stops_early(arrays):
    points = markers_at(arrays, MEAN) + [0.02, 0.0, 0.0]
    whole, _, _ = fitted(arrays, points, [0, 1, 2])
    stopped, _, angles = fitted(arrays, points, [0, 1, 2], cutoff=1.0)
    assert stopped > 1.0 and whole > 1.0
    np.testing.assert_array_equal(angles, MEAN)
