"""Namings of a digit's points against all namings fitted one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

from gloves.fit import attach
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos
from poses.shapes.validity import resting_angles, sample_valid_angles
from track.association.digit_hypotheses import DigitTrust, digit_namings, digit_ranges, search_digit
from track.association.point_matching import worth_of
from track.kinematics.joint_prior import believe_digit, foresee, resting_covariance
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_solver import PoseSolver

INDEX = 1
MARKERS = np.array([4, 5, 6])
SPREAD = 0.001


@pytest.fixture(scope="module")
def hand():
    model = HandModel.named("M")
    return PoseSolver(attach(load_layout("dense19"), model)), model


def trusted(solver, qpos, missing):
    """What a tracker knows in a pose whose index finger lacks some markers."""
    target = solver.place(qpos)
    target[missing] = np.nan
    belief = foresee(qpos[7:] + np.deg2rad(4.0), 0.1 * resting_covariance(), 0.05)
    variance = np.full(19, SPREAD**2)
    seen = solver.expect(qpos, target, belief, wrist_spread=(0.01, 0.1), variance=variance, noise=SPREAD)
    return DigitTrust(belief, seen, variance, worth_of(variance), np.zeros(19), digit_ranges(solver.hand))


def search(solver, trust, points, odds):
    namings = digit_namings(1, len(points), len(MARKERS))
    search_digit(
        solver.hand, trust, INDEX, MARKERS, points, np.arange(len(points)), odds, *(row[0] for row in namings)
    )
    return namings


@pytest.mark.parametrize("seed", range(4))
def test_every_set_of_points_has_the_name_that_fits_best(hand, seed):
    solver, model = hand
    rng = np.random.default_rng(seed)
    angles = sample_valid_angles(model, 1, rng=rng) if seed else resting_angles(model)[None]
    qpos = join_qpos(angles)[0]
    trust = trusted(solver, qpos, MARKERS[1:])
    points = solver.place(qpos)[MARKERS] + 0.0005 * rng.standard_normal((3, 3))
    points = np.concatenate([points[rng.permutation(3)], points[:1] + 0.01 * rng.standard_normal((1, 3))])
    odds = np.zeros((len(points), 19))
    namings = search(solver, trust, points, odds)
    best = namings.scores[0].argmax()
    mine, theirs = namings.names[0, best], by_hand(solver, trust, points)
    assert mine.tolist() == theirs[1]
    assert namings.scores[0, best] == pytest.approx(theirs[0], abs=0.2)


def by_hand(solver, trust, points):
    """Score and names of the best naming, every one fitted with SciPy."""
    coming, precision = np.empty(4), np.empty((4, 4))
    believe_digit(trust.belief, trust.seen.told, trust.seen.pull, INDEX, coming, precision)
    posed, root = trust.seen.qpos.copy(), np.linalg.cholesky(precision).T
    place = slice(7 + 4 * INDEX, 11 + 4 * INDEX)

    def offs(angles, naming):
        posed[place] = angles
        markers = solver.place(posed)[MARKERS]
        return [(markers[n] - points[point]) / SPREAD for n, point in enumerate(naming) if point >= 0]

    def residuals(angles, naming):
        away = root @ (angles - coming)
        square = away @ away
        capped = away * np.sqrt(20.0 * np.log1p(square / 20.0) / max(square, 1e-12))
        return np.concatenate([*offs(angles, naming), capped])

    found = []
    for naming in itertools.product(range(-1, len(points)), repeat=3):
        used = [point for point in naming if point >= 0]
        if len(set(used)) < len(used):
            continue
        fit = least_squares(residuals, coming, args=(naming,))
        jacobian = np.array(
            [
                (np.concatenate(offs(fit.x + step, naming)) - np.concatenate(offs(fit.x - step, naming)))
                / 2e-5
                for step in 1e-5 * np.eye(4)
            ]
            if used
            else np.zeros((4, 1))
        )
        away = root @ (fit.x - coming)
        normal = jacobian @ jacobian.T + precision / (1.0 + away @ away / 20.0)
        gap = 0.5 * (np.linalg.slogdet(normal)[1] - np.linalg.slogdet(precision)[1])
        found.append((len(used) * trust.worth[0] - fit.cost - gap, list(naming)))
    return max(found)


def test_odds_decide_between_points_that_fit_as_well(hand):
    solver, model = hand
    qpos = join_qpos(resting_angles(model)[None])[0]
    trust = trusted(solver, qpos, MARKERS[2:])
    tip = solver.place(qpos)[6]
    points = np.array([*solver.place(qpos)[MARKERS[:2]], tip + [0.0, 0.001, 0.0], tip - [0.0, 0.001, 0.0]])
    for favorite in (2, 3):
        odds = np.zeros((4, 19))
        odds[favorite, 6] = 3.0
        namings = search(solver, trust, points, odds)
        assert namings.names[0, namings.scores[0].argmax()].tolist() == [0, 1, favorite]


def test_ranges_hold_the_poses_of_the_hand(hand):
    solver, model = hand
    ranges = digit_ranges(hand_arrays(attach(load_layout("dense19"), model)))
    angles = sample_valid_angles(model, 50, rng=np.random.default_rng(1))
    for qpos in join_qpos(angles):
        markers = solver.place(qpos)[MARKERS]
        apart = np.linalg.norm(markers[:, None] - markers, axis=-1)
        block = np.ix_(MARKERS, MARKERS)
        assert (apart >= ranges.nearest[block] - 0.003).all() and (
            apart <= ranges.farthest[block] + 0.003
        ).all()
