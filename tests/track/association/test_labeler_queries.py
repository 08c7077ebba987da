"""Queries to the labeler on points without a label."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim.hand.model import join_qpos
from poses.shapes.validity import resting_angles
from track.association.frame_state import FrameState
from track.association.hand_state import HandState
from track.association.label_new_points import HandTrack
from track.association.labeler_queries import LabelerQueries
from train.labelers.protocol import Labeling
from train.labelers.storage import load_labeler

TIP = 6


class CountingLabeler:
    """The shipped labeler, which counts its queries."""

    def __init__(self):
        self._labeler = load_labeler("dense19")
        self.marker_names = self._labeler.marker_names
        self.times = 0

    def label_frames(self, frames) -> list[Labeling]:
        self.times += 1
        return self._labeler.label_frames(frames)


@pytest.fixture
def hand() -> HandTrack:
    """A track of a hand without the marker on the tip of its index finger."""
    user = nominal_fit(load_layout("dense19"), "M", "right")
    state = HandState(user)
    qpos = join_qpos(resting_angles(user.model)[None])[0]
    target = state.solver.marker_positions(qpos)
    target[TIP] = np.nan
    state.initialize(qpos, target, 0.0)
    prediction = state.predict(0.01)
    return HandTrack(0, state, prediction, state.fit(target, prediction.qpos, prediction))


def log_odds(queries, hand, points, ids, labels, time, first_seen=0.0):
    count = len(points)
    frame = FrameState(
        points, ids, labels[None], np.zeros(count), np.ones(count), np.full(count, first_seen), time
    )
    return queries.log_odds([hand], frame)


def test_the_labeler_is_queried_about_a_point_that_waits(hand):
    positions = hand.state.solver.marker_positions(hand.state.qpos)
    labels = np.arange(19)
    labels[TIP] = -1
    labeler = CountingLabeler()
    queries = LabelerQueries(labeler)
    assert log_odds(queries, hand, positions, np.arange(19), labels, 0.0) == {}  # it is too young
    assert labeler.times == 0
    first = log_odds(queries, hand, positions, np.arange(19), labels, 0.1)[0]
    assert first[TIP, TIP] > 2.0 and np.count_nonzero(first) == 1
    again = log_odds(queries, hand, positions, np.arange(19), labels, 0.11)[0]
    assert labeler.times == 1 and (again == first).all()  # the answer is kept
    later = log_odds(queries, hand, positions, np.arange(19), labels, 0.5)[0]
    assert labeler.times == 2 and later[TIP, TIP] > first[TIP, TIP]
    gone = np.where(np.arange(19) == TIP, 99, np.arange(19))
    assert (
        log_odds(queries, hand, positions, gone, labels, 0.5, first_seen=0.5) == {}
    )  # another ID: another point


def test_there_are_no_queries_about_whole_hands_far_points_or_points_without_an_id(hand):
    positions, labeler = hand.state.solver.marker_positions(hand.state.qpos), CountingLabeler()
    queries = LabelerQueries(labeler)
    stray = np.concatenate([positions, positions[:1] + 0.03])
    assert log_odds(queries, hand, stray, np.arange(20), np.array([*range(19), -1]), 1.0) == {}
    labels = np.arange(19)
    labels[TIP] = -1
    far = positions.copy()
    far[TIP] += 0.3
    assert log_odds(queries, hand, far, np.arange(19) + 50, labels, 1.0) == {}
    ids = np.where(np.arange(19) == TIP, -1, np.arange(19) + 100)
    assert log_odds(queries, hand, positions, ids, labels, 1.0) == {}
    assert labeler.times == 0
