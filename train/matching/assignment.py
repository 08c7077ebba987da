"""From scores or distances to labels: one point per label, one label per point, with a reject option."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from handsim.kernels.kernel import kernel

GHOST = -1
"""Label of a point that is not a marker."""
_WEIGHT: Final = 0.65
"""Weight of each of the two scores: 0.5 if they held the same information, 1 if they were independent."""
_ROUNDS: Final = 20
_NEVER: Final = 1e-30  # a probability whose logarithm is still a number
IMPOSSIBLE: Final = 1e6
"""Cost of a pair that cannot be."""


def pair_probabilities(
    point_scores: Float[np.ndarray, "N M+1"], label_scores: Float[np.ndarray, "M N+1"]
) -> Float[np.ndarray, "N+1 M+1"]:
    """Probability of each label for each point when no two points may share one.

    Both scores are weighted, added and normalized over rows and columns in turn, so that every point and
    every label is used once (Sinkhorn's iteration; ghosts and occluded labels are outside of it).

    Args:
        point_scores: Log-probability of each label, and last of ghost, for each point.
        label_scores: Log-probability of each point, and last of occluded, for each label.

    Returns:
        Probabilities; the last column is "a ghost", the last row "occluded". Rows of points sum to 1.
    """
    probabilities: NDArray[np.float64] = _balance(
        point_scores.astype(np.float64), label_scores.astype(np.float64), _WEIGHT, _ROUNDS
    )
    return probabilities


def match_probabilities(probabilities: Float[np.ndarray, "N+1 M+1"]) -> Int[np.ndarray, "N"]:
    """The one-to-one labeling with the greatest product of probabilities; `GHOST` where a point has none."""
    return solve_assignment(assignment_costs(probabilities))[1]


def assignment_costs(probabilities: Float[np.ndarray, "N+1 M+1"]) -> Float[np.ndarray, "N M+N"]:
    """What each pair of a point and a label costs, in logarithms; column M + i is point i as a ghost."""
    count, num_labels = len(probabilities) - 1, probabilities.shape[1] - 1
    costs = -np.log(np.maximum(probabilities, _NEVER))
    # A pair assigns a point and a label, which then is not occluded; each point has its own reject option.
    table = np.full((count, num_labels + count), IMPOSSIBLE)
    table[:, :num_labels] = 2.0 * costs[:count, :num_labels] - costs[count, :num_labels]
    table.ravel()[num_labels :: num_labels + count + 1] = costs[:count, num_labels]
    return table


def solve_assignment(table: Float[np.ndarray, "N M+N"]) -> tuple[float, Int[np.ndarray, "N"]]:
    """The least cost of a labeling by such a table, and its labels, `GHOST` where none."""
    rows, columns = linear_sum_assignment(table)
    labels: NDArray[np.int64] = np.where(columns < table.shape[1] - len(table), columns, GHOST)
    return float(table[rows, columns].sum()), labels


def match_distances(distances: Float[np.ndarray, "N M"], reject: float) -> Int[np.ndarray, "N"]:
    """One-to-one labeling of a cloud with the least total distance.

    The paper's equation 1, with the reject option that its results imply: a point may stay without a label at
    the cost of `reject`, so no point is matched over a larger distance.

    Args:
        distances: Distance of each point from the predicted position of each marker [m].
        reject: Cost of a point without a label [m].

    Returns:
        Label of each point, `GHOST` where none.
    """
    count, num_labels = distances.shape
    cost = np.full((count, num_labels + count), np.inf)
    cost[:, :num_labels] = distances
    cost[np.arange(count), num_labels + np.arange(count)] = reject
    _, columns = linear_sum_assignment(cost)
    labels: NDArray[np.int64] = np.where(columns < num_labels, columns, GHOST)
    return labels


@kernel
def _balance(
    point_scores: NDArray[np.float64], label_scores: NDArray[np.float64], weight: float, rounds: int
) -> NDArray[np.float64]:
    """Sinkhorn's iteration on the weighted sum of two log-probabilities.

    Args:
        point_scores: Log-probabilities (N, M + 1) by point, the last column "a ghost".
        label_scores: Log-probabilities (M, N + 1) by label, the last column "occluded".
        weight: Weight of each.
        rounds: Number of iterations.

    Returns:
        Probabilities (N + 1, M + 1), the last column "a ghost", the last row "occluded".
    """
    count, num_labels = len(point_scores), len(label_scores)
    plan = np.zeros((count + 1, num_labels + 1))
    for i in range(count):
        for j in range(num_labels):
            plan[i, j] = np.exp(weight * (point_scores[i, j] + label_scores[j, i])) + _NEVER
        plan[i, num_labels] = np.exp(2.0 * weight * point_scores[i, num_labels]) + _NEVER
    for j in range(num_labels):
        plan[count, j] = np.exp(2.0 * weight * label_scores[j, count]) + _NEVER
    for _ in range(rounds):
        for j in range(num_labels):
            total = 0.0
            for i in range(count + 1):
                total += plan[i, j]
            for i in range(count + 1):
                plan[i, j] /= total
        for i in range(count):
            total = 0.0
            for j in range(num_labels + 1):
                total += plan[i, j]
            for j in range(num_labels + 1):
                plan[i, j] /= total
    return plan
