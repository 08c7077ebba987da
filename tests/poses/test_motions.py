"""Motions: smooth, no faster than a hand, valid at every frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import ShapeError
from handsim.model import HandModel, join_qpos
from handsim.motion import HandMotion
from poses.motions import MotionConfig, minimum_jerk, sample_motion
from poses.validity import MAX_PENETRATION, is_valid


@given(seed=st.integers(0, 1000), side=st.sampled_from(["left", "right"]))
@settings(max_examples=5, deadline=None)
def test_every_frame_is_valid_and_no_joint_too_fast(seed, side):
    model, config = HandModel.named("M", side=side), MotionConfig()
    motion = sample_motion(model, 4.0, rng=np.random.default_rng(seed))
    assert len(motion.qpos) == 481
    assert motion.duration == pytest.approx(4.0)
    angles = motion.qpos[:, 7:]
    assert is_valid(model, angles).all()
    assert model.penetration(join_qpos(angles)).max() <= MAX_PENETRATION
    speeds = motion.speeds()
    assert np.abs(speeds).max() <= config.max_speed
    assert np.abs(np.diff(speeds, axis=0) * config.rate).max() <= 1.1 * config.max_acceleration
    assert (np.ptp(angles, axis=0) > 0.01).all(), "the hand must move"


def test_the_wrist_travels_smoothly(rng):
    motion = sample_motion(HandModel.named("M"), 10.0, rng=rng)
    position, quaternion = motion.qpos[:, :3], motion.qpos[:, 3:7]
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) * motion.rate
    assert 0.1 < speed.max() < 3.0
    assert (np.abs(position - [0.0, 0.0, 1.1]) <= 0.3 + 1e-9).all()
    turning = 2 * np.arccos(np.clip(np.abs((quaternion[1:] * quaternion[:-1]).sum(1)), 0, 1)) * motion.rate
    assert turning.max() < 12.0
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0)


def test_same_seed_same_motion():
    model = HandModel.named("S")
    first, second = (sample_motion(model, 1.0, rng=np.random.default_rng(5)).qpos for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_minimum_jerk_starts_and_ends_at_rest():
    share = minimum_jerk(1000)
    assert share[-1] == 1.0
    assert (np.diff(share) >= 0).all()
    assert share[0] < 1e-7
    assert np.diff(share)[-1] < 1e-6


def test_bad_motions_are_told(rng):
    with pytest.raises(ShapeError, match="the duration is 0 s, wanted a positive number"):
        sample_motion(HandModel.named("M"), 0.0, rng=rng)
    with pytest.raises(ShapeError, match="a motion needs frames"):
        HandMotion(np.zeros((0, 27)), 120.0)
    with pytest.raises(ShapeError, match="the rate is 0 Hz"):
        HandMotion(np.zeros((1, 27)), 0.0)
