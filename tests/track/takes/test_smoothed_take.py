"""Smooth poses of whole takes: nearer to the truth, the same wherever a frame stands, labels untouched."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import Capture, GloveFit, Take
from gloves.takes.take import LOST, TRACKED
from track.captures import track_capture
from track.takes.smoothed_take import _SmoothedHand, _solve_in_time, _windows, smooth_take, times_unseen
from train import simulate_take


def angle_error(take, truth):
    """RMS over hands, frames and angles [deg]."""
    return np.rad2deg(np.sqrt(np.nanmean((take.qpos - truth.qpos)[..., 7:] ** 2)))


@pytest.fixture(scope="module")
def truth():
    return simulate_take("real-like", num_frames=240, seed=5)


@pytest.fixture(scope="module")
def fitted(truth):
    """Tracked frame by frame."""
    return track_capture(truth.capture(), smooth=False)


@pytest.fixture(scope="module")
def smooth(fitted):
    return smooth_take(fitted)


def test_poses_are_nearer_to_the_truth_and_labels_stay(truth, fitted, smooth):
    assert angle_error(smooth, truth) < 0.8 * angle_error(fitted, truth)
    np.testing.assert_array_equal(smooth.point_list.labels, fitted.point_list.labels)
    np.testing.assert_array_equal(smooth.status, fitted.status)
    jumps = [np.abs(np.diff(take.qpos[..., 7:], n=2, axis=0)).mean() for take in (fitted, smooth)]
    assert jumps[1] < 0.2 * jumps[0]


def test_smoothed_poses_follow_a_hand_that_moves_quickly(truth):
    """Smoothing that lags took what it left for noise, and lagged by centimeters."""
    slow = truth.capture()
    fitted = track_capture(Capture(slow.names, slow.positions, 5.0 * slow.rate), smooth=False)
    smooth = smooth_take(fitted)
    assert np.nanmedian(smooth.rms) < 1.3 * np.nanmedian(fitted.rms)
    assert angle_error(smooth, truth) < 0.7 * angle_error(fitted, truth)


def test_the_parts_of_the_deviations_sum_up_to_them(smooth):
    for number, side in enumerate(smooth.sides):
        spread = np.rad2deg(smooth.angle_spread[:, number])
        budget = np.array(smooth.settings["budget"][side])
        np.testing.assert_allclose(
            np.sqrt(np.nanmean(spread**2, axis=0)), np.linalg.norm(budget, axis=1), rtol=0.01
        )
        assert (np.array(smooth.settings["filter"][side]) > 0.5).all()


@pytest.fixture(scope="module")
def stiff():
    """A hand with a boutonniere of the index finger, in a glove whose markers are off their places."""
    rng, take = np.random.default_rng(9), simulate_take("single-hand", num_frames=480, seed=9)
    hand, qpos = take.hands[0], take.qpos[:, 0].copy()
    qpos[:, [13, 14]] = np.deg2rad([60.0, -10.0])
    shifted = hand.attachment.points + 0.0015 * rng.standard_normal(hand.attachment.points.shape)
    worn = GloveFit(hand.model, dataclasses.replace(hand.attachment, points=shifted))
    markers = worn.markers(qpos)[0] + 0.001 * rng.standard_normal((480, hand.layout.num_markers, 3))
    truth = Take.of_poses([worn], qpos[:, None], rate=take.rate)
    return truth, Take.of_truth(
        [hand],
        qpos[:, None],
        markers,
        np.tile(np.arange(19), (480, 1)),
        np.tile(np.arange(19), (480, 1)),
        rate=take.rate,
    )


@pytest.mark.parametrize("known", [{}, {"right:index_PIP_flexion": 60.0}], ids=["unknown", "known"])
def test_angles_of_a_finger_that_does_not_move_follow_its_markers(stiff, known):
    truth, seen = stiff
    take = smooth_take(dataclasses.replace(seen, settings={"user": "auto, 190 mm", "known": known}))
    off = np.rad2deg((take.qpos - truth.qpos)[:, 0, [13, 14]]).mean(axis=0)
    told = np.rad2deg(take.angle_spread[:, 0, 6:8]).mean(axis=0)
    assert (np.abs(off) < 2.0 * told).all()
    assert (told < ([3.5, 15.0] if known else [16.0, 30.0])).all()
    assert (np.abs(off) < ([4.0, 25.0] if known else [20.0, 30.0])).all()


def test_markers_that_stay_off_their_places_widen_the_part_of_gluing(truth, fitted, rng):
    told = []
    for off in (0.0, 0.004):
        hands = []
        for hand in truth.hands:
            points = hand.attachment.points + off * rng.standard_normal(hand.attachment.points.shape)
            worn = dataclasses.replace(hand.attachment, points=points)
            hands.append(dataclasses.replace(hand, attachment=worn))
        settings = {**fitted.settings, "user": "calibrated before"}
        take = smooth_take(dataclasses.replace(fitted, hands=tuple(hands), settings=settings))
        told.append(np.mean(list(take.settings["budget"].values()), axis=(0, 1)))
    assert told[1][1] > 2.0 * told[0][1]


@pytest.mark.parametrize("glove", ["dense19", "starter10"])
def test_flesh_is_as_large_as_it_is_however_few_markers_show_it(glove, rng):
    take = simulate_take(glove=glove, num_frames=480, seed=4)
    truth = take.observed(take.sides[0])
    size, phases = 0.001, rng.uniform(0.0, 2.0 * np.pi, (*truth.shape[1:], 4))  # [m], per axis
    waves = np.sin(2.0 * np.pi * take.times[:, None, None, None] * [0.4, 0.7, 0.9, 1.3] + phases)
    hand = _SmoothedHand(take, 0)
    hand._targets = truth + size * waves.sum(axis=-1) / np.sqrt(2.0)
    hand.solve(_windows(take.status[:, 0]))
    assert 0.7 * size < hand._flesh < 1.3 * size


def test_a_frame_has_the_same_pose_at_the_start_and_at_the_end(fitted):
    """A hand that turns back in time: the same frames follow in the opposite order."""
    again = np.concatenate([np.arange(240), np.arange(240)[::-1]])
    tables = {name: getattr(fitted, name)[again] for name in ("points", "ids", "labels", "confidence")}
    frames = {name: getattr(fitted, name)[again] for name in ("qpos", "rms")}
    status = np.where(fitted.status == LOST, LOST, TRACKED)[
        again
    ]  # a hand begins anew where it was initialized
    twice = dataclasses.replace(
        fitted,
        times=np.arange(480) / fitted.rate,
        body_poses=fitted.body_poses[again],
        body_status=fitted.body_status[again],
        body_rms=fitted.body_rms[again],
        status=status,
        angle_spread=None,
        keypoint_spread=None,
        **frames,
        **tables,
    )
    angles = smooth_take(twice).qpos[..., 7:]
    there = np.isfinite(angles[:120, :, 0]) & np.isfinite(angles[360:][::-1, :, 0])
    off = (angles[:120] - angles[360:][::-1])[there]
    assert np.rad2deg(np.sqrt((off**2).mean())) < 0.3


def test_a_lost_hand_stays_lost(fitted):
    status, qpos = fitted.status.copy(), fitted.qpos.copy()
    status[:, 0], qpos[:, 0] = LOST, np.nan
    rms = fitted.rms.copy()
    rms[:, 0] = np.nan
    found = smooth_take(dataclasses.replace(fitted, status=status, qpos=qpos, rms=rms))
    assert np.isnan(found.qpos[:, 0]).all()
    assert set(found.settings["filter"]) == {found.sides[1]}


def test_a_hand_that_is_lost_for_some_frames_is_smoothed_in_the_others(fitted):
    status, qpos, rms = fitted.status.copy(), fitted.qpos.copy(), fitted.rms.copy()
    status[:30, 0] = status[100:110, 0] = LOST
    qpos[status == LOST], rms[status == LOST] = np.nan, np.nan
    found = smooth_take(dataclasses.replace(fitted, status=status, qpos=qpos, rms=rms))
    np.testing.assert_array_equal(np.isfinite(found.qpos[..., 0]), status != LOST)
    np.testing.assert_array_equal(np.isfinite(found.rms), np.isfinite(rms))


def test_a_hand_without_any_marker_for_a_while_goes_on(fitted):
    labels = fitted.labels.copy()
    labels[60:70] = -1
    found = smooth_take(dataclasses.replace(fitted, labels=labels))
    assert np.isfinite(found.qpos).all() and np.isfinite(found.angle_spread).all()
    assert (found.angle_spread[65] > found.angle_spread[50]).mean() > 0.8


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_the_blocks_solve_the_whole_system(count, rng):
    """Compare the block solver with a dense solution of the equations of all frames."""
    size, precision = 26, rng.uniform(0.5, 2.0, 26)
    root = rng.standard_normal((count, size, size))
    normal, gradient = root @ root.swapaxes(1, 2) + np.eye(size), rng.standard_normal((count, size))
    differences = np.zeros((max(count - 2, 0), count))
    for row in range(len(differences)):
        differences[row, row : row + 3] = 1.0, -2.0, 1.0
    whole = np.kron(differences.T @ differences, np.diag(precision))
    for frame in range(count):
        part = slice(size * frame, size * (frame + 1))
        whole[part, part] += normal[frame]
    step, covariances = _solve_in_time(normal, gradient, precision)
    np.testing.assert_allclose(step.ravel(), np.linalg.solve(whole, gradient.ravel()), rtol=1e-6, atol=1e-9)
    inverse = np.linalg.inv(whole).reshape(count, size, count, size)
    for frame in range(count):
        np.testing.assert_allclose(covariances[frame], inverse[frame, :, frame], rtol=1e-6, atol=1e-9)


def test_a_marker_is_unseen_since_or_until_the_nearest_frame_with_it():
    seen = np.array([[False, True, False, False, True], [False] * 5]).T
    unseen = times_unseen(0.1 * np.arange(5), seen)
    np.testing.assert_allclose(unseen[:, 0], [0.1, 0.0, 0.1, 0.1, 0.0])
    assert np.isinf(unseen[:, 1]).all()
