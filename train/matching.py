"""From scores to labels: one point a label, one label a point, with a dustbin for ghosts and occlusions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

GHOST = -1
"""Label of a point that is no marker."""


def match_scores(
    point_scores: Float[np.ndarray, "N M+1"], label_scores: Float[np.ndarray, "M N+1"]
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Most likely one-to-one labelling of one cloud.

    Every pair costs its negative log-probability in both readings; a point may stay a ghost and a label
    occluded, each at its own cost, so nothing is forced (the paper's equation 1 with a reject option).

    Args:
        point_scores: Log-probability of each label, and last of ghost, for each point.
        label_scores: Log-probability of each point, and last of occluded, for each label.

    Returns:
        Label of each point (`GHOST` where none), and the geometric mean of both probabilities [0, 1].
    """
    count, num_labels = len(point_scores), len(label_scores)
    pair_scores = point_scores[:, :num_labels] + label_scores[:, :count].T
    size = count + num_labels
    cost = np.full((size, size), 1e6)
    cost[:count, :num_labels] = -pair_scores
    cost[np.arange(count), num_labels + np.arange(count)] = -point_scores[:, -1]
    cost[count + np.arange(num_labels), np.arange(num_labels)] = -label_scores[:, -1]
    cost[count:, num_labels:] = 0.0
    rows, columns = linear_sum_assignment(cost)
    labels: NDArray[np.int64] = columns[rows.argsort()][:count]
    labels = np.where(labels < num_labels, labels, GHOST)
    scores = np.where(
        labels == GHOST,
        point_scores[:, -1],
        0.5 * pair_scores[np.arange(count), np.maximum(labels, 0)],
    )
    return labels, np.exp(scores)
