"""Hands among points of which nothing is known: cut into clouds, labelled, fitted, and checked.

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

from track.hand_memory import HandMemory
from track.inverse_kinematics import PoseFit
from track.matching import gains, match
from track.naming import targets_of
from train.labeling import Labeler, Labelling

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

MOST_RMS: Final = 0.008
"""RMS distance [m] beyond which a pose is thrown away; Han et al. 2018, section 4.4."""
_LINK: Final = 0.085  # [m] between neighbouring markers of one hand, at most
_SHARE: Final = 0.6  # of a hand's markers that must be found
_STRAYS: Final = 6  # points more than a hand has, from which on a cloud is cut
_MOST_POINTS: Final = 100  # that hang together: more are nobody's hands
_CUTS: Final = 12
_TRIES: Final = 6  # labelled clouds that are fitted, the surest first
_LOOSE: Final = (0.012, 0.006)  # [m] around a fitted hand, in which its points are looked for, then again
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


class HandFinder:
    """Finds hands without any history.

    Args:
        memories: The user's hands.
        labeler: Names the points of a cloud of one hand; blind to left and right.
    """

    def __init__(self, memories: Sequence[HandMemory], labeler: Labeler) -> None:
        self._memories = memories
        self._labeler = labeler
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
        labellings = self._labeler.label_frames([points[cloud] for cloud in clouds])
        sure = [float(one.confidence[one.labels >= 0].sum()) for one in labellings]
        best: Found | None = None
        for place in np.argsort(sure)[::-1][:_TRIES]:
            for number in wanted:
                hand = self._try(number, points, group, clouds[place], labellings[place])
                if hand is not None and (best is None or hand.score > best.score):
                    best = hand
            if best is not None and best.score > 0.9 * self._memories[best.number].num_markers:
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
        labelling: Labelling,
    ) -> Found | None:
        """Fit a hand to a labelled cloud, and again to what it then explains of the whole group."""
        memory, names = self._memories[number], np.full(len(points), -1)
        names[cloud] = labelling.labels
        if (names >= 0).sum() < self._least(number):
            return None
        fit = memory.solver.solve(targets_of(points, names, memory.num_markers)[None])
        score = 0.0
        for loose in _LOOSE:
            places = memory.solver.place(fit.qpos[0])
            spread = np.tile(loose**2 * np.eye(3), (memory.num_markers, 1, 1))
            matched, _ = match(gains(points[group], places, spread))
            names[:] = -1
            names[group] = matched
            if (names >= 0).sum() < self._least(number):
                return None
            fit = memory.solver.solve(targets_of(points, names, memory.num_markers)[None], fit.qpos)
        if not fit.rms[0] <= MOST_RMS:
            return None
        misses = np.nansum(fit.residuals[0] ** 2, axis=-1)
        score = float((names >= 0).sum() - misses.sum() / MOST_RMS**2)
        return Found(number, fit, names, score)
