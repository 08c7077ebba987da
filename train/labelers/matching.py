"""From scores or distances to labels: one point per label, one label per point, or neither.

A network scores each point by itself, so that the likeliest labeling may not be a hand: an occluded marker's
label may go to its neighbor, or a chain of labels may be shifted by one. Therefore labelings close to the
likeliest one are compared by the network's scores and a prior of hands.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.kernels import kernel
from train.labelers.pose_prior import (
    NEAREST,
    PosePrior,
    PriorTables,
    errors_of_products,
    factor_of,
    log_density,
    log_normal,
    means_by_marker,
    procrustes_errors,
    products_with_means,
    residual_of,
    seen_as_right,
    tables_of,
)

GHOST = -1
"""Label of a point that is no marker."""
_SCORE_WEIGHT: Final = 0.65
"""Weight of each of the two scores: 0.5 if they had the same information, 1 if they were independent."""
_SINKHORN_ROUNDS: Final = 20
_MIN_PROBABILITY: Final = 1e-30  # its logarithm is finite
SINKHORN: Final = {
    "score_weight": _SCORE_WEIGHT,
    "sinkhorn_rounds": _SINKHORN_ROUNDS,
    "least_probability": _MIN_PROBABILITY,
}
"""Constants of `balance`, for other programs."""
EXCLUDED_COST: Final = 1e6
"""Cost of an excluded pair."""
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SURE: Final = 0.95  # Pairs of a higher probability are final.
_MAX_UNSURE: Final = 8  # number of least certain pairs of a labeling that are excluded in turn
_MAX_EXCLUDED_PAIRS: Final = 3  # largest number of pairs excluded from a labeling
_BEAM_WIDTH: Final = 3  # number of best labelings with which the next round starts
_MAX_LABELINGS: Final = 1 + _MAX_UNSURE * (1 + (_MAX_EXCLUDED_PAIRS - 1) * _BEAM_WIDTH)
_MAX_EXTRA_COST: Final = 14.0  # [nats, for points plus labels] above the cost of the likeliest labeling
_PRIOR_WEIGHT: Final = 2.0  # weight of the prior's log-density, chosen on held-out simulated frames
_GHOST: Final = 4.0  # log-density of a ghost, uniform around the hand [1/m^3]
_NEAR_COMPONENTS: Final = 40  # number of the prior's components that are considered for a cloud
_TEMPERATURE: Final = 0.25  # temperature of the odds between labelings, for the confidence
_MIN_LABELED: Final = 4  # least number of labeled points of a hand
_MIN_DENSITY: Final = 2.5  # least log-density of a hand per coordinate; true labels have 2.8 to 4.2


def match_distances(distances: Float[np.ndarray, "N M"], reject: float) -> Int[np.ndarray, "N"]:
    """One-to-one labeling with the least total distance to predicted markers [m], the paper's equation 1.

    A point is a `GHOST` at the cost `reject` [m], an option implied by the paper's results.
    """
    return assign(distances.astype(np.float64), np.full(len(distances), reject))[1]


@kernel
def assignment_costs(probabilities: Float[np.ndarray, "N+1 M+1"]) -> tuple[FloatArray, FloatArray]:
    """Costs of pairs of point and label (N, M), relative to the label's occlusion, and of ghosts (N,)."""
    count, num_labels = len(probabilities) - 1, probabilities.shape[1] - 1
    costs, reject = np.empty((count, num_labels)), np.empty(count)
    for i in range(count):
        for j in range(num_labels):
            pair = np.log(max(probabilities[i, j], _MIN_PROBABILITY))
            costs[i, j] = np.log(max(probabilities[count, j], _MIN_PROBABILITY)) - 2.0 * pair
        reject[i] = -np.log(max(probabilities[i, num_labels], _MIN_PROBABILITY))
    return costs, reject


@kernel
def assign(costs: Float[np.ndarray, "N M"], reject: Float[np.ndarray, "N"]) -> tuple[float, IntArray]:
    """The least cost of a one-to-one labeling with ghosts at the cost `reject`, and its labels (N,).

    Shortest augmenting paths (Jonker and Volgenant 1987). Only the end of a path may be rejected, because a
    ghost takes no label from another point.
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
        if end < 0:  # a point loses its label and becomes a ghost
            end = labels[rejected]
            labels[rejected] = GHOST
        while end >= 0:  # Each point on the path passes its label on.
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
    """Shortest path by reduced costs from a point to a free label, or to a point that becomes a ghost.

    Returns its length, the number of reached labels, the free label or -1, and then the point that becomes a
    ghost. The last four arrays are overwritten: length to each label, the point before it, whether it was
    reached, and the reached labels in order.
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

    Returns probabilities (N + 1, M + 1) of pairs, if no two points share a label; rows of points sum to 1.
    The last column stands for a ghost, the last row for occlusion.
    """
    count, num_labels = len(point_scores), len(label_scores)
    plan = np.zeros((count + 1, num_labels + 1))
    for i in range(count):
        for j in range(num_labels):
            plan[i, j] = np.exp(weight * (point_scores[i, j] + label_scores[j, i])) + _MIN_PROBABILITY
        plan[i, num_labels] = np.exp(2.0 * weight * point_scores[i, num_labels]) + _MIN_PROBABILITY
    for j in range(num_labels):
        plan[count, j] = np.exp(2.0 * weight * label_scores[j, count]) + _MIN_PROBABILITY
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


def matching_constants() -> dict[str, float]:
    """Constants of `match_scores`, for other programs such as that of docs/own_labelers.md."""
    return {
        **SINKHORN,
        "impossible": EXCLUDED_COST,
        "sure": _SURE,
        "most_unsure": _MAX_UNSURE,
        "rounds": _MAX_EXCLUDED_PAIRS,
        "width": _BEAM_WIDTH,
        "farthest": _MAX_EXTRA_COST,
        "prior_weight": _PRIOR_WEIGHT,
        "ghost": _GHOST,
        "near": _NEAR_COMPONENTS,
        "nearest": NEAREST,
        "least_points": _MIN_LABELED,
        "least_density": _MIN_DENSITY,
    }


def match_scores(
    points: Float[np.ndarray, "N 3"],
    point_scores: Float[np.ndarray, "N M+1"],
    label_scores: Float[np.ndarray, "M N+1"],
    prior: PosePrior | None,
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Most likely one-to-one labeling of one cloud [m], and the probability of each point's label.

    A point may be a `GHOST`, and a label occluded. Without a prior the scores alone decide.
    """
    scores = point_scores.astype(np.float64, "C"), label_scores.astype(np.float64, "C")  # one kernel for all
    probabilities = balance(*scores, _SCORE_WEIGHT, _SINKHORN_ROUNDS)
    _, labels = assign(*assignment_costs(probabilities))
    confidence = probabilities[np.arange(len(labels)), labels]  # GHOST, -1, is the last column
    num_labels = probabilities.shape[1] - 1
    if (
        prior is None
        or confidence.min(initial=1.0) > _SURE
        or np.count_nonzero(labels >= 0) < _MIN_LABELED
        or len(points) > 2 * num_labels  # more than one hand
    ):
        return labels, confidence
    return _verify(np.ascontiguousarray(points, dtype=np.float64), probabilities, tables_of(prior))


class _Factors(NamedTuple):
    """Cholesky factors by component and by set of markers, shared between labelings."""

    sets: Bool[np.ndarray, "L M"]
    """The sets of markers."""
    stored: Int[np.ndarray, "L C"]
    """Index of the factor of each set and component, -1 for none."""
    factors: Float[np.ndarray, "F R R"]
    counts: Int[np.ndarray, "2"]
    """Numbers of stored sets and factors."""


@kernel
def _verify(
    points: Float[np.ndarray, "N 3"],
    probabilities: Float[np.ndarray, "N+1 M+1"],
    prior: PriorTables,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The best labeling (N,) close to the likeliest one, and the probability (N,) of each label."""
    costs, reject = assignment_costs(probabilities)
    least, labels = assign(costs, reject)
    near, mirrored = _near_components(points, labels, prior)
    near_table = means_by_marker(prior.means, near)
    found = np.empty((_MAX_LABELINGS, len(points)), dtype=np.int64)
    scores, densities = np.empty(_MAX_LABELINGS), np.empty(_MAX_LABELINGS)
    taken = np.full((_MAX_LABELINGS, _MAX_EXCLUDED_PAIRS), -1)  # points of excluded pairs
    columns = np.full((_MAX_LABELINGS, _MAX_EXCLUDED_PAIRS), -1)  # labels of excluded pairs
    rank = prior.directions.shape[3]
    kept = _Factors(
        np.empty((_MAX_LABELINGS, len(prior.means[0])), dtype=np.bool_),
        np.full((_MAX_LABELINGS, len(near)), -1),
        np.empty((NEAREST * _MAX_LABELINGS, rank, rank)),
        np.zeros(2, np.int64),
    )
    front, num_front, num_found = np.zeros(_MAX_LABELINGS, dtype=np.int64), 1, 0
    for step in range(_MAX_EXCLUDED_PAIRS + 1):
        first = num_found
        for parent in front[: min(num_front, _BEAM_WIDTH)]:
            unsure = _least_sure(probabilities, found[parent]) if step else np.zeros(1, np.int64)
            for point in unsure:
                cost, fresh = least, labels
                if step:
                    taken[num_found], columns[num_found] = taken[parent], columns[parent]
                    taken[num_found, step - 1], columns[num_found, step - 1] = point, found[parent, point]
                    cost, fresh = _assign_without(costs, reject, taken[num_found], columns[num_found], step)
                    if cost > least + _MAX_EXTRA_COST or _index_of(fresh, found, num_found) >= 0:
                        continue
                known = np.flatnonzero(fresh >= 0)
                density = -np.inf
                if len(known) >= _MIN_LABELED:
                    cloud, known_labels = seen_as_right(points[known], mirrored), fresh[known]
                    density = _log_density_of_near(cloud, known_labels, near, near_table, prior, kept)
                found[num_found] = fresh
                scores[num_found] = _PRIOR_WEIGHT * (density + _GHOST * (len(fresh) - len(known))) - cost
                densities[num_found] = density / max(1, 3 * len(known))
                num_found += 1
        num_front = num_found - first
        front[:num_front] = first + np.argsort(-scores[first:num_found], kind="mergesort")
    return _elected(found[:num_found], scores[:num_found], densities[:num_found], probabilities)


@kernel
def _log_density_of_near(
    cloud: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    near: Int[np.ndarray, "C"],
    table: Float[np.ndarray, "M 3 C"],
    prior: PriorTables,
    kept: _Factors,
) -> float:
    """Log-density of centered, labeled points [m] under the nearest of some components, with means `table`.

    Stores Cholesky factors for other labelings.
    """
    marked = np.zeros(kept.sets.shape[1], dtype=np.bool_)
    marked[labels] = True
    group = _index_of(marked, kept.sets, kept.counts[0])
    if group < 0:
        group = kept.counts[0]
        kept.sets[group] = marked
        kept.counts[0] += 1
    density = -np.inf
    for number in np.argsort(procrustes_errors(cloud, labels, table))[:NEAREST]:
        component, spread = near[number], float(prior.spreads[near[number]])
        directions = prior.directions[component]
        if kept.stored[group, number] < 0:
            kept.stored[group, number] = kept.counts[1]
            kept.factors[kept.counts[1]] = factor_of(labels, directions, spread)
            kept.counts[1] += 1
        lower = kept.factors[kept.stored[group, number]]
        residual = residual_of(cloud, labels, prior.means[component])
        log = prior.log_weights[component] + log_normal(residual, labels, directions, lower, spread)
        high = max(density, log)
        density = high + np.log(np.exp(density - high) + np.exp(log - high))
    return density


@kernel
def _near_components(
    points: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    prior: PriorTables,
) -> tuple[NDArray[np.int64], bool]:
    """Components (C,) nearest to labeled points of the likelier side, and whether that is the left one."""
    known = np.flatnonzero(labels >= 0)
    known_labels = labels[known]
    best, near, left = -np.inf, np.empty(0, dtype=np.int64), False
    products, squares = products_with_means(
        seen_as_right(points[known], False), known_labels, prior.by_marker
    )
    for mirrored in (False, True):
        cloud = seen_as_right(points[known], mirrored)
        chosen = np.argsort(errors_of_products(products, squares, mirrored))[:_NEAR_COMPONENTS]
        density = log_density(cloud, known_labels, chosen[:NEAREST], prior)
        if density > best or not len(near):
            best, near, left = density, chosen, mirrored
    return near, left


@kernel
def _least_sure(
    probabilities: Float[np.ndarray, "N+1 M+1"], labels: Int[np.ndarray, "N"]
) -> NDArray[np.int64]:
    """Points of a labeling with uncertain labels, the least certain first."""
    confidence = np.empty(len(labels))
    for point in range(len(labels)):
        confidence[point] = probabilities[point, labels[point]]
    order = np.argsort(confidence)[:_MAX_UNSURE]
    return order[confidence[order] < _SURE]


@kernel
def _assign_without(
    costs: Float[np.ndarray, "N M"],
    reject: Float[np.ndarray, "N"],
    points: Int[np.ndarray, "3"],
    labels: Int[np.ndarray, "3"],
    count: int,
) -> tuple[float, NDArray[np.int64]]:
    """Labeling of least cost without some pairs of point and label, -1 for a ghost."""
    rest, without = costs.copy(), reject.copy()
    for number in range(count):
        if labels[number] >= 0:
            rest[points[number], labels[number]] = EXCLUDED_COST
        else:
            without[points[number]] = EXCLUDED_COST
    return assign(rest, without)


@kernel
def _index_of(row: NDArray[np.generic], rows: NDArray[np.generic], count: int) -> int:
    """Index of a row (W,) among the first `count` rows of a table (R, W); -1 if it is not there."""
    for number in range(count):
        same = True
        for column in range(len(row)):
            if rows[number, column] != row[column]:
                same = False
                break
        if same:
            return number
    return -1


@kernel
def _elected(
    found: Int[np.ndarray, "L N"],
    scores: Float[np.ndarray, "L"],
    densities: Float[np.ndarray, "L"],
    probabilities: Float[np.ndarray, "N+1 M+1"],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The best labeling (N,), and the confidence (N,) of each of its labels.

    If all labelings agree, the confidence is the network's own; otherwise it is its geometric mean with the
    odds of the agreeing labelings. The network alone decides if the best labeling is not a hand.
    """
    best, count = int(np.argmax(scores)), len(found)
    if densities[best] < _MIN_DENSITY:
        best, count = 0, 1
    odds = np.exp(_TEMPERATURE * (scores[:count] - scores[:count].max()))
    odds /= odds.sum()
    labels, confidence = found[best].copy(), np.empty(found.shape[1])
    for point in range(found.shape[1]):
        share, all_agree = 0.0, True
        for number in range(count):
            if found[number, point] == labels[point]:
                share += odds[number]
            else:
                all_agree = False
        own = probabilities[point, labels[point]]
        confidence[point] = own if all_agree else np.sqrt(own * share)
    return labels, confidence
