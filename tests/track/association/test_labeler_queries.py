"""Opinions of a labeler on points without names."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim.hand.model import join_qpos
from poses.shapes.validity import resting_angles
from track.association.hand_state import HandMemory
from track.association.label_new_points import Following
from track.association.labeler_queries import Adviser
from train.labelers.protocol import Labeling
from train.labelers.storage import load_labeler

TIP = 6


class CountingLabeler:
    """The shipped labeler, which counts how often it is asked."""

    def __init__(self):
        self._labeler = load_labeler("dense19")
        self.marker_names = self._labeler.marker_names
        self.times = 0

    def label_frames(self, frames) -> list[Labeling]:
        self.times += 1
        return self._labeler.label_frames(frames)


@pytest.fixture
def hand() -> Following:
    """A hand that is followed without the marker on the tip of its index finger."""
    user = nominal_fit(load_layout("dense19"), "M", "right")
    memory = HandMemory(user)
    qpos = join_qpos(resting_angles(user.model)[None])[0]
    target = memory.solver.place(qpos)
    target[TIP] = np.nan
    memory.begin(qpos, target, 0.0)
    coming = memory.predict(0.01)
    return Following(0, memory, coming, memory.fit(target, coming.qpos, coming))


def odds(adviser, hand, points, ids, names, time, born=0.0):
    return adviser.odds([hand], points, ids, names[None], np.full(len(points), born), time)


def test_a_marker_that_waits_is_advised_for(hand):
    places = hand.memory.solver.place(hand.memory.qpos)
    names = np.arange(19)
    names[TIP] = -1
    labeler = CountingLabeler()
    adviser = Adviser(labeler)
    assert odds(adviser, hand, places, np.arange(19), names, 0.0) == {}  # it has only just come
    assert labeler.times == 0
    first = odds(adviser, hand, places, np.arange(19), names, 0.1)[0]
    assert first[TIP, TIP] > 2.0 and np.count_nonzero(first) == 1
    again = odds(adviser, hand, places, np.arange(19), names, 0.11)[0]
    assert labeler.times == 1 and (again == first).all()  # it is remembered, not asked again
    later = odds(adviser, hand, places, np.arange(19), names, 0.5)[0]
    assert labeler.times == 2 and later[TIP, TIP] > first[TIP, TIP]
    gone = np.where(np.arange(19) == TIP, 99, np.arange(19))
    assert odds(adviser, hand, places, gone, names, 0.5, born=0.5) == {}  # another ID: another point


def test_nobody_is_asked_about_whole_hands_far_points_or_points_without_an_id(hand):
    places, labeler = hand.memory.solver.place(hand.memory.qpos), CountingLabeler()
    adviser = Adviser(labeler)
    stray = np.concatenate([places, places[:1] + 0.03])
    assert odds(adviser, hand, stray, np.arange(20), np.array([*range(19), -1]), 1.0) == {}
    names = np.arange(19)
    names[TIP] = -1
    far = places.copy()
    far[TIP] += 0.3
    assert odds(adviser, hand, far, np.arange(19) + 50, names, 1.0) == {}
    ids = np.where(np.arange(19) == TIP, -1, np.arange(19) + 100)
    assert odds(adviser, hand, places, ids, names, 1.0) == {}
    assert labeler.times == 0
