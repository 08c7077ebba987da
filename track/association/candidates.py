"""Candidate points of each digit: those within a radius of its markers; compiled."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from handsim.kernels.kernel import kernel
from handsim.kernels.segments import point_distance

MAX_CANDIDATES: Final = 7
"""Candidates of a digit at most; the number of hypotheses and the bits of a joint assignment grow with it."""
SETTLED_EVIDENCE: Final = 4.0
"""Evidence from which on a label is settled (log-odds); below it the label can be reassigned."""
_SEEN_RADIUS: Final = 0.012  # [m] from a marker that has a point, within which others are its candidates
_MISSING_RADIUS: Final = 0.05  # [m] from a missing marker, within which points are its candidates


class MarkerTable(NamedTuple):
    """The K markers of all hands by their labels, and the label of each of N points."""

    positions: Float[np.ndarray, "K 3"]
    """Predicted positions [m]."""
    digits: Int[np.ndarray, "K"]
    """Digit of each marker, counted through the hands; -1 on a palm."""
    assigned: Int[np.ndarray, "N"]
    """Label of each point, -1 for none."""


class DigitCandidates(NamedTuple):
    """Candidate points of D digits, those with their labels among them."""

    candidates: Int[np.ndarray, "D 7"]
    """Points of each digit: first those labeled as its markers, then others, the nearest first."""
    counts: Int[np.ndarray, "D"]
    """How many there are; zero where there is nothing to decide."""
    labeled: Int[np.ndarray, "D"]
    """How many of them are labeled as the digit's markers."""


def find_candidates(
    points: Float[np.ndarray, "N 3"],
    evidence: Float[np.ndarray, "N"],
    table: MarkerTable,
    num_digits: int,
) -> DigitCandidates:
    """The candidates of each digit."""
    found = DigitCandidates(
        np.full((num_digits, MAX_CANDIDATES), -1),
        np.zeros(num_digits, dtype=np.int64),
        np.zeros(num_digits, dtype=np.int64),
    )
    _find_candidates(points, evidence, table, found)
    return found


@kernel
def _find_candidates(
    points: Float[np.ndarray, "N 3"],
    evidence: Float[np.ndarray, "N"],
    table: MarkerTable,
    found: DigitCandidates,
) -> None:
    """Fill `found`; the other arguments are those of `find_candidates`."""
    positions, digits, assigned = table
    missing = np.ones(len(positions), dtype=np.bool_)
    for owner in assigned:
        if owner >= 0:
            missing[owner] = False
    contested = _find_contested(points, evidence, table, missing)
    distances = np.full((len(found.counts), len(points)), np.inf)
    for digit in range(len(found.counts)):
        incomplete, undecided = False, False
        rivals = np.zeros(len(points), dtype=np.bool_)
        for marker in range(len(positions)):
            if digits[marker] != digit:
                continue
            incomplete = incomplete or missing[marker]
            for point in range(len(points)):
                distance = point_distance(points[point], positions[marker])
                distances[digit, point] = min(distances[digit, point], distance)
                if assigned[point] < 0:
                    rivals[point] |= distance < (_MISSING_RADIUS if missing[marker] else _SEEN_RADIUS)
                elif contested[point] and missing[marker]:
                    rivals[point] |= distance < _MISSING_RADIUS
        count = 0
        for point in range(len(points)):
            if assigned[point] >= 0 and digits[assigned[point]] == digit:
                rivals[point] = False
                undecided = (
                    undecided or contested[point] or (incomplete and evidence[point] < SETTLED_EVIDENCE)
                )
                found.candidates[digit, count] = point
                count += 1
        if not (undecided or rivals.any()):
            continue
        found.labeled[digit] = count
        found.counts[digit] = _add_nearest(distances[digit], rivals, found.candidates[digit], count)


@kernel
def _find_contested(
    points: Float[np.ndarray, "N 3"],
    evidence: Float[np.ndarray, "N"],
    table: MarkerTable,
    missing: Bool[np.ndarray, "K"],
) -> Bool[np.ndarray, "N"]:
    """Points with an unsettled label and a missing marker of another digit nearby."""
    contested = np.zeros(len(points), dtype=np.bool_)
    for point in range(len(points)):
        owner = table.assigned[point]
        if owner < 0 or table.digits[owner] < 0 or evidence[point] >= SETTLED_EVIDENCE:
            continue
        for marker in range(len(missing)):
            other = missing[marker] and table.digits[marker] not in (-1, table.digits[owner])
            if other and point_distance(points[point], table.positions[marker]) < _MISSING_RADIUS:
                contested[point] = True
    return contested


@kernel
def _add_nearest(
    distances: Float[np.ndarray, "N"],
    rivals: Bool[np.ndarray, "N"],
    candidates: Int[np.ndarray, "7"],
    count: int,
) -> int:
    """Append the nearest rivals to a digit's candidates while there is room; return their number."""
    while count < len(candidates):
        nearest = -1
        for point in range(len(rivals)):
            if rivals[point] and (nearest < 0 or distances[point] < distances[nearest]):
                nearest = point
        if nearest < 0:
            break
        rivals[nearest] = False
        candidates[count] = nearest
        count += 1
    return count
