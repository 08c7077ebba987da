"""Steps and velocities of poses; MuJoCo is the oracle."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest

from handsim.hand.model import HandModel
from handsim.kernels.integration import move, velocity_of
from handsim.space.transforms import random_quaternions


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    rng = np.random.default_rng(5)
    qpos = rng.standard_normal((40, 27))
    qpos[:, 3:7] = random_quaternions(40, rng=rng)
    return qpos


def test_a_step_is_mujocos(poses):
    model = HandModel.named("M").mj_model
    step = np.random.default_rng(6).standard_normal((len(poses), 26))
    step[0] = 0.0
    for qpos, by, moved in zip(poses, step, move(poses, step), strict=True):
        theirs = qpos.copy()
        mujoco.mj_integratePos(model, theirs, by, 1.0)
        np.testing.assert_allclose(moved, theirs, atol=1e-12)


def test_a_velocity_is_mujocos(poses):
    model, theirs = HandModel.named("M").mj_model, np.empty(26)
    for before, after in itertools.pairwise(poses):
        mujoco.mj_differentiatePos(model, theirs, 0.25, before, after)
        np.testing.assert_allclose(velocity_of(before, after, 0.25), theirs, atol=1e-9)


def test_a_step_takes_back_what_a_velocity_said(poses):
    for before, after in itertools.pairwise(poses):
        moved = move(before[None], velocity_of(before, after, 0.5)[None] * 0.5)[0]
        moved[3:7] *= np.sign(moved[3:7] @ after[3:7])
        np.testing.assert_allclose(moved, after, atol=1e-9)
