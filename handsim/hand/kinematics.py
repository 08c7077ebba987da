"""Where a hand's bones are in many poses."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.skeleton import Skeleton
from handsim.hand.topology import BONES, JOINTS
from handsim.kernels.chain import pose_bones

_MOVED_BONES: Final = [joint.bone for joint in JOINTS]  # in the order of the bones
_CHAIN: Final = np.array([(bone.parent, _MOVED_BONES.count(number)) for number, bone in enumerate(BONES)])
"""Parent of each bone, and how many joints move it."""


def bone_transforms(skeleton: Skeleton, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 4 4"]:
    """`T_world_bone` of every bone in every frame.

    Args:
        skeleton: The hand's bones.
        qpos: Wrist position [m], wrist orientation (wxyz, normalized here), joint angles [rad].
    """
    transforms: NDArray[np.float64] = pose_bones(
        np.ascontiguousarray(qpos), skeleton.offsets, skeleton.rotations, skeleton.axes, _CHAIN
    )
    return transforms
