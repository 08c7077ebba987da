"""The compiled markers and their jacobian against the numpy ones, which are held against MuJoCo elsewhere."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from gloves import GloveFit, load_layout
from gloves.fit import attach_markers
from handsim import HandModel, join_qpos, sample_shape
from handsim.hand.model import skinned_jacobian
from handsim.hand.shape import SIDES
from handsim.kernels import move
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles
from track.kinematics.marker_kinematics import (
    MARKER_NOISE,
    NUM_UNKNOWNS,
    PoseEnergy,
    accumulate_normal_equations,
    compute_markers,
    eliminate,
    hand_arrays,
    invert_positive,
    levenberg_marquardt,
    marker_jacobian,
    move_wrist,
    solve_positive,
    workspace,
)

GLOVES = (("dense19", 0.0), ("sparse13", 0.0), ("dense19", 0.6))  # with the arch of the hand


@pytest.fixture(params=[(side, *glove) for side in SIDES for glove in GLOVES])
def posed(request, rng):
    side, name, arch = request.param
    model = HandModel(dataclasses.replace(sample_shape(side=side, rng=rng), arch=[0.3 * arch, arch]))
    glove = attach_markers(load_layout(name), model)
    angles = rng.uniform(*model.skeleton.ranges.T)
    hand, work = hand_arrays(GloveFit(model, glove)), workspace(len(glove.points))
    compute_markers(hand, angles, work)
    for marker in range(len(hand.bones)):
        marker_jacobian(hand, marker, work)
    return model, glove, angles, hand, work


def true_jacobian(model, glove, angles):
    """In the order of the unknowns; a wrist at the origin makes world and wrist one."""
    bones = model.forward_kinematics(join_qpos(angles[None]))
    jacobian = skinned_jacobian(model, bones, glove.points, glove.bone_indices, glove.bone_weights)[0]
    return np.concatenate([jacobian[..., 6:], jacobian[..., :6]], axis=-1)


def test_markers_sit_where_the_glove_has_them_and_their_jacobian_is_the_numpy_one(posed):
    model, glove, angles, _, work = posed
    centers = glove.centers(model, model.forward_kinematics(join_qpos(angles[None])))[0]
    np.testing.assert_allclose(work.markers, centers, atol=1e-14)
    np.testing.assert_allclose(work.jacobian, true_jacobian(model, glove, angles), atol=1e-13)


def test_the_normal_matrix_is_accumulated_completely(posed, rng):
    model, glove, angles, hand, work = posed
    weights = rng.uniform(0.5, 2.0, size=len(glove.points))
    weights[rng.choice(len(weights), size=3, replace=False)] = 0.0
    work.residuals[:] = rng.normal(size=work.residuals.shape)
    work.residuals[weights == 0.0] = np.nan
    accumulate_normal_equations(hand, weights, work)
    jacobian = true_jacobian(model, glove, angles)
    there = weights > 0.0
    normal = np.einsum("m,mia,mib->ab", weights, jacobian, jacobian)
    gradient = np.einsum("m,mia,mi->a", weights[there], jacobian[there], work.residuals[there])
    np.testing.assert_allclose(np.triu(work.normal), np.triu(normal), atol=1e-12)
    np.testing.assert_allclose(work.gradient, gradient, atol=1e-12)
    left_out = np.arange(NUM_UNKNOWNS) < hand.skyline[:, None]
    assert left_out.sum() > 50, "the factor has zeros to keep"
    np.testing.assert_array_equal(normal[left_out], 0.0)


def costs(model, glove, target, center, pull, tightness):
    """What `levenberg_marquardt` makes small, as residuals of a pose."""
    there = np.isfinite(target).all(axis=1)
    low, high = model.skeleton.ranges.T

    def residuals(qpos):
        miss = (glove.centers(model, model.forward_kinematics(qpos[None]))[0] - target)[there] / MARKER_NOISE
        square = (miss**2).sum(axis=1, keepdims=True) * MARKER_NOISE**2
        angles = qpos[7:]
        beyond = np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)
        return np.concatenate(
            [
                (miss / np.sqrt(1.0 + tightness * square)).ravel(),
                np.sqrt(pull[:20]) * (angles - center[7:]),
                beyond / np.deg2rad(2.0),
            ]
        )

    return residuals


@pytest.mark.parametrize("tightness", [0.0, 0.005**-2])
def test_the_minimum_is_the_one_that_scipy_finds(tightness, rng):
    model = HandModel.named("M")
    glove = attach_markers(load_layout("dense19"), model)
    hand, work = hand_arrays(GloveFit(model, glove)), workspace(len(glove.points))
    truth = join_qpos(sample_valid_angles(model, 4, rng=rng), quaternion=random_quaternions(4, rng=rng))
    truth[:, 8] = model.skeleton.ranges[1, 1] + 0.1  # a limit that speaks
    markers = glove.centers(model, model.forward_kinematics(truth))
    markers += rng.normal(scale=0.0005, size=markers.shape)
    markers[:, rng.choice(19, size=3, replace=False)] = np.nan
    for target, near in zip(markers, move(truth, 0.005 * rng.standard_normal((4, 26))), strict=True):
        center = np.concatenate([near[:7], rng.normal(0.3, 0.2, size=20)])
        pull = np.concatenate([rng.uniform(0.1, 30.0, size=20), np.zeros(6)])
        pose = near.copy()
        cost, _ = levenberg_marquardt(hand, PoseEnergy(target, center, pull, tightness), pose, 50, 1e-6, work)
        residuals = costs(model, glove, target, center, pull, tightness)
        assert cost == pytest.approx((residuals(pose) ** 2).sum(), rel=1e-9)
        # A robust cost has more minima than one: theirs starts from ours, and finds nothing better around.
        start = near if tightness == 0.0 else pose
        found = least_squares(
            lambda step, start=start, residuals=residuals: residuals(move(start[None], step[None])[0]),
            np.zeros(26),
            xtol=1e-10,
            ftol=1e-12,
            gtol=1e-8,
        )
        assert cost == pytest.approx(2.0 * found.cost, rel=1e-6)
        theirs = move(start[None], found.x[None])[0]
        np.testing.assert_allclose(pose[7:], theirs[7:], atol=1e-3)


def test_no_steps_leave_the_pose_alone(rng):
    model = HandModel.named("M")
    glove = attach_markers(load_layout("dense19"), model)
    pose = join_qpos(sample_valid_angles(model, 1, rng=rng))[0]
    before, pull = pose.copy(), np.zeros(26)
    hand, work = hand_arrays(GloveFit(model, glove)), workspace(19)
    _, steps = levenberg_marquardt(
        hand, PoseEnergy(glove.points, pose.copy(), pull, 0.0), pose, 0, 1e-6, work
    )
    assert steps == 0
    np.testing.assert_array_equal(pose, before)


def test_the_wrist_moves_along_its_own_axes_as_mujoco_has_it(rng):
    model = HandModel.named("M").mj_model
    for turn in (0.7, 1e-12):
        qpos = join_qpos(np.zeros((1, 20)), position=rng.normal(size=3))
        qpos[:, 3:7] = random_quaternions(1, rng=rng)
        step = np.concatenate([np.zeros(20), rng.normal(size=3), turn * rng.normal(size=3)])
        moved = qpos[0].copy()
        move_wrist(qpos[0], step, moved)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, qpos[0, 3:7])
        velocity = np.concatenate([rotation.reshape(3, 3) @ step[20:23], step[23:], np.zeros(20)])
        theirs = qpos[0].copy()
        mujoco.mj_integratePos(model, theirs, velocity, 1.0)
        np.testing.assert_allclose(moved, theirs, atol=1e-12)
        np.testing.assert_allclose(move(qpos, velocity[None])[0], theirs, atol=1e-12)


def positive(size: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((size, 2 * size))
    return rows @ rows.T


@pytest.mark.parametrize("size", [1, 4, 26])
def test_inverse(size):
    matrix = positive(size, size)
    inverse = np.tril(matrix)  # only the lower triangle is read
    invert_positive(inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [1, 4, 20])
def test_solution(size):
    matrix, rest = positive(size, size), np.arange(1.0, size + 1.0)
    solution = rest.copy()
    solve_positive(matrix.copy(), solution)
    np.testing.assert_allclose(matrix @ solution, rest, rtol=1e-9)


def test_what_elimination_leaves_is_the_schur_complement():
    matrix, rest = positive(9, 3), np.arange(9.0)
    left, right = matrix.copy(), rest.copy()
    eliminate(left, right, 0, 5)
    first, last = slice(0, 5), slice(5, 9)
    gone = matrix[last, first] @ np.linalg.inv(matrix[first, first])
    np.testing.assert_allclose(left[last, last], matrix[last, last] - gone @ matrix[first, last])
    np.testing.assert_allclose(right[last], rest[last] - gone @ rest[first])
