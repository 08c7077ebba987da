"""The .bvh is read by forward kinematics of its own: offsets and rotations as the format states them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from handsim.hand.model import hand_keypoints
from handsim.hand.shape import BONE_NAMES, DIGITS
from handsim.motion_files.joint_files import write_bvh
from handsim.motion_files.motion import posed_bodies, posed_hands

BACK = 0.01 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The file's centimeters with y up to our meters with z up."""


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
                base = rotations[trail[-2]].apply(shift) if len(trail) > 1 else shift
                positions[trail[-1]] = positions[trail[-1]] + base
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


def test_joints_are_where_ours_are(motion, tmp_path):
    write_bvh(tmp_path / "hands.bvh", motion)
    positions, rate, _, _ = read_bvh(tmp_path / "hands.bvh")
    assert abs(rate - 60.0) < 1e-5
    for hand in posed_hands(motion):
        bones, tips = (
            hand.model.forward_kinematics(hand.qpos),
            hand_keypoints(hand.model, hand.qpos),
        )
        for number, bone in enumerate(BONE_NAMES):
            np.testing.assert_allclose(positions[f"{hand.side}_{bone}"], bones[:, number, :3, 3], atol=1e-7)
        for number, digit in enumerate(DIGITS):
            found = positions[f"{hand.side}_{digit}_distal_end"]
            np.testing.assert_allclose(found, tips[:, 4 * number + 4], atol=1e-7)


def test_a_hand_without_a_pose_keeps_the_last_one(motion, tmp_path):
    write_bvh(tmp_path / "hands.bvh", motion)
    place = read_bvh(tmp_path / "hands.bvh")[0]["left_index_distal"]
    for frame, shown in ((0, 2), (1, 2), (5, 4), (6, 4)):
        np.testing.assert_array_equal(place[frame], place[shown])


def test_things_are_where_ours_are(motion, tmp_path):
    write_bvh(tmp_path / "hands.bvh", motion)
    positions, _, rotations, _ = read_bvh(tmp_path / "hands.bvh")
    for thing, name in zip(posed_bodies(motion), ("pen", "my_wand"), strict=True):
        np.testing.assert_allclose(positions[name], thing.T_world_body[:, :3, 3], atol=1e-7)
        turn = 100.0 * BACK.T
        expected = turn @ thing.T_world_body[:, :3, :3] @ turn.T
        np.testing.assert_allclose(rotations[name].as_matrix(), expected, atol=1e-7)


def test_zero_rotations_are_the_flat_hand(motion, tmp_path):
    write_bvh(tmp_path / "hands.bvh", motion)
    path = tmp_path / "rest.bvh"
    head, _ = (tmp_path / "hands.bvh").read_text().split("MOTION\n")
    columns = head.count("rotation") + head.count("position")
    path.write_text(head + "MOTION\nFrames: 1\nFrame Time: 1\n" + "0 " * columns + "\n")
    positions = read_bvh(path)[0]
    for hand in posed_hands(motion):
        rest = hand.model.rest_transforms
        for number, bone in enumerate(BONE_NAMES):
            np.testing.assert_allclose(positions[f"{hand.side}_{bone}"][0], rest[number, :3, 3], atol=1e-7)


def test_angles_do_not_jump(motion, tmp_path):
    """No channel turns by more than half a turn between frames, also where it passes 180 degrees."""
    write_bvh(tmp_path / "hands.bvh", motion.poses_alone(960.0))
    assert np.abs(np.diff(read_bvh(tmp_path / "hands.bvh")[3], axis=0)).max() < 180.0 + 1e-6
