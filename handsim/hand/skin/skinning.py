"""Linear blend skinning, compiled: the whole skin in every frame, fast enough to cast rays against it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel


def skin_frames(
    points: Float[np.ndarray, "V 3"],
    bone_indices: Int[np.ndarray, "V 4"],
    bone_weights: Float[np.ndarray, "V 4"],
    rest_transforms: Float[np.ndarray, "L 4 4"],
    transforms: Float[np.ndarray, "T L 4 4"],
) -> Float[np.ndarray, "T V 3"]:
    """Points attached at rest, carried by the bones.

    Args:
        points: Rest positions, in the frame of `rest_transforms` [m].
        bone_weights: Their shares in descending order; the first zero ends a point's list.
        rest_transforms: Bones at rest.
        transforms: Bones in every frame, in any one frame of reference.

    Returns:
        Positions in the frame of `transforms` [m].
    """
    motion = np.ascontiguousarray((transforms @ np.linalg.inv(rest_transforms))[..., :3, :])
    skinned: NDArray[np.float64] = _skin(points, bone_indices, bone_weights, motion)
    return skinned


@kernel
def _skin(
    points: Float[np.ndarray, "V 3"],
    bones: Int[np.ndarray, "V 4"],
    weights: Float[np.ndarray, "V 4"],
    motion: Float[np.ndarray, "T L 3 4"],
) -> Any:
    """Skinned positions (T, V, 3) [m] by transforms from the rest pose to each frame."""
    skinned = np.empty((len(motion), len(points), 3))
    for t in range(len(motion)):
        for v in range(len(points)):
            px, py, pz = points[v, 0], points[v, 1], points[v, 2]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(weights.shape[1]):
                share = weights[v, i]
                if share == 0.0:
                    break
                m = motion[t, bones[v, i]]
                x += share * (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3])
                y += share * (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3])
                z += share * (m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3])
            skinned[t, v, 0], skinned[t, v, 1], skinned[t, v, 2] = x, y, z
    return skinned
