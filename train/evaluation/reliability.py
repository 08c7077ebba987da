"""Calibration of a labeler's confidence, and the error without the points of least confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

BINS: Final = 15
"""Equally wide bins of confidence."""
LEAST_SURE: Final = 0.02
"""Share of the points that a person might check by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Points in equally wide bins of confidence; NaN in bins that hold none."""

    confidence: Float[np.ndarray, "15"]
    """Mean confidence."""
    right: Float[np.ndarray, "15"]
    """Share that is right."""
    count: Int[np.ndarray, "15"]


def reliability(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> Reliability:
    """Share of right labels by confidence.

    Args:
        confidence: Confidence of each label, 0 to 1; a bin includes its lower edge, the last one also 1.
        right: Which labels are right.
    """
    index = np.floor(confidence * BINS).astype(np.int64).clip(0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    sums = [np.bincount(index, weights, minlength=BINS) for weights in (confidence, right)]
    with np.errstate(invalid="ignore"):
        return Reliability(sums[0] / count, sums[1] / count, count)


def expected_calibration_error(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> float:
    """Mean difference of a bin's confidence and its share of right labels, weighted by points; NaN if empty.

    Args:
        confidence: Confidence of each label, 0 to 1.
        right: Which labels are right.
    """
    if not len(confidence):
        return float("nan")
    bins = reliability(confidence, right)
    return float(np.nansum(np.abs(bins.confidence - bins.right) * bins.count) / len(confidence))


def error_without(
    confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"], share: float = LEAST_SURE
) -> float:
    """Share of points labeled wrongly after those of least confidence are left out; NaN when none is kept.

    Where only some points of one confidence are left out, the result is the mean over all choices, so that
    the order of the points does not matter.

    Args:
        confidence: Confidence of each label, 0 to 1.
        right: Which labels are right.
        share: Share of the points to leave out, rounded to whole points.
    """
    kept = len(confidence) - round(share * len(confidence))
    if not kept:
        return float("nan")
    least = np.partition(confidence, -kept)[-kept]  # the least confidence that is kept
    above, tied = confidence > least, confidence == least
    from_tied = (kept - above.sum()) * (~right[tied]).mean()
    return float(((~right[above]).sum() + from_tied) / kept)
