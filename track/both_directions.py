"""Labels of frames that follow from each other: the hands are tracked forward and backward.

A track that goes wrong at an event is wrong after it in one direction and before it in the other. Where the
directions differ the labeler, which knows no history, is the third witness of each point's label.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.captures.capture import runs_of
from track.association.initialization import MOST_POINTS
from track.association.point_groups import distances_to_nearest
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import TrackedHand
from track.tracker import Tracker
from track.user import User
from train.labelers.protocol import Labeler

_NEAR: Final = 0.03  # [m] from a hand's markers, within which a point without a label may be one
_NOT_ASKED: Final = -2  # label of a point that the labeler was not shown
_WORTH: Final = 6.0  # log-odds of a point that lies exactly where its marker is, against a stray
_SPREAD: Final = 0.003  # [m] of the RMS distance of labeled markers from a pose
_MOST: Final = 0.5  # share of the points with two labels, whose hands are different
_MAJORITY: Final = 2.0 / 3.0  # of the confidence in a label that one of three witnesses denies


class BothWays(NamedTuple):
    """Labels of frames, and what they were found with."""

    labels: list[Int[np.ndarray, "N"]]
    """Marker of each point of each frame, counted through the hands in their order; -1 for none."""
    agreed: list[Bool[np.ndarray, "N"]]
    """Whether the directions give it the same label."""
    qpos: Float[np.ndarray, "T H 27"]
    """The poses of the direction that fits better; NaN where both have lost a hand."""
    rms: Float[np.ndarray, "T H"]
    """3D RMS distance of the labeled markers from these poses' [m]; NaN without a fit."""


class _Tracked(NamedTuple):
    """What the tracker made of a frame in one direction."""

    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands in their order; -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Confidence in each label, 0 to 1."""
    markers: Float[np.ndarray, "H M 3"]
    """Every hand's markers [m]; NaN where it is lost."""
    qpos: Float[np.ndarray, "H 27"]
    """Every hand's pose; NaN where it is lost."""
    rms: Float[np.ndarray, "H"]
    """3D RMS distance of its labeled markers from the pose's [m]; NaN without a fit."""
    evidence: float
    """Of all hands together: log-odds of their labeled points, by their distances from the poses."""


def label_both_ways(
    frames: Sequence[StreamedFrame],
    user: User,
    labeler: Labeler,
    told: Callable[[int], None] = lambda count: None,
) -> BothWays:
    """Label frames that follow from each other.

    Args:
        frames: The frames in the order of their times.
        told: Called with the number of frames that are done; a frame is done in both directions.
    """
    forward = _track(frames, user, labeler, lambda count: told(count // 2))
    end = frames[-1].time
    reverse = [dataclasses.replace(frame, time=end - frame.time) for frame in reversed(frames)]
    backward = _track(reverse, user, labeler, lambda count: told((len(frames) + count) // 2))[::-1]
    for run in _exchanges(forward, backward, user.layout.num_markers):  # right and left: the poses tell
        sums = [sum(one.evidence for one in way[run]) for way in (forward, backward)]
        if sums[0] >= sums[1]:
            backward[run] = forward[run]
        else:
            forward[run] = backward[run]
    agreed = [one.labels == other.labels for one, other in zip(forward, backward, strict=True)]
    different = [number for number, same in enumerate(agreed) if not same.all()]
    points = [frames[number].points for number in different]
    directions = [(forward[number], backward[number]) for number in different]
    third = _ask(points, directions, user, labeler)
    labels = [one.labels for one in forward]
    for number, (one, other), witness in zip(different, directions, third, strict=True):
        labels[number] = _decide(one, other, witness)
    poses = [_poses(*pair) for pair in zip(forward, backward, strict=True)]
    return BothWays(labels, agreed, *map(np.array, zip(*poses, strict=True)))


def _track(
    frames: Sequence[StreamedFrame], user: User, labeler: Labeler, told: Callable[[int], None]
) -> list[_Tracked]:
    """The hands tracked through frames in their order."""
    tracker, tracked = Tracker(user, labeler), []
    for frame in frames:
        one = tracker.step(frame.points, frame.ids, frame.time)
        markers = np.stack([hand.markers for hand in one.hands])
        qpos, rms = np.array([hand.qpos for hand in one.hands]), np.array([hand.rms for hand in one.hands])
        evidence = sum(map(_evidence, one.hands))
        tracked.append(_Tracked(one.labels, one.confidence, markers, qpos, rms, evidence))
        told(len(tracked))
    return tracked


def _evidence(hand: TrackedHand) -> float:
    """What speaks for a hand's labels: many points near the pose's markers, where they are designed."""
    if not np.isfinite(hand.rms):
        return 0.0
    return (len(hand.markers) - len(hand.filled)) * (_WORTH - 0.5 * (hand.rms / _SPREAD) ** 2)


def _poses(one: _Tracked, other: _Tracked) -> tuple[Float[np.ndarray, "H 27"], Float[np.ndarray, "H"]]:
    """The poses of the direction with more evidence, and their RMS; the other one's of hands that it lost."""
    first, second = (one, other) if one.evidence >= other.evidence else (other, one)
    lost = np.isnan(first.qpos[:, 0])
    qpos: NDArray[np.float64] = np.where(lost[:, None], second.qpos, first.qpos)
    return qpos, np.where(lost, second.rms, first.rms)


def _exchanges(
    forward: Sequence[_Tracked], backward: Sequence[_Tracked], num_markers: int
) -> Iterator[slice]:
    """Runs of frames in which the directions give most points of a hand to different hands."""
    wrong = []
    for one, other in zip(forward, backward, strict=True):
        both = (one.labels >= 0) & (other.labels >= 0)
        wrong.append((one.labels[both] // num_markers != other.labels[both] // num_markers).mean() > _MOST
                     if both.any() else False)  # fmt: skip
    yield from (slice(first, last + 1) for first, last in runs_of(np.array(wrong, dtype=np.bool_)))


def _ask(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    directions: Sequence[tuple[_Tracked, _Tracked]],
    user: User,
    labeler: Labeler,
) -> list[NDArray[np.int64]]:
    """The labeler's labels of the points of frames, hand by hand; `_NOT_ASKED` of what it was not shown."""
    clouds = [
        (number, hand, cloud)
        for number, (points, pair) in enumerate(zip(frames, directions, strict=True))
        for hand in range(len(user))
        if 0 < len(cloud := _cloud(points, pair, hand)) <= MOST_POINTS
    ]
    labelings = labeler.label_frames([frames[number][cloud] for number, _, cloud in clouds])
    labels = [np.full(len(points), _NOT_ASKED) for points in frames]
    confidence = [np.zeros(len(points)) for points in frames]
    for (number, hand, cloud), one in zip(clouds, labelings, strict=True):
        named, before = one.labels >= 0, labels[number][cloud]
        better = named & (one.confidence > confidence[number][cloud])
        own = np.where(better, hand * user.layout.num_markers + one.labels, before)
        labels[number][cloud] = np.where(~named & (before == _NOT_ASKED), -1, own)
        confidence[number][cloud[better]] = one.confidence[better]
    return labels


def _cloud(
    points: Float[np.ndarray, "N 3"], pair: tuple[_Tracked, _Tracked], hand: int
) -> Int[np.ndarray, "C"]:
    """Points that may be a hand's: labeled so, or near its markers, but not another's in both directions."""
    own, others = np.zeros(len(points), dtype=bool), np.ones(len(points), dtype=bool)
    for tracked in pair:
        owner = np.where(tracked.labels >= 0, tracked.labels // tracked.markers.shape[1], -1)
        own |= owner == hand
        others &= (owner >= 0) & (owner != hand)
        if np.isfinite(tracked.markers[hand]).all():
            own |= distances_to_nearest(points, tracked.markers[hand]) < _NEAR
    return np.flatnonzero(own & ~others)


def _decide(one: _Tracked, other: _Tracked, witness: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """The label that two of three witnesses give each point, else that of the more confident direction.

    A direction without a label has no confidence, so that a label that nobody denies stays; and one that has
    lost a hand denies none of its labels.
    """
    sure, other_sure = (np.where(way.labels >= 0, way.confidence, 0.0) for way in (one, other))
    same = one.labels == other.labels
    first_stays = _is_lost(other, one.labels) & (other.labels < 0)
    second_stays = _is_lost(one, other.labels) & (one.labels < 0)
    second = (witness == other.labels) | ((witness != one.labels) & (other_sure > sure))
    second = (second & ~first_stays) | second_stays
    labels = np.where(second, other.labels, one.labels)
    confidence = np.where(same, one.confidence, _MAJORITY * np.where(second, other_sure, sure))
    # Every marker is at its most confident point alone.
    order = np.argsort(-confidence, kind="stable")
    kept = order[np.unique(labels[order], return_index=True)[1]]
    single = np.full(len(labels), -1)
    single[kept] = labels[kept]
    return single


def _is_lost(tracked: _Tracked, labels: Int[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Which points have the label of a hand that is lost."""
    lost = np.isnan(tracked.markers).all(axis=(1, 2))
    of_lost: Bool[np.ndarray, "N"] = lost[np.maximum(labels, 0) // tracked.markers.shape[1]]
    return of_lost & (labels >= 0)
