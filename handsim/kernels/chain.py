"""Forward kinematics of the hand's chain of bones, compiled: whole hands, and single digits."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import (
    multiply_rotations,
    rotate_about_axis,
    write_axis_angle_matrix,
    write_quaternion_matrix,
)


@kernel
def pose_bones(
    qpos: Float[np.ndarray, "T 27"],
    offsets: Float[np.ndarray, "L 3"],
    rotations: Float[np.ndarray, "L 3 3"],
    axes: Float[np.ndarray, "J 3"],
    chain: Int[np.ndarray, "L 2"],
) -> Any:
    """`T_world_bone` (T, L, 4, 4) of every bone in every frame, in one pass down the chain.

    Args:
        qpos: Wrist position [m], wrist orientation (wxyz, normalized here), joint angles [rad].
        offsets: Origin of each bone in its parent's frame [m].
        rotations: Orientation of each bone in its parent's frame at zero angles.
        axes: Unit axis of each joint in the frame of the bone that it moves.
        chain: Parent of each bone, and how many joints move it; parents come first, joints go by bones.
    """
    transforms = np.zeros((len(qpos), len(chain), 4, 4))
    rotation = np.empty((3, 3))
    for frame in range(len(qpos)):
        pose = transforms[frame]
        w, x, y, z = qpos[frame, 3], qpos[frame, 4], qpos[frame, 5], qpos[frame, 6]
        scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        write_quaternion_matrix(pose[0], w * scale, x * scale, y * scale, z * scale)
        for i in range(3):
            pose[0, i, 3] = qpos[frame, i]
        pose[0, 3, 3] = 1.0
        joint = 0
        for bone in range(1, len(chain)):
            parent, own = pose[chain[bone, 0]], pose[bone]
            for i in range(3):
                own[i, 3] = parent[i, 3]
                for j in range(3):
                    own[i, 3] += parent[i, j] * offsets[bone, j]
            own[3, 3] = 1.0
            multiply_rotations(parent, rotations[bone], own)
            for _ in range(chain[bone, 1]):
                write_axis_angle_matrix(rotation, axes[joint], qpos[frame, 7 + joint])
                multiply_rotations(own, rotation, own)
                joint += 1
    return transforms


@kernel
def pose_digit_axes(wrist: Any, angles: Any, digit: Any, posed: Any, scratch: Any) -> None:
    """Write the capsule axes of one digit: the forward kinematics of `pose_bones` for three bones.

    Args:
        wrist: The wrist's orientation (3, 3) and position (3,) [m] in the world.
        angles: The digit's joint angles (4,) [rad]: two at its first bone, one at each further one.
        digit: A tuple with the fields `offsets` (3, 3) [m], `rotations` (3, 3, 3) and `axes` (4, 3) of the
            digit's bones and joints as `pose_bones` takes them, and `ends` (3, 2, 3), both ends of each
            bone's capsule in the bone's frame [m].
        posed: Where the axes' ends in the world go (3, 2, 3) [m].
        scratch: Room for the arithmetic (4, 3).
    """
    frame, origin = scratch[:3], scratch[3]
    frame[:] = wrist[0]
    origin[:] = wrist[1]
    joint = 0
    for bone in range(3):
        for row in range(3):
            for column in range(3):
                origin[row] += frame[row, column] * digit.offsets[bone, column]
        multiply_rotations(frame, digit.rotations[bone], frame)
        for _ in range(2 if bone == 0 else 1):
            rotate_about_axis(frame, digit.axes[joint], angles[joint])
            joint += 1
        for end in range(2):
            for row in range(3):
                posed[bone, end, row] = origin[row]
                for column in range(3):
                    posed[bone, end, row] += frame[row, column] * digit.ends[bone, end, column]
