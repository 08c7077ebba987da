"""Which points are of one event where the directions differ, and where they exchange the hands."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from gloves import PointList
from gloves.takes.take import LOST, TRACKED
from track.takes.bidirectional_labeling import _events_of, _exchanged_runs, _is_likelier


def test_runs_of_exchanged_hands_are_found():
    right, left, gap = [0, 1, 2, 5, 6], [5, 6, 7, 0, 1], [-1] * 5
    digit = [1, 0, 2, 5, 6]  # another marker of the same hand
    forward = np.array([right, right, right, right, gap, right])
    backward = np.array([right, left, left, digit, left, left])
    points = PointList.of_tables(np.zeros((6, 5, 3)), forward, forward, np.ones((6, 5)))
    assert list(_exchanged_runs(points, forward.ravel(), backward.ravel(), 5)) == [slice(1, 3), slice(5, 6)]
    assert list(_exchanged_runs(points, forward.ravel(), forward.ravel(), 5)) == []


def test_labels_that_change_together_are_one_event():
    forward = np.array([[0, 1, 2, 3], [0, 1, 2, 3], [0, 1, -1, 3], [0, 1, 2, 3]])
    backward = np.array([[1, 0, 2, 3], [1, 0, 2, -1], [0, 1, 2, 3], [1, 0, 2, 3]])
    events = _events_of(np.repeat(np.arange(4), 4), forward.ravel(), backward.ravel())
    assert events.points.tolist() == [0, 1, 4, 5, 7, 10, 12, 13]
    exchange, later = events.numbers[0], events.numbers[-1]
    assert (events.numbers[:4] == exchange).all() and (events.numbers[-2:] == later).all()
    assert len({exchange, events.numbers[4], events.numbers[5], later}) == 4


def test_a_direction_that_has_lost_a_hand_does_not_outvote_the_other():
    labels, none, frames = np.array([0, 1, 2]), np.full(3, -1), np.zeros(3, dtype=int)

    def take(labels, confidence, status) -> SimpleNamespace:
        points = SimpleNamespace(labels=labels, confidence=np.full(3, confidence), frames=frames)
        parts = (range(5), range(5, 10))
        return SimpleNamespace(point_list=points, status=np.array([[status, LOST]]), hand_labels=parts)

    for status, is_likelier in ((LOST, True), (TRACKED, False)):
        events = _events_of(frames, labels, none)
        likelier = _is_likelier(take(labels, 0.8, TRACKED), take(none, 0.9, status), events)
        assert (likelier == is_likelier).all()
