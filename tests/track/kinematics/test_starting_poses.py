"""Hands put together digit by digit."""

from __future__ import annotations

import numpy as np

from gloves.fit import GloveFit, attach_markers
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos
from handsim.space.transforms import random_quaternions
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.starting_poses import initial_poses, starting_shapes


def test_every_digit_is_taken_from_the_nearest_shape(rng):
    model = HandModel.named("S", side="left")
    glove = attach_markers(load_layout("dense19"), model)
    shapes = starting_shapes(GloveFit(model, glove))
    digits = hand_arrays(GloveFit(model, glove)).digits
    low, high = model.skeleton.ranges.T
    assert ((shapes.angles >= low) & (shapes.angles <= high)).all()
    for _ in range(10):
        chosen = np.repeat(rng.integers(len(shapes.angles), size=5), 4)
        angles = shapes.angles[chosen, np.arange(20)]
        qpos = join_qpos(angles[None], position=rng.normal(size=3), quaternion=random_quaternions(1, rng=rng))
        target = glove.centers(model, model.forward_kinematics(qpos))[0]
        poses = initial_poses(shapes, digits, target)
        np.testing.assert_allclose(poses[0, 7:], angles)
        np.testing.assert_allclose(
            poses[0, :3], qpos[0, :3], atol=0.003
        )  # skin between digits moves with both
        assert {tuple(row) for row in poses[1:, 7:]} == {tuple(row) for row in shapes.angles}
