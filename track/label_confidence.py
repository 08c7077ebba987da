"""Calibrated confidence in the labels of a whole take: among labels told 0.9, nine of ten are right.

Two logistic models weigh what a take tells of its points (`track.label_evidence`): one for points with a
label, one for points without. `python -m benchmarks.doubtful_frames --fit` fits both to simulated captures.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.takes.take import Take
from track.label_evidence import Evidence, evidence_of

_LABELED: Final = (-8.11, 0.72, 3.08, 0.08, 0.68, 1.49, 2.49, 0.78)
"""Log-odds of a wrong label, and what each entry of `LABELED` adds to them."""
_UNLABELED: Final = (-9.44, 3.91, 3.13, 6.01, -0.76, 3.30, 1.62, 0.76, 1.35)
"""Log-odds of a marker that has no label, and what each entry of `UNLABELED` adds to them."""


def label_confidence(take: Take, evidence: Evidence | None = None) -> Float[np.ndarray, "P"]:
    """Probability that each point's label is right; of a point without one, that it is no marker.

    Confidences of rigid bodies' points stay, and all those of a take without poses.

    Args:
        take: A take of hands.
        evidence: What `evidence_of` makes of it, where that is known already.
    """
    confidence = take.point_list.confidence.copy()
    if not np.isfinite(take.qpos).any():
        return confidence
    told = evidence_of(take) if evidence is None else evidence
    labeled = told.labels >= 0
    right = np.zeros(len(labeled))
    for which, values, weights in (
        (labeled, told.labeled, _LABELED),
        (~labeled, told.unlabeled, _UNLABELED),
    ):
        right[which] = 1.0 / (1.0 + np.exp(weights[0] + values @ np.array(weights[1:])))
    confidence[told.points] = right
    return confidence
