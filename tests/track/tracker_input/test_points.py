"""The tracker with too few points, too many, and points that are nowhere or elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import Status
from tests.track.tracker_input.fed_frames import SURE, Fed, all_right, feed, nothing, only, plain, statuses


def test_nothing_ever_comes(tracker, take):
    _, tracked = feed(tracker, take, range(30), nothing)
    assert statuses(tracked) == {Status.LOST}


def test_a_few_empty_frames_are_coasted_through(tracker, take):
    feed(tracker, take, range(60))
    _, dark = feed(tracker, take, range(60, 66), nothing)
    assert statuses(dark) == {Status.COASTING}
    fed, tracked = feed(tracker, take, range(66, 80))
    assert all(all_right(fed[2:], tracked[2:]))


def test_every_other_frame_is_empty(tracker, take):
    fed, tracked = feed(tracker, take, range(120), lambda n, fed: nothing(n, fed) if n % 2 else fed)
    assert all(all_right(fed[::2], tracked[::2]))
    assert statuses(tracked[1::2]) == {Status.COASTING}


@pytest.mark.parametrize("nowhere", [np.nan, np.inf, -np.inf, 1e30])
def test_points_that_are_nowhere_are_left_out_and_told(tracker, take, nowhere):
    rng = np.random.default_rng(0)

    def change(number: int, fed: Fed) -> Fed:
        points, labels = fed.points.copy(), fed.labels.copy()
        gone = rng.choice(len(points), 4, replace=False)
        points[gone, rng.integers(0, 3, size=4)], labels[gone] = nowhere, -1
        return fed._replace(points=points, labels=labels)

    feed(tracker, take, range(20))
    fed, tracked = feed(tracker, take, range(20, 60), change)
    assert all(any("nowhere" in note for note in frame.notes) for frame in tracked)
    assert np.mean(all_right(fed, tracked)) >= 0.9
    fed, tracked = feed(tracker, take, range(60, 80))
    assert all(all_right(fed[3:], tracked[3:])) and not any(frame.notes for frame in tracked)


def test_frames_of_points_that_are_all_nowhere(tracker, take):
    feed(tracker, take, range(20))
    _, tracked = feed(tracker, take, range(20, 50), lambda n, fed: fed._replace(points=fed.points * np.nan))
    assert {hand.status for hand in tracked[-1].hands} == {Status.LOST}
    fed, tracked = feed(tracker, take, range(50, 60))
    assert all(all_right(fed[3:], tracked[3:]))


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("spread", [0.1, 0.5, 2.0])
def test_five_hundred_strays_around_and_among_the_hands(tracker, take, spread, lasting):
    rng = np.random.default_rng(0)
    places = rng.uniform(-spread, spread, size=(500, 3))

    def change(number: int, fed: Fed) -> Fed:
        strays = places if lasting else rng.uniform(-spread, spread, size=(500, 3))
        return fed._replace(
            points=np.concatenate([fed.points, plain(take, 20).points.mean(axis=0) + strays]),
            ids=np.concatenate([fed.ids, 10**6 + 1000 * number * (not lasting) + np.arange(500)]),
            labels=np.concatenate([fed.labels, np.full(500, -1)]),
        )

    feed(tracker, take, range(20))
    fed, tracked = feed(tracker, take, range(20, 50), change)
    assert np.mean(all_right(fed, tracked)) >= 0.95
    fed, tracked = feed(tracker, take, range(50, 60))
    assert all(all_right(fed[3:], tracked[3:]))


def test_hands_that_come_up_amid_strays_are_not_made_up(tracker, take):
    """Among so many they may stay lost; once alone they are found at once."""
    rng = np.random.default_rng(0)

    def change(number: int, fed: Fed) -> Fed:
        strays = fed.points.mean(axis=0) + rng.uniform(-0.3, 0.3, size=(500, 3))
        points = np.concatenate([fed.points, strays])
        return fed._replace(points=points, ids=np.arange(len(points)) + 1000 * number)

    feed(tracker, take, range(10), change)
    fed, tracked = feed(tracker, take, range(10, 20))
    assert all(all_right(fed, tracked))


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("jump", [(0.5, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_a_hand_that_jumps_half_a_meter_is_right_again_soon(tracker, take, jump, same):
    def change(number: int, fed: Fed) -> Fed:
        points, mine = fed.points.copy(), (fed.labels >= 0) & (fed.labels < 19)
        points[mine] += jump
        ids = fed.ids if same else fed.ids + 10**6 * mine
        return fed._replace(points=points, ids=ids, shift=np.array([jump, np.zeros(3)]))

    feed(tracker, take, range(60))
    fed, tracked = feed(tracker, take, range(60, 120), change)
    right = all_right(fed, tracked)
    assert all(right[3:])


def test_frames_of_one_point(tracker, take):
    rng = np.random.default_rng(0)
    _, tracked = feed(tracker, take, range(20), lambda n, fed: only(fed, [n]))
    assert statuses(tracked) == {Status.LOST}
    feed(tracker, take, range(20, 60))
    _, tracked = feed(tracker, take, range(60, 90), lambda n, fed: only(fed, rng.integers(0, 30, size=1)))
    assert not statuses(tracked) & set(SURE)
    assert {hand.status for hand in tracked[-1].hands} == {Status.LOST}
    fed, tracked = feed(tracker, take, range(90, 110))
    assert all(all_right(fed[3:], tracked[3:]))


def test_every_point_twice_at_one_place(tracker, take):
    def change(number: int, fed: Fed) -> Fed:
        points, ids = np.repeat(fed.points, 2, axis=0), np.repeat(2 * fed.ids, 2)
        ids[1::2] += 1
        return fed._replace(points=points, ids=ids)

    feed(tracker, take, range(20), change)


def test_a_hand_found_on_half_of_its_markers_is_right_once_all_are_there(tracker, take):
    """A point of something else passes for one of them; then nothing comes for 92 ms."""
    half = only(plain(take, 6), slice(None, None, 2))
    tracker.step(half.points, half.ids + 10**6, 6 / take.rate)
    fed, tracked = feed(tracker, take, range(17, 60))
    assert all(all_right(fed[20:], tracked[20:]))


@pytest.mark.parametrize("seed", [2, 3, 6])
def test_ghosts_of_the_first_ten_frames_are_got_over(tracker, take, seed):
    """Ten that stand 10 to 50 mm from markers when hands are found."""
    rng, first = np.random.default_rng(seed), plain(take, 0)
    markers = first.points[first.labels >= 0]
    way = rng.normal(size=(10, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ghosts = markers[rng.integers(0, len(markers), 10)] + way * rng.uniform(0.01, 0.05, size=(10, 1))
    for frame in range(10):
        points, ids, time, *_ = plain(take, frame)
        ids = np.concatenate([ids, 10**6 + np.arange(10)])
        tracker.step(np.concatenate([points, ghosts]), ids, time)
    fed, tracked = feed(tracker, take, range(10, 60))
    assert all(all_right(fed[30:], tracked[30:]))
