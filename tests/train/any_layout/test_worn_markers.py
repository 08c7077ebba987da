"""Markers on many people: what is fixed on a hand stays, what bends moves, and people differ."""

from __future__ import annotations

import numpy as np

from gloves.layout import load_layout
from train.any_layout.worn_markers import sample_worn_markers


def test_the_back_of_the_hand_is_rigid_and_fingers_bend():
    layout = load_layout("starter10")
    markers = sample_worn_markers(layout, 250, rng=np.random.default_rng(0))
    assert markers.shape == (250, 10, 3) and np.isfinite(markers).all()
    back, tip = layout.names.index("BackHand1"), layout.names.index("MiddleTip")
    second = layout.names.index("BackHand2")
    for person in range(0, 200, 100):
        rows = markers[person : person + 100]
        assert np.linalg.norm(rows[:, back] - rows[:, second], axis=1).std() < 2e-3
        assert np.linalg.norm(rows[:, back] - rows[:, tip], axis=1).std() > 1e-2
    firsts = np.linalg.norm(markers[[0, 100, 200], back] - markers[[0, 100, 200], second], axis=1)
    assert len(np.unique(firsts.round(5))) == 3  # three people


def test_the_same_seed_gives_the_same_markers():
    layout = load_layout("tips8")
    one, two = (sample_worn_markers(layout, 30, rng=np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one, two)
