"""Our hand as a UmeTrack hand model: the JSON that UmeTrack's and HOT3D's tools pose, skin and draw.

UmeTrack describes left hands and mirrors them in its x axis for right ones; ours are mirrored in y. Its wrist
frame is therefore ours rotated by 90 degrees about z. Like ours it has four joint angles per
digit and equal angles for mirrored poses, so that our angles are its angles.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.keypoints import KEYPOINT_DIGITS, hand_keypoints
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import HandShape
from handsim.hand.topology import JOINTS, NUM_BONES, NUM_JOINTS
from render.formats.annotations.common import rounded
from render.formats.annotations.joint_orders import joint_order, to_order

# Our wrist frame seen from UmeTrack's.
_UMETRACK_FROM_OURS: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_JOINTS_PER_DIGIT: Final = 4
_ROOT_FRAMES: Final = 1  # a root that moves with the wrist comes before our bones


def umetrack_wrist(T_world_wrist: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """`T_world_from_wrist` of a hand whose wrist is there."""
    pose: NDArray[np.float64] = np.array(T_world_wrist, dtype=np.float64)
    pose[:3, :3] = pose[:3, :3] @ _UMETRACK_FROM_OURS.T
    return pose


def umetrack_hand(shape: HandShape) -> dict[str, Any]:
    """The hand model of a person, the same for both sides; lengths in millimeters, as UmeTrack has them."""
    model = HandModel(shape.with_side("left"))
    bones = [joint.bone for joint in JOINTS]
    rest = model.rest_transforms[bones]
    axes = np.einsum("jab,jb->ja", rest[:, :3, :3], model.skeleton.axes)
    step = np.arange(NUM_JOINTS) % _JOINTS_PER_DIGIT
    numbers = np.arange(NUM_JOINTS)
    next_digit = numbers + _JOINTS_PER_DIGIT
    surface = model.surface
    weights = np.zeros((len(surface.vertices), _ROOT_FRAMES + NUM_BONES))
    np.add.at(
        weights, (np.arange(len(weights))[:, None], surface.bone_indices + _ROOT_FRAMES), surface.bone_weights
    )
    landmarks = to_order(hand_keypoints(model, join_qpos(np.zeros((1, NUM_JOINTS))))[0], "umetrack")
    return {
        "joint_rotation_axes": rounded(axes @ _UMETRACK_FROM_OURS.T, 8),
        "joint_rest_positions": rounded(1e3 * rest[:, :3, 3] @ _UMETRACK_FROM_OURS.T, 5),
        "joint_frame_index": [_ROOT_FRAMES + bone for bone in bones],
        "joint_parent": np.where(step == 0, -1, numbers - 1).tolist(),
        "joint_first_child": np.where(step == _JOINTS_PER_DIGIT - 1, -1, numbers + 1).tolist(),
        "joint_next_sibling": np.where((step == 0) & (next_digit < NUM_JOINTS), next_digit, -1).tolist(),
        "landmark_rest_positions": rounded(1e3 * landmarks @ _UMETRACK_FROM_OURS.T, 5),
        "landmark_rest_bone_weights": [[1.0]] * len(landmarks),
        "landmark_rest_bone_indices": [[_ROOT_FRAMES + _bone(joint)] for joint in joint_order("umetrack")],
        "mesh_vertices": rounded(1e3 * surface.vertices @ _UMETRACK_FROM_OURS.T, 4),
        "mesh_triangles": surface.faces.tolist(),
        "dense_bone_weights": rounded(weights, 6),
        "joint_limits": rounded(model.skeleton.ranges, 6),
    }


def _bone(keypoint: int) -> int:
    """The bone that a keypoint is fixed to: the one that begins there, for a tip the last."""
    digit = KEYPOINT_DIGITS[keypoint]
    return 0 if digit < 0 else 1 + 3 * digit + min((keypoint - 1) % 4, 2)
