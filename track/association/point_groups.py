"""Groups of points that are linked: the points of a hand are near each other. Compiled."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.kernels.segments import squared_distance


def linked_groups(points: Float[np.ndarray, "N 3"], distance: float) -> list[NDArray[np.int64]]:
    """Indices of the points that are linked by steps of at most `distance` [m], the largest group first.

    Args:
        distance: Longest step [m].
    """
    number = _single_linkage(points, distance)
    groups = [np.flatnonzero(number == one) for one in range(int(number.max(initial=-1)) + 1)]
    return sorted(groups, key=len, reverse=True)


def distances_to_nearest(
    points: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "N"]:
    """Distance of each point from the nearest of some others [m], of which there is one at least."""
    distances: NDArray[np.float64] = np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1)
    return distances


@kernel
def _single_linkage(points: Float[np.ndarray, "N 3"], distance: float) -> Int[np.ndarray, "N"]:
    """Number of the group of each point."""
    number = np.full(len(points), -1)
    stack = np.zeros(len(points), dtype=np.int64)
    groups = 0
    for first in range(len(points)):
        if number[first] >= 0:
            continue
        number[first], stack[0], height = groups, first, 1
        while height > 0:
            height -= 1
            here = stack[height]
            for other in range(len(points)):
                if number[other] >= 0:
                    continue
                if squared_distance(points[here], points[other]) <= distance**2:
                    number[other] = groups
                    stack[height] = other
                    height += 1
        groups += 1
    return number


@kernel
def longest_links(points: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T"]:
    """The least distance at which the points of each frame are linked to one group [m], by Prim's tree."""
    longest = np.zeros(len(points))
    for frame in range(len(points)):
        nearest = np.full(points.shape[1], np.inf)
        added = 0
        for _ in range(1, points.shape[1]):
            nearest[added] = -1.0  # is in the tree
            least, following = np.inf, added
            for other in range(points.shape[1]):
                if nearest[other] < 0.0:
                    continue
                square = squared_distance(points[frame, other], points[frame, added])
                nearest[other] = min(nearest[other], square)
                if nearest[other] < least:
                    least, following = nearest[other], other
            longest[frame] = max(longest[frame], least)
            added = following
        longest[frame] = np.sqrt(longest[frame])
    return longest
