from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.motion_files.hands_in_motion import HandsInMotion, MovingHand, changes
from handsim.space.transforms import random_quaternions

MODEL = HandModel.named("M")


def of(qpos, times, rate):
    return HandsInMotion(rate, times, (MovingHand(MODEL, qpos),))


def test_the_old_rate_changes_nothing(motion):
    again = motion.resampled(motion.rate)
    for ours, others in zip(motion.hands, again.hands, strict=True):
        np.testing.assert_array_equal(ours.present, others.present)
        np.testing.assert_allclose(ours.qpos[:, 7:], others.qpos[:, 7:], atol=1e-12)
        same = np.abs((ours.qpos[:, 3:7] * others.qpos[:, 3:7]).sum(axis=1)[ours.present])
        np.testing.assert_allclose(same, 1.0)
    for ours, others in zip(motion.things, again.things, strict=True):
        np.testing.assert_allclose(ours.T_world_thing, others.T_world_thing, atol=1e-12)


def test_frames_beside_a_missing_one_are_missing(motion):
    twice = motion.resampled(2 * motion.rate)
    left, old = twice.hands[1], motion.hands[1].present
    assert len(left.present) == 2 * len(old) - 1
    np.testing.assert_array_equal(left.present[::2], old)
    np.testing.assert_array_equal(left.present[1::2], old[1:] & old[:-1])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_between_frames_everything_is_straight(seed, share):
    rng = np.random.default_rng(seed)
    qpos = join_qpos(rng.normal(size=(2, 20)), position=rng.normal(size=(2, 3)))
    qpos[:, 3:7] = random_quaternions(2, rng=rng)
    motion = of(qpos, np.array([0.0, 0.05]), 20.0)
    middle = motion.resampled(1.0 / (0.05 * share)).hands[0].qpos[1]
    straight = qpos[0] + share * (qpos[1] - qpos[0])
    np.testing.assert_allclose(middle[[*range(3), *range(7, 27)]], straight[[*range(3), *range(7, 27)]])
    first, last, found = (Rotation.from_quat(q[3:7], scalar_first=True) for q in (*qpos, middle))
    whole = (first.inv() * last).magnitude()
    assert (first.inv() * found).magnitude() == pytest.approx(share * whole, abs=1e-7)
    assert (found.inv() * last).magnitude() == pytest.approx((1 - share) * whole, abs=1e-7)


def test_a_hole_in_a_stream_stays_one(rng):
    times = np.concatenate([np.arange(10) / 100, 1.0 + np.arange(10) / 100])
    motion = of(join_qpos(rng.normal(size=(20, 20))), times, 100.0)
    steady = motion.steady()
    assert steady.num_frames == 110
    assert steady.hands[0].present.tolist() == [True] * 10 + [False] * 90 + [True] * 10
    assert steady.steady() is steady


def test_holding(motion):
    left = motion.hands[1]
    np.testing.assert_array_equal(left.held_qpos[[0, 1, 5, 6]], left.qpos[[2, 2, 4, 4]])
    assert changes(left.present).tolist() == [0, 2, 5, 7]


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e12])
def test_rates_that_cannot_be(motion, rate):
    with pytest.raises(ArgumentError, match="expected"):
        motion.resampled(rate)


def test_motions_that_cannot_be(motion):
    right = motion.hands[0]
    for wrong in (
        {"hands": ()},
        {"hands": (right, right)},
        {"hands": (MovingHand(MODEL, right.qpos[1:]),)},
        {"hands": (MovingHand(MODEL, np.full_like(right.qpos, np.nan)),)},
        {"times": motion.times[::-1]},
        {"rate": 0.0},
    ):
        with pytest.raises(ArgumentError, match="expected"):
            dataclasses.replace(motion, **wrong)
