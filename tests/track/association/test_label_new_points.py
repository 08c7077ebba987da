"""New points get the labels of the markers that hands lack, also where two hands touch."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.hand.shape import DIGITS
from track.association.digit_hypotheses import EXCLUDED_SCORE
from track.association.frame_state import Numbering
from track.association.hand_state import HandState, HandTrack
from track.association.label_consistency import fit_labels
from track.association.label_new_points import (
    MAX_CANDIDATES,
    MarkerTable,
    best_combination,
    digit_table,
    find_candidates,
    label_new_points,
)

RATE, SETTLED = 120.0, 12.0
PALM, KNUCKLE, MIDDLE, TIP, OTHER_TIP = 17, 4, 5, 6, 9
# Two digits of three markers each and a palm of one; the digits lie 30 mm apart.
PLACES = np.array(
    [*[[0.03 * n, 0.0, 0.0] for n in range(3)], *[[0.03 * n, 0.03, 0.0] for n in range(3)], [-0.1, 0, 0]]
)
PARTS = np.array([0, 0, 0, 1, 1, 1, -1])


def labeled(frame, states: list[HandState]):
    """The frame after its new points have labels."""
    tracks = []
    for hand, state in enumerate(states):
        prediction = state.predict(frame.time)
        frame, estimate = fit_labels(frame, hand, state, prediction)
        tracks.append(HandTrack(hand, state, prediction, estimate))
    return label_new_points(frame, tracks, digit_table(states, Numbering([19] * len(states))))


def test_every_label_is_on_one_digit_or_on_a_palm(followed):
    states = [followed("right"), followed("left", (0.3, 0.0, 0.0))]
    table = digit_table(states, Numbering([19, 19]))
    on_digits = table.labels[table.labels >= 0]
    assert sorted([*on_digits, *np.flatnonzero(table.digits < 0)]) == list(range(38))
    for digit, (labels, markers) in enumerate(zip(table.labels, table.markers, strict=True)):
        hand, number = divmod(digit, len(DIGITS))
        own = labels[labels >= 0]
        assert (table.digits[own] == digit).all()
        np.testing.assert_array_equal(own - 19 * hand, markers[markers >= 0])
        assert (states[hand].digits[markers[markers >= 0]] == number).all()


def test_labels_that_are_complete_stay(followed, frame_of):
    state = followed()
    frame = frame_of(state.positions, np.arange(19), 0.5, evidence=SETTLED)
    assert labeled(frame, [state]) is frame


@pytest.mark.parametrize(
    "missing", [[PALM], [TIP], [MIDDLE, TIP], [PALM, KNUCKLE, OTHER_TIP], [4, 5, 6, 7, 8, 9]]
)
def test_new_points_at_missing_markers_get_their_labels(followed, frame_of, missing):
    state = followed()
    labels = np.where(np.isin(np.arange(19), missing), -1, np.arange(19))
    points = state.positions + 0.0005 * np.random.default_rng(0).standard_normal((19, 3))
    first_seen = np.where(labels < 0, 0.5, 0.0)
    frame = frame_of(points, labels, 0.5, evidence=SETTLED)._replace(first_seen=first_seen)
    after = labeled(frame, [state])
    np.testing.assert_array_equal(after.labels, np.arange(19))
    assert (after.evidence[missing] == 0.0).all() and (after.confidence[missing] < 1.0).all()
    assert (after.confidence[missing] > 0.5).all()
    np.testing.assert_array_equal(np.delete(after.evidence, missing), SETTLED)
    np.testing.assert_array_equal(frame.labels, labels)  # the frame before stays as it was


@pytest.mark.parametrize("marker", [PALM, TIP])
def test_a_point_beside_a_missing_marker_stays_without_a_label(followed, frame_of, marker):
    state = followed()
    points = state.positions.copy()
    points[marker] += [0.0, 0.0, 0.035]
    labels = np.where(np.arange(19) == marker, -1, np.arange(19))
    assert (
        labeled(frame_of(points, labels, 0.5, evidence=SETTLED, first_seen=0.5), [state]).labels[marker] == -1
    )


def test_of_two_points_near_a_missing_marker_the_nearer_one_gets_it(followed, frame_of):
    state = followed()
    points = np.concatenate([state.positions, state.positions[TIP : TIP + 1] + 0.006])
    labels = np.append(np.where(np.arange(19) == TIP, -1, np.arange(19)), -1)
    after = labeled(frame_of(points, labels, 0.5, evidence=SETTLED, first_seen=0.5), [state])
    assert after.labels[[TIP, 19]].tolist() == [TIP, -1]


@pytest.mark.parametrize(("evidence", "corrected"), [(0.0, True), (SETTLED, False)])
def test_a_wrong_label_that_is_not_settled_is_corrected(followed, frame_of, evidence, corrected):
    """The tip's label is on a ghost beside it, and the true point is new."""
    state = followed()
    points = np.concatenate([state.positions, state.positions[TIP : TIP + 1]])
    points[TIP] += [0.0, 0.004, 0.004]
    labels = np.append(np.arange(19), -1)
    frame = frame_of(points, labels, 0.5, evidence=evidence)._replace(first_seen=np.append(np.zeros(19), 0.5))
    frame.evidence[[n for n in range(19) if n != TIP]] = SETTLED
    state._last_seen[TIP] = 0.4  # the track saw it, though not lately
    after = labeled(frame, [state])
    assert (after.labels[19] == TIP) == corrected


def test_two_hands_that_touch_keep_their_tips_apart(followed, frame_of):
    """The tips of two index fingers, 12 mm apart, are new in the same frame."""
    right = followed("right")
    left = followed("left", (0.0, 0.0, 0.0))
    shift = right.positions[TIP] + [0.0, 0.012, 0.0] - left.positions[TIP]
    left = followed("left", tuple(shift))
    points, labels = np.concatenate([right.positions, left.positions]), np.arange(38)
    labels[[TIP, 19 + TIP]] = -1
    first_seen = np.where(labels < 0, 0.5, 0.0)
    frame = frame_of(points, labels, 0.5, hands=2, evidence=SETTLED)._replace(first_seen=first_seen)
    np.testing.assert_array_equal(labeled(frame, [right, left]).labels, np.arange(38))


def test_a_hand_without_a_pose_gets_no_labels(followed, frame_of):
    right, left = followed("right"), followed("left", (0.3, 0.0, 0.0))
    points, labels = np.concatenate([right.positions, left.positions]), np.arange(38)
    labels[19:], labels[TIP] = -1, -1
    frame = frame_of(points, labels, 0.5, hands=2, evidence=SETTLED)._replace(
        first_seen=np.where(labels < 0, 0.5, 0.0)
    )
    table = digit_table([right, left], frame.numbering)
    prediction = right.predict(0.5)
    frame, estimate = fit_labels(frame, 0, right, prediction)
    after = label_new_points(frame, [HandTrack(0, right, prediction, estimate)], table)
    np.testing.assert_array_equal(after.labels, [*range(19), *[-1] * 19])
    assert label_new_points(frame, [], table) is frame


def candidates_of(points, assigned, evidence=12.0):
    evidences = np.broadcast_to(np.asarray(evidence, dtype=float), (len(points),)).copy()
    return find_candidates(
        np.asarray(points, dtype=float), evidences, MarkerTable(PLACES, PARTS, np.array(assigned)), 2
    )


def test_a_stray_is_tried_near_a_marker_that_is_seen_and_farther_around_one_that_is_not():
    stray = [0.06, -0.02, 0.0]
    assert candidates_of([*PLACES, stray], [*range(7), -1]).counts.tolist() == [0, 0]
    assert candidates_of([*PLACES, [0.06, -0.01, 0.0]], [*range(7), -1]).counts.tolist() == [4, 0]
    without_tip = [0, 1, 3, 4, 5, 6]
    found = candidates_of([*PLACES[without_tip], stray], [*without_tip, -1])
    assert found.counts.tolist() == [3, 0]
    assert found.candidates[0, :3].tolist() == [0, 1, 6]


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


@st.composite
def tables(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scores, sets, counts and bans of up to five digits with up to ten candidate points."""
    digits, points = draw(st.integers(1, 5)), draw(st.integers(1, 10))
    counts = np.array(draw(st.lists(st.integers(1, 6), min_size=digits, max_size=digits)))
    scores, sets = (
        np.full((digits, counts.max()), EXCLUDED_SCORE),
        np.zeros((digits, counts.max()), dtype=np.int64),
    )
    for digit, count in enumerate(counts.tolist()):
        row = draw(st.lists(st.integers(-20, 40), min_size=count, max_size=count))
        scores[digit, :count] = sorted(row, reverse=True)
        sets[digit, : count - 1] = draw(
            st.lists(st.integers(0, 2**points - 1), min_size=count - 1, max_size=count - 1)
        )
    banned = np.array([draw(st.integers(-1, count - 1)) for count in counts.tolist()])
    return scores, sets, counts, banned


def best_of_all(scores: np.ndarray, sets: np.ndarray, counts: np.ndarray, banned: np.ndarray) -> float | None:
    """The most that any choice reaches that uses no point twice and nothing banned."""
    totals = []
    for rows in itertools.product(*map(range, counts)):
        used = [int(sets[digit, row]) for digit, row in enumerate(rows)]
        apart = all((one & two) == 0 for one, two in itertools.combinations(used, 2))
        if apart and not (np.array(rows) == banned).any():
            totals.append(float(sum(scores[digit, row] for digit, row in enumerate(rows))))
    return max(totals, default=None)


@settings(deadline=None, max_examples=300)
@given(tables())
def test_no_other_choice_is_better(table):
    scores, sets, counts, banned = table
    best = np.full(len(counts), -7)
    total, wanted = best_combination(scores, sets, counts, banned, best), best_of_all(*table)
    if wanted is None:
        assert total <= EXCLUDED_SCORE / 2
        return
    assert total == pytest.approx(wanted)
    chosen = np.arange(len(counts)), best
    assert ((best >= 0) & (best < counts) & (best != banned)).all()
    assert scores[chosen].sum() == pytest.approx(total)
    assert all(one & two == 0 for one, two in itertools.combinations(sets[chosen].tolist(), 2))
