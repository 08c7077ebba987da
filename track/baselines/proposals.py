"""Ways to name the points of a hand anew when markers come back (Han et al. 2018, sections 4.2 and 4.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def name_by_proximity(
    points: Float[np.ndarray, "P 3"], places: Float[np.ndarray, "K 3"], reach: float
) -> Int[np.ndarray, "P"]:
    """Give each place the point near it, the nearest pair first, one to one.

    Args:
        points: Points without a name [m].
        places: Where they are expected [m].
        reach: Distance of a pair, less than this [m].

    Returns:
        Place of each point, -1 for none.
    """
    names, apart = np.full(len(points), -1), np.linalg.norm(points[:, None] - places, axis=-1)
    while apart.size:
        point, place = np.unravel_index(apart.argmin(), apart.shape)
        if not apart[point, place] < reach:
            break
        names[point] = place
        apart[point], apart[:, place] = np.inf, np.inf
    return names


def cloud_of(
    points: Float[np.ndarray, "N 3"],
    named: Bool[np.ndarray, "N"],
    free: Bool[np.ndarray, "N"],
    *,
    most: int,
    reach: float,
) -> Int[np.ndarray, "K"]:
    """The points of a hand and those around it that are free: what a labeler is asked about.

    Args:
        points: Points of a frame [m].
        named: Those that this hand has; at least one.
        free: Those that no hand has.
        most: Points of the cloud, at most; of the free ones the nearest to the hand's center are taken.
        reach: Their distance from that center, at most [m].
    """
    own, others = np.flatnonzero(named), np.flatnonzero(free)
    away = np.linalg.norm(points[others] - points[own].mean(axis=0), axis=-1)
    near = others[away <= reach][np.argsort(away[away <= reach], kind="stable")]
    return np.concatenate([own, near[: max(0, most - len(own))]])
