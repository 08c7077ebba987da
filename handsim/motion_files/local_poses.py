"""Rotations of the bones relative to their parents, as skeletons of other programs have them."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.topology import BONES, PALM
from handsim.space.transforms import rotation_quaternions

CHILDREN: Final = tuple(
    tuple(number for number, bone in enumerate(BONES) if bone.parent == parent)
    for parent in range(len(BONES))
)
"""Indices of the bones that begin at the end of each bone."""
_PARENTS: Final = np.array([bone.parent for bone in BONES])


def local_rotations(rotations: Float[np.ndarray, "T L 3 3"]) -> Float[np.ndarray, "T L 3 3"]:
    """Each bone's orientation in its parent's frame; the palm's stays as it is."""
    local: NDArray[np.float64] = np.swapaxes(rotations[:, _PARENTS], -1, -2) @ rotations
    local[:, PALM] = rotations[:, PALM]
    return local


def smooth_quaternions(rotations: Float[np.ndarray, "T *batch 3 3"]) -> Float[np.ndarray, "T *batch 4"]:
    """Unit wxyz quaternions of rotations over time, with the signs of which neighbors are near."""
    quaternions = rotation_quaternions(rotations.reshape(-1, 3, 3)).reshape(*rotations.shape[:-2], 4)
    dots = (quaternions[1:] * quaternions[:-1]).sum(axis=-1, keepdims=True)
    signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0), axis=0)
    quaternions[1:] *= signs
    return quaternions
