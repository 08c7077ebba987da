"""Two older ways to label: what they do, and where they stay wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.paper.assignment_trackers import GATE, NEAR, HungarianTracker, NearestNeighborTracker
from benchmarks.paper.take_evaluation import evaluate_tracker, seen_frame, true_users
from benchmarks.paper.trials import hide_points
from gloves import GloveFit, Take
from train import simulate_take

BOTH = pytest.mark.parametrize("kind", [NearestNeighborTracker, HungarianTracker])


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="single-hand", num_frames=300).without_body()


@pytest.fixture(scope="module")
def users(take) -> list[GloveFit]:
    return true_users(take)


def started(kind, users, take, frames: int = 2):
    """A tracker after the first frames, and the next one."""
    tracker = kind(users, seen_frame(take, 0).labels)
    for number in range(frames):
        seen = seen_frame(take, number)
        tracker.step(seen.points, seen.ids, number / take.rate)
    return tracker, seen_frame(take, frames), frames / take.rate


@BOTH
def test_hands_in_the_air_are_followed(kind, take, users):
    report = evaluate_tracker(take, users, kind(users, seen_frame(take, 0).labels))
    assert report.right.mean() >= 0.97
    assert report.valid.all()
    assert np.nanmean(report.joint_error) < 0.0005


@BOTH
def test_hands_are_lost_with_their_points_and_stay_so(kind, take, users):
    dark = hide_points(take, 20, 200)
    tracker, seen, time = started(kind, users, dark, 220)
    frame = tracker.step(seen.points, seen.ids, time)
    assert not np.array_equal(frame.labels, seen.labels)
    assert evaluate_tracker(dark, users, kind(users, seen_frame(dark, 0).labels)).right[220:].mean() < 0.2


def test_names_go_with_ids_wherever_their_points_go(take, users):
    tracker, seen, time = started(NearestNeighborTracker, users, take)
    points = seen.points.copy()
    points[seen.labels == 5] += 0.3
    assert np.array_equal(tracker.step(points, seen.ids, time).labels, seen.labels)


@pytest.mark.parametrize(("shift", "named"), [(0.7 * NEAR, True), (1.5 * NEAR, False)])
def test_a_new_point_is_the_nearest_lost_marker(shift, named, take, users):
    tracker, seen, time = started(NearestNeighborTracker, users, take)
    points, ids = seen.points.copy(), seen.ids.copy()
    points[seen.labels == 5, 2] += shift
    ids[seen.labels == 5] = 10_000
    labels = tracker.step(points, ids, time).labels
    assert labels[seen.labels == 5] == (5 if named else -1)
    later = seen_frame(take, 3)
    points, ids = later.points.copy(), np.where(later.labels == 5, 10_000, later.ids)
    labels = tracker.step(points, ids, time + 1 / take.rate).labels
    assert labels[later.labels == 5] == (5 if named else -1), "it is new but once"


def test_lost_markers_are_looked_for_where_they_were_going(users, take):
    first = take.cut(0, 1)
    speed = np.array([1.2, 0.0, 0.0])  # [m/s]: 10 mm a frame

    def at(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        seen = seen_frame(first, 0)
        return seen.points + speed * number / 120, seen.ids, seen.labels

    tracker = NearestNeighborTracker(users, at(0)[2])
    for number in range(3):
        points, ids, labels = at(number)
        tracker.step(points, ids, number / 120)
    points, ids, labels = at(5)
    ids = np.where(labels == 5, 10_000, ids)
    there = labels != 5
    for number in (3, 4):
        tracker.step(at(number)[0][there], ids[there], number / 120)
    assert np.array_equal(tracker.step(points, ids, 5 / 120).labels, labels)


def test_the_assignment_asks_for_no_ids(take, users):
    nameless = dataclasses.replace(take, ids=np.full_like(take.ids, -1))
    frames = [
        evaluate_tracker(part, users, HungarianTracker(users, seen_frame(take, 0).labels)).right
        for part in (take.cut(0, 60), nameless.cut(0, 60))
    ]
    np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize(("shift", "named"), [(0.7 * GATE, True), (1.5 * GATE, False)])
def test_points_beyond_the_gate_are_nobodys(shift, named, take, users):
    tracker, seen, time = started(HungarianTracker, users, take)
    points = seen.points.copy()
    tip = seen.labels == take.hands[0].layout.names.index("MiddleTip")
    points[tip] += (
        shift * (points[tip] - points.mean(axis=0)) / np.linalg.norm(points[tip] - points.mean(axis=0))
    )
    assert (tracker.step(points, seen.ids, time).labels[tip] >= 0).all() == named
