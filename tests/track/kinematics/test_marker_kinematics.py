"""The compiled markers and their jacobian against the numpy ones, which are held against MuJoCo elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import GloveFit, attach_markers
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos, skinned_jacobian
from handsim.hand.shape import SIDES, sample_shape
from track.kinematics.marker_kinematics import (
    NUM_UNKNOWNS,
    accumulate_normal_equations,
    compute_markers,
    hand_arrays,
    marker_jacobian,
    workspace,
)


@pytest.fixture(params=[(side, name) for side in SIDES for name in ("dense19", "sparse13")])
def posed(request, rng):
    side, name = request.param
    model = HandModel(sample_shape(side=side, rng=rng))
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


def test_markers_sit_where_the_glove_has_them(posed):
    model, glove, angles, _, work = posed
    centers = glove.centers(model, model.forward_kinematics(join_qpos(angles[None])))[0]
    np.testing.assert_allclose(work.markers, centers, atol=1e-14)


def test_the_jacobian_is_the_numpy_one(posed):
    model, glove, angles, _, work = posed
    np.testing.assert_allclose(work.jacobian, true_jacobian(model, glove, angles), atol=1e-13)


def test_the_jacobian_of_an_earlier_pose_is_overwritten(posed, rng):
    model, glove, _, hand, work = posed
    angles = rng.uniform(*model.skeleton.ranges.T)
    compute_markers(hand, angles, work)
    for marker in range(len(hand.bones)):
        marker_jacobian(hand, marker, work)
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
