"""The .bvh is read by forward kinematics of its own: offsets and rotations as the format states them."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from gloves.fit import nominal_fit
from gloves.takes.take import posed_motion
from handsim import HandModel, HandSimWarning, join_qpos
from handsim.errors import CaptureError
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import BONE_NAMES, DIGITS, JOINT_NAMES, named_shape
from handsim.motion_files.motion import (
    OPENXR_JOINTS,
    changes,
    corner_normals,
    joint_poses,
    joint_radii,
    read_joint_csv,
    split_vertices,
    write_bvh,
    write_joint_csv,
    write_mot,
)
from handsim.space.transforms import MIRROR
from tests.sentences import error_names

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Our world with z up in axes with y up."""
BACK = 0.01 * Y_UP.T
"""The file's centimeters with y up to our meters with z up."""
PARTS = ("METACARPAL", "PROXIMAL", "INTERMEDIATE", "DISTAL", "TIP")
CHAINS = [
    [f"{digit.upper()}_{part}" for part in PARTS if (digit, part) != ("thumb", "INTERMEDIATE")]
    for digit in DIGITS
]
NUMBERS = {
    "PALM": 0, "WRIST": 1, "THUMB_METACARPAL": 2, "THUMB_TIP": 5, "INDEX_METACARPAL": 6, "INDEX_TIP": 10,
    "MIDDLE_PROXIMAL": 12, "RING_DISTAL": 19, "LITTLE_METACARPAL": 21, "LITTLE_TIP": 25,
}  # fmt: skip
"""The extension's enumeration, from XR_HAND_JOINT_PALM_EXT = 0 to XR_HAND_JOINT_LITTLE_TIP_EXT = 25."""


def test_the_last_pose_is_held(motion):
    left = posed_motion(motion).hands[1]
    assert left.side == "left" and np.flatnonzero(~left.present).tolist() == [0, 1, 5, 6]
    np.testing.assert_array_equal(left.qpos[left.present], motion.qpos[left.present, 1])
    np.testing.assert_array_equal(left.qpos[[0, 1, 5, 6]], motion.qpos[[2, 2, 4, 4], 1])
    pen = posed_motion(motion).bodies[0]
    assert pen.shape is not None and np.flatnonzero(~pen.present).tolist() == [7, 8]
    np.testing.assert_array_equal(pen.T_world_body[[7, 8]], pen.T_world_body[[6, 6]])


def test_changes_are_where_something_appears_or_goes(motion):
    left = posed_motion(motion).hands[1]
    assert changes(left.present).tolist() == [0, 2, 5, 7]


def test_edges_of_a_box_stay_sharp():
    box = trimesh.creation.box()
    normals = corner_normals(box.vertices, box.faces)
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-12)
    vertices, outward, faces = split_vertices(box.faces, normals)
    assert len(vertices) == 24
    np.testing.assert_allclose(box.vertices[vertices][faces], box.vertices[box.faces])
    np.testing.assert_allclose(outward[faces], normals, atol=1e-12)


def test_a_ball_is_smooth():
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = corner_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices[ball.faces], atol=0.02)
    assert len(split_vertices(ball.faces, normals)[0]) == len(ball.vertices)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_row_per_frame_and_hand_holds_the_pose(motion, tmp_path):
    path = tmp_path / "joints.csv"
    write_joint_csv(path, posed_motion(motion))
    rows = rows_of(path)
    assert len(rows) == 2 * motion.num_frames
    for number, row in enumerate(rows):
        frame, hand = number // 2, posed_motion(motion).hands[number % 2]
        assert (int(row["frame"]), row["hand"]) == (frame, hand.side)
        assert float(row["time_s"]) == pytest.approx(motion.times[frame], abs=1e-6)
        if not hand.present[frame]:
            assert {row[key] for key in row if key not in ("frame", "time_s", "hand")} == {""}
            continue
        angles = [float(row[f"{joint}_rad"]) for joint in JOINT_NAMES]
        wrist = [float(row[f"wrist_{part}"]) for part in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
        np.testing.assert_allclose([*wrist, *angles], hand.qpos[frame], rtol=1e-8, atol=1e-9)
        found = [[float(row[f"{keypoint}_{axis}_m"]) for axis in "xyz"] for keypoint in KEYPOINT_NAMES]
        expected = hand_keypoints(hand.model, hand.qpos[frame : frame + 1])[0]
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def test_what_was_written_is_read(motion, tmp_path):
    path = tmp_path / "poses.csv"
    write_joint_csv(path, posed_motion(motion))
    table = read_joint_csv(path)
    assert table.sides == ("right", "left")
    np.testing.assert_allclose(table.times, motion.times, atol=1e-6)
    np.testing.assert_allclose(table.qpos, motion.qpos, rtol=1e-8, atol=1e-9)  # NaN where ours are


@pytest.mark.parametrize("start", [0.0, 86_400.0, 1.7e9])
def test_times_of_any_clock_are_kept(motion, tmp_path, start):
    path, late = tmp_path / "poses.csv", dataclasses.replace(motion, times=motion.times + start)
    write_joint_csv(path, posed_motion(late))
    np.testing.assert_allclose(np.diff(read_joint_csv(path).times), np.diff(motion.times), atol=3e-6)


def test_names_of_earlier_versions_are_read(motion, tmp_path):
    path = tmp_path / "poses.csv"
    write_joint_csv(path, posed_motion(motion))
    path.write_text(path.read_text().replace("thumb_metacarpal_", "thumb_CMC_"))
    np.testing.assert_allclose(read_joint_csv(path).qpos, motion.qpos, rtol=1e-8, atol=1e-9)


def test_angles_of_the_isb_stand_beside_the_models(motion, tmp_path):
    path, between = tmp_path / "joints.csv", (motion.times[2], motion.times[4])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)  # the hand moves
        motion.export(path, neutral=between)
        wanted = motion.angles("right", convention="isb", neutral=between)
    assert read_joint_csv(path).qpos.shape == motion.qpos.shape
    rows = [row for row in rows_of(path) if row["hand"] == "right"]
    for joint, values in wanted.items():
        found = [float(row[f"{joint}_isb_neutral_rad"]) for row in rows]
        np.testing.assert_allclose(found, values, atol=1e-8)


def test_columns_may_come_in_any_order_and_be_more_or_fewer(motion, tmp_path):
    write_joint_csv(tmp_path / "poses.csv", posed_motion(motion))
    with (tmp_path / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in reversed(rows[0]) if not name.startswith(("thumb_tip", "index_MCP_x"))]
    with (tmp_path / "other.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*names, "note"], extrasaction="ignore", restval="ours, or not")
        writer.writeheader()
        writer.writerows(row for row in rows if row["hand"] == "left")
    table = read_joint_csv(tmp_path / "other.csv")
    assert table.sides == ("left",)
    np.testing.assert_allclose(table.qpos[:, 0], motion.qpos[:, 1], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("wrist_qw", "wrist_w", "no column 'wrist_qw'; of a .csv are read frame, time_s, hand, wrist_x_m to"),
        ("0,100,right", "0,100,both", "line 2: unknown hand 'both'; valid names: left, right"),
        ("0,100,left", "0,100,right", "line 3 has frame 0 of the right hand again"),
        ("0,100,right,", "0,100,right,1 m", "line 2: could not convert string to float: '1 m"),
    ],
)
def test_what_cannot_be_read_is_told(motion, tmp_path, old, new, words):
    path = tmp_path / "poses.csv"
    write_joint_csv(path, posed_motion(motion))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with error_names(CaptureError, words):
        read_joint_csv(path)


def test_header_and_angles(motion, tmp_path):
    path = tmp_path / "hands.mot"
    write_mot(path, posed_motion(motion))
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    stated = dict(line.split("=") for line in lines[1:end])
    names = lines[end + 1].split("\t")
    table = np.array([line.split("\t") for line in lines[end + 2 :]], dtype=float)
    assert lines[0] == "hands" and stated["version"] == "1" and stated["inDegrees"] == "yes"
    assert stated["convention"] == "model"
    assert (int(stated["nRows"]), int(stated["nColumns"])) == table.shape == (len(table), len(names))
    columns = dict(zip(names, table.T, strict=True))
    np.testing.assert_allclose(columns["time"], posed_motion(motion).seconds, atol=1e-8)
    for number, hand in enumerate(motion.hands):
        qpos = (
            posed_motion(motion).hands[number].qpos
        )  # without a pose it keeps the last one: OpenSim takes no NaN
        assert np.isnan(motion.qpos[:, number]).any() == (hand.side == "left")
        angles = np.stack([columns[f"{hand.side}_{joint}"] for joint in JOINT_NAMES], axis=1)
        np.testing.assert_allclose(np.deg2rad(angles), qpos[:, 7:], atol=1e-9)
        place = np.stack([columns[f"{hand.side}_wrist_t{axis}"] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(place @ Y_UP, qpos[:, :3], atol=1e-8)
        turns = np.stack([columns[f"{hand.side}_wrist_r{axis}"] for axis in "xyz"], axis=1)
        expected = Rotation.from_matrix(Y_UP) * Rotation.from_quat(qpos[:, 3:7], scalar_first=True)
        error = Rotation.from_euler("XYZ", turns, degrees=True).inv() * expected
        assert error.magnitude().max() < 1e-8


def read_bvh(path):
    """Positions (T, 3) of joints and end sites [m] in our world, rate [Hz], and orientations in the file."""
    head, body = path.read_text("ascii").split("MOTION\n")
    frames, step, *rows = body.splitlines()
    table = np.array([row.split() for row in rows], dtype=float)
    assert frames == f"Frames: {len(table)}"
    words, column = iter(head.split()), 0
    assert next(words) == "HIERARCHY"
    positions, rotations, offsets, trail, channels = {}, {}, {}, [], []
    for word in words:
        if word in ("ROOT", "JOINT", "End"):
            name = next(words)
            trail.append(name if word != "End" else f"{trail[-1]}_end")
        elif word == "OFFSET":
            offsets[trail[-1]] = np.array([next(words) for _ in range(3)], dtype=float)
            above = trail[-2] if len(trail) > 1 else None
            place = np.zeros(3) if above is None else positions[above]
            turn = Rotation.identity() if above is None else rotations[above]
            positions[trail[-1]] = place + turn.apply(np.tile(offsets[trail[-1]], (len(table), 1)))
            rotations[trail[-1]] = turn
        elif word == "CHANNELS":
            names = [next(words) for _ in range(int(next(words)))]
            values = dict(zip(names, table[:, column : column + len(names)].T, strict=True))
            column += len(names)
            channels += names
            if "Xposition" in values:
                shift = np.stack([values[f"{axis}position"] for axis in "XYZ"], axis=1)
                above = trail[-2] if len(trail) > 1 else None  # a position stands for the offset
                positions[trail[-1]] = shift if above is None else place + rotations[above].apply(shift)
            angles = np.stack([values[name] for name in names if name.endswith("rotation")], axis=1)
            order = "".join(name[0] for name in names if name.endswith("rotation"))
            own = Rotation.from_euler(order, angles, degrees=True)
            rotations[trail[-1]] = rotations[trail[-1]] * own
        elif word == "}":
            trail.pop()
    assert column == table.shape[1]
    angles = table[:, [name.endswith("rotation") for name in channels]]
    rate = 1.0 / float(step.removeprefix("Frame Time: "))
    return {name: place @ BACK.T for name, place in positions.items()}, rate, rotations, angles


def test_joints_and_things_are_where_ours_are(motion, tmp_path):
    write_bvh(tmp_path / "hands.bvh", posed_motion(motion))
    positions, rate, rotations, _ = read_bvh(tmp_path / "hands.bvh")
    assert abs(rate - 60.0) < 1e-5
    for hand in posed_motion(motion).hands:  # without a pose it keeps the last one
        bones, tips = hand.model.forward_kinematics(hand.qpos), hand_keypoints(hand.model, hand.qpos)
        for number, bone in enumerate(BONE_NAMES):
            np.testing.assert_allclose(positions[f"{hand.side}_{bone}"], bones[:, number, :3, 3], atol=1e-7)
        for number, digit in enumerate(DIGITS):
            found = positions[f"{hand.side}_{digit}_distal_end"]
            np.testing.assert_allclose(found, tips[:, 4 * number + 4], atol=1e-7)
    turn = 100.0 * BACK.T
    for thing, name in zip(posed_motion(motion).bodies, ("pen", "my_wand"), strict=True):
        np.testing.assert_allclose(positions[name], thing.T_world_body[:, :3, 3], atol=1e-7)
        expected = turn @ thing.T_world_body[:, :3, :3] @ turn.T
        np.testing.assert_allclose(rotations[name].as_matrix(), expected, atol=1e-7)


def test_zero_rotations_are_the_flat_hand(motion, tmp_path):
    rigid = [nominal_fit("dense19", "M", side) for side in motion.sides]  # an arch has positions, too
    motion = dataclasses.replace(motion, hands=rigid)
    write_bvh(tmp_path / "hands.bvh", posed_motion(motion))
    path = tmp_path / "rest.bvh"
    head, _ = (tmp_path / "hands.bvh").read_text().split("MOTION\n")
    columns = head.count("rotation") + head.count("position")
    path.write_text(head + "MOTION\nFrames: 1\nFrame Time: 1\n" + "0 " * columns + "\n")
    positions = read_bvh(path)[0]
    for hand in posed_motion(motion).hands:
        rest = hand.model.rest_transforms
        for number, bone in enumerate(BONE_NAMES):
            np.testing.assert_allclose(positions[f"{hand.side}_{bone}"][0], rest[number, :3, 3], atol=1e-7)


def test_angles_do_not_jump(motion, tmp_path):
    """No channel turns by more than half a turn between frames, also where it passes 180 degrees."""
    write_bvh(tmp_path / "hands.bvh", posed_motion(motion.poses_alone(960.0)))
    assert np.abs(np.diff(read_bvh(tmp_path / "hands.bvh")[3], axis=0)).max() < 180.0 + 1e-6


@pytest.fixture(params=["right", "left", "arched"])
def hand(request):
    if request.param == "arched":
        return HandModel(dataclasses.replace(named_shape("M"), arch=[0.1, 0.5]))
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
