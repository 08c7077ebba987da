"""Whether a labeler's confidence says how often it is right, and what it buys to leave the least sure out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

BINS: Final = 15
"""Equally wide bins of confidence."""
LEAST_SURE: Final = 0.02
"""Share of the points that a reader might look through by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Points in equally wide bins of confidence; NaN in bins that hold none."""

    confidence: Float[np.ndarray, "15"]
    """Mean confidence."""
    right: Float[np.ndarray, "15"]
    """Share that is right."""
    count: Int[np.ndarray, "15"]


def reliability(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> Reliability:
    """How often points of each confidence are right.

    Args:
        confidence: How sure each label is, 0 to 1; a bin holds its lower edge, the last one 1 too.
        right: Which labels are right.
    """
    place = np.floor(confidence * BINS).astype(np.int64).clip(0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    sums = [np.bincount(place, weights, minlength=BINS) for weights in (confidence, right)]
    with np.errstate(invalid="ignore"):
        return Reliability(sums[0] / count, sums[1] / count, count)


def expected_calibration_error(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> float:
    """Mean distance of a bin's confidence from its share right, weighted by its points; NaN without any.

    Args:
        confidence: How sure each label is, 0 to 1.
        right: Which labels are right.
    """
    if not len(confidence):
        return float("nan")
    bins = reliability(confidence, right)
    return float(np.nansum(np.abs(bins.confidence - bins.right) * bins.count) / len(confidence))


def error_without(
    confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"], share: float = LEAST_SURE
) -> float:
    """Share of points labeled wrongly after the least sure are left out; NaN when none is kept.

    Of points of one confidence, only some of which go, it goes the mean over all ways to choose them: the
    order in which points came has no say.

    Args:
        confidence: How sure each label is, 0 to 1.
        right: Which labels are right.
        share: How many to leave out, rounded to whole points.
    """
    kept = len(confidence) - round(share * len(confidence))
    if not kept:
        return float("nan")
    least = np.partition(confidence, -kept)[-kept]  # the least sure that is kept
    above, tied = confidence > least, confidence == least
    from_tied = (kept - above.sum()) * (~right[tied]).mean()
    return float(((~right[above]).sum() + from_tied) / kept)
