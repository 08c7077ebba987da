"""Bones and joint axes of a hand at zero angles, for either side, and where its bones are in many poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.shape import BONES, JOINTS, NUM_BONES, HandShape
from handsim.kernels import pose_bones
from handsim.space.transforms import MIRROR, euler_matrix

_MOVED_BONES: Final = [joint.bone for joint in JOINTS]  # in the order of the bones
_CHAIN: Final = np.array([(bone.parent, _MOVED_BONES.count(number)) for number, bone in enumerate(BONES)])
"""Parent of each bone, and how many joints move it."""


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Rest transforms of the bones relative to their parents, joint axes, and bone lengths."""

    offsets: Float[np.ndarray, "L 3"]
    """Origin of each bone in its parent's frame [m]; zero for the palm."""
    rotations: Float[np.ndarray, "L 3 3"]
    """Orientation of each bone in its parent's frame at zero angles."""
    axes: Float[np.ndarray, "J 3"]
    """Unit joint axes in the frames of the bones they move."""
    ranges: Float[np.ndarray, "J 2"]
    """Lowest and highest angle of each joint [rad]."""
    lengths: Float[np.ndarray, "L"]
    """Length of each bone along its x axis [m]; for the palm, wrist to the middle knuckle."""

    def rest_transforms(self) -> Float[np.ndarray, "L 4 4"]:
        """`T_wrist_bone` of every bone at zero angles."""
        transforms = np.tile(np.eye(4), (NUM_BONES, 1, 1))
        for number, bone in enumerate(BONES):
            if bone.parent >= 0:
                local = np.eye(4)
                local[:3, :3], local[:3, 3] = self.rotations[number], self.offsets[number]
                transforms[number] = transforms[bone.parent] @ local
        return transforms


def build_skeleton(shape: HandShape) -> Skeleton:
    """Skeleton of a hand; a left hand is the mirror image, so equal angles give mirrored poses."""
    offsets, rotations = np.zeros((NUM_BONES, 3)), np.tile(np.eye(3), (NUM_BONES, 1, 1))
    lengths = np.zeros(NUM_BONES)
    lengths[0] = shape.knuckles[2, 0]
    digits = euler_matrix(shape.base_angles)
    for number, bone in enumerate(BONES):
        if bone.digit < 0:
            continue
        index = (number - 1) % 3
        lengths[number] = shape.bone_lengths[bone.digit, index]
        if index == 0:
            offsets[number] = shape.knuckles[bone.digit]
            rotations[number] = digits[bone.digit]
        else:
            offsets[number, 0] = shape.bone_lengths[bone.digit, index - 1]
    axes = np.array([joint.axis for joint in JOINTS])
    if shape.side == "left":
        offsets, rotations = offsets @ MIRROR, MIRROR @ rotations @ MIRROR
        axes = -axes @ MIRROR  # a mirrored rotation has the opposite sense
    ranges = np.deg2rad([(joint.low, joint.high) for joint in JOINTS])
    return Skeleton(offsets, rotations, axes, ranges, lengths)


def bone_transforms(skeleton: Skeleton, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 4 4"]:
    """`T_world_bone` of every bone in every frame.

    Args:
        qpos: Wrist position [m], wrist orientation (wxyz, normalized here), joint angles [rad].
    """
    transforms: NDArray[np.float64] = pose_bones(
        np.ascontiguousarray(qpos), skeleton.offsets, skeleton.rotations, skeleton.axes, _CHAIN
    )
    return transforms
