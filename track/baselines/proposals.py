"""Label proposals for new points of a hand (Han et al. 2018, sections 4.2 and 4.4)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def label_by_proximity(
    points: Float[np.ndarray, "P 3"], positions: Float[np.ndarray, "K 3"], radius: float
) -> Int[np.ndarray, "P"]:
    """Assign points to expected positions one to one, the nearest pair first.

    Args:
        points: Points without a label [m].
        positions: Expected positions of markers [m].
        radius: Upper bound of the distance of a pair [m].

    Returns:
        Index of each point's position, -1 for none.
    """
    labels, apart = np.full(len(points), -1), np.linalg.norm(points[:, None] - positions, axis=-1)
    while apart.size:
        point, position = np.unravel_index(apart.argmin(), apart.shape)
        if not apart[point, position] < radius:
            break
        labels[point] = position
        apart[point], apart[:, position] = np.inf, np.inf
    return labels


def labeler_cloud(
    points: Float[np.ndarray, "N 3"],
    labeled: Bool[np.ndarray, "N"],
    free: Bool[np.ndarray, "N"],
    *,
    most: int,
    radius: float,
) -> Int[np.ndarray, "K"]:
    """Indices of the points for a labeler query: those of a hand and the free ones around it.

    Args:
        points: Points of a frame [m].
        labeled: Points with a label of this hand; at least one.
        free: Points without a label.
        most: Largest number of points; of the free ones those nearest to the hand's center are taken.
        radius: Largest distance of a free point from that center [m].
    """
    own, others = np.flatnonzero(labeled), np.flatnonzero(free)
    away = np.linalg.norm(points[others] - points[own].mean(axis=0), axis=-1)
    near = others[away <= radius][np.argsort(away[away <= radius], kind="stable")]
    return np.concatenate([own, near[: max(0, most - len(own))]])
