from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim import Camera, HandModel, Lens, join_qpos, look_at
from handsim.hand.model import hand_keypoints
from handsim.hand.shape import Side
from handsim.space.camera import pinhole
from handsim.space.transforms import axis_angle_matrix, quaternion_matrix, random_quaternions
from render.formats.records import UMETRACK_JOINTS, to_json
from render.formats.webdataset import (
    camera_record,
    crop_camera,
    crops_record,
    frame_record,
    hands_record,
    markers_record,
    umetrack_hand,
    umetrack_wrist,
)

PIXELS = 128


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
    [Lens(), Lens("brown", (0.1, -0.05, 0.01, -0.02, 0.03)), Lens("fisheye", (0.05, -0.01, 0.004, -0.001))],
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
    assert Camera(**record["camera"]).record() == bent.record()


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
    np.testing.assert_allclose(landmarks, 1e3 * hand_keypoints(model, qpos)[0, UMETRACK_JOINTS], atol=1e-3)
    vertices = skinned(np.array(record["mesh_vertices"]), np.array(record["dense_bone_weights"]), frames)
    np.testing.assert_allclose(vertices, 1e3 * model.skin(qpos)[0], atol=1e-2)  # [mm]


def test_both_sides_have_one_model() -> None:
    right, left = (umetrack_hand(HandModel.named("S", side=side).shape) for side in ("right", "left"))
    assert right == left
    assert len(right["joint_limits"]) == len(right["joint_parent"]) == 20
    assert right["joint_parent"][:5] == [-1, 0, 1, 2, -1]
    assert right["joint_next_sibling"][::4] == [4, 8, 12, 16, -1]


def pixels_in_crop(entry: dict, points: np.ndarray) -> np.ndarray:
    """Where the crop's picture has points of the world; NaN behind it."""
    pose = entry["T_world_from_crop_camera"]
    rotation = quaternion_matrix(np.array(pose["quaternion_wxyz"]))
    x, y, z = ((points - pose["translation_xyz"]) @ rotation).T
    focal = PIXELS / 2 / np.tan(entry["crop_camera_fov"] / 2)
    pixels = np.stack([x / z, y / z], axis=1) * focal + (PIXELS - 1) / 2
    return np.where(z[:, None] > 0, pixels, np.nan)


def test_each_seen_hand_has_a_crop_in_each_stream(make_frame, camera: Camera) -> None:
    other = dataclasses.replace(camera, name="other").at(look_at(np.array([0.1, -0.5, -0.3]), np.zeros(3)))
    frames = [make_frame(3, ("right", "left"), camera=view) for view in (camera, other)]
    record = json.loads(to_json(crops_record(frames)))
    for frame in frames:
        for hand in frame.hands:
            entry = record[hand.shape.side][frame.camera.name]
            pixels = pixels_in_crop(entry, hand.keypoints_world)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            np.testing.assert_allclose((low + high) / 2, (PIXELS - 1) / 2, atol=0.01)  # in the middle
            np.testing.assert_allclose((high - low).max(), 0.8 * PIXELS, atol=0.01)  # with room around
            np.testing.assert_allclose(
                entry["T_world_from_crop_camera"]["translation_xyz"], frame.camera.T_world_camera[:3, 3]
            )


def test_hands_that_are_not_seen_have_none(make_frame) -> None:
    assert crops_record([make_frame(away=True)]) == {"left": {}, "right": {}}


@given(
    spot=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.3, 1.5)),
    spread=st.floats(0.01, 0.1),
    seed=st.integers(0, 99),
)
def test_all_points_are_inside_wherever_the_hand_is(
    spot: tuple[float, float, float], spread: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    camera = pinhole("c", (64, 48), 60.0, (32.0, 24.0)).at(look_at(rng.normal(size=3), rng.normal(size=3)))
    local = np.array(spot) + rng.uniform(-spread, spread, (21, 3))
    points = local @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    crop = crop_camera(camera, points)
    assert crop is not None
    T_world_crop, angle = crop
    np.testing.assert_allclose(T_world_crop[:3, :3] @ T_world_crop[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T_world_crop[:3, :3]) > 0
    turned = (points - T_world_crop[:3, 3]) @ T_world_crop[:3, :3]
    angles = np.arctan2(np.abs(turned[:, :2]).max(axis=1), turned[:, 2])
    assert angles.max() < angle / 2
    # Level as the stream's camera: the crop's x axis has no part along the camera's y axis.
    assert abs(T_world_crop[:3, 0] @ camera.T_world_camera[:3, 1]) < 1e-9


@pytest.mark.parametrize("spot", [(0.0, 0.0, -0.4), (0.0, 0.0, 0.01), (0.0, 0.4, 0.0)])
def test_hands_behind_and_around_the_camera_have_none(camera: Camera, spot: tuple[float, ...]) -> None:
    local = np.array(spot) + np.random.default_rng(0).uniform(-0.08, 0.08, (21, 3))
    local -= (0.0, 0.0, 1e-9 + max(0.0, local[:, 2].mean())) if spot[1] else 0.0
    points = local @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    assert crop_camera(camera, points) is None
