"""Labels for new points: first the palms' markers, then those of all digits with candidates, jointly.

All assignments of a digit's candidates to its markers are tested on the digit
(`track.association.digit_hypotheses`). Where digits share candidates, of one hand or of two that touch, the
best joint assignment is taken (`track.association.joint_assignment`). Labels that are not settled yet can be
reassigned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.topology import DIGITS
from track.association.candidates import MAX_CANDIDATES, DigitCandidates, MarkerTable, find_candidates
from track.association.digit_hypotheses import DigitHypotheses, empty_hypotheses, evaluate_digit
from track.association.frame_state import FrameState
from track.association.hand_state import Estimate, HandState, Prediction
from track.association.joint_assignment import assign_jointly
from track.association.point_matching import match_log_odds, match_points


@dataclass(frozen=True, slots=True, eq=False)
class HandTrack:
    """A hand with a pose in the current frame."""

    index: int
    """Index of the hand."""
    state: HandState
    """Its filter state."""
    prediction: Prediction
    """The pose before the frame's markers were used."""
    estimate: Estimate
    """The pose fitted to the labels that IDs carried over."""


def label_new_points(hands: Sequence[HandTrack], frame: FrameState) -> Float[np.ndarray, "P"]:
    """Label points without a label, and reassign labels that are not settled.

    Args:
        hands: The hands that have a pose.
        frame: The frame; its `labels` are overwritten.

    Returns:
        Confidence in each label that has changed; NaN for the others.
    """
    confidence = np.full(len(frame.points), np.nan)
    if not hands:
        return confidence
    for hand in hands:
        _label_palm(hand, frame, confidence)
    table = _marker_table(hands, frame)
    association = hands[0].state.config.association
    candidates = find_candidates(frame.points, frame.evidence, table, len(hands) * len(DIGITS), association)
    if not candidates.counts.any():
        return confidence
    markers = _markers_of_digits(table.digits, len(candidates.counts))
    hypotheses = empty_hypotheses(len(candidates.counts), MAX_CANDIDATES, markers.shape[1])
    first = 0
    for row, hand in enumerate(hands):
        digits = slice(row * len(DIGITS), (row + 1) * len(DIGITS))
        own = DigitCandidates(*(values[digits] for values in candidates))
        rows = DigitHypotheses(*(values[digits] for values in hypotheses))
        _evaluate_hand(hand, frame, own, markers[digits] - first, rows)
        first += hand.state.num_markers
    before, margins = table.assigned.copy(), np.full(len(frame.points), np.nan)
    assign_jointly(candidates, hypotheses, markers, table.assigned, margins)
    changed = before != table.assigned
    confidence[changed] = 1.0 / (1.0 + np.exp(-np.clip(margins[changed], 0.0, 30.0)))
    _write_labels(hands, table.assigned, frame)
    return confidence


def _label_palm(
    hand: HandTrack,
    frame: FrameState,
    confidence: NDArray[np.float64],
) -> None:
    """Match unlabeled points with the missing markers of a palm; labels and confidence are overwritten."""
    labels = frame.labels[hand.index]
    missing = hand.state.digits < 0
    missing[labels[labels >= 0]] = False
    if not missing.any():
        return
    palm, free = np.flatnonzero(missing), np.flatnonzero(frame.unlabeled)
    if len(free) == 0:
        return
    log_odds = match_log_odds(
        frame.points[free],
        hand.estimate.positions[palm],
        hand.estimate.covariances[palm],
        hand.state.config.association.stray_density,
    )
    log_odds += hand.state.presence_log_odds(frame.first_seen[free])[:, palm]
    matched, match_confidence = match_points(log_odds)
    chosen = free[matched >= 0]
    labels[chosen], confidence[chosen] = palm[matched[matched >= 0]], match_confidence[matched >= 0]


def _marker_table(hands: Sequence[HandTrack], frame: FrameState) -> MarkerTable:
    """The markers of all hands in a row."""
    assigned, digits, first = np.full(len(frame.points), -1), [], 0
    for row, hand in enumerate(hands):
        labels, own = frame.labels[hand.index], hand.state.digits
        assigned[labels >= 0] = first + labels[labels >= 0]
        digits.append(np.where(own >= 0, row * len(DIGITS) + own, -1))
        first += hand.state.num_markers
    positions = np.concatenate([hand.estimate.positions for hand in hands])
    return MarkerTable(positions, np.concatenate(digits), assigned)


def _markers_of_digits(digits: NDArray[np.int64], num_digits: int) -> NDArray[np.int64]:
    """Markers of each digit (D, K), -1 where there are fewer."""
    members = [np.flatnonzero(digits == digit) for digit in range(num_digits)]
    markers = np.full((num_digits, max(map(len, members))), -1)
    for row, own in zip(markers, members, strict=True):
        row[: len(own)] = own
    return markers


def _evaluate_hand(
    hand: HandTrack,
    frame: FrameState,
    candidates: DigitCandidates,
    markers: NDArray[np.int64],
    hypotheses: DigitHypotheses,
) -> None:
    """Evaluate the hypotheses of one hand's digits, which are filled."""
    if not candidates.counts.any():
        return
    state, labels = hand.state, frame.labels[hand.index]
    log_odds, labeled = state.presence_log_odds(frame.first_seen), np.flatnonzero(labels >= 0)
    log_odds[labeled, labels[labeled]] = frame.evidence[labeled]
    confirmed, unconfirmed = state.digit_models(hand.prediction, hand.estimate)
    for digit in np.flatnonzero(candidates.counts).tolist():
        evaluate_digit(
            state.adapted,
            confirmed if state.confirmed[digit] else unconfirmed,
            digit,
            markers[digit, markers[digit] >= 0],
            frame.points,
            candidates.candidates[digit, : candidates.counts[digit]],
            log_odds,
            *(values[digit] for values in hypotheses),
        )


def _write_labels(hands: Sequence[HandTrack], assigned: NDArray[np.int64], frame: FrameState) -> None:
    """Write the markers of points, counted through the hands, to the frame's labels."""
    first = 0
    for hand in hands:
        last = first + hand.state.num_markers
        frame.labels[hand.index] = np.where((assigned >= first) & (assigned < last), assigned - first, -1)
        first = last
