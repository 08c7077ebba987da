"""The hands of a capture with their labels: how many each frame holds, and which is left and right.

Frames in which the hands stand apart are decided on their own (`train.hands.frame_hands`), all of them vote
for left and right (`train.hands.sides`), and the other frames follow from these (`train.hands.following`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from train.hands.following import FOLLOWED, Follower
from train.hands.frame_hands import FoundHand, HandFinder
from train.hands.links import previous_points
from train.hands.sides import sides_of
from train.labelers.protocol import check_clouds

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

    Frames = Sequence[NDArray[np.float64]]

_CHUNK: Final = 512
_SPEED, _ACCELERATION = 2.0, 80.0  # of a marker [m/s], [m/s^2]
_REACH: Final = 1.5  # of a hand for single points, in distances within which most markers are linked
_GAIN: Final = 0.3  # points more that a hand labeled once more must explain
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
    frames: Frames, finder: HandFinder, rate: float, *, progress: Callable[[int], None] | None = None
) -> list[FrameLabels]:
    """Label the hands of every frame.

    Args:
        frames: Points of each frame [m].
        finder: Finds the hands of single frames.
        rate: Frames per second [Hz].
        progress: Called with the number of frames that are done.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
    """
    check_clouds(frames)
    found: list[list[FoundHand]] = []
    settled: list[bool] = []
    for first in range(0, len(frames), _CHUNK):
        for hands, complete in finder.find(frames[first : first + _CHUNK]):
            found.append(_two_best(hands))
            settled.append(complete or len(hands) >= 2)
        if progress is not None:
            progress(len(found))
    starts = np.concatenate([[0], np.cumsum([len(points) for points in frames])]).astype(np.int64)
    previous = previous_points(
        np.concatenate([np.zeros((0, 3)), *frames]),
        starts,
        min(_FARTHEST, _SPEED / rate + _NOISE),
        min(_FARTHEST, 0.5 * _ACCELERATION / rate**2 + _NOISE),
    )
    sides = sides_of(found, starts, previous)
    by_side = [dict(zip(side, hands, strict=True)) for side, hands in zip(sides, found, strict=True)]
    Follower(frames, by_side, finder, previous, rate).follow(settled)
    _complete(frames, by_side, finder)
    return [_frame_labels(len(points), hands) for points, hands in zip(frames, by_side, strict=True)]


def _two_best(hands: list[FoundHand]) -> list[FoundHand]:
    return sorted(hands, key=lambda hand: hand.weight, reverse=True)[:2]


def _complete(
    frames: Sequence[NDArray[np.float64]], by_side: list[dict[int, FoundHand]], finder: HandFinder
) -> None:
    """Label hands once more together with the points near them that have no label."""
    clouds, owners = [], []
    for number, (points, hands) in enumerate(zip(frames, by_side, strict=True)):
        free = np.ones(len(points), dtype=bool)
        for hand in hands.values():
            free[hand.points] = False
        if not free.any():
            continue
        rest = np.flatnonzero(free)
        for side, hand in hands.items():
            distance = np.linalg.norm(points[rest, None] - points[hand.points], axis=-1).min(axis=1)
            near = rest[distance <= _REACH * finder.measures.link_distance]
            if len(near) and len(hand.points) < finder.num_markers:
                clouds.append((points, np.sort(np.concatenate([hand.points, near]))))
                owners.append((number, side))
    for first in range(0, len(clouds), _CHUNK):
        part = slice(first, first + _CHUNK)
        for (number, side), found in zip(owners[part], finder.label(clouds[part], FOLLOWED), strict=True):
            if found is not None and found.weight > by_side[number][side].weight + _GAIN:
                by_side[number][side] = found


def _frame_labels(count: int, hands: dict[int, FoundHand]) -> FrameLabels:
    """Labels of a frame with `count` points; of two hands with a point the more confident one has it."""
    sides, labels, confidence = np.zeros(count, dtype=np.int64), np.full(count, -1), np.zeros(count)
    for side, hand in hands.items():
        mine = hand.confidence > confidence[hand.points]
        here = hand.points[mine]
        sides[here], labels[here], confidence[here] = side, hand.labels[mine], hand.confidence[mine]
    return FrameLabels(sides, labels, confidence)
