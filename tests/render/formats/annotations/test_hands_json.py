"""JSON of clips; our hand, posed by UmeTrack's published formula, is where our kinematics has it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from handsim.hand.model import HandModel, hand_keypoints, join_qpos
from handsim.hand.shape import Side
from handsim.space.camera import Camera, Lens, camera_from_record, look_at
from handsim.space.transforms import axis_angle_matrix, quaternion_matrix, random_quaternions
from render.formats.annotations.common import to_json
from render.formats.annotations.hands_json import (
    camera_record,
    frame_record,
    hands_record,
    markers_record,
    umetrack_hand,
    umetrack_wrist,
)
from render.formats.annotations.joint_orders import to_order


def polynomial(kind: str, flat: np.ndarray, k: list[float]) -> np.ndarray:
    """The distortions that UmeTrack's tools publish, in their order of coefficients."""
    square = (flat**2).sum(axis=-1, keepdims=True)
    if kind == "PinholePlane":
        return flat
    if kind == "OculusVisionFishEye":
        return flat * (1 + k[0] * square + k[1] * square**2 + k[2] * square**3 + k[3] * square**4)
    x, y = flat[:, :1], flat[:, 1:]
    radial = 1 + k[0] * square + k[1] * square**2 + k[2] * square**3
    p1, p2 = k[3:]
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    return np.concatenate([bent_x, bent_y], axis=1)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(),
        Lens("brown", (0.1, -0.05, 0.01, -0.02, 0.03)),
        Lens("fisheye", (0.05, -0.01, 0.004, -0.001)),
    ],
)
def test_a_reader_projects_as_we_do(camera: Camera, lens: Lens, rng: np.random.Generator) -> None:
    bent = dataclasses.replace(camera, lens=lens)
    device = look_at(np.array([0.3, -0.4, 0.2]), np.zeros(3))
    record = json.loads(to_json(camera_record(bent, device)))
    pose, calibration = record["T_world_from_camera"], record["calibration"]
    points = rng.uniform(-0.2, 0.2, (20, 3))
    rotation = quaternion_matrix(np.array(pose["quaternion_wxyz"]))
    x, y, z = ((points - pose["translation_xyz"]) @ rotation).T
    flat = np.stack([x / z, y / z], axis=1)
    kind = calibration["projection_model_type"]
    if kind == "OculusVisionFishEye":
        across = np.hypot(x, y)
        flat = np.stack([x, y], axis=1) * (np.arctan2(across, z) / across)[:, None]
    fx, fy, cx, cy, *rest = calibration["projection_params"]
    window = polynomial(kind, flat, rest) * (fx, fy) + (cx, cy)
    np.testing.assert_allclose(window + 0.5, bent.project(points), atol=1e-9)
    assert "rgb" in calibration["label"]
    on_device = calibration["T_device_from_camera"]
    turned = device[:3, :3] @ quaternion_matrix(np.array(on_device["quaternion_wxyz"]))
    np.testing.assert_allclose(turned, rotation, atol=1e-9)
    eye = device[:3, :3] @ on_device["translation_xyz"] + device[:3, 3]
    np.testing.assert_allclose(eye, pose["translation_xyz"], atol=1e-9)
    assert camera_from_record(record["camera"]).record() == bent.record()


def test_hands_are_named_by_side_and_stream(make_frame, camera: Camera) -> None:
    other = dataclasses.replace(camera, name="other")
    views = [make_frame(4, ("left",), camera=view) for view in (camera, other)]
    record = json.loads(to_json(hands_record(views)))
    assert record["right"] is None
    hand = views[0].hands[0]
    assert set(record["left"]["pixels"]) == {"small", "other"}
    np.testing.assert_allclose(np.array(record["left"]["pixels"]["small"]) + 0.5, hand.keypoints, atol=1e-4)
    np.testing.assert_allclose(record["left"]["landmarks"][5], hand.keypoints_world[0], atol=1e-8)
    np.testing.assert_allclose(record["left"]["umetrack_pose"]["joint_angles"], hand.qpos[7:])
    pose = record["left"]["umetrack_pose"]["T_world_from_wrist"]
    np.testing.assert_allclose(pose["translation_xyz"], hand.qpos[:3])
    np.testing.assert_allclose(
        quaternion_matrix(np.array(pose["quaternion_wxyz"])),
        np.array(record["left"]["umetrack_pose"]["wrist_xform"])[:3, :3],
        atol=1e-12,
    )


def test_markers_raw_and_labeled(make_frame) -> None:
    frame = make_frame()
    record = json.loads(to_json(markers_record(frame)))
    np.testing.assert_allclose(record["points"], frame.points, atol=1e-8)
    assert record["labels"] == [1, 0, -1, 1]
    assert record["label_names"] == ["first", "second"]
    assert record["hands"][0]["marker_names"] == ["first", "second"]


def test_our_own_record_counts_from_the_corner(make_frame) -> None:
    frame = make_frame(away=True, sides=("right", "right"))  # here two of a side are welcome
    record = json.loads(to_json(frame_record(frame)))
    pixels = np.array(record["hands"][0]["pixels"], dtype=float)  # null becomes NaN
    np.testing.assert_allclose(pixels, frame.hands[0].keypoints, atol=1e-4)
    assert record["hands"][0]["box"] == [None] * 4
    assert record["choices"]["light"] == {"strength": 1.5, "direction": [0.0, 1.0, None]}


def bone_frames(record: dict, angles: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """17 skinning transforms: root, wrist, three a digit; hinges turn about axes through rest places."""
    axes, places = np.array(record["joint_rotation_axes"]), np.array(record["joint_rest_positions"])
    frames = [wrist, wrist]
    for digit in range(5):
        transform = wrist
        for place in range(4):
            joint = 4 * digit + place
            turn = np.eye(4)
            turn[:3, :3] = axis_angle_matrix(axes[joint], angles[joint])
            turn[:3, 3] = places[joint] - turn[:3, :3] @ places[joint]
            transform = transform @ turn
            if place > 0:
                frames.append(transform)
    return np.array(frames)


def skinned(points: np.ndarray, weights: np.ndarray, frames: np.ndarray) -> np.ndarray:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return np.einsum("vf,fij,vj->vi", weights, frames, homogeneous)[:, :3]


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_formula_poses_our_hand(side: Side, rng: np.random.Generator) -> None:
    model = HandModel.named("L", side=side)
    record = umetrack_hand(model.shape)
    angles = rng.uniform(-0.2, 1.0, (1, 20))
    spot, turn = rng.normal(size=(1, 3)), random_quaternions(1, rng=rng)
    qpos = join_qpos(angles, position=spot, quaternion=turn)
    wrist = umetrack_wrist(model.forward_kinematics(qpos)[0, 0])
    wrist[:3, 3] *= 1e3
    if side == "right":
        wrist[:, 0] *= -1.0
    frames = bone_frames(record, angles[0], wrist)
    weights = np.zeros((20, 17))
    weights[np.arange(20), np.ravel(record["landmark_rest_bone_indices"])] = 1.0
    landmarks = skinned(np.array(record["landmark_rest_positions"]), weights, frames)
    np.testing.assert_allclose(
        landmarks, 1e3 * to_order(hand_keypoints(model, qpos)[0], "umetrack"), atol=1e-3
    )
    vertices = skinned(np.array(record["mesh_vertices"]), np.array(record["dense_bone_weights"]), frames)
    np.testing.assert_allclose(vertices, 1e3 * model.skin(qpos)[0], atol=1e-2)  # [mm]


def test_both_sides_have_one_model() -> None:
    right, left = (umetrack_hand(HandModel.named("S", side=side).shape) for side in ("right", "left"))
    assert right == left
    assert len(right["joint_limits"]) == len(right["joint_parent"]) == 20
    assert right["joint_parent"][:5] == [-1, 0, 1, 2, -1]
    assert right["joint_next_sibling"][::4] == [4, 8, 12, 16, -1]
