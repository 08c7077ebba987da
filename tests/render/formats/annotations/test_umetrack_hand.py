"""Our hand, posed as UmeTrack's published formula poses hands, is where our own kinematics has it."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.keypoints import hand_keypoints
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import Side
from handsim.space.transforms import axis_angle_matrix, random_quaternions
from render.formats.annotations.joint_orders import to_order
from render.formats.annotations.umetrack_hand import umetrack_hand, umetrack_wrist


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
