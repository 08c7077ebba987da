"""Captures in which a layout is tried: what is counted, and the sentence on two layouts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.layout import load_layout
from track.glove_advice.score_page import trial_rows
from track.glove_advice.trials import METHODS, Trial, _rights, try_take, verdict
from train.labelers.storage import load_labeler
from train.simulation.takes import simulate_take


@pytest.fixture(scope="module")
def take():
    return simulate_take("single-hand", glove="dense19", num_frames=40, seed=1, hands=["right"])


def trial(share, joints):
    slots = np.full(4, share)
    slots[2] -= 0.1
    return Trial(dict.fromkeys(METHODS, slots), dict.fromkeys(METHODS, share), np.full(20, joints), 0.002)


def test_a_hand_in_the_dense_glove_is_labeled_and_tracked(take):
    found = try_take(take, load_layout("dense19"), load_labeler("dense19"))
    assert min(found.share(method) for method in METHODS) > 0.98
    assert np.rad2deg(np.sqrt(np.mean(found.joints**2))) < 15.0
    assert found.size_error < 0.012


def test_truth_is_all_right_and_exchanged_markers_are_not(take):
    share, frames = _rights(take, take)
    assert (share == 1.0).all() and frames == 1.0
    labels = take.labels.copy()
    labels[:20][take.labels[:20] == 3] = 4
    labels[:20][take.labels[:20] == 4] = 3
    share, frames = _rights(take, dataclasses.replace(take, labels=labels))
    assert share[3] == pytest.approx(share[4]) and share[3] <= 0.5 + 1e-9
    assert (np.delete(share, [3, 4]) == 1.0).all() and frames <= 0.5


def test_labels_of_a_hand_that_is_not_there_are_wrong(take):
    both = simulate_take("single-hand", glove="dense19", num_frames=40, seed=1)
    other = dataclasses.replace(take, hands=(both.hands[1],))
    share, frames = _rights(take, other)
    assert share.max() < 0.2 and frames == 0.0


def test_the_sentence_says_whether_a_layout_is_better():
    before, more, same = trial(0.95, 0.2), trial(0.99, 0.21), trial(0.951, 0.1)
    assert verdict({"a": before}, {"a": more}).startswith("Better in captures: 92.50 %")
    assert verdict({"a": before}, {"a": same}).startswith("Better in captures")
    assert verdict({"a": more}, {"a": before}).startswith("Not better in captures")
    assert verdict({"a": before}, {"a": before}).startswith("Not better in captures")


def test_the_table_names_the_worst_marker(tips):
    header, row = trial_rows({"two touching": trial(0.95, 0.2)}, tips)
    assert len(header) == len(row)
    assert row[0] == "two touching" and f"{tips.names[2]} (85 %)" in row
