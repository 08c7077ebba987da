"""The Jacobian against finite differences along MuJoCo's own integration, and against mj_jac."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from gloves.fit import attach_markers
from gloves.layout import load_layout
from handsim.hand.model import NUM_VELOCITIES, HandModel, join_qpos, skinned_jacobian
from handsim.hand.shape import SIDES, sample_shape
from handsim.space.transforms import random_quaternions


@pytest.fixture(params=SIDES)
def posed(request, rng):
    model = HandModel(sample_shape(side=request.param, rng=rng))
    low, high = model.skeleton.ranges.T
    qpos = join_qpos(
        rng.uniform(low, high, size=(4, 20)),
        position=rng.normal(size=(4, 3)),
        quaternion=random_quaternions(4, rng=rng),
    )
    return model, qpos


def test_skinned_points_move_as_the_jacobian_says(posed):
    model, qpos = posed
    glove = attach_markers(load_layout("dense19"), model)
    assert (glove.bone_weights[:, 1] > 0.05).any(), "the test needs points between bones"
    jacobian = skinned_jacobian(
        model, model.forward_kinematics(qpos), glove.points, glove.bone_indices, glove.bone_weights
    )
    step = 1e-6
    for velocity in range(NUM_VELOCITIES):
        direction = np.zeros(NUM_VELOCITIES)
        direction[velocity] = 1.0
        ends = []
        for sign in (1.0, -1.0):
            moved = qpos.copy()
            for row in moved:
                mujoco.mj_integratePos(model.mj_model, row, direction, sign * step)
            ends.append(glove.markers(model, model.forward_kinematics(moved))[0])
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(jacobian[..., velocity], slope, atol=1e-8)


def test_points_on_one_bone_agree_with_mujoco(posed, rng):
    model, qpos = posed
    bones = rng.integers(16, size=6)
    points = model.rest_transforms[bones, :3, 3] + rng.normal(scale=0.01, size=(6, 3))
    indices, weights = np.tile(bones[:, None], (1, 4)), np.tile([1.0, 0, 0, 0], (6, 1))
    transforms = model.forward_kinematics(qpos)
    ours = skinned_jacobian(model, transforms, points, indices, weights)
    data = mujoco.MjData(model.mj_model)
    rest = np.linalg.inv(model.rest_transforms)
    for frame, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model.mj_model, data)
        mujoco.mj_comPos(model.mj_model, data)
        for number, bone in enumerate(bones):
            motion = transforms[frame, bone] @ rest[bone]
            place = motion[:3, :3] @ points[number] + motion[:3, 3]
            theirs = np.zeros((3, 26))
            mujoco.mj_jac(model.mj_model, data, theirs, None, place, bone + 1)
            np.testing.assert_allclose(ours[frame, number], theirs, atol=1e-12)
