"""Takes for other programs: their poses alone, at any rate, in the format that a name's ending says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gloves.captures.formats import read_capture
from gloves.fit import nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import LOST, MOTION_FORMATS, RigidBody, Take
from handsim.errors import ArgumentError
from handsim.hand.model import join_qpos
from handsim.hand.motion import is_steady
from handsim.space.transforms import random_quaternions

FRAMES = 13
HANDS = tuple(nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left"))
WAND = RigidBody("wand", (), np.empty((0, 3)))


@pytest.fixture
def take(rng) -> Take:
    qpos = join_qpos(0.5 * rng.random((2 * FRAMES, 20)), position=rng.normal(size=(2 * FRAMES, 3)))
    qpos[:, 3:7] = random_quaternions(2 * FRAMES, rng=rng)
    qpos = qpos.reshape(FRAMES, 2, 27)
    qpos[[0, 1, 5, 6], 1] = np.nan
    poses = np.concatenate([rng.normal(size=(FRAMES, 3)), random_quaternions(FRAMES, rng=rng)], axis=1)
    return Take.of_poses(HANDS, qpos, rate=60.0, bodies=[WAND], body_poses=poses[:, None])


def present(take: Take) -> np.ndarray:
    return take.status != LOST


def test_the_old_rate_changes_nothing(take):
    again = take.poses_alone(take.rate)
    np.testing.assert_array_equal(present(take), present(again))
    np.testing.assert_allclose(take.qpos[..., 7:], again.qpos[..., 7:], atol=1e-12)
    for ours, others in ((take.qpos, again.qpos), (take.body_poses, again.body_poses)):
        np.testing.assert_allclose(ours[..., :3], others[..., :3], atol=1e-12)
        same = np.abs((ours[..., 3:7] * others[..., 3:7]).sum(axis=-1))
        np.testing.assert_allclose(same[np.isfinite(same)], 1.0)


def test_frames_beside_a_missing_one_are_missing(take):
    twice, old = present(take.poses_alone(2 * take.rate))[:, 1], present(take)[:, 1]
    assert len(twice) == 2 * len(old) - 1
    np.testing.assert_array_equal(twice[::2], old)
    np.testing.assert_array_equal(twice[1::2], old[1:] & old[:-1])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_between_frames_everything_is_straight(seed, share):
    rng = np.random.default_rng(seed)
    qpos = join_qpos(rng.normal(size=(2, 20)), position=rng.normal(size=(2, 3)))
    qpos[:, 3:7] = random_quaternions(2, rng=rng)
    take = Take.of_poses(HANDS[:1], qpos[:, None], rate=20.0)
    middle = take.poses_alone(1.0 / (0.05 * share)).qpos[1, 0]
    straight = qpos[0] + share * (qpos[1] - qpos[0])
    np.testing.assert_allclose(middle[[*range(3), *range(7, 27)]], straight[[*range(3), *range(7, 27)]])
    first, last, found = (Rotation.from_quat(q[3:7], scalar_first=True) for q in (*qpos, middle))
    whole = (first.inv() * last).magnitude()
    assert (first.inv() * found).magnitude() == pytest.approx(share * whole, abs=1e-7)
    assert (found.inv() * last).magnitude() == pytest.approx((1 - share) * whole, abs=1e-7)


def test_a_hole_in_a_stream_stays_one_in_formats_without_times(rng, tmp_path):
    times = np.concatenate([np.arange(10) / 100, 1.0 + np.arange(10) / 100])
    qpos = join_qpos(rng.normal(size=(20, 20)), position=np.ones(3))
    take = Take.of_poses(HANDS[:1], qpos[:, None], rate=100.0, times=times)
    assert not is_steady(take.times, take.rate)
    take.export(tmp_path / "hands.trc")
    seen = np.isfinite(read_capture(tmp_path / "hands.trc").positions[:, 0, 0])
    assert seen.tolist() == [True] * 10 + [False] * 90 + [True] * 10
    take.export(tmp_path / "hands.csv")
    assert len((tmp_path / "hands.csv").read_text().splitlines()) == 21


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e12])
def test_rates_that_cannot_be(take, rate):
    with pytest.raises(ArgumentError, match="expected"):
        take.poses_alone(rate)


def test_what_has_no_pose_is_left_out(take):
    qpos, poses = take.qpos.copy(), np.full_like(take.body_poses, np.nan)
    qpos[:, 0] = np.nan
    alone = Take.of_poses(HANDS, qpos, rate=60.0, bodies=[WAND], body_poses=poses).poses_alone()
    assert alone.sides == ("left",) and alone.bodies == () and alone.body_poses.shape == (FRAMES, 0, 7)
    nobody = dataclasses.replace(take, qpos=np.full_like(qpos, np.nan), status=np.zeros_like(take.status))
    with pytest.raises(ArgumentError, match="no hand has a pose"):
        nobody.export("hands.bvh")


def test_other_endings_are_refused_with_the_valid_ones(take, tmp_path):
    with pytest.raises(ArgumentError) as caught:
        take.export(tmp_path / "hands.fbx")
    assert all(ending in str(caught.value) for ending in MOTION_FORMATS)
    assert not list(tmp_path.iterdir())
