"""Labels verified by a pose: labelings near the likeliest one compete by the network's scores and the prior.

A network says for each point by itself what it may be. Where it is unsure, a neighbor's marker in an occluded
label's place or a chain of labels shifted by one can be the likeliest labeling and yet no hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from train.matching.assignment import (
    IMPOSSIBLE,
    assignment_costs,
    match_probabilities,
    pair_probabilities,
    solve_assignment,
)
from train.matching.pose_prior import PosePrior

_SURE: Final = 0.95  # a pair of this probability is not taken back
_MOST_UNSURE: Final = 8  # pairs that are taken back, one at a time; the least sure
_ROUNDS: Final = 3  # how many pairs are taken back in turn
_WIDTH: Final = 3  # labelings of a round that the next one starts from
_FARTHEST: Final = 14.0  # cost of a labeling above that of the likeliest [nats, twice]
_WEIGHT: Final = 2.0  # of the prior's density against the scores, chosen on held-out simulated frames
_GHOST: Final = 4.0  # log-density of a ghost, uniform around the hand [1/m^3]
_NEAR: Final = 80  # components that count for the labelings around the likeliest one
_TEMPERATURE: Final = 0.25  # of the odds between labelings, for the confidence
_LEAST: Final = 4  # labeled points of a hand
_LEAST_DENSITY: Final = 2.5  # of a hand, for each coordinate; true labels of real hands have 2.8 to 4.2


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A labeling, what it scores, and the pairs that were taken back for it."""

    score: float
    density: float
    """Log-density of the labeled points, for each coordinate."""
    labels: NDArray[np.int64]
    without: tuple[tuple[int, int], ...] = ()


def match_scores(
    points: Float[np.ndarray, "N 3"],
    point_scores: Float[np.ndarray, "N M+1"],
    label_scores: Float[np.ndarray, "M N+1"],
    prior: PosePrior | None,
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Most likely one-to-one labeling of one cloud.

    A point may stay a ghost and a label occluded, each at its own cost, so nothing is forced (the paper's
    equation 1 with a reject option).

    Args:
        points: Points [m].
        point_scores: Log-probability of each label, and last of ghost, for each point.
        label_scores: Log-probability of each point, and last of occluded, for each label.
        prior: What hands look like; None to believe the scores alone.

    Returns:
        Label of each point (`GHOST` where none), and its probability.
    """
    probabilities = pair_probabilities(point_scores, label_scores)
    labels = match_probabilities(probabilities)
    confidence = probabilities[np.arange(len(labels)), labels]  # GHOST, -1, is the last column
    num_labels = probabilities.shape[1] - 1
    if (
        prior is None
        or confidence.min(initial=1.0) > _SURE
        or np.count_nonzero(labels >= 0) < _LEAST
        or len(points) > 2 * num_labels  # more than a hand: somebody has to divide them first
    ):
        return labels, confidence
    return _verify(points, probabilities, labels, prior)


def _verify(
    points: Float[np.ndarray, "N 3"],
    probabilities: Float[np.ndarray, "N+1 M+1"],
    labels: Int[np.ndarray, "N"],
    prior: PosePrior,
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The best of the labelings around the likeliest one, and the probability of each of its labels."""
    table = assignment_costs(probabilities)
    cost, _ = solve_assignment(table)
    known = labels >= 0
    near, _, mirrored = max(
        (_nearest_components(points[known], labels[known], prior, mirrored) for mirrored in (False, True)),
        key=lambda side: side[1],
    )

    def scored(cost: float, labels: NDArray[np.int64], without: tuple[tuple[int, int], ...]) -> _Candidate:
        known = labels >= 0
        density = prior.log_density(points[known], labels[known], mirrored=mirrored, among=near)
        count = int(known.sum())
        score = _WEIGHT * (density + _GHOST * (len(labels) - count)) - cost
        return _Candidate(score, density / max(1, 3 * count), labels, without)

    found = {labels.tobytes(): scored(cost, labels, ())}
    front = list(found.values())
    for _ in range(_ROUNDS):
        fresh = []
        for candidate in front[:_WIDTH]:
            for without in _taken_back(candidate, probabilities):
                worth, other = solve_assignment(_without(table, without))
                if worth <= cost + _FARTHEST and other.tobytes() not in found:
                    found[other.tobytes()] = scored(worth, other, without)
                    fresh.append(found[other.tobytes()])
        front = sorted(fresh, key=lambda one: -one.score)
    return _elected(list(found.values()), probabilities)


def _nearest_components(
    points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], prior: PosePrior, mirrored: bool
) -> tuple[Int[np.ndarray, "C"], float, bool]:
    """The components that are near to the points of a hand of one side, and their density."""
    near = prior.nearest(points, labels, mirrored=mirrored, count=_NEAR)
    return near, prior.log_density(points, labels, mirrored=mirrored, among=near), mirrored


def _taken_back(
    candidate: _Candidate, probabilities: Float[np.ndarray, "N+1 M+1"]
) -> list[tuple[tuple[int, int], ...]]:
    """Sets of pairs of a point and a column of the table: those taken back so far and one more."""
    labels, num_labels = candidate.labels, probabilities.shape[1] - 1
    confidence = probabilities[np.arange(len(labels)), labels]
    unsure = [point for point in np.argsort(confidence)[:_MOST_UNSURE] if confidence[point] < _SURE]
    columns = np.where(labels >= 0, labels, num_labels + np.arange(len(labels)))
    return [(*candidate.without, (int(point), int(columns[point]))) for point in unsure]


def _without(
    table: Float[np.ndarray, "N M+N"], pairs: tuple[tuple[int, int], ...]
) -> Float[np.ndarray, "N M+N"]:
    """The table of costs without some pairs."""
    rest = table.copy()
    for point, column in pairs:
        rest[point, column] = IMPOSSIBLE
    return rest


def _elected(
    candidates: list[_Candidate], probabilities: Float[np.ndarray, "N+1 M+1"]
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The best labeling, and the confidence of each of its labels.

    That is the geometric mean of the network's own and the share of the labelings that agree, by their odds;
    the network's own where all agree. Points that are no hand in any labeling are labeled as the
    network has it.
    """
    scores = np.array([one.score for one in candidates])
    best = candidates[int(scores.argmax())]
    if best.density < _LEAST_DENSITY:
        best, candidates, scores = candidates[0], candidates[:1], scores[:1]
    labels = best.labels
    odds = np.exp(_TEMPERATURE * (scores - scores.max()))
    agree = np.array([one.labels == labels for one in candidates])
    share = (odds / odds.sum()) @ agree
    own = probabilities[np.arange(len(labels)), labels]
    return labels, np.where(agree.all(axis=0), own, np.sqrt(own * share))
