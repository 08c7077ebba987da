from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handsim.hand.model import KEYPOINT_NAMES, HandModel, hand_keypoints, join_qpos
from handsim.hand.shape import DIGITS
from handsim.motion_files.joint_files import OPENXR_JOINTS, joint_poses, joint_radii, write_openxr
from handsim.motion_files.motion import posed_hands
from handsim.space.transforms import MIRROR

# The extension's enumeration, from XR_HAND_JOINT_PALM_EXT = 0 to XR_HAND_JOINT_LITTLE_TIP_EXT = 25.
NUMBERS = {"PALM": 0, "WRIST": 1, "THUMB_METACARPAL": 2, "THUMB_TIP": 5, "INDEX_METACARPAL": 6}
NUMBERS |= {
    "INDEX_TIP": 10,
    "MIDDLE_PROXIMAL": 12,
    "RING_DISTAL": 19,
    "LITTLE_METACARPAL": 21,
    "LITTLE_TIP": 25,
}
CHAINS = [
    [f"{digit.upper()}_{part}" for part in parts]
    for digit in DIGITS
    for parts in [
        ("METACARPAL", "PROXIMAL", "DISTAL", "TIP")
        if digit == "thumb"
        else ("METACARPAL", "PROXIMAL", "INTERMEDIATE", "DISTAL", "TIP")
    ]
]


@pytest.fixture(params=["right", "left"])
def hand(request):
    return HandModel.named("M", side=request.param)


def posed(hand, rng):
    ranges = hand.skeleton.ranges
    angles = ranges[:, 0] + rng.random((20, 20)) * np.ptp(ranges, axis=1)
    return join_qpos(angles, position=rng.normal(size=(20, 3)), quaternion=rng.normal(size=(20, 4)))


def test_order():
    assert len(OPENXR_JOINTS) == len(set(OPENXR_JOINTS)) == 26
    assert {name: OPENXR_JOINTS.index(name) for name in NUMBERS} == NUMBERS


def test_forward_is_minus_z_to_the_next_joint(hand, rng):
    poses = dict(zip(OPENXR_JOINTS, joint_poses(hand, posed(hand, rng)).swapaxes(0, 1), strict=True))
    for chain in CHAINS:
        for near, far in itertools.pairwise(chain):
            way = poses[far][:, :3, 3] - poses[near][:, :3, 3]
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            np.testing.assert_allclose(-poses[near][:, :3, 2], way, atol=1e-9)
        np.testing.assert_array_equal(poses[chain[-1]][:, :3, :3], poses[chain[-2]][:, :3, :3])
    for pose in poses.values():
        np.testing.assert_allclose(np.linalg.det(pose[:, :3, :3]), 1.0, atol=1e-9)
        np.testing.assert_allclose(
            pose[:, :3, :3] @ pose[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-9
        )


def test_up_is_out_of_the_back_and_right_is_right(hand):
    """A flat hand on its palm, fingers ahead: its back is up, a right hand's little finger on the right."""
    poses = joint_poses(hand, join_qpos(np.zeros((1, 20))))[0]
    for name, pose in zip(OPENXR_JOINTS, poses, strict=True):
        if not name.startswith("THUMB"):
            assert pose[2, 1] > 0.85, name
            assert pose[1, 0] < -0.85, name  # +x to the right, where our -y is
    little = poses[OPENXR_JOINTS.index("LITTLE_PROXIMAL")] @ np.array([0, 0, 0, 1.0])
    in_palm = np.linalg.inv(poses[OPENXR_JOINTS.index("PALM")]) @ little
    assert (in_palm[0] > 0) == (hand.shape.side == "right")


def test_the_left_hand_is_the_mirror_image(rng):
    right, left = HandModel.named("L"), HandModel.named("L", side="left")
    qpos = join_qpos(rng.uniform(-0.2, 0.6, size=(5, 20)))
    ours, others = joint_poses(right, qpos), joint_poses(left, qpos)
    np.testing.assert_allclose(others[..., :3, 3], ours[..., :3, 3] @ MIRROR, atol=1e-12)
    flip = np.diag([-1.0, 1.0, 1.0])  # of x, as OpenXR's hands mirror each other
    np.testing.assert_allclose(others[..., :3, :3], MIRROR @ ours[..., :3, :3] @ flip, atol=1e-12)


def test_joints_that_both_have_are_in_the_same_places(hand, rng):
    qpos = posed(hand, rng)
    keypoints = hand_keypoints(hand, qpos)
    of_ours = ["WRIST", *(name for chain in CHAINS for name in chain[-4:])]
    places = joint_poses(hand, qpos)[:, [OPENXR_JOINTS.index(name) for name in of_ours]][..., :3, 3]
    assert len(of_ours) == len(KEYPOINT_NAMES)
    np.testing.assert_allclose(places, keypoints, atol=1e-12)


def test_radii_reach_the_skin(hand):
    """From each joint the skin is about as near as stated."""
    skin, joints = hand.surface.vertices, joint_poses(hand, join_qpos(np.zeros((1, 20))))[0, :, :3, 3]
    nearest = np.linalg.norm(skin[None] - joints[:, None], axis=2).min(axis=1)
    tips = np.array([name.endswith("TIP") for name in OPENXR_JOINTS])
    assert (nearest[~tips] < 1.35 * joint_radii(hand)[~tips]).all()
    assert nearest[tips].max() < 0.002  # our tips lie on the skin


def test_file(motion, tmp_path):
    path = tmp_path / "hands.openxr.json"
    write_openxr(path, motion)
    content = json.loads(path.read_text())
    assert tuple(content["joints"]) == OPENXR_JOINTS and len(content["frames"]) == motion.num_frames
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for frame, stored in enumerate(content["frames"]):
        assert stored["time"] == motion.times[frame]
        for hand in posed_hands(motion):
            rows = stored["hands"][hand.side]
            assert (rows is not None) == hand.present[frame]
            if rows is not None:
                expected, rows = joint_poses(hand.model, hand.qpos[frame : frame + 1])[0], np.array(rows)
                np.testing.assert_allclose(rows[:, :3], expected[:, :3, 3] @ up.T, atol=1e-7)
                found = Rotation.from_quat(rows[:, 3:]).as_matrix()
                np.testing.assert_allclose(found, up @ expected[:, :3, :3], atol=1e-6)
