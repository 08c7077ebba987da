"""New points get the labels of the markers that hands lack, also where two hands touch."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.shape import DIGITS
from track.association.frame_state import Numbering
from track.association.hand_state import HandState, HandTrack
from track.association.label_consistency import fit_labels
from track.association.label_new_points import digit_table, label_new_points

RATE, SETTLED = 120.0, 12.0
PALM, KNUCKLE, MIDDLE, TIP, OTHER_TIP = 17, 4, 5, 6, 9


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
