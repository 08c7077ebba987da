"""Labels of continuous frames: hands are tracked forward and backward, and the better labels are kept.

A tracker that fails at an event is wrong after it when tracking forward, and before it when tracking
backward. Where the directions differ, each event takes the labels of the direction in which they are
likelier.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.takes.points import PointList
from gloves.takes.take import LOST, TRACKED, Take
from handsim.app.workers import LocalProcesses, can_be_sent
from handsim.arrays import Flags, Integers
from handsim.hand.shape import NUM_QPOS
from track.association.initialization import connected_components
from track.frames import StreamedFrame, TrackedHand
from track.takes.label_confidence import label_confidence
from track.tracker import Tracker

_EXACT_LOG_ODDS: Final = 6.0  # log-odds that a point exactly at a marker is that marker and not a stray
_RMS_SPREAD: Final = 0.003  # [m] standard deviation of the RMS distance of labeled markers from a pose
_EXCHANGED_SHARE: Final = 0.5  # Hands are exchanged if more points than this share change hands.
_LEAST_CONFIDENCE: Final = 1e-4  # Confidences are clipped to between this and one minus this.
_AGREEMENT_ODDS: Final = 5.0  # factor of a label's odds where both directions agree, on simulated captures


class _TrackedCapture(NamedTuple):
    """Result of tracking a capture in one direction."""

    take: Take
    """Labels and poses."""
    evidence: Float[np.ndarray, "T"]
    """Log-odds of the labeled points of all hands, from their distances to the poses."""


class _Events(NamedTuple):
    """The E points whose labels differ between the directions."""

    points: Int[np.ndarray, "E"]
    """Indices of these points in the take."""
    numbers: Int[np.ndarray, "E"]
    """Event number of each point."""


def label_both_ways(
    take: Take,
    frames: Sequence[StreamedFrame],
    new_tracker: Callable[[], Tracker],
    on_count: Callable[[int], None],
    helper: LocalProcesses | None = None,
) -> Take:
    """Label a take in both directions, backward in a helper process if there is one.

    `on_count` is called with the number of frames done.
    """
    forward, backward = _track_both_ways(take, frames, new_tracker, on_count, helper)
    points, forward_labels = take.point_list, forward.take.point_list.labels
    backward_labels = backward.take.point_list.labels
    takes_backward = np.zeros(forward_labels.shape, dtype=bool)
    events = _events_of(points.frames, forward_labels, backward_labels)
    takes_backward[events.points] = _is_likelier(backward.take, forward.take, events)
    is_better = backward.evidence > forward.evidence
    # Where the directions exchange the hands, one direction decides for the whole run.
    for run in _exchanged_runs(points, forward_labels, backward_labels, len(take.hand_labels[0])):
        is_better[run] = backward.evidence[run].sum() > forward.evidence[run].sum()
        takes_backward[points.starts[run.start] : points.starts[run.stop]] = is_better[run.start]
    labels = np.where(takes_backward, backward_labels, forward_labels)
    qpos, rms = _better_poses(forward.take, backward.take, is_better)
    right = label_confidence(_with_poses(take, labels, qpos, rms))
    odds = np.where(forward_labels == backward_labels, _AGREEMENT_ODDS, 1.0)
    confidence = odds * right / (1.0 - right + odds * right)
    points = dataclasses.replace(points, labels=labels, confidence=confidence)
    return dataclasses.replace(take, point_list=points)


def _track_both_ways(
    take: Take,
    frames: Sequence[StreamedFrame],
    new_tracker: Callable[[], Tracker],
    on_count: Callable[[int], None],
    helper: LocalProcesses | None,
) -> tuple[_TrackedCapture, _TrackedCapture]:
    """Track the hands twice: from the first frame to the last, and from the last to the first."""
    count = len(frames)
    order = range(count)
    if helper is None or not can_be_sent(new_tracker):
        forward = _track(take, frames, order, new_tracker, lambda done: on_count(done // 2))
        return forward, _track(
            take, frames, order[::-1], new_tracker, lambda done: on_count((count + done) // 2)
        )
    backward = helper.submit(_track, take, frames, order[::-1], new_tracker)
    forward = _track(take, frames, order, new_tracker, lambda done: on_count(min(done, count - 1)))
    found: _TrackedCapture = backward.result()
    on_count(count)
    return forward, found


def _track(
    take: Take,
    frames: Sequence[StreamedFrame],
    order: Sequence[int],
    new_tracker: Callable[[], Tracker],
    on_count: Callable[[int], None] = lambda _: None,
) -> _TrackedCapture:
    """Track the hands through frames in the given order."""
    tracker = new_tracker()
    points, num_hands = take.point_list, len(tracker.hands)
    labels, evidence = points.labels.copy(), np.zeros(len(frames))
    qpos, rms = np.zeros((len(frames), num_hands, NUM_QPOS)), np.zeros((len(frames), num_hands))
    for count, row in enumerate(order, 1):
        frame = frames[row]
        one = tracker.step(frame.points, frame.ids, abs(frame.time - frames[order[0]].time))
        labels[points.of(row)] = one.labels
        qpos[row], rms[row] = [hand.qpos for hand in one.hands], [hand.rms for hand in one.hands]
        evidence[row] = sum(map(_hand_evidence, one.hands))
        on_count(count)
    posed = _with_poses(take, labels, qpos, rms)
    sure = dataclasses.replace(posed.point_list, confidence=label_confidence(posed))
    return _TrackedCapture(dataclasses.replace(posed, point_list=sure), evidence)


def _with_poses(
    take: Take, labels: Int[np.ndarray, "P"], qpos: Float[np.ndarray, "T H 27"], rms: Float[np.ndarray, "T H"]
) -> Take:
    """The take with labels and the poses [m, rad] that gave them, NaN for lost hands."""
    status = np.where(np.isfinite(qpos[..., 0]), TRACKED, LOST)
    points = dataclasses.replace(take.point_list, labels=labels)
    return dataclasses.replace(take, point_list=points, qpos=qpos, status=status, rms=rms)


def _hand_evidence(hand: TrackedHand) -> float:
    """Log-odds of a hand's labels, from the number and RMS distance of its points."""
    if not np.isfinite(hand.rms):
        return 0.0
    return (len(hand.markers) - len(hand.filled)) * (_EXACT_LOG_ODDS - 0.5 * (hand.rms / _RMS_SPREAD) ** 2)


def _events_of(frames: Integers, one: Integers, other: Integers) -> _Events:
    """Group the points (P,) whose two labels differ into events.

    Two points belong to one event if they exchange a label between the directions in a frame, or if they have
    the same two labels in successive frames.
    """
    points = np.flatnonzero(one != other)
    rows = frames[points]
    first, second = (labels[points].astype(np.int64) + 1 for labels in (one, other))
    span = max(first.max(initial=0), second.max(initial=0)) + 1
    pairs = first * span + second
    order = np.lexsort((rows, pairs))
    follows = (np.diff(pairs[order]) == 0) & (np.diff(rows[order]) == 1)
    with_first, with_second = np.flatnonzero(first), np.flatnonzero(second)
    keys = rows[with_first] * span + first[with_first], rows[with_second] * span + second[with_second]
    _, mine, others = np.intersect1d(*keys, assume_unique=True, return_indices=True)
    same, exchanged = [order[:-1][follows], order[1:][follows]], [with_first[mine], with_second[others]]
    links = np.concatenate([same, exchanged], axis=1)
    return _Events(points, connected_components(links, len(rows)))


def _is_likelier(take: Take, other: Take, events: _Events) -> Bool[np.ndarray, "E"]:
    """For each point, whether a take's labels of its event are likelier than another take's.

    An unlabeled point counts as no evidence if its take has lost the hand of the other take's label.
    """
    log_odds, markers = [], len(take.hand_labels[0])
    rows = take.point_list.frames[events.points]
    for one, rival in ((take, other), (other, take)):
        right = np.clip(one.point_list.confidence[events.points], _LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE)
        hand = rival.point_list.labels[events.points] // markers
        is_silent = (hand >= 0) & (hand < len(take.hand_labels)) & (one.point_list.labels[events.points] < 0)
        is_silent[is_silent] &= one.status[rows[is_silent], hand[is_silent]] == LOST
        log_odds.append(np.where(is_silent, 0.0, np.log(right / (1.0 - right))))
    gain = np.bincount(events.numbers, log_odds[0] - log_odds[1])
    return np.asarray(gain[events.numbers] > 0.0)


def _exchanged_runs(
    points: PointList, one: Int[np.ndarray, "P"], other: Int[np.ndarray, "P"], num_markers: int
) -> Iterator[slice]:
    """Runs of frames in which the directions give most points of a hand to different hands."""
    both = (one >= 0) & (other >= 0)
    exchanged = both & (one // num_markers != other // num_markers)
    count = len(points.counts)
    numbers = [np.bincount(points.frames[which], minlength=count) for which in (exchanged, both)]
    wrong = numbers[0] > _EXCHANGED_SHARE * numbers[1]
    yield from (slice(first, last + 1) for first, last in runs_of(wrong))


def _better_poses(
    one: Take, other: Take, is_better: Bool[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T H 27"], Float[np.ndarray, "T H"]]:
    """Poses and RMS of the better take; for hands that it has lost, those of the other take."""
    there = [np.isfinite(take.qpos[..., 0]) for take in (one, other)]
    chosen: Flags = np.where(is_better[:, None], there[1], there[1] & ~there[0])
    return np.where(chosen[..., None], other.qpos, one.qpos), np.where(chosen, other.rms, one.rms)
