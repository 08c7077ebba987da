"""Queries to the labeler on points that stay without a label near a hand that lacks markers.

Labels that go along with IDs can hold a hand in a wrong pose that excludes a marker which is clearly visible.
The labeler sees the same points without that history; its answers are log-odds beside those of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from track.association.frame_state import FrameState
from track.association.label_new_points import HandTrack
from track.config import QueryConfig
from train.labelers.protocol import Labeler

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray


class LabelerQueries:
    """Collects the labeler's answers on points for as long as their IDs last.

    Args:
        labeler: Labels the points of a cloud of one hand.
        config: When it is queried, and how much its answers count.
    """

    def __init__(self, labeler: Labeler, config: QueryConfig = QueryConfig()) -> None:  # noqa: B008
        self._labeler = labeler
        self._config = config
        self._last_query: dict[int, float] = {}
        self._budget, self._last_time = config.burst, -np.inf
        self._due: dict[tuple[int, int], float] = {}
        self._answers: dict[tuple[int, int], NDArray[np.float64]] = {}

    def log_odds(self, hands: Sequence[HandTrack], frame: FrameState) -> dict[int, Float[np.ndarray, "P M"]]:
        """Query the labeler if points are due, and sum up its answers so far.

        Args:
            hands: The hands that have a pose.
            frame: The frame; points without an ID are never queried.

        Returns:
            For each hand on whose points there was an answer, the log-odds of each point being each marker.
        """
        rows = {point: row for row, point in enumerate(frame.ids.tolist()) if point >= 0}
        self._due = {key: due for key, due in self._due.items() if key[0] in rows}
        self._answers = {key: answer for key, answer in self._answers.items() if key[0] in rows}
        earned = self._config.rate * (frame.time - self._last_time)
        self._budget, self._last_time = min(self._budget + earned, self._config.burst), frame.time
        if self._budget >= 1.0:
            self._query_one(hands, frame)
        log_odds: dict[int, NDArray[np.float64]] = {}
        for (point, index), answer in self._answers.items():
            log_odds.setdefault(index, np.zeros((len(frame.points), len(answer))))[rows[point]] = answer
        return log_odds

    def _query_one(self, hands: Sequence[HandTrack], frame: FrameState) -> None:
        """Query the points of one hand, because a query takes time: of that with the oldest query first."""
        unlabeled = np.flatnonzero(frame.unlabeled & (frame.ids >= 0))
        for hand in sorted(hands, key=lambda hand: self._last_query.get(hand.index, -np.inf)):
            due = [
                self._due.get(
                    (int(frame.ids[row]), hand.index), frame.first_seen[row] + self._config.first_age
                )
                for row in unlabeled
            ]
            waiting = unlabeled[frame.time >= np.array(due)]
            if len(waiting) and self._query(hand, frame, waiting):
                self._last_query[hand.index] = frame.time
                self._budget -= 1.0
                for row in waiting:
                    age = frame.time - frame.first_seen[row]
                    next_age = (self._config.next_age_factor - 1.0) * age
                    self._due[int(frame.ids[row]), hand.index] = frame.time + next_age
                return

    def _query(self, hand: HandTrack, frame: FrameState, waiting: NDArray[np.int64]) -> bool:
        """Query waiting points if they may be markers that the hand lacks; return whether they may."""
        labels, positions = frame.labels[hand.index], hand.estimate.positions
        missing = np.ones(len(positions), dtype=bool)
        missing[labels[labels >= 0]] = False
        if not missing.any() or not self._near(frame.points[waiting], positions[missing]).any():
            return False
        shown, unlabeled = labels >= 0, frame.unlabeled
        shown[unlabeled] = self._near(frame.points[unlabeled], positions)
        cloud = np.flatnonzero(shown)
        labeling = self._labeler.label_frames([frame.points[cloud]])[0]
        most, most_answer = self._config.most_log_odds, self._config.most_answer_log_odds
        for row, label, confidence in zip(cloud, labeling.labels, labeling.confidence, strict=True):
            if row in waiting and label >= 0 and missing[label]:
                answer = self._answers.setdefault((int(frame.ids[row]), hand.index), np.zeros(len(missing)))
                log_odds = np.log(confidence / max(1.0 - confidence, 1e-6))
                answer[label] = min(answer[label] + np.clip(log_odds, 0.0, most_answer), most)
        return True

    def _near(self, points: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points are within the radius of a position."""
        distances = np.linalg.norm(points[:, None] - positions, axis=-1)
        near: NDArray[np.bool_] = (distances < self._config.radius).any(axis=1)
        return near
