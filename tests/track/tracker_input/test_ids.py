"""The tracker with IDs that are exchanged, shared, missing or shuffled."""

from __future__ import annotations

import numpy as np
import pytest

from tests.track.tracker_input.fed_frames import Fed, all_right, feed, only


def test_an_id_that_goes_over_while_its_marker_is_hidden_does_not_take_the_name_along(tracker, take):
    """To every other marker of the digit in turn; the marker's own point comes back under another ID."""
    feed(tracker, take, range(20))
    fed, tracked = [], []
    for round_, (hidden, heir) in enumerate([(4, 5), (4, 6), (10, 11), (23, 24), (29, 35), (4, 23)]):

        def change(number: int, fed: Fed, begin=20 + 12 * round_, hidden=hidden, heir=heir) -> Fed:
            own = fed.ids[fed.labels == hidden]
            ids = fed.ids + 1000 * (number >= begin + 8) * (fed.labels == hidden)
            if number < begin + 8:
                fed = only(fed._replace(ids=ids), fed.labels != hidden)
                return fed._replace(ids=np.where(fed.labels == heir, own.max(initial=-1), fed.ids))
            return fed._replace(ids=ids)

        part = feed(tracker, take, range(20 + 12 * round_, 32 + 12 * round_), change)
        fed, tracked = fed + part[0], tracked + part[1]
    assert np.mean(all_right(fed, tracked)) >= 0.95


def test_two_points_with_one_id_are_told_apart(tracker, take):
    def change(number: int, fed: Fed) -> Fed:
        ids = fed.ids.copy()
        ids[fed.labels == 5], ids[fed.labels == 30] = ids[fed.labels == 4].max(), ids[fed.labels == 11].max()
        return fed._replace(ids=ids)

    feed(tracker, take, range(20))
    fed, tracked = feed(tracker, take, range(20, 80), change)
    assert all(any("several points" in note for note in frame.notes) for frame in tracked)
    assert np.mean(all_right(fed, tracked)) >= 0.95


def test_all_points_have_one_id(tracker, take):
    fed, tracked = feed(tracker, take, range(60), lambda n, fed: fed._replace(ids=0 * fed.ids + 7))
    assert np.mean(all_right(fed, tracked)) >= 0.95


@pytest.mark.parametrize("nobody", [-1, np.iinfo(np.int64).min])
def test_points_without_ids(tracker, take, nobody):
    fed, tracked = feed(tracker, take, range(60), lambda n, fed: fed._replace(ids=0 * fed.ids + nobody))
    assert np.mean(all_right(fed, tracked)) >= 0.95


def test_every_frame_has_new_ids(tracker, take):
    def change(number: int, fed: Fed) -> Fed:
        return fed._replace(ids=2**62 - 1000 * number - np.arange(len(fed.ids)))

    fed, tracked = feed(tracker, take, range(60), change)
    assert np.mean(all_right(fed, tracked)) >= 0.95


def test_the_order_of_points_says_nothing(tracker, take):
    rng = np.random.default_rng(0)

    def change(number: int, fed: Fed) -> Fed:
        order = rng.permutation(len(fed.points))
        return only(fed, order)

    fed, tracked = feed(tracker, take, range(60), change)
    assert np.mean(all_right(fed, tracked)) >= 0.95


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_ids_that_are_shuffled_in_every_frame(tracker, take, share):
    """Such IDs lie. Poses must not be stood by that follow from lies."""
    rng = np.random.default_rng(0)

    def change(number: int, fed: Fed) -> Fed:
        ids, mixed = fed.ids.copy(), rng.permutation(len(fed.ids))[: round(share * len(fed.ids))]
        ids[mixed] = ids[rng.permutation(mixed)]
        return fed._replace(ids=ids)

    feed(tracker, take, range(20))
    fed, tracked = feed(tracker, take, range(20, 60), change)
    assert np.mean(all_right(fed, tracked)) >= 0.8
    fed, tracked = feed(tracker, take, range(60, 80))
    assert all(all_right(fed[10:], tracked[10:]))
