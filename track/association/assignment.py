"""Assignment of points to markers: by log-odds for a palm, by hypotheses for digits that share points.

The digits' candidates and hypotheses are those of `candidates` and `digit_hypotheses`; their joint assignment
is compiled.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from handsim.kernels.kernel import kernel
from track.association.candidates import DigitCandidates
from track.association.digit_hypotheses import IMPOSSIBLE, DigitHypotheses
from train.labelers.matching import assign


def match_log_odds(
    points: Float[np.ndarray, "P 3"],
    positions: Float[np.ndarray, "K 3"],
    covariances: Float[np.ndarray, "K 3 3"],
    stray_density: float,
) -> Float[np.ndarray, "P K"]:
    """Log-odds of each point being a marker rather than a stray.

    Args:
        stray_density: Density of points that are no marker [1/m^3].
    """
    innovation = points[:, None] - positions
    precision = np.linalg.inv(covariances)
    square = np.einsum("pki,kij,pkj->pk", innovation, precision, innovation)
    log_odds: np.ndarray = (
        0.5 * np.log(np.linalg.det(precision)) - 0.5 * square - _stray_log_density(stray_density)
    )
    return log_odds


def peak_log_odds(variances: Float[np.ndarray, "K"], stray_density: float) -> Float[np.ndarray, "K"]:
    """Log-odds of a point exactly at the predicted position of a marker.

    Args:
        variances: Variance of each marker in each direction [m^2].
        stray_density: Density of points that are no marker [1/m^3].
    """
    log_odds: np.ndarray = -1.5 * np.log(variances) - _stray_log_density(stray_density)
    return log_odds


def match_points(
    log_odds: Float[np.ndarray, "P K"],
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The most likely assignment of points to markers, one to one; either may stay alone.

    Returns the marker of each point, -1 for none, and the confidence in it [0, 1], which weighs the
    alternatives of both.
    """
    _, labels = assign(-log_odds, np.zeros(len(log_odds)))
    if 0 in log_odds.shape:
        return labels, np.ones(len(log_odds))
    weights = np.exp(np.minimum(log_odds, 50.0))
    alternatives = 1.0 + weights.sum(axis=1, keepdims=True) + weights.sum(axis=0) - weights
    share = weights / alternatives
    confidence = 1.0 - (weights / (1.0 + weights.sum(axis=1, keepdims=True))).sum(axis=1)
    matched = np.flatnonzero(labels >= 0)
    confidence[matched] = share[matched, labels[matched]]
    return labels, confidence


def _stray_log_density(stray_density: float) -> float:
    """Log density of strays, less the constant of a normal density."""
    return float(np.log(stray_density * (2.0 * np.pi) ** 1.5))


@kernel
def assign_jointly(
    candidates: DigitCandidates,
    hypotheses: DigitHypotheses,
    markers: Int[np.ndarray, "D K"],
    assigned: Int[np.ndarray, "N"],
    margins: Float[np.ndarray, "N"],
) -> None:
    """Assign points to digits: the best combination of hypotheses of all digits that share points.

    Args:
        hypotheses: The best assignment of every set of them, digit by digit.
        markers: Markers of each digit, counted through the hands; -1 where there are fewer.
        assigned: Marker of each point, -1 for none; overwritten.
        margins: Log-odds by which the next best combination is worse in which a point has another label;
            written for candidate points.
    """
    pending = candidates.counts > 0
    group = np.empty(len(pending), dtype=np.int64)
    for first in range(len(pending)):
        if not pending[first]:
            continue
        group[0], size, index = first, 1, 0
        pending[first] = False
        while index < size:
            for other in range(len(pending)):
                if pending[other] and _share_points(candidates, group[index], other):
                    pending[other] = False
                    group[size] = other
                    size += 1
            index += 1
        _assign_group(group[:size], candidates, hypotheses, markers, assigned, margins)


@kernel
def _share_points(candidates: DigitCandidates, one: int, other: int) -> bool:
    """Whether two digits have a candidate in common."""
    for index in range(candidates.counts[one]):
        for second in range(candidates.counts[other]):
            if candidates.candidates[one, index] == candidates.candidates[other, second]:
                return True
    return False


@kernel
def _assign_group(
    group: Int[np.ndarray, "G"],
    candidates: DigitCandidates,
    hypotheses: DigitHypotheses,
    markers: Int[np.ndarray, "D K"],
    assigned: Int[np.ndarray, "N"],
    margins: Float[np.ndarray, "N"],
) -> None:
    """`assign_jointly` for a group of digits that share points, directly or through others."""
    most = hypotheses.scores.shape[1]
    rows, counts = np.zeros((len(group), most), dtype=np.int64), np.zeros(len(group), dtype=np.int64)
    scores, sets = np.full((len(group), most), -IMPOSSIBLE), np.zeros((len(group), most), dtype=np.int64)
    bits = np.full(len(assigned), -1)
    num_bits = 0  # 61 at most for ten digits with seven candidates, as each shares one with another
    for index, digit in enumerate(group):
        for point in candidates.candidates[digit, : candidates.counts[digit]]:
            assigned[point], margins[point] = -1, np.inf
            if bits[point] < 0:
                bits[point] = num_bits
                num_bits += 1
        counts[index] = _sort_rows(hypotheses.scores[digit], rows[index])
        for rank in range(counts[index]):
            row = rows[index, rank]
            scores[index, rank] = hypotheses.scores[digit, row]
            for number in range(candidates.counts[digit]):
                if row >> number & 1:
                    sets[index, rank] |= 1 << bits[candidates.candidates[digit, number]]
    banned, other = np.full(len(group), -1), np.zeros(len(group), dtype=np.int64)
    best = np.zeros(len(group), dtype=np.int64)
    total = best_combination(scores, sets, counts, banned, best)
    for index, digit in enumerate(group):
        row = rows[index, best[index]]
        for number in range(markers.shape[1]):
            if hypotheses.assignments[digit, row, number] >= 0:
                assigned[candidates.candidates[digit, hypotheses.assignments[digit, row, number]]] = markers[
                    digit, number
                ]
        banned[index] = best[index]
        alternative = best_combination(scores, sets, counts, banned, other)
        banned[index] = -1
        alternative = max(alternative, total - scores[index, best[index]] + hypotheses.runners_up[digit, row])
        for point in candidates.candidates[digit, : candidates.counts[digit]]:
            margins[point] = min(margins[point], total - alternative)


@kernel
def _sort_rows(scores: Float[np.ndarray, "S"], rows: Int[np.ndarray, "S"]) -> int:
    """Write the rows that are possible to `rows`, the best first, and return how many there are."""
    count = 0
    for row in range(len(scores)):
        if scores[row] <= -IMPOSSIBLE:
            continue
        index = count
        while index > 0 and scores[rows[index - 1]] < scores[row]:
            rows[index] = rows[index - 1]
            index -= 1
        rows[index] = row
        count += 1
    return count


@kernel
def best_combination(
    scores: Float[np.ndarray, "D S"],
    sets: Int[np.ndarray, "D S"],
    counts: Int[np.ndarray, "D"],
    banned: Int[np.ndarray, "D"],
    best: Int[np.ndarray, "D"],
) -> float:
    """The best choice of one row per digit such that no point is used twice, by branch and bound.

    Args:
        scores: Scores of each digit's rows (log-odds), the best first.
        sets: Points that each row uses, one bit per point.
        counts: Rows of each digit; the last must use no point.
        banned: A row of each digit that must not be chosen; -1 for none.
        best: The chosen rows, overwritten.

    Returns:
        The sum of their scores; `-IMPOSSIBLE` if there is no choice.
    """
    digits = len(scores)
    bound = np.zeros(digits + 1)
    for digit in range(digits - 1, -1, -1):
        bound[digit] = bound[digit + 1] + scores[digit, 0]
    row, total, used = np.full(digits, -1), np.zeros(digits + 1), np.zeros(digits + 1, dtype=np.int64)
    most, digit = -IMPOSSIBLE, 0
    while digit >= 0:
        row[digit] += 1
        chosen = row[digit]
        if chosen >= counts[digit] or total[digit] + scores[digit, chosen] + bound[digit + 1] <= most:
            row[digit] = -1
            digit -= 1
            continue
        if chosen == banned[digit] or used[digit] & sets[digit, chosen]:
            continue
        total[digit + 1] = total[digit] + scores[digit, chosen]
        used[digit + 1] = used[digit] | sets[digit, chosen]
        if digit + 1 < digits:
            digit += 1
        elif total[digits] > most:
            most = total[digits]
            best[:] = row
    return most
