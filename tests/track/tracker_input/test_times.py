"""The tracker with time stamps that go back, stand still, shake or are none."""

from __future__ import annotations

import numpy as np
import pytest

from tests.track.tracker_input.fed_frames import Fed, all_right, feed, plain


@pytest.mark.parametrize(
    ("told", "note"),
    [
        pytest.param(lambda time: 1.0 - time, "went back", id="backwards"),
        pytest.param(lambda time: 0.25, "stood still", id="still"),
        pytest.param(lambda time: np.nan, "not a number", id="NaN"),
        pytest.param(lambda time: -np.inf, "not a number", id="-inf"),
        pytest.param(lambda time: np.inf, "not a number", id="inf"),
        pytest.param(lambda time: -1e9 * time, "went back", id="far back"),
        pytest.param(lambda time: 1e9 * time, "no frame for", id="far ahead"),
    ],
)
def test_times_that_are_none_do_not_stop_a_hand(tracker, take, told, note):
    feed(tracker, take, range(30))
    fed, tracked = feed(tracker, take, range(30, 60), lambda n, fed: fed._replace(time=told(fed.time)))
    assert all(any(note in words for words in frame.notes) for frame in tracked[1:])
    assert np.mean(all_right(fed[3:], tracked[3:])) >= 0.95, "a hand is followed by the frames that come"
    fed, tracked = feed(tracker, take, range(60, 80))
    assert all(all_right(fed[3:], tracked[3:]))
    assert not any(frame.notes for frame in tracked[1:])


def test_a_frame_that_comes_twice_changes_little(tracker, take):
    fed, tracked = feed(tracker, take, [frame for frame in range(60) for _ in range(2)])
    assert all(all_right(fed, tracked))


@pytest.mark.parametrize("apart", [3e-3, 1e-4, 1e-6])
def test_stamps_that_lie_close_together(tracker, take, apart):
    """Every tenth frame is stamped just after the one before, as when a computer was busy."""

    def change(number: int, fed: Fed) -> Fed:
        return fed._replace(time=(number - 1) / take.rate + apart) if number % 10 == 5 else fed

    fed, tracked = feed(tracker, take, range(60), change)
    assert np.mean(all_right(fed, tracked)) >= 0.95


@pytest.mark.parametrize("jitter", [0.002, 0.004])
def test_stamps_that_shake(tracker, take, jitter):
    times = np.sort(np.arange(120) / take.rate + jitter * np.random.default_rng(0).normal(size=120))
    fed, tracked = feed(tracker, take, range(120), lambda n, fed: fed._replace(time=float(times[n])))
    assert np.mean(all_right(fed, tracked)) >= 0.95


@pytest.mark.parametrize("step", [4, 8])
def test_a_slow_system(tracker, take, step):
    fed, tracked = feed(tracker, take, range(0, 240, step))
    assert np.mean(all_right(fed, tracked)) >= 0.9


@pytest.mark.parametrize("again", [False, True])
def test_a_stream_that_is_silent_for_two_seconds_and_comes_back_elsewhere(tracker, take, again):
    """With the IDs that the points had (they are of other markers now), or with new ones."""
    feed(tracker, take, range(60))

    def change(number: int, fed: Fed) -> Fed:
        before = plain(take, 59).ids
        ids = fed.ids + 10**6
        if again:
            ids[: len(before)] = before[: len(ids)]
        return fed._replace(time=fed.time + 1.0, ids=ids)

    fed, tracked = feed(tracker, take, range(180, 240), change)
    assert "no frame for" in tracked[0].notes[0]
    assert all(all_right(fed[3:], tracked[3:]))
