"""Plain formulas for skins and meshes, which compiled code must agree with."""

from __future__ import annotations

import numpy as np
import trimesh

from handsim import HandModel
from handsim.hand.capsules import overlap_between


def blend_skin(points, bone_indices, bone_weights, rest_transforms, transforms):
    """Points (N, 3) at rest, carried by the bones into every pose (..., N, 3)."""
    motion = transforms @ np.linalg.inv(rest_transforms)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    carried = np.einsum("...nkij,nj->...nki", motion[..., bone_indices, :, :], homogeneous)
    return (bone_weights[..., None] * carried[..., :3]).sum(axis=-2)


def winding(solid: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How often a closed surface goes around points (Van Oosterom and Strackee's solid angles): 1 inside."""
    a, b, c = (solid.triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    dot = np.einsum("pfi,pfi->pf", a, b) * lc + np.einsum("pfi,pfi->pf", b, c) * la
    dot += np.einsum("pfi,pfi->pf", c, a) * lb + la * lb * lc
    return 2 * np.arctan2(np.einsum("pfi,pfi->pf", a, np.cross(b, c)), dot).sum(axis=1) / (4 * np.pi)


def hands_overlap(
    right: HandModel, left: HandModel, right_qpos: np.ndarray, left_qpos: np.ndarray
) -> np.ndarray:
    """Deepest overlap (T,) of any capsule of one hand with any of the other [m]; negative where apart."""
    bones = right.forward_kinematics(right_qpos), left.forward_kinematics(left_qpos)
    return overlap_between(right.capsules, bones[0], left.capsules, bones[1])
