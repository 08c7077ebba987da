"""Labels for new points: first of the palms' markers, then of all digits with candidates, jointly.

Points within a radius of a digit's markers are its candidates. All assignments of them to its markers are
tested (`track.association.digit_hypotheses`). Where digits share candidates, within one hand or between two,
the best joint assignment is chosen. Labels with weak evidence can be reassigned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.hand.shape import DIGITS
from handsim.kernels import kernel, point_distance
from track.association.digit_hypotheses import (
    EXCLUDED_SCORE,
    DigitHypotheses,
    empty_hypotheses,
    evaluate_digit,
)
from track.association.frame_state import FrameState, Numbering, match_log_odds, match_points
from track.association.hand_state import HandState, HandTrack

MAX_CANDIDATES: Final = 7
"""Largest number of candidates of a digit; hypotheses and bits of joint assignments grow with it."""
SETTLED_EVIDENCE: Final = 4.0
"""Evidence (log-odds) from which a label is settled; weaker labels can be reassigned."""
_NOWHERE: Final = 1e6  # [m] position for markers of hands without a pose, far from all points
_SEEN_RADIUS: Final = 0.012  # [m] Points this close to a seen marker are its candidates.
_MISSING_RADIUS: Final = 0.05  # [m] Points this close to a missing marker are its candidates.


class DigitTable(NamedTuple):
    """The D digits of all hands, numbered through the hands, and their labels."""

    digits: Int[np.ndarray, "K"]  # digit of each label, -1 for the palm
    labels: Int[np.ndarray, "D K"]  # labels of each digit, -1 where there are fewer
    markers: Int[np.ndarray, "D K"]  # the same as markers of the hand's layout


class MarkerTable(NamedTuple):
    """The K markers of all hands, indexed by label, and the label of each of N points."""

    positions: Float[np.ndarray, "K 3"]  # predicted positions [m]
    digits: Int[np.ndarray, "K"]  # digit of each marker, numbered through the hands; -1 for the palm
    assigned: Int[np.ndarray, "N"]  # label of each point, -1 for none


class DigitCandidates(NamedTuple):
    """Candidate points of D digits, including their labeled points."""

    candidates: Int[np.ndarray, "D 7"]
    """Points of each digit: those labeled as its markers, then others, the nearest first."""
    counts: Int[np.ndarray, "D"]  # number of candidates; 0 if there is nothing to decide


def digit_table(states: Sequence[HandState], numbering: Numbering) -> DigitTable:
    """The table of all hands."""
    own = [np.where(one.digits >= 0, row * len(DIGITS) + one.digits, -1) for row, one in enumerate(states)]
    digits = np.concatenate([np.zeros(0, dtype=np.int64), *own])
    members = [np.flatnonzero(digits == digit) for digit in range(len(states) * len(DIGITS))]
    labels = np.full((len(members), max(map(len, members), default=0)), -1)
    for row, some in zip(labels, members, strict=True):
        row[: len(some)] = some
    owners = np.repeat(np.arange(len(states)), len(DIGITS))
    markers = [numbering.markers(owner, row) for owner, row in zip(owners.tolist(), labels, strict=True)]
    return DigitTable(digits, labels, np.array(markers).reshape(labels.shape))


def label_new_points(frame: FrameState, tracks: Sequence[HandTrack], table: DigitTable) -> FrameState:
    """Label unlabeled points, and reassign weakly supported labels, for hands with a pose."""
    if not tracks:
        return frame
    positions = np.full((len(table.digits), 3), _NOWHERE)
    for track in tracks:
        frame = _label_palm(frame, track)
        positions[frame.numbering.part(track.hand)] = track.estimate.positions
    assigned = frame.labels.copy()
    markers = MarkerTable(positions, table.digits, assigned)
    candidates = find_candidates(frame.points, frame.evidence, markers, len(table.labels))
    if not candidates.counts.any():
        return frame
    hypotheses = empty_hypotheses(len(table.labels), MAX_CANDIDATES, table.labels.shape[1])
    for track in tracks:
        _evaluate_hand(frame, track, candidates, table.markers, hypotheses)
    margins = np.full(len(frame.points), np.nan)
    assign_jointly(candidates, hypotheses, table.labels, assigned, margins)
    changed = assigned != frame.labels
    confidence = 1.0 / (1.0 + np.exp(-np.clip(margins[changed], 0.0, 30.0)))
    return frame._replace(labels=assigned).with_confidence(changed, confidence)


def _label_palm(frame: FrameState, track: HandTrack) -> FrameState:
    """Match unlabeled points with missing markers of a palm."""
    free = np.flatnonzero(frame.unlabeled)
    markers, missing = frame.markers(track.hand), track.state.digits < 0
    missing[markers[markers >= 0]] = False
    if not len(free) or not missing.any():
        return frame
    palm, expected = np.flatnonzero(missing), track.estimate.predicted
    density = track.state.config.stray_density
    log_odds = match_log_odds(
        frame.points[free], expected.positions[palm], expected.covariances[palm], density
    )
    log_odds += track.state.presence_log_odds(frame.first_seen, frame.free_since, markers)[np.ix_(free, palm)]
    matched, confidence = match_points(log_odds)
    chosen = free[matched >= 0]
    markers[chosen] = palm[matched[matched >= 0]]
    return frame.with_markers(track.hand, markers).with_confidence(chosen, confidence[matched >= 0])


def _evaluate_hand(
    frame: FrameState,
    track: HandTrack,
    candidates: DigitCandidates,
    digit_markers: NDArray[np.int64],
    hypotheses: DigitHypotheses,
) -> None:
    """Evaluate the hypotheses of one hand's digits, and write them to `hypotheses`."""
    first = track.hand * len(DIGITS)
    open_digits = np.flatnonzero(candidates.counts[first : first + len(DIGITS)]).tolist()
    if not open_digits:
        return
    state, markers = track.state, frame.markers(track.hand)
    log_odds = state.presence_log_odds(frame.first_seen, frame.free_since, markers)
    labeled = np.flatnonzero(markers >= 0)
    log_odds[labeled, markers[labeled]] = frame.evidence[labeled]
    confirmed, unconfirmed = state.digit_models(track.prediction, track.estimate)
    for digit in open_digits:
        row = first + digit
        evaluate_digit(
            state.solver.hand,
            confirmed if state.confirmed[digit] else unconfirmed,
            digit,
            digit_markers[row, digit_markers[row] >= 0],
            frame.points,
            candidates.candidates[row, : candidates.counts[row]],
            log_odds,
            DigitHypotheses(*(values[row] for values in hypotheses)),
        )


def find_candidates(
    points: Float[np.ndarray, "N 3"], evidence: Float[np.ndarray, "N"], table: MarkerTable, num_digits: int
) -> DigitCandidates:
    """Find the candidates of each digit."""
    found = DigitCandidates(np.full((num_digits, MAX_CANDIDATES), -1), np.zeros(num_digits, dtype=np.int64))
    _find_candidates(points, evidence, table, found)
    return found


@kernel
def _find_candidates(
    points: Float[np.ndarray, "N 3"],
    evidence: Float[np.ndarray, "N"],
    table: MarkerTable,
    found: DigitCandidates,
) -> None:
    """Kernel of `find_candidates`."""
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
                weak = incomplete and evidence[point] < SETTLED_EVIDENCE
                undecided = undecided or contested[point] or weak
                found.candidates[digit, count] = point
                count += 1
        if undecided or rivals.any():
            found.counts[digit] = _add_nearest(distances[digit], rivals, found.candidates[digit], count)


@kernel
def _find_contested(
    points: Float[np.ndarray, "N 3"],
    evidence: Float[np.ndarray, "N"],
    table: MarkerTable,
    missing: Bool[np.ndarray, "K"],
) -> Bool[np.ndarray, "N"]:
    """Points with a weakly supported label and a missing marker of another digit nearby."""
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


@kernel
def assign_jointly(
    candidates: DigitCandidates,
    hypotheses: DigitHypotheses,
    markers: Int[np.ndarray, "D K"],
    assigned: Int[np.ndarray, "N"],
    margins: Float[np.ndarray, "N"],
) -> None:
    """Choose the best joint hypothesis of all digits; write labels and their margins over the next best."""
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
    """`assign_jointly` for a group of digits that share points directly or indirectly."""
    most = hypotheses.scores.shape[1]
    rows, counts = np.zeros((len(group), most), dtype=np.int64), np.zeros(len(group), dtype=np.int64)
    scores, sets = np.full((len(group), most), EXCLUDED_SCORE), np.zeros((len(group), most), dtype=np.int64)
    bits = np.full(len(assigned), -1)
    num_bits = 0  # at most 61: ten digits with seven candidates, each sharing one with another
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
    """Write the possible rows to `rows`, the best first; return their number."""
    count = 0
    for row in range(len(scores)):
        if scores[row] <= EXCLUDED_SCORE:
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
    """Choose one row per digit without a shared point, by branch and bound; return the best score."""
    digits = len(scores)
    bound = np.zeros(digits + 1)
    for digit in range(digits - 1, -1, -1):
        bound[digit] = bound[digit + 1] + scores[digit, 0]
    row, total, used = np.full(digits, -1), np.zeros(digits + 1), np.zeros(digits + 1, dtype=np.int64)
    most, digit = EXCLUDED_SCORE, 0
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
