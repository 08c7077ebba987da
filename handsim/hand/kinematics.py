"""Where the bones of many poses are, compiled: one pass down the chain a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np

from handsim.hand.skeleton import Skeleton
from handsim.hand.topology import BONES, JOINTS

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_HINGES: Final = [joint.bone for joint in JOINTS]  # in the order of the bones
_CHAIN: Final = np.array([(bone.parent, _HINGES.count(number)) for number, bone in enumerate(BONES)])
"""Parent of each bone, and how many hinges move it."""


def bone_transforms(skeleton: Skeleton, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 4 4"]:
    """`T_world_bone` of every bone in every frame, quaternions normalized first."""
    transforms: NDArray[np.float64] = _chain(
        np.ascontiguousarray(qpos), skeleton.offsets, skeleton.rotations, skeleton.axes, _CHAIN
    )
    return transforms


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _chain(qpos: Any, offsets: Any, rotations: Any, axes: Any, chain: Any) -> Any:
    transforms = np.zeros((len(qpos), len(chain), 4, 4))
    turn = np.empty((3, 3))
    for frame in range(len(qpos)):
        pose = transforms[frame]
        w, x, y, z = qpos[frame, 3], qpos[frame, 4], qpos[frame, 5], qpos[frame, 6]
        scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        _write_turn(pose[0], w * scale, x * scale, y * scale, z * scale)
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
            _multiply(parent, rotations[bone], own)
            for _ in range(chain[bone, 1]):
                sine, cosine = np.sin(0.5 * qpos[frame, 7 + joint]), np.cos(0.5 * qpos[frame, 7 + joint])
                _write_turn(turn, cosine, sine * axes[joint, 0], sine * axes[joint, 1], sine * axes[joint, 2])
                _multiply(own, turn, own)
                joint += 1
    return transforms


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _multiply(first: Any, second: Any, result: Any) -> None:
    """Product of two rotations, written into the upper left of `result`, which may be `first`."""
    for i in range(3):
        x, y, z = first[i, 0], first[i, 1], first[i, 2]
        for j in range(3):
            result[i, j] = x * second[0, j] + y * second[1, j] + z * second[2, j]


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _write_turn(turn: Any, w: Any, x: Any, y: Any, z: Any) -> None:
    """Rotation matrix of a unit quaternion, written into the upper left of `turn`."""
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
