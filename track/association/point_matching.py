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
    points: Float[np.ndarray, "P 3"],
    places: Float[np.ndarray, "K 3"],
    covariances: Float[np.ndarray, "K 3 3"],
) -> Float[np.ndarray, "P K"]:
    """Log odds that a point is a marker rather than a stray.

    Args:
        points: Points [m].
        places: Where markers are expected [m].
        covariances: How far they may be from there [m^2].
    """
    off = points[:, None] - places
    precision = np.linalg.inv(covariances)
    square = np.einsum("pki,kij,pkj->pk", off, precision, off)
    odds: np.ndarray = 0.5 * np.log(np.linalg.det(precision)) - 0.5 * square - _NOTHING
    return odds


def worth_of(variances: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Log odds of a point that lies where a marker with this variance [m^2] in each direction is expected."""
    worth: np.ndarray = -1.5 * np.log(variances) - _NOTHING
    return worth


def match(
    odds: Float[np.ndarray, "P K"],
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The likeliest assignment of points to markers, one to one; either may stay alone.

    Returns:
        Marker of each point, -1 for none, and how sure that is [0, 1], the rivals of both being weighed.
    """
    labels = np.full(len(odds), -1)
    if 0 in odds.shape:
        return labels, np.ones(len(odds))
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
