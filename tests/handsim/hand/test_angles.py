"""Angles of the ISB, found again from the directions of bones in the world."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handsim import HandModel, join_qpos, sample_shape
from handsim.hand.angles import ISB_NAMES, isb_angles
from handsim.hand.shape import DIGITS, JOINT_NAMES, bones_of
from handsim.space.transforms import random_quaternions

FRAMES = 20


@pytest.fixture(params=["right", "left"])
def model(request, rng):
    return HandModel(sample_shape(side=request.param, rng=rng))


@pytest.fixture
def angles(model, rng):
    low, high = model.skeleton.ranges.T
    return low + (high - low) * rng.random((FRAMES, 20))


def by_name(model, angles, neutral=None):
    return dict(zip(ISB_NAMES, isb_angles(model.shape, angles, neutral).T, strict=True))


def test_they_are_angles_of_the_bones_in_the_world(model, angles, rng):
    """The first two are of a bone's direction: in the plane of flexion, and out of it."""
    qpos = join_qpos(angles, quaternion=random_quaternions(1, rng=rng)[0])
    frames = model.forward_kinematics(qpos)[..., :3, :3]
    found = by_name(model, angles)
    ulnar = 1.0 if model.shape.side == "left" else -1.0  # of our y axis
    for digit in DIGITS:
        first, _, last = bones_of(digit)
        rest = np.eye(3) if digit == "thumb" else model.skeleton.rotations[first]
        distal, y, dorsal = np.einsum("tji,tj->it", frames[:, 0] @ rest, frames[:, first, :, 0])
        names = ("MCP_flexion", "MCP_ulnar_deviation")
        names = ("metacarpal_palmar_abduction", "metacarpal_radial_abduction") if digit == "thumb" else names
        sign = -ulnar if digit == "thumb" else ulnar
        flexion, deviation = (found[f"{digit}_{name}"] for name in names)
        np.testing.assert_allclose(flexion, np.arctan2(-dorsal, distal), atol=1e-9)
        np.testing.assert_allclose(deviation, np.arcsin(sign * y), atol=1e-9)
        outer = Rotation.from_matrix(np.swapaxes(frames[:, last - 1], -1, -2) @ frames[:, last])
        name = "thumb_IP_flexion" if digit == "thumb" else f"{digit}_DIP_flexion"
        np.testing.assert_allclose(found[name], outer.as_rotvec()[:, 1], atol=1e-9)


def test_the_flat_hand_is_zero_but_for_the_first_metacarpal(model):
    found = by_name(model, np.zeros((1, 20)))
    at_rest = {name for name, value in found.items() if abs(value[0]) > 1e-9}
    assert at_rest == {name for name in ISB_NAMES if "metacarpal" in name}
    assert 15.0 < np.rad2deg(found["thumb_metacarpal_palmar_abduction"][0]) < 60.0


def test_an_abducted_little_finger_deviates_to_the_ulna_and_a_bent_one_flexes(model):
    pose = np.zeros((1, 20))
    pose[0, JOINT_NAMES.index("little_MCP_abduction")] = np.deg2rad(-15.7)
    pose[0, JOINT_NAMES.index("index_PIP_flexion")] = 1.0
    found = by_name(model, pose)
    assert np.rad2deg(found["little_MCP_ulnar_deviation"][0]) == pytest.approx(15.7)
    assert found["index_PIP_flexion"][0] == pytest.approx(1.0)


def test_all_angles_are_zero_in_the_neutral_pose_and_turn_about_the_same_axes(model, angles):
    found = isb_angles(model.shape, angles[:1], angles[0])
    np.testing.assert_allclose(found, 0.0, atol=1e-9)
    neutral = np.zeros(20)
    neutral[JOINT_NAMES.index("index_MCP_flexion")] = 0.3
    bent = neutral.copy()
    bent[JOINT_NAMES.index("index_MCP_flexion")] = 0.7
    bent[JOINT_NAMES.index("index_DIP_flexion")] = 0.2
    found = by_name(model, bent[None], neutral)
    assert found["index_MCP_flexion"][0] == pytest.approx(0.4)
    assert found["index_DIP_flexion"][0] == pytest.approx(0.2)
    assert sum(abs(value[0]) > 1e-9 for value in found.values()) == 2


def test_a_missing_pose_has_no_angles(model, angles):
    angles[3] = np.nan
    found = isb_angles(model.shape, angles)
    assert np.isnan(found[3]).all() and np.isfinite(np.delete(found, 3, axis=0)).all()


@pytest.mark.parametrize("frames", [0, 2])
def test_frames_without_any_pose_have_no_angles(model, frames):
    found = isb_angles(model.shape, np.full((frames, 20), np.nan))
    assert found.shape == (frames, 25) and np.isnan(found).all()
