"""Which direction is right where they give points to different hands."""

from __future__ import annotations

import numpy as np

from track.both_directions import _exchanges, _Tracked


def tracked(labels):
    row = np.array(labels)
    return _Tracked(row, np.ones(len(row)), np.zeros((2, 5, 3)), np.zeros((2, 27)), np.zeros(2), 0.0)


def test_runs_of_exchanged_hands_are_found():
    right, left, gap = tracked([0, 1, 2, 5, 6]), tracked([5, 6, 7, 0, 1]), tracked([-1] * 5)
    digit = tracked([1, 0, 2, 5, 6])  # another marker of the same hand
    forward = [right, right, right, right, gap, right]
    backward = [right, left, left, digit, left, left]
    assert list(_exchanges(forward, backward, 5)) == [slice(1, 3), slice(5, 6)]
    assert list(_exchanges(forward, forward, 5)) == []
