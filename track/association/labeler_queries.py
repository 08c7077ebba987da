"""A second opinion: the labeler is asked about points that stay unnamed near a hand that lacks markers.

Names that go along with a hand can drift into a pose that has no room for a marker that is plainly there. The
labeler sees the same points without that history; what it says counts as odds beside the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from track.association.label_new_points import Following
from train.labelers.protocol import Labeler

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

_NEAR: Final = 0.06  # [m] around the markers of a hand: points that the labeler is shown
_FIRST: Final = 0.05  # [s] that a point is there before anybody is asked about it
_LATER: Final = 3.0  # of its age: it is asked about again
_RATE, _BURST = 0.9, 6.0  # [1/s] askings, which take longer than the rest of a frame; those saved up at most
_MOST: Final = 12.0  # log odds that opinions may come to
_WEIGHT: Final = 4.0  # log odds of one sure opinion


class Adviser:
    """Collects opinions on points for as long as their IDs last.

    Args:
        labeler: Names the points of a cloud of one hand.
    """

    def __init__(self, labeler: Labeler) -> None:
        self._labeler = labeler
        self._asked: dict[int, float] = {}
        self._left, self._last = _BURST, -np.inf
        self._due: dict[tuple[int, int], float] = {}
        self._opinions: dict[tuple[int, int], NDArray[np.float64]] = {}

    def odds(
        self,
        hands: Sequence[Following],
        points: Float[np.ndarray, "N 3"],
        ids: Int[np.ndarray, "N"],
        names: Int[np.ndarray, "H N"],
        born: Float[np.ndarray, "N"],
        time: float,
    ) -> dict[int, Float[np.ndarray, "N M"]]:
        """Log odds of names by what the labeler said, for those hands on whose points it said anything.

        Args:
            hands: The hands that have a pose.
            points: The frame's points [m].
            ids: Their IDs; nobody is asked about those that have none.
            names: Names of every hand.
            born: When each point appeared [s].
            time: Time of the frame [s].
        """
        rows = {point: row for row, point in enumerate(ids.tolist()) if point >= 0}
        self._due = {key: due for key, due in self._due.items() if key[0] in rows}
        self._opinions = {key: said for key, said in self._opinions.items() if key[0] in rows}
        unnamed = np.flatnonzero((names < 0).all(axis=0) & (ids >= 0))
        self._left, self._last = min(self._left + _RATE * (time - self._last), _BURST), time
        for hand in sorted(
            hands if self._left >= 1.0 else (), key=lambda hand: self._asked.get(hand.number, -np.inf)
        ):
            due = [self._due.get((int(ids[row]), hand.number), born[row] + _FIRST) for row in unnamed]
            waiting = unnamed[time >= np.array(due)]
            if len(waiting) and self._ask(
                hand, points, ids, names, waiting
            ):  # one hand a frame: it takes time
                self._asked[hand.number] = time
                self._left -= 1.0
                for row in waiting:
                    self._due[int(ids[row]), hand.number] = time + (_LATER - 1.0) * (time - born[row])
                break
        found: dict[int, NDArray[np.float64]] = {}
        for (point, number), said in self._opinions.items():
            found.setdefault(number, np.zeros((len(points), len(said))))[rows[point]] = said
        return found

    def _ask(
        self,
        hand: Following,
        points: NDArray[np.float64],
        ids: NDArray[np.int64],
        names: NDArray[np.int64],
        waiting: NDArray[np.int64],
    ) -> bool:
        """Ask about points that wait, if they may be markers that a hand lacks; whether they may."""
        mine, places = names[hand.number], hand.estimate.places
        missing = np.ones(len(places), dtype=bool)
        missing[mine[mine >= 0]] = False
        if not missing.any() or not _near(points[waiting], places[missing]).any():
            return False
        shown, free = mine >= 0, (names < 0).all(axis=0)
        shown[free] = _near(points[free], places)
        cloud = np.flatnonzero(shown)
        labeling = self._labeler.label_frames([points[cloud]])[0]
        for row, label, sure in zip(cloud, labeling.labels, labeling.confidence, strict=True):
            if row in waiting and label >= 0 and missing[label]:
                said = self._opinions.setdefault((int(ids[row]), hand.number), np.zeros(len(missing)))
                odds = np.log(sure / max(1.0 - sure, 1e-6))
                said[label] = min(said[label] + np.clip(odds, 0.0, _WEIGHT), _MOST)
        return True


def _near(points: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = (np.linalg.norm(points[:, None] - places, axis=-1) < _NEAR).any(axis=1)
    return near
