"""Rigid fits against the numpy one, and hands put together digit by digit."""

from __future__ import annotations

import numpy as np

from gloves.attachment import attach_markers
from gloves.fit import GloveFit
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos
from handsim.space.transforms import quaternion_matrix, random_quaternions, rigid_fit
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.starting_poses import align_rigid, initial_poses, starting_shapes


def test_rigid_fits_are_the_best_ones(rng):
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
