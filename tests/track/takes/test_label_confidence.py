"""Confidence in labels by all of a take: errors that are put into a tracked take are told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import Take
from gloves.takes.take import LOST
from track import track_capture
from track.takes.label_confidence import evidence_of, label_confidence
from train import simulate_take

FRAMES = 120


@pytest.fixture(scope="module")
def tracked() -> Take:
    truth = simulate_take(kind="single-hand", num_frames=FRAMES, seed=1)
    take = track_capture(truth, hands=truth.hands, labeler="dense19", smooth=False)
    assert (take.labels == truth.labels).mean() > 0.999
    return take


def column_of(take: Take, first: int, last: int, name: str = "right:IndexTip") -> int:
    """The column that has a label through a span."""
    label = take.label_names.index(name)
    return int(np.flatnonzero((take.labels[first : last + 1] == label).all(axis=0))[0])


def relabeled(take: Take, first: int, last: int, column: int, label: int) -> Take:
    labels = take.labels.copy()
    labels[first : last + 1, column] = label
    return dataclasses.replace(take, labels=labels)


def confidence_of(take: Take) -> np.ndarray:
    """The confidence as a table (T, N)."""
    return take.point_list.table(label_confidence(take), np.nan)


def test_right_labels_are_sure(tracked):
    assert np.nanmedian(tracked.confidence) > 0.99, "a tracked capture has it already"
    np.testing.assert_allclose(confidence_of(tracked), tracked.confidence)


def test_a_marker_that_loses_its_label_for_some_frames(tracked):
    column = column_of(tracked, 40, 80)
    confidence = confidence_of(relabeled(tracked, 50, 65, column, -1))
    assert (confidence[50:66, column] < 0.5).all() and (confidence[40:48, column] > 0.8).all()


def test_markers_that_exchange_their_labels_for_some_frames(tracked):
    one, other = (column_of(tracked, 40, 80, f"right:{name}") for name in ("IndexTip", "MiddleTip"))
    labels = tracked.labels.copy()
    labels[50:56, [one, other]] = labels[50:56, [other, one]]
    confidence = confidence_of(dataclasses.replace(tracked, labels=labels))
    assert (confidence[50:56, [one, other]] < 0.5).all()


def test_lives_go_on_where_ids_do_not_last_or_are_exchanged(tracked):
    there = tracked.ids >= 0
    fresh = np.where(there, np.cumsum(there).reshape(there.shape), -1)
    column = column_of(tracked, 40, 80)
    wrong = relabeled(dataclasses.replace(tracked, ids=fresh), 50, 52, column, -1)
    assert (confidence_of(wrong)[50:53, column] < 0.5).all()


def test_a_lost_hand_whose_points_are_there(tracked):
    status, labels, qpos = tracked.status.copy(), tracked.labels.copy(), tracked.qpos.copy()
    status[60:80, 0], qpos[60:80, 0] = LOST, np.nan
    own = (labels[60:80] >= 0) & (labels[60:80] < 19)
    labels[60:80][own] = -1
    take = dataclasses.replace(tracked, status=status, labels=labels, qpos=qpos)
    assert np.median(confidence_of(take)[60:80][own]) < 0.5


def test_a_foreign_marker_without_a_label_is_sure(tracked):
    far = np.full((FRAMES, 1, 3), 2.0)
    columns = {
        "points": np.concatenate([tracked.points, far], axis=1),
        "ids": np.pad(tracked.ids, ((0, 0), (0, 1)), constant_values=10_000),
        "labels": np.pad(tracked.labels, ((0, 0), (0, 1)), constant_values=-1),
        "confidence": np.pad(tracked.confidence, ((0, 0), (0, 1)), constant_values=0.5),
    }
    assert (confidence_of(dataclasses.replace(tracked, **columns))[:, -1] > 0.9).all()


def test_points_that_come_and_go_at_one_offset_from_a_marker_that_is_not_seen(tracked):
    marker, hand = tracked.label_names.index("right:IndexTip"), tracked.hands[0]
    bones = hand.model.forward_kinematics(tracked.qpos[:, 0])[:, hand.attachment.main_bones[marker], :3, :3]
    shifted = tracked.pose_markers("right")[:, marker] + bones @ (0.0, 0.0, 0.012)

    def confidence(frames: list[int]) -> np.ndarray:
        points, labels, known = tracked.points.copy(), tracked.labels.copy(), tracked.confidence.copy()
        rows, columns = np.nonzero(labels == marker)
        points[rows, columns], labels[rows, columns] = shifted[rows], -1
        hidden = ~np.isin(rows, frames)
        points[rows[hidden], columns[hidden]] = known[rows[hidden], columns[hidden]] = np.nan
        found = confidence_of(dataclasses.replace(tracked, points=points, labels=labels, confidence=known))
        return found[rows[~hidden], columns[~hidden]]

    assert confidence([50]) > 0.9 and (confidence(list(range(5, 115, 12))) < 0.8).all()


def test_a_take_without_poses_keeps_its_confidence(tracked):
    blank = np.full(tracked.qpos.shape, np.nan)
    take = dataclasses.replace(tracked, qpos=blank, status=np.full(tracked.status.shape, LOST))
    np.testing.assert_array_equal(confidence_of(take), take.confidence)


def test_evidence_is_of_every_point_of_a_hand(tracked):
    evidence = evidence_of(tracked)
    assert len(evidence.points) == np.isfinite(tracked.points[..., 0]).sum()
    assert (evidence.labels == tracked.point_list.labels[evidence.points]).all()
    assert np.isfinite(evidence.labeled).all() and np.isfinite(evidence.unlabeled).all()
    assert len(evidence.labeled) == (evidence.labels >= 0).sum()
