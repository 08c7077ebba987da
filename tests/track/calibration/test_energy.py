"""The equations of a calibration are the derivative of its energy, for poses, shape, markers and touches."""

from __future__ import annotations

import dataclasses
from copy import copy

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim import HandModel, join_qpos
from handsim.hand.shape import DIGITS
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses.shapes import resting_angles, sample_valid_angles
from poses.touch import touching_angles
from track.calibration.energy import (
    PAD_COMPRESSION,
    ContactGeometry,
    Estimate,
    Problem,
    are_touches,
    contact_geometry,
    contact_weights,
    eliminate_poses,
    error_covariance,
    find_touches,
    initialize_contacts,
    levenberg_marquardt,
    shared_covariance,
    slide_contacts,
)
from track.calibration.hand_parameters import NUM_PARAMETERS, SkinPatch, nearest_coordinates

FRAMES = 12
SHARED = NUM_PARAMETERS + 57
RATE = 60.0


@pytest.fixture(scope="module")
def problem_and_estimate():
    """A hand in poses of which two are touches, looked for 3 mm and more away from where it is."""
    rng = np.random.default_rng(7)
    hand = nominal_fit(load_layout("dense19"), "M", "right")
    angles = sample_valid_angles(hand.model, FRAMES, rng=rng)
    touches = [(0, "index"), (1, "ring")]
    for frame, finger in touches:
        angles[frame] = touching_angles(hand.model, finger)
    qpos = join_qpos(
        angles, position=rng.normal(size=(FRAMES, 3)), quaternion=random_quaternions(FRAMES, rng=rng)
    )
    bones = hand.model.forward_kinematics(qpos)
    targets = hand.attachment.centers(hand.model, bones) + rng.normal(scale=0.001, size=(FRAMES, 19, 3))
    targets[3, 5] = np.nan
    worn = hand.attachment
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, hand.shape)
    problem = Problem(hand.model.shape, coordinates, 0.0032, targets, noise=0.001, robust_scale=0.01)
    contacts = initialize_contacts(hand.model, touches, bones[:2])
    estimate = Estimate(np.zeros(NUM_PARAMETERS), hand.attachment.points, coordinates, qpos, contacts)
    shared = rng.normal(size=SHARED) * np.r_[np.full(NUM_PARAMETERS, 0.002), np.full(57, 0.0005)]
    estimate = problem.apply_step(estimate, rng.normal(scale=0.02, size=(FRAMES, 26)), shared)
    fit = problem.fit(estimate)
    return problem, dataclasses.replace(estimate, contacts=slide_contacts(contacts, fit.model, fit.bones[:2]))


def direction(kind, rng):
    poses, shared = np.zeros((FRAMES, 26)), np.zeros(SHARED)
    if kind == "poses":
        poses = rng.normal(size=poses.shape)
    elif kind == "shape":
        shared[:NUM_PARAMETERS] = rng.normal(size=NUM_PARAMETERS) * 0.1
    else:
        shared[NUM_PARAMETERS:] = rng.normal(size=57) * 0.01
    return poses, shared


# E_prior's normals are held within a step, and a marker that moves along the skin turns its own.
@pytest.mark.parametrize(("kind", "tolerance"), [("poses", 2e-3), ("shape", 2e-3), ("markers", 3e-2)])
def test_the_gradient_is_the_energys(kind, tolerance, problem_and_estimate, rng, monkeypatch):
    # How far a touch is trusted is held within a step, which is what reweighting means.
    monkeypatch.setattr(
        "track.calibration.energy.contact_weights", lambda geometry, fingers: np.full(len(fingers), 0.7)
    )
    problem, estimate = problem_and_estimate
    equations = problem.normal_equations(estimate, problem.fit(estimate))
    poses, shared = direction(kind, rng)
    step = 1e-5
    there, back = (
        problem.fit(problem.apply_step(estimate, sign * poses, sign * shared)).cost for sign in (step, -step)
    )
    told = (equations.pose_gradient * poses).sum() + equations.shared_gradient @ shared
    assert told == pytest.approx((there - back) / (4 * step), rel=tolerance)


def test_elimination_solves_the_whole_system(problem_and_estimate):
    problem, estimate = problem_and_estimate
    equations = problem.normal_equations(estimate, problem.fit(estimate))
    reduced, solved = eliminate_poses(equations, 0.0)
    shared = -np.linalg.solve(reduced[:, :-1], reduced[:, -1])
    poses = -solved[..., -1] - solved[..., :-1] @ shared
    left = equations.shared @ shared + np.einsum("fps,fp->s", equations.mixed, poses)
    scale = np.sqrt(equations.shared.diagonal())
    np.testing.assert_allclose((left + equations.shared_gradient) / scale, 0.0, atol=1e-6)
    rest = np.einsum("fpq,fq->fp", equations.pose, poses) + equations.mixed @ shared + equations.pose_gradient
    np.testing.assert_allclose(rest / np.sqrt(np.einsum("fpp->fp", equations.pose)), 0.0, atol=1e-6)


def angle_spreads(problem, estimate, covariance):
    """Standard deviations of joint angles over the frames of a problem [rad]."""
    _, answers = shared_covariance(problem, estimate, problem.fit(estimate))
    return np.sqrt(np.einsum("fis,st,fit->i", answers[:, 6:], covariance, answers[:, 6:]) / len(answers))


def test_a_thumb_that_gestures_may_turn_is_told_as_unsure(problem_and_estimate):
    problem, estimate = copy(problem_and_estimate[0]), problem_and_estimate[1]
    problem.noise = problem.data_noise = 0.003  # so that the markers tell little
    fit = problem.fit(estimate)
    without, told = (
        angle_spreads(problem, estimate, covariance)
        for covariance in (
            shared_covariance(problem, estimate, fit)[0],
            error_covariance(problem, estimate, fit),
        )
    )
    assert (told >= without).all()
    assert told[0] > 1.05 * without[0] > 0.0


def test_flesh_that_follows_the_angles_is_found_and_not_averaged_out(problem_and_estimate, rng):
    problem, estimate = copy(problem_and_estimate[0]), problem_and_estimate[1]
    problem.robust_scale, problem.data_noise = np.inf, 1e-6
    fit = problem.fit(estimate)
    fit = fit._replace(residuals=np.zeros_like(fit.residuals))
    without, answers = error_covariance(problem, estimate, fit), shared_covariance(problem, estimate, fit)[1]
    digits = nominal_fit(load_layout("dense19"), "M", "right").attachment.digits
    turns, before = quaternion_matrix(estimate.qpos[:, 3:7]), problem.normal_equations(estimate, fit)
    by_pose, by_shared, _, _ = problem.weighted_jacobians(estimate, fit)
    ratios = []
    for _ in range(20):
        moved = np.zeros_like(fit.residuals)
        for marker, digit in enumerate(digits):
            some = slice(12, None, 4) if digit < 0 else slice(7 + 4 * digit, 11 + 4 * digit)
            off = estimate.qpos[:, some] - estimate.qpos[:, some].mean(axis=0)
            off *= 0.0008 / np.sqrt((off**2).sum(axis=1).mean())
            moved[:, marker] = np.einsum("fij,fj->fi", turns, off @ rng.standard_normal((4, 3)))
        moved *= problem.present[..., None]
        after = problem.normal_equations(estimate, fit._replace(residuals=-moved))
        change = after._replace(
            pose_gradient=after.pose_gradient - before.pose_gradient,
            shared_gradient=after.shared_gradient - before.shared_gradient,
        )
        reduced, solved = eliminate_poses(change, 0.0)
        shared = -np.linalg.solve(reduced[:, :-1], reduced[:, -1])
        poses = -solved[..., -1] - answers @ shared
        left = np.einsum("frp,fp->fr", by_pose, poses) + by_shared @ shared
        residuals = problem.noise * left[:, :-1].reshape(moved.shape) - moved
        by_flesh = error_covariance(problem, estimate, fit._replace(residuals=residuals)) - without
        variances = np.einsum("fis,st,fit->fi", answers[:, 6:], by_flesh, answers[:, 6:])
        ratios.append((answers[:, 6:] @ shared) ** 2 / variances)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.25)


def test_noise_that_is_known_to_be_less_than_its_weight_says_leaves_less_open(problem_and_estimate):
    problem, estimate = copy(problem_and_estimate[0]), problem_and_estimate[1]
    fit = problem.fit(estimate)
    fit = fit._replace(residuals=np.zeros_like(fit.residuals))
    before = error_covariance(problem, estimate, fit)
    problem.data_noise /= 2.0
    after = error_covariance(problem, estimate, fit)
    assert (angle_spreads(problem, estimate, after) < angle_spreads(problem, estimate, before)).all()


@pytest.mark.parametrize(
    ("gap", "spread", "touches"),
    [
        (0.0005, 0.001, True),
        (0.0015, 0.001, True),
        (-0.004, 0.001, True),  # pads that overlap
        (0.006, 0.001, False),  # a thumb that rests beside a finger
        (0.006, 0.002, False),
        (0.003, 0.0, False),
    ],
)
def test_pads_that_rest_near_each_other_are_no_touch(gap, spread, touches):
    assert are_touches(np.array([gap]), np.array([spread])) == [touches]


def test_gaps_are_as_open_as_hands_of_the_prior_make_them(problem_and_estimate):
    problem, estimate = problem_and_estimate
    spreads = problem.gap_spreads(estimate, problem.fit(estimate))
    assert ((spreads > 0.0005) & (spreads < 0.006)).all()
    surer = copy(problem)
    surer.precision = 100.0 * problem.precision
    assert (surer.gap_spreads(estimate, surer.fit(estimate)) < spreads).all()


def test_steps_go_down_and_are_told(problem_and_estimate):
    problem, estimate = problem_and_estimate
    told = []
    _, fit, steps = levenberg_marquardt(problem, estimate, 10, 14, told.append)
    assert fit.cost < 0.2 * problem.fit(estimate).cost
    assert told == list(range(11, steps + 1))
    assert np.sqrt(np.median((fit.residuals**2).sum(axis=(1, 2)) / problem.present.sum(axis=1))) < 0.0015


@pytest.fixture(scope="module")
def model():
    return HandModel.named("M")


def visits(model, fingers, hold):
    """From rest to each finger's touch and back, holding there for some frames; where the holds are."""
    rest, parts, holds = resting_angles(model), [], []
    for finger in fingers:
        touch = touching_angles(model, finger)
        share = (0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 30)))[:, None]
        parts += [rest + share * (touch - rest), np.tile(touch, (hold, 1)), touch + share * (rest - touch)]
        end = sum(len(part) for part in parts) - 30
        holds.append((end - hold, end))
    return np.concatenate(parts), holds


def geometry_of(model, touches, angles):
    bones = model.forward_kinematics(join_qpos(angles[[frame for frame, _ in touches]]))
    contacts = initialize_contacts(model, touches, bones)
    corners = SkinPatch(contacts.pads.faces).corners(model.surface.vertices)
    return contacts, contact_geometry(contacts, corners, model, bones)


def test_every_touch_is_found_once(model):
    fingers = ("index", "ring", "index")
    angles, holds = visits(model, fingers, hold=20)
    touches = find_touches(model, angles, np.ones((len(angles), 5), dtype=bool), RATE)
    held = [touch for touch in touches if any(a - 3 <= touch[0] <= b + 3 for a, b in holds)]
    assert [finger for _, finger in held] == list(fingers)


def test_a_digit_that_lacks_markers_touches_nothing(model):
    angles, _ = visits(model, ("index",), hold=20)
    trusted = np.ones((len(angles), 5), dtype=bool)
    trusted[:, DIGITS.index("index")] = False
    assert all(finger != "index" for _, finger in find_touches(model, angles, trusted, RATE))


def test_a_wave_past_the_finger_is_no_touch(model):
    angles, _ = visits(model, ("middle",), hold=1)
    touches = find_touches(model, angles, np.ones((len(angles), 5), dtype=bool), 240.0)
    assert not [touch for touch in touches if touch[1] == "middle" and 20 < touch[0] < 45]


@pytest.mark.parametrize("finger", ["index", "middle", "ring", "little"])
def test_pads_of_a_touch_press_as_much_as_is_held(finger, model):
    angles = touching_angles(model, finger)[None]
    contacts, geometry = geometry_of(model, [(0, finger)], angles)
    assert geometry.facing.all()
    assert abs(geometry.gaps[0]) < 0.0015
    assert DIGITS[contacts.fingers[0]] == finger


def test_gaps_grow_as_the_thumb_leaves(model):
    touch, rest = touching_angles(model, "index"), resting_angles(model)
    angles = touch + np.array([[0.0], [0.1], [0.2], [0.3]]) * (rest - touch)
    _, geometry = geometry_of(model, [(number, "index") for number in range(4)], angles)
    assert (np.diff(geometry.gaps) > 0.0005).all()
    assert PAD_COMPRESSION == 0.001  # what gaps count from, told in the document


def test_an_odd_touch_is_not_trusted():
    gaps = np.array([0.003, 0.0032, 0.0029, 0.009, 0.02])
    fingers = np.array([1, 1, 1, 1, 2])
    geometry = ContactGeometry(np.zeros((5, 3)), gaps, np.array([True, True, True, True, False]))
    weights = contact_weights(geometry, fingers)
    assert weights[:3].min() > 0.9
    assert weights[3] < 0.05
    assert weights[4] == 0.0
