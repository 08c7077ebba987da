"""Kinematics and contact against MuJoCo, and what a mirrored or resized hand must keep."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import load_layout
from gloves.fit import attach_markers
from handsim import HandModel, join_qpos, sample_shape
from handsim.errors import ArgumentError
from handsim.hand.model import NUM_VELOCITIES, metacarpal_flexions, skinned_jacobian
from handsim.hand.shape import EVERYBODY, JOINT_NAMES, NUM_JOINTS, SIDES, SIZES, named_shape
from handsim.space.transforms import MIRROR, axis_angle_matrix, random_quaternions


def random_qpos(model: HandModel, count: int, rng: np.random.Generator) -> np.ndarray:
    low, high = model.skeleton.ranges.T
    return join_qpos(
        rng.uniform(low, high, size=(count, NUM_JOINTS)),
        position=rng.normal(size=(count, 3)),
        quaternion=random_quaternions(count, rng=rng),
    )


@pytest.mark.parametrize("side", SIDES)
def test_forward_kinematics_is_mujocos(side, rng):
    model = HandModel(sample_shape(EVERYBODY, side=side, rng=rng))
    data = mujoco.MjData(model.mj_model)
    qpos = random_qpos(model, 100, rng)
    ours = model.forward_kinematics(qpos)
    for frame, values in zip(ours, qpos, strict=True):
        data.qpos[:] = values
        mujoco.mj_kinematics(model.mj_model, data)
        np.testing.assert_allclose(frame[:, :3, 3], data.xpos[1:], atol=1e-9)
        np.testing.assert_allclose(frame[:, :3, :3], data.xmat[1:].reshape(-1, 3, 3), atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_penetration_is_mujocos(side, rng):
    model = HandModel(sample_shape(EVERYBODY, side=side, rng=rng))
    data = mujoco.MjData(model.mj_model)
    qpos = random_qpos(model, 200, rng)
    depths = model.penetration(qpos)
    assert (depths > 0.001).mean() > 0.1, "the test needs poses that collide"
    for depth, values in zip(depths, qpos, strict=True):
        data.qpos[:] = values
        mujoco.mj_fwdPosition(model.mj_model, data)
        deepest = max((-contact.dist for contact in data.contact), default=0.0)
        assert depth == pytest.approx(max(deepest, 0.0), abs=1e-9)


def test_left_hand_is_the_mirror_image(rng):
    shape = sample_shape(side="right", rng=rng)
    right, left = HandModel(shape), HandModel(shape.with_side("left"))
    low, high = right.skeleton.ranges.T
    qpos = join_qpos(rng.uniform(low, high, size=(20, NUM_JOINTS)))
    ours, mirrored = left.forward_kinematics(qpos), right.forward_kinematics(qpos)
    np.testing.assert_allclose(ours[..., :3, 3], mirrored[..., :3, 3] @ MIRROR, atol=1e-12)
    np.testing.assert_allclose(left.skin(qpos[:3]), right.skin(qpos[:3]) @ MIRROR, atol=1e-12)
    np.testing.assert_allclose(left.penetration(qpos), right.penetration(qpos), atol=1e-12)


def test_positive_flexion_bends_towards_the_palm_and_the_thumb_opposes():
    model = HandModel.named("M")
    tip = model.skeleton.lengths

    def fingertip(bone: int, **degrees: float) -> np.ndarray:
        angles = np.zeros((1, NUM_JOINTS))
        for name, value in degrees.items():
            angles[0, JOINT_NAMES.index(name)] = np.deg2rad(value)
        frame = model.forward_kinematics(join_qpos(angles))[0, bone]
        return frame[:3, :3] @ [tip[bone], 0.0, 0.0] + frame[:3, 3]

    flat, bent = fingertip(6), fingertip(6, index_MCP_flexion=60.0)
    assert bent[2] < flat[2] - 0.03
    assert fingertip(6, index_MCP_abduction=15.0)[1] > flat[1] + 0.01
    resting = fingertip(3)
    opposed = fingertip(
        3,
        thumb_metacarpal_abduction=28.0,
        thumb_metacarpal_flexion=30.0,
        thumb_MCP_flexion=30.0,
        thumb_IP_flexion=30.0,
    )
    little = fingertip(15, little_MCP_flexion=70.0, little_PIP_flexion=60.0, little_DIP_flexion=30.0)
    assert np.linalg.norm(opposed - little) < 0.6 * np.linalg.norm(resting - little)


@pytest.mark.parametrize("size", SIZES)
def test_named_sizes_have_their_measures(size):
    length, breadth = SIZES[size]
    shape = named_shape(size)
    model = HandModel(shape)
    tip = model.forward_kinematics(join_qpos(np.zeros((1, NUM_JOINTS))))[0, 9]
    reach = (tip[:3, :3] @ [shape.bone_lengths[2, 2], 0, 0] + tip[:3, 3])[0]
    assert reach == pytest.approx(length, rel=0.03)
    assert shape.breadth == pytest.approx(breadth)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_sampled_people_are_plausible(seed):
    shape = sample_shape(EVERYBODY, rng=np.random.default_rng(seed))
    assert 0.09 < shape.length < 0.23
    assert 0.35 < shape.breadth / shape.length < 0.58
    assert (shape.bone_lengths > 0.008).all()


def test_population_varies_length_and_breadth_separately(rng):
    shapes = [sample_shape(rng=rng) for _ in range(400)]
    lengths, breadths = np.array([(shape.length, shape.breadth) for shape in shapes]).T
    assert 0.45 < np.corrcoef(lengths, breadths)[0, 1] < 0.85  # ANSUR II, both sexes mixed: 0.7
    assert lengths.mean() == pytest.approx(0.187, abs=0.003)


@pytest.mark.parametrize(
    ("qpos", "sentence"),
    [
        (np.zeros((2, 26)), r"qpos has shape \(2, 26\), expected \(\.\.\., any, 27\)"),
        (np.full((1, 27), np.nan), "qpos holds NaN or infinite values, expected finite numbers"),
    ],
)
def test_bad_qpos_is_told(qpos, sentence):
    with pytest.raises(ArgumentError, match=sentence):
        HandModel.named("M").forward_kinematics(qpos)


def test_unknown_size_is_told():
    with pytest.raises(ArgumentError, match=r"unknown size 'XXL' .* valid names: XS, S, M, L, XL"):
        named_shape("XXL")


@pytest.fixture(params=SIDES)
def posed(request, rng):
    model = HandModel(sample_shape(side=request.param, rng=rng))
    return model, random_qpos(model, 4, rng)


def test_skinned_points_move_as_the_jacobian_says(posed):
    model, qpos = posed
    glove = attach_markers(load_layout("dense19"), model)
    assert (glove.bone_weights[:, 1] > 0.05).any(), "the test needs points between bones"
    jacobian = skinned_jacobian(
        model, model.forward_kinematics(qpos), glove.points, glove.bone_indices, glove.bone_weights
    )
    step = 1e-6
    for velocity in range(NUM_VELOCITIES):
        direction = np.zeros(NUM_VELOCITIES)
        direction[velocity] = 1.0
        ends = []
        for sign in (1.0, -1.0):
            moved = qpos.copy()
            for row in moved:
                mujoco.mj_integratePos(model.mj_model, row, direction, sign * step)
            ends.append(glove.markers(model, model.forward_kinematics(moved))[0])
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(jacobian[..., velocity], slope, atol=1e-8)


@pytest.mark.parametrize("side", SIDES)
def test_skinned_points_of_an_arch_move_as_the_jacobian_says(side, rng):
    model = HandModel(dataclasses.replace(sample_shape(side=side, rng=rng), arch=[0.2, 0.6]))
    test_skinned_points_move_as_the_jacobian_says((model, random_qpos(model, 4, rng)))


@pytest.mark.parametrize("side", SIDES)
def test_a_metacarpal_flexes_with_its_finger_about_its_base(side):
    shape = dataclasses.replace(named_shape("L", side=side), arch=[0.0, 0.5])
    qpos = join_qpos(np.deg2rad(40.0 * (np.array(JOINT_NAMES) == "little_MCP_flexion"))[None])
    both = named_shape("L", side=side), shape
    flat, bent = (HandModel(one).forward_kinematics(qpos)[0, 13] for one in both)
    palm = axis_angle_matrix(np.array([0.0, 1.0, 0.0]), np.deg2rad(20.0))
    np.testing.assert_allclose(bent[:3, :3], palm @ flat[:3, :3], atol=1e-12)
    base = 0.38 * flat[:3, 3]
    np.testing.assert_allclose(bent[:3, 3], base + palm @ (flat[:3, 3] - base), atol=1e-12)
    assert bent[2, 3] < flat[2, 3] - 0.015  # towards the palm


def test_a_metacarpal_flexes_within_its_range():
    model = HandModel(dataclasses.replace(named_shape("L"), arch=[0.0, 0.5]))
    angles = np.zeros((3, NUM_JOINTS))
    angles[:, JOINT_NAMES.index("little_MCP_flexion")] = np.deg2rad([40.0, 60.0, 90.0])
    bones = model.forward_kinematics(join_qpos(angles))
    found = np.rad2deg(metacarpal_flexions(model.skeleton, bones))
    np.testing.assert_allclose(found[:, 4], [20.0, 27.0, 27.0], atol=1e-9)
    np.testing.assert_allclose(found[:, :4], 0.0, atol=1e-9)


@pytest.mark.parametrize("arch", [[-0.1, 0.2], [0.1, 5.0], [0.1, np.nan], [0.1]])
def test_a_wrong_arch_is_told(arch):
    with pytest.raises(ArgumentError, match="arch"):
        dataclasses.replace(named_shape("M"), arch=arch)


def test_points_on_one_bone_agree_with_mujoco(posed, rng):
    model, qpos = posed
    bones = rng.integers(16, size=6)
    points = model.rest_transforms[bones, :3, 3] + rng.normal(scale=0.01, size=(6, 3))
    indices, weights = np.tile(bones[:, None], (1, 4)), np.tile([1.0, 0, 0, 0], (6, 1))
    transforms = model.forward_kinematics(qpos)
    ours = skinned_jacobian(model, transforms, points, indices, weights)
    data = mujoco.MjData(model.mj_model)
    rest = np.linalg.inv(model.rest_transforms)
    for frame, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model.mj_model, data)
        mujoco.mj_comPos(model.mj_model, data)
        for number, bone in enumerate(bones):
            motion = transforms[frame, bone] @ rest[bone]
            place = motion[:3, :3] @ points[number] + motion[:3, 3]
            theirs = np.zeros((3, 26))
            mujoco.mj_jac(model.mj_model, data, theirs, None, place, bone + 1)
            np.testing.assert_allclose(ours[frame, number], theirs, atol=1e-12)
