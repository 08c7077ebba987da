from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handsim.space.transforms import cross, euler_angles, euler_matrix, pose_matrices, quaternion_matrix

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


def test_single_vectors_and_quaternions_give_what_arrays_of_them_give(rng):
    first, second = rng.normal(size=(2, 3))
    np.testing.assert_array_equal(cross(first, second), np.cross(first, second))
    many = rng.normal(size=(3, 2, 4))
    np.testing.assert_array_equal(quaternion_matrix(many)[1, 1], quaternion_matrix(many[1, 1]))
    np.testing.assert_allclose(
        quaternion_matrix(np.array([1.0, 1.0, 0.0, 0.0])) @ [0, 1, 0], [0, 0, 1], atol=1e-12
    )
