"""Labels for new points: first the palms' markers, then those of all digits with candidates, jointly.

All assignments of a digit's candidates to its markers are tested on the digit
(`track.association.digit_hypotheses`). Where digits share candidates, of one hand or of two that touch, the
best joint assignment is taken (`track.association.assignment`). Labels that are not settled yet can be
reassigned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from handsim.hand.shape import DIGITS
from track.association.assignment import assign_jointly, match_log_odds, match_points
from track.association.candidates import MAX_CANDIDATES, DigitCandidates, MarkerTable, find_candidates
from track.association.digit_hypotheses import DigitHypotheses, empty_hypotheses, evaluate_digit
from track.association.frame_state import FrameState, Numbering
from track.association.hand_state import HandState, HandTrack

_NOWHERE: Final = 1e6  # [m] of the markers of a hand without a pose, which no point is near


class DigitTable(NamedTuple):
    """The D digits of all hands, counted through the hands, with their labels."""

    digits: Int[np.ndarray, "K"]
    """Digit of each label, -1 for a palm's."""
    labels: Int[np.ndarray, "D K"]
    """Labels of each digit, -1 where there are fewer."""
    markers: Int[np.ndarray, "D K"]
    """The same in the order of the hand's layout."""


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
    """Label points without a label, and reassign labels that are not settled.

    Args:
        tracks: The hands that have a pose.
    """
    if not tracks:
        return frame
    for track in tracks:
        frame = _label_palm(frame, track)
    positions = np.full((len(table.digits), 3), _NOWHERE)
    for track in tracks:
        positions[frame.numbering.part(track.hand)] = track.estimate.positions
    assigned = frame.labels.copy()
    markers = MarkerTable(positions, table.digits, assigned)
    candidates = find_candidates(frame.points, frame.evidence, markers, len(table.labels))
    if not candidates.counts.any():
        return frame
    hypotheses = empty_hypotheses(len(table.labels), MAX_CANDIDATES, table.labels.shape[1])
    for track in tracks:
        rows = _rows(track.hand)
        own = DigitCandidates(*(values[rows] for values in candidates))
        filled = DigitHypotheses(*(values[rows] for values in hypotheses))
        _evaluate_hand(frame, track, own, table.markers[rows], filled)
    margins = np.full(len(frame.points), np.nan)
    assign_jointly(candidates, hypotheses, table.labels, assigned, margins)
    changed = assigned != frame.labels
    confidence = 1.0 / (1.0 + np.exp(-np.clip(margins[changed], 0.0, 30.0)))
    return frame._replace(labels=assigned).with_confidence(changed, confidence)


def _rows(hand: int) -> slice:
    """The digits of a hand."""
    return slice(hand * len(DIGITS), (hand + 1) * len(DIGITS))


def _label_palm(frame: FrameState, track: HandTrack) -> FrameState:
    """Match unlabeled points with the missing markers of a palm."""
    free = np.flatnonzero(frame.unlabeled)
    if not len(free):
        return frame
    markers, missing = frame.markers(track.hand), track.state.digits < 0
    missing[markers[markers >= 0]] = False
    if not missing.any():
        return frame
    palm = np.flatnonzero(missing)
    log_odds = match_log_odds(
        frame.points[free],
        track.estimate.positions[palm],
        track.estimate.covariances[palm],
        track.state.config.stray_density,
    )
    log_odds += track.state.presence_log_odds(frame.first_seen[free])[:, palm]
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
    """Evaluate the hypotheses of one hand's digits, which are filled."""
    if not candidates.counts.any():
        return
    state, markers = track.state, frame.markers(track.hand)
    log_odds, labeled = state.presence_log_odds(frame.first_seen), np.flatnonzero(markers >= 0)
    log_odds[labeled, markers[labeled]] = frame.evidence[labeled]
    confirmed, unconfirmed = state.digit_models(track.prediction, track.estimate)
    for digit in np.flatnonzero(candidates.counts).tolist():
        evaluate_digit(
            state.adapted,
            confirmed if state.confirmed[digit] else unconfirmed,
            digit,
            digit_markers[digit, digit_markers[digit] >= 0],
            frame.points,
            candidates.candidates[digit, : candidates.counts[digit]],
            log_odds,
            *(values[digit] for values in hypotheses),
        )
