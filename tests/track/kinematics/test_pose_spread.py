"""Standard deviations of poses: against simulated errors, and what more or fewer markers do to them."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import GloveFit, attach, load_layout
from gloves.fit import nominal_fit
from handsim import HandModel
from handsim.hand.model import hand_keypoints, join_qpos
from handsim.hand.shape import DIGIT_OF_BONE, JOINT_NAMES, SIDES
from poses import sample_poses
from track.config import HandOrigin
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_solver import PoseSolver
from track.kinematics.pose_spread import (
    NOT_SMOOTHED,
    SKELETON_NUMBERS,
    SOURCES,
    HandErrors,
    MarkerPrediction,
    Measure,
    SpreadModel,
    digit_prior,
    errors_of_motions,
    hand_doubt,
    known_hand,
    measurement_error,
    pose_spreads,
    predict_joints,
    resting_prior,
    with_keypoints,
)

NOTHING = 1e-9 * np.eye(20)  # precision of hinges of which nothing is known
INDEX = slice(4, 8)
SEEDS = st.integers(0, 1000)
SPANS = st.floats(0.0, 5.0)
LEAST = np.deg2rad(0.5) ** 2 * np.eye(20)


def spreads_of(fit, doubt, qpos, unseen, prior=NOTHING):
    variances, keypoints = pose_spreads(with_keypoints(fit), prior, doubt, qpos, unseen, NOT_SMOOTHED)
    return np.sqrt(variances[:, :20].sum(axis=-1)), keypoints


def test_a_learned_arch_leaves_less_of_its_part(rng):
    fit = nominal_fit("dense19", "M", "right")
    arched = GloveFit(HandModel(dataclasses.replace(fit.model.shape, arch=[0.0, 0.4])), fit.attachment)
    qpos, little = sample_poses(fit.model, 5, rng=rng), JOINT_NAMES.index("little_MCP_flexion")
    whole, left = (
        np.sqrt(SpreadModel(one, "measured").variances(qpos, np.zeros((5, 19)), 0.001)[0][..., 4])
        for one in (fit, arched)
    )
    assert (whole[:, little] > 0.0).all()
    assert np.mean(left[:, little] / whole[:, little]) < 0.9


@pytest.mark.parametrize("side", SIDES)
def test_they_are_what_noise_makes_of_the_solver(side, rng):
    """Markers of a known hand with noise, in one pose, solved again and again."""
    fit = nominal_fit("starter30", "M", side)
    qpos = np.repeat(sample_poses(fit.model, 1, rng=rng), 400, axis=0)
    noise = 0.0003
    markers = fit.markers(qpos)[0] + noise * rng.standard_normal((400, 30, 3))
    solved = PoseSolver(fit).solve(markers, qpos).qpos
    doubt = known_hand(hand_arrays(fit).digits, noise)
    angles, keypoints = spreads_of(fit, doubt, qpos[:1], np.zeros((1, 30)))
    found = np.sqrt(((solved - qpos)[:, 7:] ** 2).mean(axis=0))
    assert 0.9 < np.median(found / angles[0]) < 1.1
    off = hand_keypoints(fit.model, solved) - hand_keypoints(fit.model, qpos)
    ratios = np.sqrt((off**2).mean(axis=(0, 2))) / keypoints[0]
    np.testing.assert_allclose(ratios, 1.0, atol=0.15)


def test_they_are_what_other_bones_directions_and_places_make_of_the_solver(rng):
    """A person whose hand is not the model's: drawn again and again, in one pose, without noise."""
    fit = nominal_fit("starter30", "M", "right")
    digits, shape = hand_arrays(fit).digits, fit.shape
    qpos, solver = sample_poses(fit.model, 1, rng=rng), PoseSolver(fit)
    usual = known_hand(digits, 0.0002)
    numbers = np.zeros((SKELETON_NUMBERS, 50))
    np.fill_diagonal(numbers, np.tile(np.repeat([0.0004, np.deg2rad(0.8), 0.01], 3), 5))
    numbers[:45, 45:] = np.kron(np.eye(5), np.repeat([0.0, 0.01], [6, 3])[:, None])
    errors = HandErrors(numbers, np.zeros((30, 3, 50)))
    doubt = usual._replace(places=np.full((30, 2), 0.0004), errors=errors)
    angles, keypoints = spreads_of(fit, doubt, qpos, np.zeros((1, 30)))
    off, places = [], []
    for _ in range(150):
        lengths = 0.01 * (rng.standard_normal((5, 1)) + rng.standard_normal((5, 3)))
        person = dataclasses.replace(
            shape,
            bone_lengths=shape.bone_lengths * np.exp(lengths),
            knuckles=shape.knuckles + 0.0004 * rng.standard_normal((5, 3)),
            base_angles=shape.base_angles + np.deg2rad(0.8) * rng.standard_normal((5, 3)),
        )
        worn = attach(load_layout("starter30"), HandModel(person))
        moved = worn.attachment.points + 0.0004 * rng.standard_normal((30, 3))
        worn = GloveFit(worn.model, dataclasses.replace(worn.attachment, points=moved))
        solved = solver.solve(worn.markers(qpos)[0], qpos).qpos
        off.append((solved - qpos)[0, 7:])
        places.append(hand_keypoints(fit.model, solved)[0] - hand_keypoints(worn.model, qpos)[0])
    ratios = np.sqrt(np.square(off).mean(axis=0)) / angles[0]
    assert 0.8 < np.median(ratios) < 1.25
    assert (ratios > 0.5).all() and (ratios < 2.0).all()
    ratios = np.sqrt(np.square(places).mean(axis=(0, 2))) / keypoints[0]
    assert 0.75 < np.median(ratios) < 1.3


def test_they_are_what_markers_that_slip_along_the_skin_make_of_the_solver(rng):
    """Markers of one hand are shifted in all poses alike, and its poses solved again."""
    fit = nominal_fit("starter30", "M", "right")
    digits, qpos, solver = hand_arrays(fit).digits, sample_poses(fit.model, 1, rng=rng), PoseSolver(fit)
    usual, off, along, worn = known_hand(digits, 0.00001), [], [0.0004, 0.0], fit.attachment
    angles, _ = spreads_of(fit, usual._replace(places=np.tile(along, (30, 1))), qpos, np.zeros((1, 30)))
    for _ in range(150):
        shifts = along[0] * rng.standard_normal((30, 3))
        shifts -= (shifts * worn.normals).sum(axis=1, keepdims=True) * worn.normals
        moved = GloveFit(fit.model, dataclasses.replace(worn, points=worn.points + shifts))
        off.append((solver.solve(moved.markers(qpos)[0], qpos).qpos - qpos)[0, 7:])
    ratios = np.sqrt(np.square(off).mean(axis=0)) / angles[0]
    np.testing.assert_allclose(ratios, 1.0, atol=0.25)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 1000), st.integers(0, 18))
def test_a_further_marker_makes_no_angle_of_a_known_hand_wider(seed, marker):
    rng = np.random.default_rng(seed)
    fit = nominal_fit("dense19", "M", "right")
    qpos, doubt = sample_poses(fit.model, 1, rng=rng), known_hand(hand_arrays(fit).digits, 0.001)
    unseen = np.where(rng.random((1, 19)) < 0.4, np.inf, 0.0)
    unseen[0, marker] = np.inf
    without = spreads_of(fit, doubt, qpos, unseen, resting_prior().precision)
    unseen[0, marker] = 0.0
    there = spreads_of(fit, doubt, qpos, unseen, resting_prior().precision)
    for one, other in zip(there, without, strict=True):
        assert (one <= other * (1.0 + 1e-6)).all()


@pytest.mark.parametrize("origin", get_args(HandOrigin))
def test_a_digit_that_is_hidden_is_wider_the_longer_and_at_last_as_wide_as_its_prior(origin):
    fit = nominal_fit("dense19", "M", "left")
    model = SpreadModel(fit, origin)
    qpos = np.zeros((4, 27))
    qpos[:, 3] = 1.0
    unseen = np.zeros((4, 19))
    unseen[:, hand_arrays(fit).digits == 1] = np.array([0.0, 0.3, 2.0, np.inf])[:, None]
    angles, keypoints = model.spreads(qpos, unseen, 0.0005)
    assert (np.diff(angles[1:, INDEX], axis=0) > 0.0).all()
    assert (angles[-1, INDEX] > angles[0, INDEX]).all()
    assert (np.diff(keypoints[1:, 8]) > 0.0).all()
    assert (angles[-1, INDEX] > np.deg2rad([4.0, 10.0, 10.0, 10.0])).all()
    assert (angles <= resting_prior().spread * 1.5).all()


def test_measuring_and_calibration_make_them_narrower_and_noise_wider(rng):
    fit = nominal_fit("dense19", "M", "right")
    qpos, seen = sample_poses(fit.model, 5, rng=rng), np.zeros((5, 19))
    qpos[:, [20, 24]] = 0.0  # MCP flexion of ring and little finger, without which the palm does not arch
    measured = hand_doubt(hand_arrays(fit).digits, "measured").errors
    little = HandErrors(*(0.1 * values for values in measured))
    widest, wide, middle, narrow = (
        model.spreads(qpos, seen, noise)
        for model, noise in (
            (SpreadModel(fit, "named"), 0.0005),
            (SpreadModel(fit, "measured"), 0.0005),
            (SpreadModel(fit, "calibrated", little), 0.0005),
            (SpreadModel(fit, "calibrated", little), 0.0001),
        )
    )
    for wider, narrower in pairwise((widest, wide, middle, narrow)):
        assert all((one < other).all() for one, other in zip(narrower, wider, strict=True))


@pytest.mark.parametrize("side", SIDES)
def test_they_are_what_an_arch_of_the_palm_makes_of_the_solver(side):
    """A tenth of the arch, so that it is small: metacarpals of two fingers turn about their hinges."""
    fit = nominal_fit("starter30", "M", side)
    qpos = join_qpos(np.deg2rad([[0.0, 30.0, 25.0, 15.0]] * 5).reshape(1, 20))
    doubt = SpreadModel(fit, "measured")._doubt
    noise = known_hand(hand_arrays(fit).digits, 0.001)._replace(arch=doubt.arch)
    parts, _ = pose_spreads(with_keypoints(fit), NOTHING, noise, qpos, np.zeros((1, 30)), NOT_SMOOTHED)
    markers, _ = fit.markers(qpos)
    for digit, share in ((3, 0.13), (4, 0.32)):
        bones = DIGIT_OF_BONE[fit.attachment.bone_indices] == digit
        lever = markers[0] - fit.model.skeleton.offsets[1 + 3 * digit] + [0.054, 0.0, 0.0]
        turn = 0.1 * share * np.deg2rad(30.0) * (fit.attachment.bone_weights * bones).sum(axis=1)
        markers[0] += turn[:, None] * np.cross([0.0, 1.0, 0.0], lever)
    found = 10.0 * (PoseSolver(fit).solve(markers, qpos).qpos - qpos)[0, 7:]
    stated = np.sqrt(parts[0, :20, SOURCES.index("palm")])
    assert (stated[[13, 17]] > np.deg2rad([4.0, 15.0])).all()
    assert not stated[:12].any()  # of thumb, index and middle finger
    np.testing.assert_allclose(np.abs(found[12:]), stated[12:], rtol=0.15, atol=np.deg2rad(1.5))


def test_the_arch_of_the_palm_is_of_bent_fingers():
    fit = nominal_fit("dense19", "M", "right")
    angles = np.zeros((3, 20))
    angles[1, [5, 9]], angles[2, [13, 17]] = 0.5, 0.5  # MCP flexion of index and middle, of ring and little
    parts, _ = SpreadModel(fit, "measured").variances(join_qpos(angles), np.zeros((3, 19)), 0.001)
    palm = parts[..., SOURCES.index("palm")]
    assert not palm[:2].any() and JOINT_NAMES[palm[2, :20].argmax()] == "little_MCP_flexion"


@pytest.mark.parametrize("origin", get_args(HandOrigin))
@pytest.mark.parametrize("measure", get_args(Measure))
def test_the_palm_of_a_person_is_much_the_same_in_each_session(origin, measure):
    budget = np.array([[1.0, 2.0, 1.0, 2.0, 0.0], [1.0, 2.0, 1.0, 2.0, 10.0]])
    without, error = measurement_error(budget, origin, measure)
    assert 2.0 < np.sqrt(error**2 - without**2) <= 5.0


def test_a_calibrated_hand_without_stored_errors_is_as_unsure_as_a_measured_one(rng):
    fit = nominal_fit("dense19", "M", "left")
    qpos, seen = sample_poses(fit.model, 3, rng=rng), np.zeros((3, 19))
    for one, other in zip(
        *(SpreadModel(fit, origin).spreads(qpos, seen, 0.0003) for origin in ("calibrated", "measured")),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("part", ["knuckles", "base_angles", "bone_lengths"])
def test_errors_of_a_hand_move_its_points_as_another_hand_does(part, side, rng):
    """A hand with another bone and other marker places has the keypoints that the linear model says."""
    fit = nominal_fit("dense19", "M", side)
    change = 1e-4 * rng.standard_normal((5, 3))
    scale = fit.shape.bone_lengths if part == "bone_lengths" else 1.0
    shape = dataclasses.replace(fit.shape, **{part: getattr(fit.shape, part) + change * scale})
    shifts = 1e-4 * rng.standard_normal((19, 3))
    worn = dataclasses.replace(fit.attachment, points=fit.attachment.points + shifts)
    other = GloveFit(HandModel(shape), worn)
    skeletons = [one.model.skeleton for one in (fit, other)]
    numbers = np.zeros((5, 3, 3))
    numbers[:, 0] = np.subtract(*(one.offsets[1::3] for one in skeletons[::-1]))
    turned = skeletons[1].rotations[1::3] @ skeletons[0].rotations[1::3].swapaxes(1, 2)
    numbers[:, 1] = turned[:, [2, 0, 1], [1, 2, 0]]
    numbers[:, 2] = np.log(shape.bone_lengths / fit.shape.bone_lengths)
    errors = errors_of_motions(fit, np.append(numbers, 0.0)[:, None], shifts[..., None])
    qpos = sample_poses(fit.model, 3, rng=rng)
    solver = PoseSolver(fit)
    solved = solver.solve(other.markers(qpos)[0], qpos).qpos
    off = hand_keypoints(fit.model, solved) - hand_keypoints(other.model, qpos)
    doubt = known_hand(hand_arrays(fit).digits, 1e-6)._replace(errors=errors)
    angles, keypoints = spreads_of(fit, doubt, solved, np.zeros((3, 19)))
    # Joints at their limits move less than the linear model says.
    found = np.sqrt((off**2).mean(axis=2)), np.abs(solved - qpos)[:, 7:]
    for one, stated in zip(found, (keypoints, angles), strict=True):
        assert np.abs(one - stated).mean() < 0.15 * stated.mean()


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
    np.testing.assert_allclose(prior.covariance, resting_prior().covariance + LEAST, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(prior.angles, resting_prior().angles)


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
    known *= 0.5 * np.linalg.eigvalsh(resting_prior().covariance).min() / np.linalg.eigvalsh(known).max()
    soon, late = (predict_joints(angles, known, span).covariance for span in spans)
    assert np.linalg.eigvalsh(late - soon).min() > -1e-12


def test_neighboring_fingers_rest_alike():
    covariance = resting_prior().covariance
    spread = np.sqrt(np.diag(covariance))
    together = covariance / np.outer(spread, spread)
    assert (np.diag(together[5:20:4, 9:20:4]) > 0.4).all(), "fingers flex with their neighbors"


def conditioned(prior, seen, digit):
    angles, precision = np.empty(4), np.empty((4, 4))
    digit_prior(prior, seen, digit, angles, precision)
    return angles, precision


def nothing_seen():
    shapes = [(27,), (19, 3), (19, 3, 3), (19, 3, 3), (20, 20), (20, 20), (20,)]
    seen = MarkerPrediction(*map(np.empty, shapes))
    seen.information_matrix[:], seen.information_vector[:] = 0.0, 0.0
    return seen


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
