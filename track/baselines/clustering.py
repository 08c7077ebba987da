"""Points cut into clusters that may be a hand each (Han et al. 2018, section 4.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

REACH: Final = 0.2
"""Distance between the centers of two clusters that are joined, at most [m]."""


def cluster_points(
    points: Float[np.ndarray, "N 3"], *, most: int, reach: float = REACH
) -> list[Int[np.ndarray, "K"]]:
    """Join single points and then clusters, those with the nearest centers first.

    Args:
        points: Points of a frame [m].
        most: Points of a cluster, at most; the paper has 22.
        reach: Distance of centers that are joined, at most [m].

    Returns:
        Places of each cluster's points, in order of the first of them.
    """
    centers, members = points.copy(), [np.array([place]) for place in range(len(points))]
    sizes = np.ones(len(points))
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(apart, np.inf)
    while len(points) > 1:
        allowed = np.where(sizes[:, None] + sizes <= most, apart, np.inf)
        one, other = np.sort(np.unravel_index(allowed.argmin(), allowed.shape))
        if not allowed[one, other] <= reach:
            break
        members[one] = np.concatenate([members[one], members[other]])
        members[other] = members[other][:0]
        centers[one] = points[members[one]].mean(axis=0)
        sizes[one], sizes[other] = len(members[one]), np.inf
        apart[one] = apart[:, one] = np.linalg.norm(centers - centers[one], axis=-1)
        apart[one, one] = apart[other] = apart[:, other] = np.inf
    return [np.sort(group) for group in members if len(group)]
