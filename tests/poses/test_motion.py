"""Motions of one hand and of its wrist."""

from __future__ import annotations

import contextlib
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import HandModel, HandMotion, join_qpos, sample_shape
from handsim.errors import ArgumentError, PoseError
from handsim.files.inputs import package_data
from handsim.hand.shape import SIDES
from handsim.space.transforms import quaternion_matrix
from poses import MotionConfig, sample_motion
from poses.motion import (
    angles_through,
    can_be_left,
    minimum_jerk,
    path_to_rest,
    script_poses,
    scripted_motion,
    with_wrist,
    wrist_path,
)
from poses.shapes import (
    HIGH,
    LOW,
    MAX_PENETRATION,
    gesture,
    gesture_names,
    is_valid,
    make_valid,
    resting_angles,
)
from poses.touch import FINGERS, is_touching
from tests.sentences import error_names

RATE = 120.0


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
    assert np.abs(np.diff(speeds, axis=0) * config.rate).max() <= config.max_acceleration
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


def _check_motion(model: HandModel, motion: HandMotion, config: MotionConfig) -> None:
    angles = motion.qpos[:, 7:]
    assert (angles >= LOW - 1e-9).all()
    assert (angles <= HIGH + 1e-9).all()
    assert model.penetration(motion.qpos).max() <= MAX_PENETRATION
    speeds = motion.speeds()
    assert np.abs(speeds).max() <= config.max_speed
    assert np.abs(np.diff(speeds, axis=0) * motion.rate).max() <= config.max_acceleration


def _people(count: int, seed: int) -> list[HandModel]:
    """Random hands whose fingers have room at rest."""
    rng, people = np.random.default_rng(seed), []
    while len(people) < count:
        model = HandModel(sample_shape(side=SIDES[len(people) % 2], rng=rng))
        with contextlib.suppress(PoseError):
            resting_angles(model)
            people.append(model)
    return people


@pytest.mark.parametrize("script", package_data("poses", "scripts")["scripts"])
def test_every_frame_of_every_script_is_valid(script):
    for number, model in enumerate([HandModel.named("XS"), HandModel.named("XL"), *_people(3, seed=3)]):
        motion = scripted_motion(model, script, 5.0, rng=np.random.default_rng(number))
        assert len(motion.qpos) == 601
        _check_motion(model, motion, MotionConfig())
        assert np.ptp(motion.qpos[:, 7:], axis=0).max() > 0.1, "the hand must move"


def test_the_free_script_is_the_free_motion():
    model = HandModel.named("M")
    scripted = scripted_motion(model, "free", 2.0, rng=np.random.default_rng(2))
    free = sample_motion(model, 2.0, rng=np.random.default_rng(2))
    np.testing.assert_array_equal(scripted.qpos, free.qpos)


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_a_motion_goes_through_its_poses_in_turn(seed):
    rng = np.random.default_rng(seed)
    model, config = HandModel.named("S"), MotionConfig(rate=100.0, max_speed=6.0, max_acceleration=90.0)
    names = rng.choice(gesture_names("fingerspelling") + gesture_names("grasps"), size=8)
    poses = make_valid(model, np.stack([gesture(name) for name in names]))
    angles = np.concatenate([poses[:1], angles_through(model, poses, config, rng=rng)])
    motion = with_wrist(angles, config, rng=rng)
    _check_motion(model, motion, config)
    at = 0
    for pose in poses:
        here = np.flatnonzero(np.abs(motion.qpos[at:, 7:] - pose).max(axis=1) < 1e-9)
        assert len(here), "every pose is reached, one after the other"
        at += int(here[0])
    np.testing.assert_allclose(motion.qpos[0, 7:], poses[0])
    np.testing.assert_allclose(motion.qpos[-1, 7:], poses[-1], atol=1e-9)


def test_pinches_touch_and_are_held():
    model = HandModel.named("L", side="left")
    motion = scripted_motion(model, "pinches", 12.0, rng=np.random.default_rng(0))
    angles = motion.qpos[:, 7:]
    touching = np.stack([is_touching(model, angles, finger) for finger in FINGERS])
    assert touching.any(axis=1).all(), "every finger has its turn"
    assert (touching.sum(axis=0) <= 1).all(), "one at a time"
    assert 0.1 < touching.any(axis=0).mean() < 0.9


def test_a_pianist_presses_four_to_eight_keys_a_second():
    model = HandModel.named("M")
    motion = scripted_motion(model, "piano", 20.0, rng=np.random.default_rng(1))
    poses = script_poses(model, "piano")
    down = np.abs(motion.qpos[:, None, 7:] - poses).max(axis=2) < 1e-9
    presses = (np.diff(down.astype(int), axis=0) == 1).sum() / motion.duration
    assert 4.0 <= presses <= 8.0


def test_the_wrist_is_the_one_of_the_config():
    model, still = HandModel.named("M"), MotionConfig(volume=0.0, rate=60.0)
    motion = sample_motion(model, 2.0, still, rng=np.random.default_rng(0))
    assert len(motion.qpos) == 121
    np.testing.assert_allclose(motion.qpos[:, :3], np.tile([0.0, 0.0, 1.1], (121, 1)))


def test_tight_poses_can_be_left(rng):
    model = HandModel.named("M")
    resting = resting_angles(model)
    poses = make_valid(model, np.stack([gesture("fist"), gesture("asl_m"), resting]))
    assert can_be_left(model, poses).all()
    way = path_to_rest(model, poses[1], MotionConfig(), rng)
    assert is_valid(model, way).all()
    np.testing.assert_allclose(way[-1], resting, atol=1e-12)


def test_minimum_jerk_starts_and_ends_at_rest():
    share = minimum_jerk(1000)
    assert share[-1] == 1.0
    assert (np.diff(share) >= 0).all()
    assert share[0] < 1e-7
    assert np.diff(share)[-1] < 1e-6


@pytest.mark.parametrize("duration", [0.0, 0.004, -1.0, np.nan, np.inf])
def test_a_motion_of_no_length_is_told(duration, rng):
    model = HandModel.named("M")
    wanted = f"the motion is {duration:g} s long, expected a number of at least one step at 120 Hz"
    with pytest.raises(
        ArgumentError, match=f"{re.escape(wanted)}|duration is {duration:g}, expected a number"
    ):
        sample_motion(model, duration, rng=rng)
    with pytest.raises(ArgumentError, match=re.escape(wanted)):
        scripted_motion(model, "piano", duration, rng=rng)


def test_bad_motions_are_told(rng):
    model = HandModel.named("M")
    with error_names(ArgumentError, "unknown script 'pian' (did you mean 'piano'?); valid names: free"):
        scripted_motion(model, "pian", 1.0, rng=rng)
    with pytest.raises(ArgumentError, match="unknown script 'free'"):
        script_poses(model, "free")
    with pytest.raises(ArgumentError, match="a motion needs frames"):
        HandMotion(np.zeros((0, 27)), 120.0)
    with pytest.raises(ArgumentError, match=r"the rate \[Hz\] is 0"):
        HandMotion(np.zeros((1, 27)), 0.0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 700), st.floats(0.0, 0.5), st.sampled_from([0.0, 0.5]))
def test_a_wrist_stays_in_its_cube_and_moves_smoothly(seed, frames, volume, turning):
    rng, center = np.random.default_rng(seed), (0.2, -0.1, 1.0)
    position, quaternion = wrist_path(frames, RATE, center=center, volume=volume, turning=turning, rng=rng)
    assert position.shape == (frames, 3) and quaternion.shape == (frames, 4)
    assert (np.abs(position - np.array(center)) <= volume + 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-12)
    # Minimum-jerk ways: 1.875 times the mean speed of the longest way in the shortest time.
    fastest = 1.875 * 2.0 * volume / (0.6 - 1.0 / RATE)
    assert (np.abs(np.diff(position, axis=0)) * RATE <= fastest + 1e-9).all()
    if frames > 2:
        steps = np.abs(np.diff(position, n=2, axis=0)) * RATE**2
        assert (steps <= 5.8 * 2.0 * volume / (0.6 - 1.0 / RATE) ** 2 + 1e-6).all()
    dots = np.abs(np.einsum("ti,ti->t", quaternion[1:], quaternion[:-1]))
    turns = 2.0 * np.arccos(np.clip(dots, 0.0, 1.0)) * RATE
    assert (turns <= 1.875 * np.pi / (0.6 - 1.0 / RATE) + 1e-3).all()


def test_the_seed_decides_the_path():
    first, again, other = (
        np.concatenate(wrist_path(300, RATE, rng=np.random.default_rng(seed)), axis=1) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_it_gets_around(rng):
    position, _ = wrist_path(12_000, RATE, rng=rng)
    assert np.ptp(position, axis=0).min() > 0.45, "most of a cube of 0.6 m"


@pytest.mark.parametrize("turning", [0.0, 0.3])
def test_turning_spreads_around_fingers_ahead_and_palm_down(turning, rng):
    _, quaternion = wrist_path(24_000, RATE, turning=turning, rng=rng)
    axes = quaternion_matrix(quaternion)
    fingers, back = axes[:, :, 0].mean(axis=0), axes[:, :, 2].mean(axis=0)
    np.testing.assert_allclose(fingers / np.linalg.norm(fingers), [0.0, 1.0, 0.0], atol=0.15)
    np.testing.assert_allclose(back / np.linalg.norm(back), [0.0, 0.0, 1.0], atol=0.15)
    assert (axes.std(axis=0).max() < 1e-9) == (turning == 0.0)
