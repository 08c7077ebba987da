"""The compiled skinning against the plain one."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import sample_shape
from handsim.hand.skin.skinning import skin_frames
from handsim.hand.topology import NUM_JOINTS
from handsim.space.transforms import random_quaternions
from tests.handsim.hand.skin.blending import blend_skin


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_vertex_agrees_with_plain_skinning(side, rng):
    model = HandModel(sample_shape(side=side, rng=rng))
    low, high = model.skeleton.ranges.T
    qpos = join_qpos(
        rng.uniform(low, high, size=(7, NUM_JOINTS)),
        position=rng.uniform(-1.0, 1.0, size=(7, 3)),
        quaternion=random_quaternions(7, rng=rng),
    )
    surface = model.surface
    rest = (surface.vertices, surface.bone_indices, surface.bone_weights, model.rest_transforms)
    plain = blend_skin(*rest, model.forward_kinematics(qpos))
    np.testing.assert_allclose(skin_frames(*rest, model.forward_kinematics(qpos)), plain, atol=1e-14)
    np.testing.assert_array_equal(model.skin(qpos), skin_frames(*rest, model.forward_kinematics(qpos)))


def test_weights_sum_to_one_before_the_first_zero():
    """The compiled loop ends a vertex's list at the first zero."""
    weights = HandModel.named("S").surface.bone_weights
    ended = np.cumsum(weights == 0.0, axis=1) > 0
    assert ended.any(), "the test needs vertices with fewer than four bones"
    assert (weights[ended] == 0.0).all()


def test_no_frames():
    model = HandModel.named("S")
    assert model.skin(join_qpos(np.zeros((0, NUM_JOINTS)))).shape == (0, len(model.surface.vertices), 3)
