"""Numbers of points that last from frame to frame, also in streams whose own IDs do not.

Some systems number the points of every frame anew. Then the points of the last frame are predicted, those
with a label by the motion of their hand, and assigned to the points of the new frame; a hand that moves
otherwise than predicted is aligned with its points that were found so far.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from handsim.space.transforms import rigid_fit
from track.config import LinkingConfig

Predicted = Mapping[int, tuple[int, NDArray[np.float64]]]
"""Hand and predicted position (3,) [m] of numbered points."""


class PointLinker:
    """Numbers the points of a stream.

    Args:
        config: Distances, and when the stream's own IDs are not used.
    """

    def __init__(self, config: LinkingConfig = LinkingConfig()) -> None:  # noqa: B008
        self._config = config
        self._numbers: dict[int, int] = {}  # of the stream's IDs in the last frame
        self._last = np.zeros(0, dtype=np.int64)  # numbers (Q,) of the last frame's points
        self._points = np.zeros((0, 3))  # those points [m]
        self._next = 0

    def number(
        self,
        points: Float[np.ndarray, "P 3"],
        ids: Int[np.ndarray, "P"],
        labeled: Collection[int],
        predict: Callable[[], Predicted],
    ) -> Int[np.ndarray, "P"]:
        """Number the points of the next frame, as the stream does where most of its IDs last.

        Args:
            points: The points [m].
            ids: The stream's IDs, -1 for none.
            labeled: Numbers of the points that had a label in the last frame. Where there are any, the IDs of
                these count: ghosts have short lives.
            predict: Predicts points of the last frame; called where IDs do not last.

        Returns:
            The number of each point; a point without an ID in a stream that has them gets a new one.
        """
        known = np.array([self._numbers.get(number, -1) for number in ids.tolist()], dtype=np.int64)
        before = np.array(list(labeled), dtype=np.int64) if labeled else self._last
        fewest = self._config.lasting_share * min(len(before), len(ids))
        if np.isin(before, known).sum() < fewest:
            known = self._link(points, predict())
        new = np.flatnonzero(known < 0)
        known[new] = self._next + np.arange(len(new))
        self._next += len(new)
        self._numbers = {one: n for one, n in zip(ids.tolist(), known.tolist(), strict=True) if one >= 0}
        self._last, self._points = known, points
        return known

    def _link(self, points: NDArray[np.float64], predicted: Predicted) -> NDArray[np.int64]:
        """Numbers of the last frame's points for the points of this one, -1 where there is none."""
        expected, hands = self._points.copy(), np.full(len(self._last), -1)
        for row, number in enumerate(self._last.tolist()):
            if number in predicted:
                hands[row], expected[row] = predicted[number]
        beside = self._beside(hands)
        moved, found = expected.copy(), np.full(len(points), -1)
        for distance in (self._config.first_distance, self._config.next_distance, self._config.last_distance):
            rows, columns = _assign(points, moved, distance)
            for hand in np.unique(hands[hands >= 0]):
                own = hands[columns] == hand
                if own.sum() >= self._config.fewest_aligned:
                    rotation, shift = rigid_fit(expected[columns[own]], points[rows[own]])
                    moved[hands == hand] = expected[hands == hand] @ rotation.T + shift
                    rotation, shift = rigid_fit(self._points[columns[own]], points[rows[own]])
                    moved[beside == hand] = self._points[beside == hand] @ rotation.T + shift
        found[rows] = self._last[columns]
        return found

    def _beside(self, hands: NDArray[np.int64]) -> Int[np.ndarray, "Q"]:
        """The hand that each point of the last frame without one is beside, and moves with; -1 for none."""
        beside, loose, held = np.full(len(hands), -1), np.flatnonzero(hands < 0), np.flatnonzero(hands >= 0)
        if len(loose) and len(held):
            distances = np.linalg.norm(self._points[loose, None] - self._points[held], axis=-1)
            near = distances.min(axis=1) < self._config.beside_distance
            beside[loose[near]] = hands[held[distances.argmin(axis=1)[near]]]
        return beside


def _assign(
    points: NDArray[np.float64], predicted: NDArray[np.float64], distance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points and predicted points, one to one, within a distance [m]."""
    squares = ((points[:, None] - predicted) ** 2).sum(axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(squares, distance**2))
    near = squares[rows, columns] < distance**2
    return rows[near], columns[near]
