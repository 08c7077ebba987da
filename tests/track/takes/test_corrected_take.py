"""Right labels bring back right poses, and nothing else of a take changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import Take, load_layout, load_take
from gloves.fit import nominal_fit
from gloves.takes.corrections import NO_MARKER, Correction
from gloves.takes.take import LOST
from handsim import join_qpos
from handsim.errors import CaptureError
from poses import sample_poses
from track import solve_pose
from track.takes.corrected_take import correct_take

FRAMES, COUNT = 50, 19
SWAPPED = (3, 7)
SPAN = slice(20, 31)


@pytest.fixture(scope="module")
def right() -> Take:
    """Two hands that are tracked without a mistake, between two poses; the last column is a stray."""
    rng = np.random.default_rng(11)
    layout = load_layout("dense19")
    hands = tuple(nominal_fit(layout, size, side) for size, side in (("L", "right"), ("M", "left")))
    ends = np.asarray(sample_poses(hands[0].model, 4, rng=rng))[:, -20:].reshape(2, 2, 20)
    share = np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    angles = (1 - share) * ends[0] + share * ends[1]
    places = np.array([[0.0, -0.2, 1.0], [0.0, 0.2, 1.0]]) + 0.1 * share
    qpos = np.stack(
        [join_qpos(angles[:, hand], position=places[:, hand], quaternion=np.tile([1.0, 0, 0, 0], (FRAMES, 1)))
         for hand in range(2)], axis=1,
    )  # fmt: skip
    markers = np.stack([hand.markers(qpos[:, number])[0] for number, hand in enumerate(hands)], axis=1)
    points = np.concatenate([markers.reshape(FRAMES, -1, 3), np.full((FRAMES, 1, 3), 0.9)], axis=1)
    columns = np.arange(2 * COUNT + 1)
    ids = np.tile(100 + columns, (FRAMES, 1)).astype(np.int32)
    labels = np.tile(np.where(columns < 2 * COUNT, columns, -1), (FRAMES, 1)).astype(np.int16)
    take = Take.of_truth(hands, qpos, points, ids, labels, rate=120.0, settings={"user": "L"})
    confidence = np.full((FRAMES, len(columns)), 0.9)
    return dataclasses.replace(take, rms=np.full((FRAMES, 2), 1e-4), confidence=confidence)


@pytest.fixture(scope="module")
def wrong(right) -> Take:
    """The same with two labels of the right hand exchanged in eleven frames, and a pose bent by that."""
    labels, qpos = right.labels.copy(), right.qpos.copy()
    labels[SPAN, SWAPPED] = labels[SPAN, SWAPPED[::-1]]
    markers = dataclasses.replace(right, labels=labels).observed("right")
    fit = solve_pose(right.hands[0], markers[SPAN], initial=qpos[SPAN, 0])
    qpos[SPAN, 0], rms = fit.qpos, right.rms.copy()
    rms[SPAN, 0] = fit.rms
    return dataclasses.replace(right, labels=labels, qpos=qpos, rms=rms)


def correction(take, column, label, first=20, last=30) -> Correction:
    return Correction(first, last, tuple(take.points[first, column].tolist()), label)


def keypoint_error(one, other) -> float:
    return float(np.nanmax(np.linalg.norm(one.keypoints() - other.keypoints(), axis=-1)))


def test_corrected_labels_bring_the_pose_back(right, wrong):
    assert keypoint_error(wrong, right) > 0.005
    names = wrong.label_names
    both = [correction(wrong, column, names[column]) for column in SWAPPED]
    result = correct_take(wrong, both)
    changed = result.take.labels != wrong.labels
    assert (changed.sum(), changed.any(axis=1).sum(), result.unfitting) == (22, 11, ())
    np.testing.assert_array_equal(result.take.labels, right.labels)
    assert keypoint_error(result.take, right) < 0.0005
    assert result.take.rms[SPAN, 0].max() < 0.0005 < wrong.rms[SPAN, 0].min()
    np.testing.assert_allclose(result.take.markers("right"), right.markers("right"))
    assert (result.take.confidence[SPAN, SWAPPED] == 1.0).all()
    outside = np.delete(np.arange(FRAMES), np.arange(20, 31))
    np.testing.assert_array_equal(result.take.qpos[outside], wrong.qpos[outside])
    np.testing.assert_array_equal(result.take.qpos[:, 1], wrong.qpos[:, 1])


def test_the_file_says_what_was_corrected_and_again_is_the_same(wrong, tmp_path):
    one = [correction(wrong, 3, NO_MARKER)]
    once = correct_take(wrong, one).take
    once.save(tmp_path / "a.npz")
    again = load_take(tmp_path / "a.npz")
    assert again.settings == {"user": "L", "corrections": [one[0].record()]}
    twice = correct_take(again, one).take
    np.testing.assert_array_equal(twice.labels, again.labels)
    assert twice.settings == again.settings


def test_a_marker_that_is_taken_away_is_filled_in_from_the_pose(right):
    result = correct_take(right, [correction(right, 5, NO_MARKER)]).take
    assert (result.labels[SPAN, 5] == -1).all() and result.filled("right")[SPAN, 5].all()
    away = np.linalg.norm((result.markers("right") - right.markers("right"))[SPAN, 5], axis=1)
    assert 0.0 < away.max() < 0.01


def test_a_label_goes_from_one_hand_to_the_other(right):
    result = correct_take(right, [correction(right, 5, right.label_names[COUNT + 5])]).take
    assert (result.labels[SPAN, 5] == COUNT + 5).all() and (result.labels[SPAN, COUNT + 5] == -1).all()
    assert result.filled("right")[SPAN, 5].all() and not result.filled("left")[SPAN, 5].any()


def test_lost_hands_and_hands_with_few_markers_keep_what_they_have(right):
    status, qpos = right.status.copy(), right.qpos.copy()
    status[25, 0], qpos[25, 0] = LOST, np.nan
    rms = right.rms.copy()
    rms[25, 0] = np.nan
    lost = dataclasses.replace(right, status=status, qpos=qpos, rms=rms)
    result = correct_take(lost, [correction(lost, 5, NO_MARKER)]).take
    assert np.isnan(result.qpos[25, 0]).all() and (result.labels[25, 5] == -1)
    labels = right.labels.copy()
    labels[22, 4:COUNT] = -1
    few = dataclasses.replace(right, labels=labels)
    result = correct_take(few, [correction(few, 0, NO_MARKER)]).take
    np.testing.assert_array_equal(result.qpos[22, 0], few.qpos[22, 0])
    assert result.filled("right")[22].sum() == 16 and np.isnan(result.rms[22, 0])


def test_the_bias_of_a_glove_is_learned_from_the_take(right):
    """Markers off by 4 mm in their bones' frames: the fitted pose does not jump at the ends of a span."""
    worn, qpos = right.hands[0], right.qpos[:, 0]
    rng = np.random.default_rng(3)
    bias = rng.normal(scale=0.003, size=(COUNT, 3))
    turns = worn.model.forward_kinematics(qpos)[:, worn.attachment.main_bones, :3, :3]
    points = right.points.copy()
    points[:, :COUNT] -= np.einsum("tmij,mj->tmi", turns, bias)
    take = dataclasses.replace(right, points=points)
    np.testing.assert_allclose(take.marker_bias("right"), bias, atol=1e-9)
    result = correct_take(take, [correction(take, 5, NO_MARKER)]).take
    assert keypoint_error(result, right) < 0.004
    plain = solve_pose(worn, points[SPAN, :COUNT], initial=qpos[SPAN])
    assert (
        np.abs(plain.qpos[:, 7:] - qpos[SPAN, 7:]).max()
        > np.abs(result.qpos[SPAN, 0, 7:] - qpos[SPAN, 7:]).max()
    )


def test_two_points_of_one_frame_never_have_one_label(right):
    name = right.label_names[2]
    with pytest.raises(CaptureError, match="two points of frame 24 are corrected to right:"):
        correct_take(right, [correction(right, 5, name), correction(right, 6, name, 24, 40)])
