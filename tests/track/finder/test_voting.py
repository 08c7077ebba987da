"""Labels of a point's path decide frame by frame; paths that labels contradict do not."""

from __future__ import annotations

import numpy as np
import pytest

from track.finder.voting import vote

FRAMES, MARKERS = 40, 5
STARTS = np.arange(FRAMES + 1) * MARKERS


def votes(labels, *, asked=None, previous=None):
    """The vote on labels (T, M) of points that keep their order."""
    if previous is None:
        previous = np.arange(labels.size).reshape(labels.shape) - MARKERS
        previous[0] = -1
    confidence = np.where(labels < 0, 0.0, 0.9)
    asked = np.ones(labels.shape, dtype=bool) if asked is None else asked
    flat = (part.ravel() for part in (labels, confidence, asked))
    elected, shares = vote(*flat, STARTS, previous.ravel(), num_markers=MARKERS, rate=120.0)
    return elected.reshape(labels.shape), shares.reshape(labels.shape)


@pytest.fixture
def steady():
    return np.tile(np.arange(MARKERS), (FRAMES, 1))


def test_a_missing_a_wrong_and_a_fleeting_label(steady):
    given = steady.copy()
    given[10:13, 2] = -1
    given[20, 2] = 2 + MARKERS  # the other hand's
    truth = steady.copy()
    truth[:, 4] = given[:, 4] = -1
    given[30, 4] = 4  # a ghost that looked like a marker once
    elected, shares = votes(given)
    np.testing.assert_array_equal(elected, truth)
    assert (shares[truth >= 0] > 0.5).all() and (shares[truth < 0] == 0.0).all()


def test_frames_that_were_passed_over_take_the_labels_around(steady):
    asked = np.zeros(steady.shape, dtype=bool)
    asked[::4] = True
    elected, _ = votes(np.where(asked, steady, -1), asked=asked)
    np.testing.assert_array_equal(elected[:37], steady[:37])


def test_no_label_twice_in_a_frame(steady):
    given = steady.copy()
    given[15:25, 3] = 1  # for a while two points are taken for one marker
    given[15:25, 1] = -1
    elected, _ = votes(given)
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in elected)


def test_frames_in_no_order_keep_their_labels(steady, rng):
    given = rng.permuted(steady, axis=1)
    elected, _ = votes(given)
    assert (elected == given).mean() > 0.98
