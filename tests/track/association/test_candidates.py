"""Candidate points of digits, on markers in a row."""

from __future__ import annotations

import numpy as np

from track.association.candidates import MAX_CANDIDATES, MarkerTable, find_candidates

# Two digits of three markers each and a palm of one; the digits lie 30 mm apart.
PLACES = np.array(
    [*[[0.03 * n, 0.0, 0.0] for n in range(3)], *[[0.03 * n, 0.03, 0.0] for n in range(3)], [-0.1, 0, 0]]
)
PARTS = np.array([0, 0, 0, 1, 1, 1, -1])


def candidates_of(points, assigned, evidence=12.0):
    evidences = np.broadcast_to(np.asarray(evidence, dtype=float), (len(points),)).copy()
    return find_candidates(
        np.asarray(points, dtype=float),
        evidences,
        MarkerTable(PLACES, PARTS, np.array(assigned)),
        2,
    )


def test_a_whole_hand_has_nothing_to_decide():
    assert candidates_of(PLACES, range(7)).counts.tolist() == [0, 0]


def test_a_stray_is_tried_near_a_marker_that_is_seen_and_farther_around_one_that_is_not():
    stray = [0.06, -0.02, 0.0]
    assert candidates_of([*PLACES, stray], [*range(7), -1]).counts.tolist() == [0, 0]
    assert candidates_of([*PLACES, [0.06, -0.01, 0.0]], [*range(7), -1]).counts.tolist() == [4, 0]
    without_tip = [0, 1, 3, 4, 5, 6]
    found = candidates_of([*PLACES[without_tip], stray], [*without_tip, -1])
    assert found.counts.tolist() == [3, 0]
    assert found.candidates[0, :3].tolist() == [0, 1, 6] and found.labeled[0] == 2


def test_unsettled_labels_of_a_neighbor_are_contested_and_settled_ones_are_not():
    without = [0, 1, 3, 4, 5, 6]
    points = PLACES[without].copy()
    settled = candidates_of(points, without)
    assert settled.counts.tolist() == [0, 0]
    unsettled = candidates_of(points, without, [12.0, 12.0, 12.0, 12.0, 0.0, 12.0])  # the neighbor's tip
    assert unsettled.counts.tolist() == [3, 3]
    assert 4 in unsettled.candidates[0, :3]


def test_the_nearest_are_tried_first_and_not_too_many():
    strays = [[0.06, -0.001 * n, 0.002] for n in range(9, 0, -1)]
    found = candidates_of([*PLACES[:2], *PLACES[3:], *strays], [0, 1, 3, 4, 5, 6, *[-1] * 9])
    assert found.counts[0] == MAX_CANDIDATES
    assert found.candidates[0].tolist() == [0, 1, 14, 13, 12, 11, 10]
