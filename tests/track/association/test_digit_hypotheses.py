"""Hypotheses of a digit's points against all assignments fitted one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

from gloves.fit import attach
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos
from poses.shapes import resting_angles, sample_valid_angles
from track.association.assignment import peak_log_odds
from track.association.digit_hypotheses import DigitModel, digit_ranges, empty_hypotheses, evaluate_digit
from track.config import TrackerConfig
from track.kinematics.joint_prior import digit_prior, predict_joints, resting_covariance
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_solver import PoseSolver

INDEX = 1
MARKERS = np.array([4, 5, 6])
SPREAD = 0.001
STRAYS = TrackerConfig.stray_density


@pytest.fixture(scope="module")
def hand():
    model = HandModel.named("M")
    return PoseSolver(attach(load_layout("dense19"), model)), model


def digit_model(solver, qpos, missing):
    """What a tracker knows in a pose whose index finger lacks some markers."""
    target = solver.marker_positions(qpos)
    target[missing] = np.nan
    prior = predict_joints(qpos[7:] + np.deg2rad(4.0), 0.1 * resting_covariance(), 0.05)
    variance = np.full(19, SPREAD**2)
    seen = solver.predict_markers(
        qpos, target, prior, wrist_spread=(0.01, 0.1), variance=variance, noise=SPREAD
    )
    return DigitModel(
        prior,
        seen,
        variance,
        peak_log_odds(variance, STRAYS),
        np.zeros(19),
        digit_ranges(solver.hand),
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
        *(row[0] for row in hypotheses),
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
    digit_prior(
        model_of_digit.joint_prior,
        model_of_digit.predicted.information_matrix,
        model_of_digit.predicted.information_vector,
        INDEX,
        prediction,
        precision,
    )
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
    ranges = digit_ranges(hand_arrays(attach(load_layout("dense19"), model)))
    angles = sample_valid_angles(model, 50, rng=np.random.default_rng(1))
    for qpos in join_qpos(angles):
        markers = solver.marker_positions(qpos)[MARKERS]
        apart = np.linalg.norm(markers[:, None] - markers, axis=-1)
        block = np.ix_(MARKERS, MARKERS)
        assert (apart >= ranges.nearest[block] - 0.003).all() and (
            apart <= ranges.farthest[block] + 0.003
        ).all()
