"""Clusters of points that may be one hand each (Han et al. 2018, section 4.2)."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

RADIUS: Final = 0.2
"""Largest distance between the centers of two clusters that are joined [m]."""


def cluster_points(
    points: Float[np.ndarray, "N 3"], *, most: int, radius: float = RADIUS
) -> list[Int[np.ndarray, "K"]]:
    """Agglomerative clustering: join the two clusters with the nearest centers, starting from single points.

    Args:
        points: Points of a frame [m].
        most: Largest number of points in a cluster; 22 in the paper.
        radius: Largest distance of centers that are joined [m].

    Returns:
        Indices of each cluster's points, in order of the first of them.
    """
    centers, members = points.copy(), [np.array([index]) for index in range(len(points))]
    sizes = np.ones(len(points))
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    while len(points) > 1:
        allowed = np.where(sizes[:, None] + sizes <= most, distances, np.inf)
        one, other = np.sort(np.unravel_index(allowed.argmin(), allowed.shape))
        if not allowed[one, other] <= radius:
            break
        members[one] = np.concatenate([members[one], members[other]])
        members[other] = members[other][:0]
        centers[one] = points[members[one]].mean(axis=0)
        sizes[one], sizes[other] = len(members[one]), np.inf
        distances[one] = distances[:, one] = np.linalg.norm(centers - centers[one], axis=-1)
        distances[one, one] = distances[other] = distances[:, other] = np.inf
    return [np.sort(group) for group in members if len(group)]
