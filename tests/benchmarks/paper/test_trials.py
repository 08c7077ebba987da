"""Takes that are cut or go dark, and how long trackers wait."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.paper.take_evaluation import seen_frame
from benchmarks.paper.trials import FEWEST_FRAMES, hide_points, initialization_times, recovery_times
from gloves import Status, Take
from handsim.errors import ArgumentError
from track import TrackedFrame, TrackedHand
from train import simulate_take


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=FEWEST_FRAMES + 20)


class Late:
    """Knows the truth, but not in the first frames, and not while it lacks so many points in a row."""

    def __init__(self, take: Take, after: int) -> None:
        self.take, self.after, self.frame, self.seen = take, after, -1, 0

    def step(self, points: np.ndarray, ids: np.ndarray, time: float) -> TrackedFrame:
        self.frame += 1
        self.seen = self.seen + 1 if len(points) else 0
        labels = seen_frame(self.take, self.frame).labels
        if self.seen <= self.after:
            labels = np.full(len(points), -1)
        hand = TrackedHand("right", Status.TRACKED, np.zeros(27), 0.001, np.zeros((19, 3)), np.arange(0))
        return TrackedFrame(time, (hand, hand), labels, np.ones(len(points)))


def test_what_comes_back_from_the_dark_has_other_ids(take):
    dark = hide_points(take, 60, 120)
    assert all(not len(seen_frame(dark, frame).points) for frame in range(60, 180))
    before = np.unique(dark.ids[:60][dark.ids[:60] >= 0])
    after = np.unique(dark.ids[180:][dark.ids[180:] >= 0])
    assert len(np.intersect1d(before, after)) == 0
    assert len(np.intersect1d(take.ids[:60], take.ids[180:])) > 20, "which was not so before"
    np.testing.assert_array_equal(dark.points[180:], take.points[180:])
    np.testing.assert_array_equal(dark.labels[:60], take.labels[:60])
    assert (take.ids[60:180] >= 0).any(), "the take itself stays as it is"


def test_a_take_without_its_body_has_only_points_of_hands_and_ghosts(take):
    bare = take.without_body()
    hands = take.labels >= 0
    hands &= take.labels < 38
    assert (take.labels >= 38).any() and not (bare.labels >= 38).any()
    np.testing.assert_array_equal(bare.labels[hands], take.labels[hands])
    gone = np.isfinite(take.points[..., 0]) & ~np.isfinite(bare.points[..., 0])
    np.testing.assert_array_equal(gone, take.labels >= 38)


def test_waits_are_counted_from_the_first_frame_with_points(take, rng):
    for after in (0, 7):
        np.testing.assert_array_equal(
            initialization_times(take, lambda part, n=after: Late(part, n), 3, rng=rng), after
        )
        np.testing.assert_array_equal(
            recovery_times(take, lambda part, n=after: Late(part, n), 2, rng=rng), after
        )
    assert np.isnan(initialization_times(take, lambda part: Late(part, 120), 2, rng=rng)).all()
    assert np.isnan(recovery_times(take, lambda part: Late(part, 120), 2, rng=rng)).all()


def test_a_short_take_is_told(take, rng):
    with pytest.raises(ArgumentError, match="the take has 50 frames, expected at least 120"):
        initialization_times(take.cut(0, 50), lambda part: Late(part, 0), 1, rng=rng)
