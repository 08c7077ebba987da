"""Linear blend skinning by its formula, for any weights and any batch of poses."""

from __future__ import annotations

import numpy as np


def blend_skin(points, bone_indices, bone_weights, rest_transforms, transforms):
    """Points (N, 3) at rest, carried by the bones into every pose (..., N, 3)."""
    motion = transforms @ np.linalg.inv(rest_transforms)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    carried = np.einsum("...nkij,nj->...nki", motion[..., bone_indices, :, :], homogeneous)
    return (bone_weights[..., None] * carried[..., :3]).sum(axis=-2)
