"""Hands that are close to each other, followed from the frames in which they stand apart.

From both ends of such a stretch, frame by frame: a point that was a hand's a moment ago is that hand's. Each
hand is labeled among its own points and those of which nothing is known; where both claim one, the more
confident hand has it. A new point is a hand's own after some frames, and one that a hand does not want is
free again. Some frames are passed over: the votes of the others decide there (`track.finder.voting`). Where
nothing is known of merged hands, they are cut (`track.finder.frame_hands`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from track.finder.frame_hands import Criteria, FoundHand, HandFinder
from track.finder.links import following_points

SIDES: Final = (1, -1)
"""Right, left."""
_KNOWN: Final = 0.5  # value of a point from which on it is a hand's own; 1 at most
_LABEL_EVERY: Final = 0.02  # [s]
_GUESSED: Final = 0.3  # added in each labeled frame in which a hand claims a point
_UNWANTED: Final = 0.7  # left of the value of a point that its hand does not claim
_MEMORY: Final = 0.5  # time in which a value that nothing confirms fades [s]
_FEWEST: Final = 4
_BESIDE: Final = 0.2  # distance within which the points of a second hand are from the first [m]
_CUT_EVERY: Final = 0.1  # [s]
_BETTER: Final = 3.0  # points more that cut hands must explain
_CERTAIN: Final = 0.75  # confidence of a hand of which nothing was known
_CONFIDENT: Final = 0.7  # of a hand from which on its points are learnt
FOLLOWED: Final = Criteria(fewest=_FEWEST, confidence=0.4, fitting_share=0.6, misfit=0.012, clearness=0.0)


@dataclass(slots=True)
class _Front:
    """Where one end of a stretch is followed to."""

    frame: int
    step: int
    """1 forwards, -1 backwards."""
    left: int
    """Frames that are left to do."""
    values: NDArray[np.float64]
    """Of the points of `frame`: 1 for a right hand's, -1 for a left hand's, 0 where nothing is known."""
    since_cut: float = np.inf
    """Frames since merged hands were cut."""


class Follower:
    """Follows hands through a capture.

    Args:
        frames: Points of each frame [m].
        by_side: The hands that were found in each frame; those that are followed are added.
        finder: Finds and labels hands.
        previous: See `track.finder.links.previous_points`.
        rate: Frames per second [Hz].
    """

    def __init__(
        self,
        frames: Sequence[NDArray[np.float64]],
        by_side: list[dict[int, FoundHand]],
        finder: HandFinder,
        previous: NDArray[np.int64],
        rate: float,
    ) -> None:
        self._frames, self._by_side, self._finder = frames, by_side, finder
        self._starts = np.concatenate([[0], np.cumsum([len(points) for points in frames])])
        self._links = {1: previous, -1: following_points(previous)}
        self._keep = float(np.exp(-1.0 / (_MEMORY * rate)))
        self._cut_every = max(1, round(_CUT_EVERY * rate))
        self._label_every = max(1, round(_LABEL_EVERY * rate))
        self.labeled = np.ones(len(frames), dtype=bool)
        """Frames that were not passed over."""

    def follow(self, settled: Sequence[bool], told: Callable[[int], None] = lambda count: None) -> None:
        """Follow the hands through every stretch of frames that are not settled.

        Args:
            settled: Which frames are.
            told: Called with the number of frames that were done since the last call.
        """
        fronts = self._fronts(np.asarray(settled, dtype=bool))
        while fronts:
            self._advance(fronts)
            told(len(fronts))
            fronts = [front for front in fronts if front.left > 0]

    def _fronts(self, settled: NDArray[np.bool_]) -> list[_Front]:
        edges = np.flatnonzero(np.diff(np.concatenate([[True], settled, [True]]).astype(int)))
        fronts = []
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            length = int(end - begin)
            backwards = 0 if end == len(settled) else length if begin == 0 else length // 2
            if length > backwards:
                fronts.append(_Front(int(begin) - 1, 1, length - backwards, self._seed(int(begin) - 1)))
            if backwards:
                fronts.append(_Front(int(end), -1, backwards, self._seed(int(end))))
        return fronts

    def _seed(self, frame: int) -> NDArray[np.float64]:
        values = np.zeros(len(self._frames[frame]) if frame >= 0 else 0)
        if frame >= 0:
            for side, hand in self._by_side[frame].items():
                values[hand.points] = side
        return values

    def _advance(self, fronts: list[_Front]) -> None:
        """One frame further with every front."""
        clouds, owners, guesses = [], [], []
        for front in fronts:
            self._carry(front)
            if front.left % self._label_every:
                self.labeled[front.frame] = False
                continue
            points, there = self._frames[front.frame], self._by_side[front.frame]
            known = np.where(np.abs(front.values) >= _KNOWN, np.sign(front.values), 0.0)
            for side in SIDES:
                if side not in there and (cloud := self._cloud(points, known, side)) is not None:
                    clouds.append((points, cloud))
                    owners.append((front, side))
                    guesses.append(int((known == side).sum()) < _FEWEST)
        claims: dict[int, dict[int, FoundHand]] = {}
        hands_found = self._finder.label(clouds, FOLLOWED)
        for (front, side), guess, hand in zip(owners, guesses, hands_found, strict=True):
            if hand is not None and not (guess and self._unlike(hand, side)):
                claims.setdefault(id(front), {})[side] = hand
        for front in fronts:
            if not self.labeled[front.frame]:
                continue
            hands = _settle(claims.get(id(front), {}))
            self._by_side[front.frame].update(hands)
            _learn(front.values, hands)
            self._cut(front)

    def _carry(self, front: _Front) -> None:
        """Move a front to the next frame, with what is known of its points."""
        new = front.frame + front.step
        low, high = self._starts[new], self._starts[new + 1]
        values = np.zeros(high - low)
        if 0 <= front.frame:
            link = self._links[front.step][low:high]
            there = link >= 0
            values[there] = self._keep * front.values[link[there] - self._starts[front.frame]]
        for side, hand in self._by_side[new].items():
            values[hand.points] = side
        front.frame, front.values = new, values
        front.left -= 1
        front.since_cut += 1

    def _unlike(self, hand: FoundHand, side: int) -> bool:
        """Whether a hand of which nothing was known is no certain one of this side."""
        few = len(hand.points) < self._finder.fewest
        return few or hand.confidence.mean() < _CERTAIN or hand.vote * side < self._finder.certain.clearness

    def _cut(self, front: _Front) -> None:
        """Cut merged hands if many points have no label, and take what is found if it explains more."""
        points, there = self._frames[front.frame], self._by_side[front.frame]
        labeled = sum(len(hand.points) for hand in there.values())
        if len(points) - labeled < self._finder.fewest or front.since_cut < self._cut_every:
            return
        if not self._finder.is_merged(points):
            return
        front.since_cut = 0.0
        hands = sorted(self._finder.find_merged(points), key=lambda hand: -hand.weight)[:2]
        if sum(hand.weight for hand in hands) < _BETTER + sum(hand.weight for hand in there.values()):
            return
        balance = [front.values[hand.points].sum() for hand in hands]
        if abs(balance[0] - sum(balance[1:])) < _FEWEST:  # too little is known
            balance = [hand.vote for hand in hands]
        side = 1 if balance[0] - sum(balance[1:]) >= 0.0 else -1
        self._by_side[front.frame] = dict(zip((side, -side), hands, strict=False))
        front.values = self._seed(front.frame)

    def _cloud(
        self, points: NDArray[np.float64], known: NDArray[np.float64], side: int
    ) -> NDArray[np.int64] | None:
        """The points of one side, and near them those of which nothing is known; None if they are too few."""
        mine, free = known == side, known == 0.0
        if mine.sum() < _FEWEST:
            return self._rest(points, free, known == -side)
        if not free.any():
            return np.flatnonzero(mine)
        distance = np.linalg.norm(points[free, None] - points[mine], axis=-1).min(axis=1)
        near = np.flatnonzero(free)[distance <= self._finder.measures.link_distance]
        return np.sort(np.concatenate([np.flatnonzero(mine), near]))

    def _rest(
        self, points: NDArray[np.float64], free: NDArray[np.bool_], other: NDArray[np.bool_]
    ) -> NDArray[np.int64] | None:
        """The points near the other hand of which nothing is known: this hand may be among them."""
        if other.sum() < _FEWEST or free.sum() < self._finder.fewest:
            return None
        distance = np.linalg.norm(points[free, None] - points[other], axis=-1).min(axis=1)
        near = np.flatnonzero(free)[distance <= _BESIDE]
        return near if len(near) >= self._finder.fewest else None


def _settle(hands: dict[int, FoundHand]) -> dict[int, FoundHand]:
    """Hands without shared points: the more confident one keeps each."""
    if len(hands) < 2:
        return hands
    right, left = (hands[side] for side in SIDES)
    _, mine, its = np.intersect1d(right.points, left.points, assume_unique=True, return_indices=True)
    lost = right.confidence[mine] < left.confidence[its]
    kept = {1: _without(right, mine[lost]), -1: _without(left, its[~lost])}
    return {side: hand for side, hand in kept.items() if len(hand.points)}


def _without(hand: FoundHand, which: NDArray[np.int64]) -> FoundHand:
    keep = np.ones(len(hand.points), dtype=bool)
    keep[which] = False
    return dataclasses.replace(
        hand, points=hand.points[keep], labels=hand.labels[keep], confidence=hand.confidence[keep]
    )


def _learn(values: NDArray[np.float64], hands: dict[int, FoundHand]) -> None:
    """Change the values of a frame's points by what confident hands claim."""
    for side, hand in hands.items():
        if len(hand.points) < _FEWEST or hand.confidence.mean() < _CONFIDENT:
            continue
        own = np.sign(values) * (np.abs(values) >= _KNOWN) == side
        claimed = np.zeros(len(values), dtype=bool)
        claimed[hand.points] = True
        values[own & ~claimed] *= _UNWANTED
        values[claimed & own] = side
        values[claimed & ~own] += _GUESSED * side
