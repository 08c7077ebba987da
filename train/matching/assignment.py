"""From scores or distances to labels: one point per label, one label per point, with a reject option."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.kernels import kernel

GHOST = -1
"""Label of a point that is not a marker."""
_WEIGHT: Final = 0.65
"""Weight of each of the two scores: 0.5 if they held the same information, 1 if they were independent."""
_ROUNDS: Final = 20
_NEVER: Final = 1e-30  # a probability whose logarithm is still a number
SINKHORN: Final = {"score_weight": _WEIGHT, "sinkhorn_rounds": _ROUNDS, "least_probability": _NEVER}
"""What `pair_probabilities` goes by, for other programs that do the same."""
IMPOSSIBLE: Final = 1e6
"""Cost of a pair that cannot be."""
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


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
    return balance(point_scores.astype(np.float64), label_scores.astype(np.float64), _WEIGHT, _ROUNDS)


def match_probabilities(probabilities: Float[np.ndarray, "N+1 M+1"]) -> Int[np.ndarray, "N"]:
    """The one-to-one labeling with the greatest product of probabilities; `GHOST` where a point has none."""
    costs, reject = assignment_costs(probabilities)
    return assign(costs, reject)[1]


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
    return assign(distances.astype(np.float64), np.full(len(distances), reject))[1]


@kernel
def assignment_costs(probabilities: Float[np.ndarray, "N+1 M+1"]) -> tuple[FloatArray, FloatArray]:
    """What each pair of a point and a label costs (N, M), and each point as a ghost (N,), in logarithms.

    A pair assigns a point and a label, which then is not occluded.
    """
    count, num_labels = len(probabilities) - 1, probabilities.shape[1] - 1
    costs, reject = np.empty((count, num_labels)), np.empty(count)
    for i in range(count):
        for j in range(num_labels):
            pair = np.log(max(probabilities[i, j], _NEVER))
            costs[i, j] = np.log(max(probabilities[count, j], _NEVER)) - 2.0 * pair
        reject[i] = -np.log(max(probabilities[i, num_labels], _NEVER))
    return costs, reject


@kernel
def assign(costs: Float[np.ndarray, "N M"], reject: Float[np.ndarray, "N"]) -> tuple[float, IntArray]:
    """The least cost of a labeling, and its labels (N,): a point per label, `GHOST` at the cost of a reject.

    The shortest augmenting paths of Jonker and Volgenant (1987); only a path's own end may be a reject,
    because a point that is a ghost takes no label from another.
    """
    count, num_labels = costs.shape
    labels, owner = np.full(count, GHOST), np.full(num_labels, -1)
    row_dual, column_dual = np.zeros(count), np.zeros(num_labels)
    shortest, before = np.empty(num_labels), np.empty(num_labels, dtype=np.int64)
    reached, columns = np.empty(num_labels, dtype=np.bool_), np.empty(num_labels, dtype=np.int64)
    for start in range(count):
        length, steps, end, rejected = _shortest_path(
            start, costs, reject, row_dual, column_dual, owner, shortest, before, reached, columns
        )
        row_dual[start] += length
        for step in range(steps):
            column = columns[step]
            if owner[column] >= 0:
                row_dual[owner[column]] += length - shortest[column]
            column_dual[column] -= length - shortest[column]
        if end < 0:  # a point gives its label up and is a ghost
            end = labels[rejected]
            labels[rejected] = GHOST
        while end >= 0:  # each point on the path passes its label on
            row = before[end]
            owner[end] = row
            end, labels[row] = labels[row], end
    total = 0.0
    for row in range(count):
        total += reject[row] if labels[row] < 0 else costs[row, labels[row]]
    return total, labels


@kernel
def _shortest_path(
    start: int,
    costs: Float[np.ndarray, "N M"],
    reject: Float[np.ndarray, "N"],
    row_dual: Float[np.ndarray, "N"],
    column_dual: Float[np.ndarray, "M"],
    owner: Int[np.ndarray, "M"],
    shortest: Float[np.ndarray, "M"],
    before: Int[np.ndarray, "M"],
    reached: Bool[np.ndarray, "M"],
    columns: Int[np.ndarray, "M"],
) -> tuple[float, int, int, int]:
    """The shortest path by reduced costs from a point to a free label, or to a point that may be a ghost.

    Returns its length, the number of reached labels, the free label or -1, and the point that is a ghost
    then. The last four arrays are overwritten: length to each label, the point before it, whether it was
    reached, and the reached labels in their order.
    """
    shortest[:] = np.inf
    reached[:] = False
    row, length, steps = start, 0.0, 0
    least_reject, rejected = np.inf, start
    while True:
        off = length - row_dual[row]
        if off + reject[row] < least_reject:
            least_reject, rejected = off + reject[row], row
        nearest, least = -1, np.inf
        for j in range(len(owner)):
            if reached[j]:
                continue
            path = off + costs[row, j] - column_dual[j]
            if path < shortest[j]:
                shortest[j], before[j] = path, row
            if shortest[j] < least:
                nearest, least = j, shortest[j]
        if least_reject <= least:
            return least_reject, steps, -1, rejected
        length = least
        reached[nearest] = True
        columns[steps] = nearest
        steps += 1
        if owner[nearest] < 0:
            return length, steps, nearest, -1
        row = owner[nearest]


@kernel
def balance(
    point_scores: NDArray[np.float64], label_scores: NDArray[np.float64], weight: float, rounds: int
) -> NDArray[np.float64]:
    """Sinkhorn's iteration on the weighted sum of log-probabilities by point (N, M + 1) and label (M, N + 1).

    Returns probabilities (N + 1, M + 1), the last column "a ghost", the last row "occluded".
    """
    count, num_labels = len(point_scores), len(label_scores)
    plan = np.zeros((count + 1, num_labels + 1))
    for i in range(count):
        for j in range(num_labels):
            plan[i, j] = np.exp(weight * (point_scores[i, j] + label_scores[j, i])) + _NEVER
        plan[i, num_labels] = np.exp(2.0 * weight * point_scores[i, num_labels]) + _NEVER
    for j in range(num_labels):
        plan[count, j] = np.exp(2.0 * weight * label_scores[j, count]) + _NEVER
    totals = np.empty(num_labels)
    for _ in range(rounds):
        totals[:] = 0.0
        for i in range(count + 1):
            for j in range(num_labels):
                totals[j] += plan[i, j]
        for j in range(num_labels):
            totals[j] = 1.0 / totals[j]
        for i in range(count + 1):
            total = plan[i, num_labels]
            for j in range(num_labels):
                plan[i, j] *= totals[j]
                total += plan[i, j]
            if i < count:
                scale = 1.0 / total
                for j in range(num_labels + 1):
                    plan[i, j] *= scale
    return plan
