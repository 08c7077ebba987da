"""Labels of captures: none, one or two hands, each with its side, in motion and in single frames."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import Capture
from track import label_capture, track_capture
from train import evaluate_labeler, load_labeler, simulate_take

FRAMES, RATE = 120, 120.0


def capture_of(frames):
    """Points of each frame as a capture; columns go on from frame to frame."""
    positions = np.full((len(frames), max(map(len, frames)), 3), np.nan)
    for row, points in zip(positions, frames, strict=True):
        row[: len(points)] = points
    return Capture(tuple(f"*{column}" for column in range(positions.shape[1])), positions, RATE)


def right_slots(truth, labels, count):
    """Share of the slots of all frames that have their point, or rightly none."""
    right = [
        np.array_equal(np.flatnonzero(row == marker), np.flatnonzero(mine == marker))
        for row, mine in zip(truth, labels, strict=True)
        for marker in range(count)
    ]
    return np.mean(right)


def sides_there(take):
    """Whether each frame has labels of the right hand, and of the left one."""
    count = take.hands[0].layout.num_markers
    return [(bool(((row >= 0) & (row < count)).any()), bool((row >= count).any())) for row in take.labels]


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand"])
def test_two_hands_are_labeled_better_than_frame_by_frame_and_as_by_the_tracker(kind):
    """In the mean over two people, whom the labeler alone or the tracker takes for others in some frames."""
    slots = []
    for seed in (0, 4):
        take = simulate_take(kind=kind, num_frames=FRAMES, seed=seed)
        alone = evaluate_labeler(load_labeler("dense19"), [take]).figures["slot_accuracy"]
        labels = label_capture(take.capture()).labels
        tracked = track_capture(take.capture()).labels
        ours, theirs = (right_slots(take.labels, one, len(take.label_names)) for one in (labels, tracked))
        slots.append((ours, theirs, alone))
    ours, theirs, alone = np.mean(slots, axis=0)
    assert ours >= max(alone, theirs) - 0.001


def test_one_hand_none_and_a_body(rng):
    take = simulate_take(num_frames=30)
    left = take.observed(take.hand_labels[1])
    body = rng.uniform(-0.9, 0.9, size=(40, 3)) + [0.0, 0.0, 5.0]
    frames = []
    for number, markers in enumerate(left):
        seen = markers[np.isfinite(markers[:, 0])]
        frames.append(np.concatenate([body, seen]) if number < 20 else body)
    labeled = label_capture(capture_of(frames))
    assert sides_there(labeled) == [(False, True)] * 20 + [(False, False)] * 10
    assert (labeled.labels[:, : len(body)] < 0).all()
    hands = [row[len(body) : len(points)] for row, points in zip(labeled.labels[:20], frames, strict=False)]
    assert np.mean([(row >= 0).mean() for row in hands]) > 0.98


@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_random_points_are_no_hand(spread, rng):
    walk = np.cumsum(rng.normal(scale=0.001, size=(8, 1, 3)), axis=0)
    labeled = label_capture(capture_of(list(walk + rng.normal(scale=spread, size=(30, 3)))))
    assert (labeled.labels >= 0).mean() < 0.01


def test_frames_without_order_are_labeled_as_the_labeler_does():
    """Poses that follow from nothing, a right hand in each with drops and ghosts."""
    rng = np.random.default_rng(1)
    take = simulate_take(num_frames=600)
    part = take.hand_labels[0]
    frames, truth = [], []
    for number in rng.permutation(600)[:60]:
        here = np.flatnonzero((take.labels[number] >= part.start) & (take.labels[number] < part.stop))
        kept = rng.permutation(here)[3:]
        center = take.points[number, kept].mean(axis=0)
        ghosts = center + rng.uniform(-0.08, 0.08, size=(2, 3))
        frames.append(np.concatenate([take.points[number, kept], ghosts]))
        truth.append(np.append(take.labels[number, kept] - part.start, [-1, -1]))
    given = [one.labels for one in load_labeler("dense19").label_frames(frames)]
    labeled = label_capture(capture_of(frames))
    ours = [row[: len(points)] for row, points in zip(labeled.labels, frames, strict=True)]
    assert np.mean([right for right, _ in sides_there(labeled)]) > 0.95
    count = part.stop - part.start
    assert right_slots(truth, ours, count) >= right_slots(truth, given, count) - 0.005


def test_a_mirrored_capture_has_the_other_sides():
    take = simulate_take(num_frames=30)
    points = take.points
    names = tuple(f"*{column}" for column in range(points.shape[1]))
    straight = label_capture(Capture(names, points, RATE))
    mirrored = label_capture(Capture(names, points * [-1.0, 1.0, 1.0], RATE))
    count = straight.hands[0].layout.num_markers
    swapped = np.where(mirrored.labels >= 0, (mirrored.labels + count) % (2 * count), -1)
    assert (straight.labels == swapped).mean() > 0.99


def test_empty_frames_hold_no_hand():
    labeled = label_capture(Capture(("*0",), np.full((3, 1, 3), np.nan), RATE))
    assert (labeled.labels == -1).all()
