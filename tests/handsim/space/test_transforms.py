from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handsim.space.transforms import (
    cross,
    euler_angles,
    euler_matrix,
    pose_matrices,
    quaternion_matrix,
    rotation_quaternions,
)

TURN = st.floats(-np.pi, np.pi)


@given(TURN, st.one_of(st.floats(-np.pi / 2, np.pi / 2), st.sampled_from([np.pi / 2, -np.pi / 2])), TURN)
def test_euler_angles_make_the_same_rotation(yaw, pitch, roll):
    rotation = euler_matrix(np.array([yaw, pitch, roll]))
    again = euler_matrix(euler_angles(rotation[None])[0])
    np.testing.assert_allclose(again, rotation, atol=1e-7)


def test_poses_that_are_missing_stay_missing(rng):
    poses = rng.normal(size=(3, 7))
    poses[1] = np.nan
    matrices = pose_matrices(poses)
    assert np.isnan(matrices[1]).all()
    np.testing.assert_allclose(np.linalg.det(matrices[[0, 2], :3, :3]), 1.0)
    np.testing.assert_array_equal(matrices[2, :3, 3], poses[2, :3])


def test_quaternions_of_rotations_are_scipys(rng):
    half_turns = Rotation.from_euler("xyz", rng.integers(-4, 5, size=(200, 3)) * np.pi / 4)
    rotations = Rotation.concatenate([Rotation.random(500, rng=rng), half_turns, Rotation.identity(1)])
    theirs = rotations.as_matrix()
    np.testing.assert_array_equal(
        rotation_quaternions(theirs), Rotation.from_matrix(theirs).as_quat(scalar_first=True)
    )


def test_quaternions_of_nearly_rotations_are_those_of_the_nearest_ones(rng):
    rotations = Rotation.random(20, rng=rng).as_matrix()
    bent = rotations + rng.normal(scale=1e-4, size=rotations.shape)
    left, _, right = np.linalg.svd(bent)
    np.testing.assert_allclose(
        Rotation.from_quat(rotation_quaternions(bent), scalar_first=True).as_matrix(), left @ right, atol=1e-9
    )


def test_single_vectors_and_quaternions_give_what_arrays_of_them_give(rng):
    first, second = rng.normal(size=(2, 3))
    np.testing.assert_array_equal(cross(first, second), np.cross(first, second))
    many = rng.normal(size=(3, 2, 4))
    np.testing.assert_array_equal(quaternion_matrix(many)[1, 1], quaternion_matrix(many[1, 1]))
    np.testing.assert_allclose(
        quaternion_matrix(np.array([1.0, 1.0, 0.0, 0.0])) @ [0, 1, 0], [0, 0, 1], atol=1e-12
    )
