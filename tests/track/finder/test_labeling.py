"""Hands are counted frame by frame: none among other things, one, or two, each with its side."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gloves.captures.markers import unlabeled_frames
from gloves.layout import load_layout
from track.finder.frame_hands import HandFinder
from track.finder.labeling import label_hands
from train.evaluate import evaluate_labeler
from train.glove_labeler import load_labeler
from train.labelers.protocol import Labeling
from train.simulation.takes import simulate_take

FRAMES = 120


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Two test processes with two threads each would wait for one another most of the time."""
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def finder():
    return HandFinder(load_labeler("dense19"), load_layout("dense19"), rng=np.random.default_rng(0))


def slots_right(take, labelings):
    """Share of the slots of both hands that are right, sides among them."""
    right = []
    for row, there, one in zip(take.labels, np.isfinite(take.points[..., 0]), labelings, strict=True):
        truth = row[there]
        for hand, label in zip(take.hands, take.hand_labels, strict=True):
            side = 1 if hand.side == "right" else -1
            given, true = np.full((2, len(label)), -1)
            given[one.labels[one.sides == side]] = np.flatnonzero(one.sides == side)
            mine = np.flatnonzero((truth >= label.start) & (truth < label.stop))
            true[truth[mine] - label.start] = mine
            right.append((given == true).mean())
    return np.mean(right)


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand"])
def test_two_hands_are_labeled_as_well_as_each_by_itself(kind, finder):
    take = simulate_take(kind=kind, num_frames=FRAMES)
    alone = evaluate_labeler(load_labeler("dense19"), [take]).figures["slot_accuracy"]
    labelings = label_hands(unlabeled_frames(take.capture()), finder, take.rate)
    assert slots_right(take, labelings) > alone - (0.005 if kind == "single-hand" else 0.03)
    assert np.mean([all(one.hands) for one in labelings]) > 0.95


def test_one_hand_none_and_a_body(finder, rng):
    take = simulate_take(num_frames=30)
    left = take.observed(take.hand_labels[1])
    body = rng.uniform(-0.9, 0.9, size=(40, 3)) + [0.0, 0.0, 5.0]
    frames = []
    for number, markers in enumerate(left):
        seen = markers[np.isfinite(markers[:, 0])]
        frames.append(np.concatenate([body, seen]) if number < 20 else body)
    labelings = label_hands(frames, finder, take.rate)
    assert [one.hands for one in labelings] == [(False, True)] * 20 + [(False, False)] * 10
    assert all((one.labels[: len(body)] < 0).all() for one in labelings)
    assert np.mean([(one.labels[len(body) :] >= 0).mean() for one in labelings[:20]]) > 0.98


@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_random_points_are_no_hand(spread, finder, rng):
    walk = np.cumsum(rng.normal(scale=0.001, size=(40, 1, 3)), axis=0)
    frames = list(walk + rng.normal(scale=spread, size=(30, 3)))
    named = [(one.labels >= 0).mean() for one in label_hands(frames, finder, 120.0)]
    assert np.mean(named) < 0.01  # a few points among many can lie as those of a hand


@pytest.mark.parametrize("seed", [13, 16, 22])
def test_random_points_that_fit_distances_are_no_hand(seed, finder):
    """These clouds have labels whose distances are a hand's, and no pose."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(scale=0.001, size=(40, 1, 3)), axis=0)
    frames = list(walk + rng.normal(scale=0.05, size=(30, 3)))
    named = [(one.labels >= 0).any() for one in label_hands(frames, finder, 120.0)]
    assert np.mean(named) < 0.2


def test_a_moved_and_mirrored_capture(finder):
    take = simulate_take(num_frames=10)
    frames = unlabeled_frames(take.capture())
    straight = label_hands(frames, finder, take.rate)
    mirrored = label_hands([points * [-1.0, 1.0, 1.0] + 3.0 for points in frames], finder, take.rate)
    for one, other in zip(straight, mirrored, strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.sides, -other.sides)


def test_no_frames_and_empty_frames(finder):
    assert label_hands([], finder, 120.0) == []
    (one,) = label_hands([np.zeros((0, 3))], finder, 120.0)
    assert one.hands == (False, False) and one.labels.shape == (0,)


class Unsure:
    """The shipped labeler, half as confident."""

    def __init__(self, labeler):
        self.marker_names, self._labeler = labeler.marker_names, labeler

    def label_frames(self, frames):
        labelings = self._labeler.label_frames(frames)
        return [Labeling(one.labels, 0.5 * one.confidence) for one in labelings]


def test_a_labeler_of_little_confidence_finds_hands(finder):
    rng = np.random.default_rng(0)
    unsure = HandFinder(Unsure(load_labeler("dense19")), load_layout("dense19"), rng=rng)
    assert unsure.certain.confidence < 0.5 < finder.certain.confidence == 0.75
    take = simulate_take(num_frames=5)
    assert all(all(one.hands) for one in label_hands(unlabeled_frames(take.capture()), unsure, take.rate))
