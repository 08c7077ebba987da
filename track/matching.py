"""Points without a label meet markers without a point: who belongs to whom, and how surely."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.optimize import linear_sum_assignment

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_STRAYS: Final = 2000.0
"""Points [1/m^3] near a hand that no marker made and that could be taken for one: one in an 8 cm cube."""
_NOTHING: Final = np.log(_STRAYS * (2.0 * np.pi) ** 1.5)


def gains(
    points: Float[np.ndarray, "P 3"], places: Float[np.ndarray, "K 3"], spreads: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "P K"]:
    """Log odds that a point is a marker rather than a stray.

    Args:
        points: Points [m].
        places: Where markers are expected [m]; NaN for none.
        spreads: How far they may be from there in each direction, one standard deviation [m].
    """
    square = ((points[:, None] - places[None]) ** 2).sum(axis=-1)
    odds: np.ndarray = -0.5 * square / spreads**2 - 3.0 * np.log(spreads) - _NOTHING
    return np.where(np.isnan(odds), -np.inf, odds)


def match(
    odds: Float[np.ndarray, "P K"],
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The likeliest assignment of points to markers, one to one; either may stay alone.

    Returns:
        Marker of each point, -1 for none, and how sure that is [0, 1], the rivals of both being weighed.
    """
    labels, confidence = np.full(len(odds), -1), np.ones(len(odds))
    if 0 in odds.shape:
        return labels, confidence
    gain = np.maximum(odds, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    weights = np.exp(np.minimum(odds, 50.0))
    rivals = 1.0 + weights.sum(axis=1, keepdims=True) + weights.sum(axis=0) - weights
    share = weights / rivals
    real = gain[rows, columns] > 0.0
    labels[rows[real]] = columns[real]
    confidence = 1.0 - (weights / (1.0 + weights.sum(axis=1, keepdims=True))).sum(axis=1)
    confidence[rows[real]] = share[rows[real], columns[real]]
    return labels, confidence
