"""Arrays that a tracker is given and hands out: whose they are, and those that do not fit together."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import GloveFit, Take
from handsim.errors import ArgumentError
from tests.track.tracker_input.fed_frames import nothing, plain
from track import Tracker
from train import Labeler


def changes_of(users: list[GloveFit], labeler: Labeler, take: Take, spoil: bool) -> list[np.ndarray]:
    """Poses of both hands as they were said, of frames some of which are empty."""
    tracker, poses = Tracker(users, labeler), []
    for frame in range(40):
        fed = plain(take, frame) if frame % 10 < 8 else nothing(frame, plain(take, frame))
        given = fed.points.copy(), fed.ids.copy()
        tracked = tracker.step(*given, fed.time)
        np.testing.assert_array_equal(given[0], fed.points)
        np.testing.assert_array_equal(given[1], fed.ids)
        poses.append(np.array([hand.qpos for hand in tracked.hands]))
        for array in (*given, tracked.labels, tracked.confidence) if spoil else ():
            array[:] = 0
        for hand in tracked.hands if spoil else ():
            hand.markers[:] = 0.0
            hand.qpos[:] = 0.0
    return poses


def test_what_is_given_and_said_is_the_callers_own(users, labeler, take):
    own, spoilt = (changes_of(users, labeler, take, spoil) for spoil in (False, True))
    np.testing.assert_array_equal(own, spoilt)


def test_what_was_said_stays_said(tracker, take):
    kept = [tracker.step(*plain(take, frame)[:3]) for frame in range(40)]
    poses = np.array([[hand.qpos for hand in one.hands] for one in kept])
    steps = np.abs(np.diff(poses[:, :, 7:], axis=0)).max(axis=-1)
    assert (steps > 0.0).all() and steps[1:].max() < 0.2  # the first frame may lack a finger tip


def test_two_trackers_that_are_given_the_same_say_the_same(users, labeler, take):
    one, two = (changes_of(users, labeler, take, spoil=False) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_a_caller_whose_points_and_ids_do_not_fit_is_told(tracker):
    with pytest.raises(ArgumentError, match="expected"):
        tracker.step(np.zeros((3, 3)), np.zeros(2, dtype=int), 0.0)
    with pytest.raises(ArgumentError, match="expected"):
        tracker.step(np.zeros((3, 2)), np.zeros(3, dtype=int), 0.0)
