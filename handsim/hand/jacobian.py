"""Jacobian of skinned points with respect to the hand's 26 degrees of freedom, batched over frames."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.topology import BONES, JOINTS, NUM_BONES, NUM_JOINTS

NUM_VELOCITIES: Final = 6 + NUM_JOINTS
"""MuJoCo's nv: wrist velocity in the world, wrist angular velocity in its own frame, joint rates."""


def _moved_bones() -> NDArray[np.bool_]:
    """Which bones (J, L) each joint moves: its own and all beyond it."""
    moved = np.zeros((NUM_JOINTS, NUM_BONES), dtype=bool)
    for number, joint in enumerate(JOINTS):
        for bone in range(NUM_BONES):
            ancestor = bone
            while ancestor >= 0 and ancestor != joint.bone:
                ancestor = BONES[ancestor].parent
            moved[number, bone] = ancestor == joint.bone
    return moved


_MOVED: Final = _moved_bones()
# The first joint of a bone rotates about an axis fixed in the parent, a second one about its own bone's.
_FIRST: Final = np.array([n == 0 or JOINTS[n - 1].bone != joint.bone for n, joint in enumerate(JOINTS)])
_BONE: Final = np.array([joint.bone for joint in JOINTS])
_PARENT: Final = np.array([BONES[joint.bone].parent for joint in JOINTS])


def joint_axes(
    model: HandModel, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3"]]:
    """Unit axes and anchors [m] of all joints in the world."""
    skeleton = model.skeleton
    parent = T_world_bone[:, _PARENT, :3, :3] @ skeleton.rotations[_BONE]
    own = T_world_bone[:, _BONE, :3, :3]
    frames = np.where(_FIRST[:, None, None], parent, own)
    return np.einsum("tjab,jb->tja", frames, skeleton.axes), T_world_bone[:, _BONE][..., :3, 3]


def skinned_jacobian(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    bone_indices: Int[np.ndarray, "M 4"],
    bone_weights: Float[np.ndarray, "M 4"],
) -> Float[np.ndarray, "T M 3 26"]:
    """Derivative of skinned points [m] with respect to MuJoCo's velocities (`NUM_VELOCITIES`).

    Args:
        T_world_bone: Its bones, from `forward_kinematics`.
        points: Rest positions in the wrist frame [m].
    """
    frames, count = len(T_world_bone), len(points)
    motion = T_world_bone @ np.linalg.inv(model.rest_transforms)
    homogeneous = np.concatenate([points, np.ones((count, 1))], axis=1)
    carried = np.einsum("tmkij,mj->tmki", motion[:, bone_indices, :3], homogeneous)  # by each bone alone
    placed = np.einsum("mk,tmki->tmi", bone_weights, carried)
    jacobian = np.zeros((frames, count, 3, NUM_VELOCITIES))
    jacobian[..., :3] = np.eye(3)
    wrist = T_world_bone[:, 0]
    turning = np.swapaxes(wrist[:, :3, :3], 1, 2)  # rows are the wrist's own axes in the world
    arms = placed - wrist[:, None, :3, 3]
    jacobian[..., 3:6] = np.cross(turning[:, None], arms[:, :, None]).swapaxes(-1, -2)
    axes, anchors = joint_axes(model, T_world_bone)
    # A joint moves the share of a point that its bones carry: axis x (sum of w (p - anchor)).
    shares = bone_weights * _MOVED[:, bone_indices]  # (J, M, 4)
    lever = np.einsum("jmk,tmki->tmji", shares, carried)
    lever -= shares.sum(-1).T[..., None] * anchors[:, None]
    jacobian[..., 6:] = np.cross(axes[:, None], lever).swapaxes(-1, -2)
    return jacobian
