"""Hands among points of which nothing is known: cut into clouds, labeled, fitted, and checked.

A labeler knows clouds of one hand. Hands that touch make one cloud of two; it is cut in half along several
directions, of which one mostly leaves most of a hand whole, and what a fitted hand explains of the cloud
tells which one that was. Whose hand it is, left or right, follows from the fit: a mirrored hand does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.cluster.hierarchy import fclusterdata

from track.association.hand_state import HandMemory
from track.association.label_consistency import targets_of
from track.association.point_matching import gains, match, worth_of
from track.kinematics.pose_solver import PoseFit
from train.labelers.protocol import Labeler, Labeling

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

MOST_RMS: Final = 0.008
"""RMS distance [m] beyond which a pose is thrown away; Han et al. 2018, section 4.4."""
_LINK: Final = 0.085  # [m] between neighboring markers of one hand, at most
_SHARE: Final = 0.45  # of a hand's markers that must be found
_STRAYS: Final = 6  # points more than a hand has, from which on a cloud is cut
_MOST_POINTS: Final = 100  # that hang together: more are nobody's hands
_CUTS: Final = 12
_TRIES: Final = 8  # labeled clouds that are fitted, the surest first
_ROUNDS: Final = 2  # of looking for the points of a fitted hand
_LOOSE: Final = 4.0  # of their spread so far: where its points are looked for
_GATES: Final = (0.003, 0.012)  # [m] that is, at least and at most
_FREEDOM: Final = 20.0  # coordinates of its points that a pose fits, whatever they are
_STRICT: Final = 60  # frames in which a hand that was known is looked for as it was, before as anybody's
_LEAST_SCORE: Final = 50.0  # of a hand that is one: twelve points 5 mm off
_PLAIN: Final = 10.0  # of its markers: such a hand is beyond doubt, and no further cloud is tried
_FINEST: Final = 0.0003  # [m] below which a spread says no more
_FEWEST_POINTS: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A hand that was found."""

    number: int
    """Which of the hands that were looked for."""
    fit: PoseFit
    names: Int[np.ndarray, "N"]
    """Marker of each point, -1 for what is none of this hand's."""
    score: float
    """See `score_of`."""


class HandFinder:
    """Finds hands without any history.

    Args:
        memories: The user's hands.
        labeler: Names the points of a cloud of one hand; blind to left and right.
    """

    def __init__(self, memories: Sequence[HandMemory], labeler: Labeler) -> None:
        self._memories = memories
        self._labeler = labeler
        self._sought = np.zeros(len(memories), dtype=np.int64)
        spread = np.arange(_CUTS) + 0.5
        height, turn = 1.0 - spread / _CUTS, np.pi * (1.0 + 5.0**0.5) * spread  # even over half a sphere
        flat = np.sqrt(1.0 - height**2)
        self._directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)

    def find(self, points: Float[np.ndarray, "N 3"], wanted: Sequence[int]) -> list[Found]:
        """Look for some of the hands among points that nobody has named [m]."""
        found: list[Found] = []
        for group in self._groups(points, wanted):
            left, missing = group, [number for number in wanted if all(f.number != number for f in found)]
            while missing:
                hand = self._best(points, left, missing)
                if hand is None:
                    break
                found.append(hand)
                left = left[hand.names[left] < 0]
                missing.remove(hand.number)
            self._sought[missing] += 1
        for hand in found:
            self._sought[hand.number] = 0
        return found

    def _groups(self, points: NDArray[np.float64], wanted: Sequence[int]) -> list[NDArray[np.int64]]:
        """Points that hang together and are enough for a hand, the largest group first."""
        least = min((self._least(number) for number in wanted), default=0)
        if len(points) < max(least, 2):
            return []
        cluster = fclusterdata(points, _LINK, criterion="distance", method="single")
        groups = [np.flatnonzero(cluster == number) for number in np.unique(cluster)]
        groups = [group for group in groups if least <= len(group) <= _MOST_POINTS]
        return sorted(groups, key=len, reverse=True)

    def _least(self, number: int) -> int:
        return max(_FEWEST_POINTS, int(np.ceil(_SHARE * self._memories[number].num_markers)))

    def _best(
        self, points: NDArray[np.float64], group: NDArray[np.int64], wanted: Sequence[int]
    ) -> Found | None:
        """The hand that explains most of a group."""
        clouds = self._cut(points, group, max(self._memories[number].num_markers for number in wanted))
        labelings = self._labeler.label_frames([points[cloud] for cloud in clouds])
        sure = [float(one.confidence[one.labels >= 0].sum()) for one in labelings]
        best: Found | None = None
        for place in np.argsort(sure)[::-1][:_TRIES]:
            for number in wanted:
                hand = self._try(number, points, group, clouds[place], labelings[place])
                if hand is not None and (best is None or hand.score > best.score):
                    best = hand
            if best is not None and best.score > _PLAIN * self._memories[best.number].num_markers:
                break
        return best

    def _cut(
        self, points: NDArray[np.float64], group: NDArray[np.int64], markers: int
    ) -> list[NDArray[np.int64]]:
        clouds = [group]
        if len(group) > markers + _STRAYS:
            half = len(group) // 2
            for direction in self._directions:
                order = group[np.argsort(points[group] @ direction)]
                clouds += [order[:half], order[half:]]
        return clouds

    def _try(
        self,
        number: int,
        points: NDArray[np.float64],
        group: NDArray[np.int64],
        cloud: NDArray[np.int64],
        labeling: Labeling,
    ) -> Found | None:
        """Fit a hand to a labeled cloud, and again to what it then explains of the whole group."""
        memory, names = self._memories[number], np.full(len(points), -1)
        names[cloud] = labeling.labels
        found = self._trim(number, points, names, None)
        for _ in range(_ROUNDS):
            if found is None:
                return None
            places = memory.solver.place(found.fit.qpos[0])
            loose = np.clip(_LOOSE * _spread_of(found), *_GATES)
            spread = np.tile(loose**2 * np.eye(3), (memory.num_markers, 1, 1))
            names = np.full(len(points), -1)
            names[group], _ = match(gains(points[group], places, spread))
            found = self._trim(number, points, names, found.fit)
        return found

    def _trim(
        self, number: int, points: NDArray[np.float64], names: NDArray[np.int64], start: PoseFit | None
    ) -> Found | None:
        """Fit named points, without those that the others speak against, the worst first."""
        memory, best = self._memories[number], None
        while (names >= 0).sum() >= self._least(number):
            targets = targets_of(points, names, memory.num_markers)
            fit = memory.solver.solve(targets[None], None if start is None else start.qpos)
            count, rms = int((names >= 0).sum()), float(fit.rms[0])
            known = memory.spread if self._sought[number] < _STRICT else None
            found = Found(number, fit, names, score_of(count, rms, known))
            if best is not None and found.score <= best.score:
                break
            best, start = found, fit
            mine = np.flatnonzero(names >= 0)
            off = (fit.residuals[0, names[mine]] ** 2).sum(axis=1)
            names = names.copy()
            names[mine[off.argmax()]] = -1
        good = best is not None and best.fit.rms[0] <= MOST_RMS and best.score >= _LEAST_SCORE
        return best if good else None


def score_of(count: int, rms: float, spread: float | None = None) -> float:
    """Log odds of named points against strays.

    Few points that lie right can so be worth more than many that lie roughly.

    Args:
        count: Named points.
        rms: Their RMS distance from the hand's markers [m].
        spread: What is known of how they lie around them, in each direction [m]; what it seems to be when
            nothing is.
    """
    freedom = max(3.0 * count - _FREEDOM, 1.0)
    usual = max(rms * np.sqrt(count / freedom), _FINEST) if spread is None else spread
    worth = worth_of(np.array([usual**2]))
    off = 1.5 if spread is None else 0.5 * rms**2 / spread**2
    return count * float(worth[0] - off)


def _spread_of(found: Found) -> float:
    return float(found.fit.rms[0] / np.sqrt(3.0))
