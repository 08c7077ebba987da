"""Left or right: each hand is followed from frame to frame, and all its frames vote together.

Two hands of one frame are a left and a right one, so they vote together as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from track.finder.frame_hands import FoundHand

_FOLLOWED: Final = 0.5  # share of a hand's points that were another's in the frames before, if it is the same


def sides_of(
    frames: Sequence[Sequence[FoundHand]], starts: Int[np.ndarray, "T+1"], previous: Int[np.ndarray, "P"]
) -> list[list[int]]:
    """The side of every hand: 1 for right, -1 for left.

    Args:
        frames: At most two hands in each frame.
        starts: Where each frame starts among all points.
        previous: Which point of the frame before each point was, see `track.finder.links.previous_points`.
    """
    tracks, votes = _tracks(frames, starts, previous)
    together = Counter(tuple(sorted(pair)) for pair in tracks if len(pair) == 2 and pair[0] != pair[1])
    groups = _Opposites(len(votes))
    for (one, other), _ in together.most_common():
        groups.oppose(one, other)
    sums = np.zeros(len(votes))
    for track, vote in enumerate(votes):
        root, sign = groups.root(track)
        sums[root] += sign * vote
    sides = []
    for track in range(len(votes)):
        root, sign = groups.root(track)
        sides.append(sign if sums[root] >= 0.0 else -sign)
    return [_apart([sides[track] for track in pair]) for pair in tracks]


def _apart(pair: list[int]) -> list[int]:
    """Two hands of a frame have two sides, also where their tracks were taken for one another."""
    return [pair[0], -pair[0]] if len(pair) == 2 else pair


def _tracks(
    frames: Sequence[Sequence[FoundHand]], starts: NDArray[np.int64], previous: NDArray[np.int64]
) -> tuple[list[list[int]], list[float]]:
    """Number of the track of every hand, and the sum of the votes of each track."""
    owner = np.full(len(previous), -1)
    tracks: list[list[int]] = []
    votes: list[float] = []
    for number, hands in enumerate(frames):
        here = slice(starts[number], starts[number + 1])
        old = previous[here]
        inherited = np.where(old >= 0, owner[old], -1)
        owner[here] = inherited
        row: list[int] = []
        for hand in hands:
            known = inherited[hand.points]
            known = known[(known >= 0) & ~np.isin(known, row)]
            track = int(np.bincount(known).argmax()) if len(known) else -1
            if track < 0 or (known == track).sum() < _FOLLOWED * len(hand.points):
                track = len(votes)
                votes.append(0.0)
            votes[track] += hand.vote
            row.append(track)
            owner[starts[number] + hand.points] = track
        tracks.append(row)
    return tracks, votes


class _Opposites:
    """Groups of tracks of which each is on the side of the first one, 1, or on the other, -1."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))
        self._sign = [1] * count

    def root(self, track: int) -> tuple[int, int]:
        sign = 1
        while self._parent[track] != track:
            sign *= self._sign[track]
            track = self._parent[track]
        return track, sign

    def oppose(self, one: int, other: int) -> None:
        """Put two tracks on two sides, unless their sides are decided already."""
        (first, a), (second, b) = self.root(one), self.root(other)
        if first != second:
            self._parent[second], self._sign[second] = first, -a * b
