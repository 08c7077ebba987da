"""Poses come back from their own markers, with some missing or noisy."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.attach import attach
from gloves.layout import load_layout
from handsim.errors import ShapeError
from handsim.model import HandModel, join_qpos
from handsim.shape import sample_shape
from handsim.topology import SIDES
from handsim.transforms import random_quaternions
from poses.validity import resting_angles, sample_valid_angles
from track.inverse_kinematics import solve_poses


def gloved_hand(side, rng):
    while True:
        model = HandModel(sample_shape(side=side, rng=rng))
        try:
            resting_angles(model)
        except ShapeError:
            continue
        return model, attach(load_layout("dense19"), model)


def random_poses(model, count, rng):
    return join_qpos(
        sample_valid_angles(model, count, rng=rng),
        position=rng.normal(size=(count, 3)),
        quaternion=random_quaternions(count, rng=rng),
    )


@pytest.mark.parametrize("side", SIDES)
def test_poses_come_back_from_a_relaxed_start(side, rng):
    model, glove = gloved_hand(side, rng)
    qpos = random_poses(model, 100, rng)
    markers, _ = glove.markers(model, model.forward_kinematics(qpos))
    fit = solve_poses(model, glove, markers)
    assert np.percentile(fit.rms, 99) < 0.0002
    error = np.rad2deg(np.abs(fit.qpos[:, 7:] - qpos[:, 7:])).mean(axis=1)
    assert np.median(error) < 0.5
    found, true = (model.forward_kinematics(poses)[..., :3, 3] for poses in (fit.qpos, qpos))
    assert np.percentile(np.linalg.norm(found - true, axis=-1), 95) < 0.001


def test_missing_markers_are_done_without(rng):
    model, glove = gloved_hand("right", rng)
    qpos = random_poses(model, 50, rng)
    markers, _ = glove.markers(model, model.forward_kinematics(qpos))
    true = markers.copy()
    for row in markers:
        row[rng.choice(16, size=2, replace=False)] = np.nan
    fit = solve_poses(model, glove, markers)
    assert np.percentile(fit.rms, 95) < 0.0005
    missing = np.isnan(markers).any(axis=-1)
    assert np.isnan(fit.residuals[missing]).all()
    filled, _ = glove.markers(model, model.forward_kinematics(fit.qpos))
    assert np.median(np.linalg.norm(filled - true, axis=-1)[missing]) < 0.01


def test_noise_stays_noise(rng):
    model, glove = gloved_hand("right", rng)
    qpos = random_poses(model, 50, rng)
    markers, _ = glove.markers(model, model.forward_kinematics(qpos))
    fit = solve_poses(model, glove, markers + rng.uniform(-0.003, 0.003, markers.shape))
    # 57 coordinates of 1.73 mm standard deviation, less what 26 freedoms take of it.
    assert 0.0018 < np.median(fit.rms) < 0.0026


def test_a_start_near_the_end_needs_few_steps(rng):
    model, glove = gloved_hand("left", rng)
    qpos = random_poses(model, 20, rng)
    markers, _ = glove.markers(model, model.forward_kinematics(qpos))
    near = qpos.copy()
    near[:, 7:] += rng.normal(scale=0.05, size=(20, 20))
    assert np.percentile(solve_poses(model, glove, markers, initial=near, iterations=5).rms, 95) < 0.0002


def test_bad_targets_are_told(rng):
    model, glove = gloved_hand("right", rng)
    with pytest.raises(ShapeError, match=r"targets have shape \(2, 13, 3\), wanted \(T, 19, 3\)"):
        solve_poses(model, glove, np.zeros((2, 13, 3)))
    few = np.full((2, 19, 3), np.nan)
    few[0], few[1, :3] = 0.1, 0.1
    with pytest.raises(ShapeError, match="frame 1 has 3 markers, wanted at least 4"):
        solve_poses(model, glove, few)
