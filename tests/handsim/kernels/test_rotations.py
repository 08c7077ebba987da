"""Compiled rotations against SciPy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handsim.kernels.rotations import (
    align_rigid,
    multiply_rotations,
    quaternion_product,
    rotate_about_axis,
    rotate_quaternion,
    write_axis_angle_matrix,
    write_quaternion_matrix,
)
from handsim.space.transforms import quaternion_matrix, rigid_fit

SEEDS = st.integers(0, 100_000)


def _quaternion(rotation: Rotation) -> np.ndarray:
    return np.ascontiguousarray(rotation.as_quat(scalar_first=True))


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_matrices_are_scipys(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng)
    transform = np.full((4, 4), 7.0)
    write_quaternion_matrix(transform, *_quaternion(rotation))
    np.testing.assert_allclose(transform[:3, :3], rotation.as_matrix(), atol=1e-14)
    assert (transform[3] == 7.0).all()
    assert (transform[:, 3] == 7.0).all()
    axis, angle = rotation.apply([1.0, 0.0, 0.0]), rng.uniform(-6.0, 6.0)
    matrix = np.empty((3, 3))
    write_axis_angle_matrix(matrix, axis, angle)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-14)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_products_are_scipys(seed):
    rng = np.random.default_rng(seed)
    first, second = Rotation.random(2, rng=rng)
    both = (first * second).as_matrix()
    product = first.as_matrix()
    multiply_rotations(product, second.as_matrix(), product)
    np.testing.assert_allclose(product, both, atol=1e-14)
    numbers = quaternion_product(*_quaternion(first), *_quaternion(second))
    np.testing.assert_allclose(Rotation.from_quat(numbers, scalar_first=True).as_matrix(), both, atol=1e-14)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_rotations_about_own_axes_are_scipys(seed):
    rng = np.random.default_rng(seed)
    start, axis = Rotation.random(rng=rng), Rotation.random(rng=rng).apply([1.0, 0.0, 0.0])
    angle = rng.uniform(-3.0, 3.0)
    expected = (start * Rotation.from_rotvec(angle * axis)).as_matrix()
    frame = start.as_matrix()
    rotate_about_axis(frame, axis, angle)
    np.testing.assert_allclose(frame, expected, atol=1e-14)
    after = np.empty(4)
    rotate_quaternion(_quaternion(start), angle * axis, after)
    np.testing.assert_allclose(np.linalg.norm(after), 1.0, atol=1e-15)
    np.testing.assert_allclose(Rotation.from_quat(after, scalar_first=True).as_matrix(), expected, atol=1e-13)


def test_no_rotation_leaves_an_orientation_as_it_is():
    after = np.empty(4)
    rotate_quaternion(np.array([0.6, 0.0, 0.8, 0.0]), np.zeros(3), after)
    np.testing.assert_allclose(after, [0.6, 0.0, 0.8, 0.0], atol=1e-16)


def test_rigid_fits_are_the_best_ones():
    rng = np.random.default_rng(0)
    for _ in range(20):
        source, target = rng.normal(size=(2, 19, 3))
        target[rng.choice(19, size=5, replace=False)] = np.nan
        weights, pose = rng.integers(1, 4, size=19).astype(float), np.zeros(27)
        squares = align_rigid(source, target, weights, pose)
        there = np.repeat(
            np.arange(19), weights.astype(int) * np.isfinite(target[:, 0])
        )  # weights by counting
        rotation, translation = rigid_fit(source[there], target[there])
        np.testing.assert_allclose(quaternion_matrix(pose[3:7]), rotation, atol=1e-9)
        np.testing.assert_allclose(pose[:3], translation, atol=1e-9)
        left = source[there] @ rotation.T + translation - target[there]
        np.testing.assert_allclose(squares, (left**2).sum(), rtol=1e-9)
