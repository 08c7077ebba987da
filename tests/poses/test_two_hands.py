"""Two hands that meet: valid at every frame, really in contact, human in speed; MuJoCo judges the depth."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import HandModel, join_qpos, sample_shape
from handsim.files.inputs import package_data
from handsim.hand.model import build_spec
from handsim.hand.shape import EVERYBODY
from handsim.space.transforms import random_quaternions
from poses.contact import (
    close_fingers,
    first_contact,
    smooth_above,
    smooth_below,
)
from poses.motion import MAX_ACCELERATION, MAX_SPEED
from poses.shapes import gesture_names, is_valid, resting_angles
from poses.two_hands import INTERACTIONS, sample_two_hand_motion, sample_two_hand_poses
from tests.meshes import hands_overlap

DEEPEST = 0.001
TOUCHING = 0.001


@functools.cache
def hands() -> tuple[HandModel, HandModel]:
    return HandModel.named("M"), HandModel.named("M", side="left")


def assert_valid(right, left, right_qpos, left_qpos):
    assert is_valid(right, right_qpos[:, 7:]).all()
    assert is_valid(left, left_qpos[:, 7:]).all()
    assert hands_overlap(right, left, right_qpos, left_qpos).max() <= DEEPEST


def mujoco_distances(right: HandModel, left: HandModel, qpos: np.ndarray) -> np.ndarray:
    """Smallest signed distance between the hands' geoms, frame by frame, in one scene with both."""
    scene = mujoco.MjSpec()
    scene.option.gravity = np.zeros(3)
    for model, prefix in ((right, "right_"), (left, "left_")):
        scene.attach(
            build_spec(model.skeleton, model.capsules), prefix=prefix, frame=scene.worldbody.add_frame()
        )
    compiled = scene.compile()
    data = mujoco.MjData(compiled)
    owners = [compiled.geom(number).name.split("_")[0] for number in range(compiled.ngeom)]
    first, second = ([n for n, owner in enumerate(owners) if owner == side] for side in ("right", "left"))
    distances = []
    for values in qpos:
        data.qpos[:] = values
        mujoco.mj_kinematics(compiled, data)
        distances.append(
            min(mujoco.mj_geomDistance(compiled, data, i, j, 1.0, None) for i in first for j in second)
        )
    return np.array(distances)


def test_overlap_of_two_hands_is_mujocos(rng):
    right = HandModel(sample_shape(EVERYBODY, side="right", rng=rng))
    left = HandModel(sample_shape(EVERYBODY, side="left", rng=rng))
    posed = list(sample_two_hand_poses(right, left, 60, rng=rng))
    for qpos in posed:  # some of them deep in each other
        qpos[20:] = join_qpos(
            rng.uniform(*right.skeleton.ranges.T, size=(40, 20)),
            position=rng.normal(scale=0.03, size=(40, 3)),
            quaternion=random_quaternions(40, rng=rng),
        )
    ours = hands_overlap(right, left, *posed)
    theirs = -mujoco_distances(right, left, np.concatenate(posed, axis=1))
    assert (ours > 0.005).sum() >= 5, "the test needs hands that collide"
    assert (ours < -0.001).any(), "and hands apart"
    np.testing.assert_allclose(ours, theirs, atol=1e-7)


@pytest.fixture(autouse=True)
def short_rests(monkeypatch):
    monkeypatch.setattr("poses.contact.PAUSE_TIMES", (0.0, 0.6))


@pytest.mark.parametrize("name", INTERACTIONS)
def test_every_frame_is_valid_and_the_hands_really_touch(name, rng, monkeypatch):
    monkeypatch.setattr("poses.two_hands.INTERACTIONS", (name,))
    right, left = hands()
    motions = sample_two_hand_motion(right, left, 8.0, rng=rng)
    assert [len(motion.qpos) for motion in motions] == [961, 961]
    qpos = [motion.qpos for motion in motions]
    assert_valid(right, left, *qpos)
    touching = hands_overlap(right, left, *qpos) >= -TOUCHING
    assert touching.mean() > 0.25, "ways between meetings included"
    for motion in motions:
        speeds = motion.speeds()
        assert np.abs(speeds).max() <= MAX_SPEED
        assert np.abs(np.diff(speeds, axis=0) * motion.rate).max() <= MAX_ACCELERATION
        wrist = np.linalg.norm(np.diff(motion.qpos[:, :3], axis=0), axis=1) * motion.rate
        assert wrist.max() < (4.0 if name == "clap" else 2.5)
        assert wrist.max() > 0.1
        held = touching[1:] & touching[:-1]
        assert (np.abs(speeds[held]).max(axis=1) > 0.02).mean() > 0.3, "fingers do not freeze in contact"


@pytest.mark.parametrize("sizes", [("XS", "XL"), ("XL", "S")])
def test_hands_of_two_people_meet_too(sizes, rng):
    right, left = HandModel.named(sizes[0]), HandModel.named(sizes[1], side="left")
    motions = sample_two_hand_motion(right, left, 4.0, rng=rng)
    assert_valid(right, left, *(motion.qpos for motion in motions))
    assert_valid(right, left, *sample_two_hand_poses(right, left, 100, rng=rng))


def test_single_poses_touch_and_differ(rng):
    right, left = hands()
    qpos = sample_two_hand_poses(right, left, 400, rng=rng)
    assert [each.shape for each in qpos] == [(400, 27), (400, 27)]
    assert_valid(right, left, *qpos)
    gaps = -hands_overlap(right, left, *qpos)
    assert (gaps <= TOUCHING).mean() > 0.6
    assert (gaps > 0.01).mean() > 0.05, "some nearly touch"
    for each in qpos:
        assert (each[:, 7:].std(axis=0) > np.deg2rad(1.0)).all()
        assert np.abs(each[:, :3] - [0.0, 0.0, 1.1]).max() < 0.5


def test_clapping_hands_come_and_go(rng, monkeypatch):
    monkeypatch.setattr("poses.two_hands.INTERACTIONS", ("clap",))
    right, left = hands()
    qpos = [motion.qpos for motion in sample_two_hand_motion(right, left, 6.0, rng=rng)]
    touching = hands_overlap(right, left, *qpos) >= -TOUCHING
    beats = np.flatnonzero(touching[1:] & ~touching[:-1])
    assert len(beats) >= 4
    between = np.diff(beats) / 120.0
    assert 0.15 < np.median(between) < 0.6


def test_pointing_touches_palms_with_an_index_finger(rng, monkeypatch):
    monkeypatch.setattr("poses.two_hands.INTERACTIONS", ("point_at_palm",))
    right, left = hands()
    qpos = [motion.qpos for motion in sample_two_hand_motion(right, left, 6.0, rng=rng)]
    touching = hands_overlap(right, left, *qpos) >= -TOUCHING
    wrists = [model.forward_kinematics(each) for model, each in zip(hands(), qpos, strict=True)]
    tips = [
        frames[:, 6, :3, 3] + model.skeleton.lengths[6] * frames[:, 6, :3, 0]
        for model, frames in zip(hands(), wrists, strict=True)
    ]
    near = []
    for tip, other in zip(tips, wrists[::-1], strict=True):
        local = np.einsum("tij,ti->tj", other[:, 0, :3, :3], tip - other[:, 0, :3, 3])
        near.append((np.abs(local[:, 2]) < 0.05) & (local[:, 0] > 0.0) & (local[:, 0] < 0.15))
    assert (near[0] | near[1])[touching].mean() > 0.9


def test_hands_are_brought_together_from_the_free_side(rng):
    right, left = hands()
    still = join_qpos(np.tile(resting_angles(right), (20, 1)))
    moving = join_qpos(
        np.tile(resting_angles(left), (20, 1)),
        position=rng.normal(scale=0.03, size=(20, 3)),
        quaternion=random_quaternions(20, rng=rng),
    )
    axis = rng.normal(size=(20, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    reach = first_contact(right, still, left, moving, axis)
    met = reach > -0.15
    assert met.sum() > 10
    for extra in (0.0, 0.001, 0.02, 0.1):
        placed = moving.copy()
        placed[:, :3] += (reach + extra)[:, None] * axis
        depth = hands_overlap(right, left, still, placed)
        assert (depth <= 0.0005 + 1e-6).all()
        if extra == 0.0:
            np.testing.assert_allclose(depth[met], 0.0005, atol=3e-5)


def test_fingers_close_until_they_meet_something():
    right, left = hands()
    flat = np.deg2rad(
        np.array(package_data("poses", "interactions")["hands"]["clap"], dtype=float).reshape(1, 20)
    )
    opened, closed = join_qpos(flat), flat.copy()
    closed[:, 5::4] += 0.6
    far = join_qpos(flat, position=np.array([[0.0, 0.0, 1.0]]))
    free = close_fingers(right, opened, closed, np.ones((1, 5)), other=left, other_qpos=far)
    np.testing.assert_allclose(free, closed)
    near = far.copy()
    near[0, :7] = 0.02, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0  # palm to palm
    axis = np.array([[0.0, 0.0, -1.0]])
    near[:, :3] += (first_contact(right, opened, left, near, axis) + 0.002) * axis
    assert hands_overlap(right, left, opened, near)[0] < 0.0
    held = close_fingers(right, opened, closed, np.ones((1, 5)), other=left, other_qpos=near)
    depth = hands_overlap(right, left, join_qpos(held), near)[0]
    assert 0.0 < depth <= 0.0008 + 1e-6
    assert (held <= closed + 1e-12).all()
    assert (held < closed - 0.1).any()


@given(seed=st.integers(0, 1000), window=st.sampled_from([1, 3, 15, 43]))
@settings(max_examples=30, deadline=None)
def test_smoothing_stays_on_the_free_side(seed, window):
    values = np.random.default_rng(seed).normal(size=100)
    assert (smooth_above(values, window) >= values - 1e-12).all()
    assert (smooth_below(values, window) <= values + 1e-12).all()
    np.testing.assert_allclose(smooth_above(np.ones(50), window), 1.0)


def test_same_seed_same_motion():
    first, second = (sample_two_hand_motion(*hands(), 2.0, rng=np.random.default_rng(5)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.qpos, other.qpos)


def test_the_data_file_names_what_exists():
    assert set(INTERACTIONS) == {"clasp", "clap", "rub", "point_at_palm", "interlace"}
    known = set(gesture_names()) | set(package_data("poses", "interactions")["hands"])
    for variants in package_data("poses", "interactions")["interactions"].values():
        for variant in variants:
            assert {
                variant[role][state] for role in ("still", "moving") for state in ("open", "closed")
            } <= known
    assert not set(gesture_names()) & set(package_data("poses", "interactions")["hands"])
