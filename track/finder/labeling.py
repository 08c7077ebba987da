"""The hands of a capture with their labels: how many each frame holds, and which is left and right.

Frames in which the hands stand apart are decided on their own (`track.finder.frame_hands`), all of them vote
for left and right (`track.finder.sides`), and the other frames follow from these (`track.finder.following`).
At the end all labels of a point's path vote for its label in each frame (`track.finder.voting`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from track.finder.following import Follower
from track.finder.frame_hands import FoundHand, HandFinder
from track.finder.links import previous_points
from track.finder.sides import sides_of
from track.finder.voting import vote
from train.labelers.protocol import check_clouds

Frames = Sequence[NDArray[np.float64]]

_CHUNK: Final = 512
_SPEED, _ACCELERATION = 2.0, 80.0  # of a marker [m/s], [m/s^2]
_NOISE, _FARTHEST = 0.004, 0.03  # of a step from frame to frame [m]


@dataclass(frozen=True, slots=True, eq=False)
class FrameLabels:
    """The labels of one frame with any number of hands up to two."""

    sides: Int[np.ndarray, "N"]
    """1 for a point of a right hand, -1 for one of a left hand, 0 for one of no hand."""
    labels: Int[np.ndarray, "N"]
    """Marker of each point, -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Of each label, 0 to 1; 0 for a point without one."""

    @property
    def hands(self) -> tuple[bool, bool]:
        """Whether there is a right hand, and a left one."""
        return bool((self.sides > 0).any()), bool((self.sides < 0).any())


def label_hands(
    frames: Frames, finder: HandFinder, rate: float, *, told: Callable[[int], None] = lambda count: None
) -> list[FrameLabels]:
    """Label the hands of every frame.

    Args:
        frames: Points of each frame [m].
        finder: Finds the hands of single frames.
        rate: Frames per second [Hz].
        told: Called with the number of frames that were done since the last call.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
    """
    # In an order of their own, so that the columns of a capture do not matter where choices are equally good.
    orders = [np.lexsort(points.T) for points in check_clouds(frames)]
    frames = [points[order] for points, order in zip(frames, orders, strict=True)]
    found: list[list[FoundHand]] = []
    settled: list[bool] = []
    for first in range(0, len(frames), _CHUNK):
        for hands, complete in finder.find(frames[first : first + _CHUNK]):
            found.append(_two_best(hands))
            settled.append(complete or len(hands) >= 2)
        told(sum(settled[first:]))
    starts = np.concatenate([[0], np.cumsum([len(points) for points in frames])]).astype(np.int64)
    points = np.concatenate([np.zeros((0, 3)), *frames])
    previous = _linked(points, starts, np.full(len(points), -1), rate)
    sides = sides_of(found, starts, previous)
    by_side = [dict(zip(side, hands, strict=True)) for side, hands in zip(sides, found, strict=True)]
    follower = Follower(frames, by_side, finder, previous, rate)
    follower.follow(settled, told)
    labels, confidence = _in_a_row(starts, by_side, finder.num_markers)
    previous = _linked(points, starts, labels, rate)
    labels, confidence = vote(
        labels,
        confidence,
        np.repeat(follower.labeled, np.diff(starts)),
        starts,
        previous,
        num_markers=finder.num_markers,
        rate=rate,
    )
    return [
        _frame_labels(labels[first:last][back], confidence[first:last][back], finder.num_markers)
        for (first, last), back in zip(pairwise(starts), map(np.argsort, orders), strict=True)
    ]


def _linked(
    points: NDArray[np.float64], starts: NDArray[np.int64], labels: NDArray[np.int64], rate: float
) -> NDArray[np.int64]:
    """Which point of the frame before each point was, see `previous_points`."""
    first, next_one = _SPEED / rate + _NOISE, 0.5 * _ACCELERATION / rate**2 + _NOISE
    return previous_points(points, starts, labels, min(_FARTHEST, first), min(_FARTHEST, next_one))


def _two_best(hands: list[FoundHand]) -> list[FoundHand]:
    return sorted(hands, key=lambda hand: hand.weight, reverse=True)[:2]


def _in_a_row(
    starts: NDArray[np.int64], by_side: Sequence[dict[int, FoundHand]], num_markers: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Label of each point of all frames, those of the left hand after those of the right one; its confidence.

    Of two hands with a point the more confident one has it.
    """
    labels, confidence = np.full(starts[-1], -1), np.zeros(starts[-1])
    for start, hands in zip(starts, by_side, strict=False):
        for side, hand in hands.items():
            here = start + hand.points
            mine = hand.confidence > confidence[here]
            labels[here[mine]] = hand.labels[mine] + (num_markers if side < 0 else 0)
            confidence[here[mine]] = hand.confidence[mine]
    return labels, confidence


def _frame_labels(
    labels: NDArray[np.int64], confidence: NDArray[np.float64], num_markers: int
) -> FrameLabels:
    there = labels >= 0
    sides = np.where(there, np.where(labels < num_markers, 1, -1), 0)
    return FrameLabels(sides, np.where(there, labels % num_markers, -1), confidence)
