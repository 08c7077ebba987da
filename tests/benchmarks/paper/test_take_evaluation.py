"""What is counted of a tracker, tried on trackers that know the truth and err on purpose."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.paper.take_evaluation import (
    OCCLUSIONS,
    evaluate_tracker,
    nearest_size,
    nominal_users,
    seen_frame,
    true_users,
)
from gloves import Status, Take
from handsim.hand.shape import NUM_QPOS, SIZES
from track import TrackedFrame, TrackedHand
from track.kinematics.pose_solver import PoseSolver
from train import simulate_take

SHIFT = np.concatenate([[0.003, 0.0, 0.004], np.zeros(24)])


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=100)


class Knowing:
    """Says what is true, each frame changed by a function of its number."""

    def __init__(self, take: Take, change: Callable[[int, TrackedFrame], TrackedFrame]) -> None:
        self.take, self.change, self.frame = take, change, 0

    def step(self, points: np.ndarray, ids: np.ndarray, time: float) -> TrackedFrame:
        seen = seen_frame(self.take, self.frame)
        assert time == self.frame / self.take.rate
        np.testing.assert_array_equal(points, seen.points)
        np.testing.assert_array_equal(ids, seen.ids)
        hands = tuple(
            TrackedHand(
                hand.shape.side,
                Status.TRACKED,
                hand.qpos[self.frame],
                0.0005,
                np.full((19, 3), np.nan),
                np.arange(0),
            )
            for hand in self.take.moving_hands()
        )
        frame = TrackedFrame(time, hands, seen.labels.copy(), np.ones(len(points)))
        self.frame += 1
        return self.change(self.frame - 1, frame)


def report_of(take: Take, change=lambda number, frame: frame):
    return evaluate_tracker(take, true_users(take), Knowing(take, change))


def with_hand(frame: TrackedFrame, number: int, **changes) -> TrackedFrame:
    hands = list(frame.hands)
    hands[number] = dataclasses.replace(hands[number], **changes)
    return dataclasses.replace(frame, hands=tuple(hands))


def test_the_truth_is_all_right(take):
    report = report_of(take)
    figures = report.figures()
    assert figures["right"] == figures["valid"] == figures["valid_and_right"] == 1.0
    assert figures["joint_error"] == pytest.approx(0.0, abs=1e-12)
    assert figures["angle_error"] == 0.0
    np.testing.assert_array_equal(
        report.missing.sum(axis=1), 38 - take.markers_present().sum(axis=1), "markers that are not seen"
    )
    assert sum(count for count, _, _ in report.by_occlusion().values()) == 2 * take.num_frames


def test_one_wrong_point_makes_a_frame_wrong(take):
    def change(number: int, frame: TrackedFrame) -> TrackedFrame:
        if number in (3, 50):
            frame.labels[np.flatnonzero(frame.labels == 7)[0]] = -1
        return frame

    report = report_of(take, change)
    assert np.flatnonzero(~report.right).tolist() == [3, 50]
    assert report.figures()["right_of_valid"] == pytest.approx(0.98)


def test_markers_of_an_object_may_have_labels_of_their_own_but_none_of_a_hand(take):
    assert (take.labels >= 38).any(axis=1).all(), "the controller is seen"

    def own(number: int, frame: TrackedFrame) -> TrackedFrame:
        frame.labels[:] = take.labels[number][np.isfinite(take.points[number, :, 0])]
        return frame

    def hands(number: int, frame: TrackedFrame) -> TrackedFrame:
        own(number, frame)
        frame.labels[frame.labels >= 38] -= 38
        return frame

    assert report_of(take, own).right.all()
    assert not report_of(take, hands).right.any()


def test_frames_are_valid_when_every_hand_fits(take):
    def change(number: int, frame: TrackedFrame) -> TrackedFrame:
        if number < 10:
            return with_hand(frame, number % 2, rms=0.0081)
        if number < 30:
            nothing = {"status": Status.LOST, "rms": np.nan, "qpos": np.full(NUM_QPOS, np.nan)}
            return with_hand(frame, 1, **nothing)
        if number < 40:
            return with_hand(frame, 0, status=Status.COASTING, rms=np.nan)
        return with_hand(frame, 0, rms=0.0079)

    report = report_of(take, change)
    np.testing.assert_array_equal(report.valid, np.arange(100) >= 40)
    np.testing.assert_array_equal(np.isnan(report.joint_error[:, 1]), np.isin(range(100), range(10, 30)))
    figures = report.figures()
    assert (figures["right"], figures["valid"], figures["valid_and_right"]) == (1.0, 0.6, 0.6)
    assert figures["joint_error"] == pytest.approx(0.0, abs=1e-12), "only where there is a pose"


def test_pose_errors_are_means_over_joints_and_hinges(take):
    def change(number: int, frame: TrackedFrame) -> TrackedFrame:
        qpos = frame.hands[0].qpos.copy()
        qpos[1] += 0.005
        qpos[7:] += 0.02 * (np.arange(20) % 2)
        return with_hand(frame, 0, qpos=qpos)

    report = report_of(take, change)
    np.testing.assert_allclose(report.angle_error[:, 0], 0.01)
    assert (report.joint_error[:, 0] > 0.003).all() and (report.joint_error[:, 0] < 0.007).all()
    np.testing.assert_allclose(report.joint_error[:, 1], 0.0, atol=1e-12)
    shifted = report_of(take, lambda _, frame: with_hand(frame, 1, qpos=frame.hands[1].qpos + SHIFT))
    np.testing.assert_allclose(shifted.joint_error[:, 1], 0.005)
    for bounds, (count, joint, angle) in shifted.by_occlusion().items():
        assert bounds in OCCLUSIONS
        lacking = (shifted.missing >= bounds[0]) & (shifted.missing <= bounds[1])
        assert count == lacking.sum()
        if count:
            assert joint == pytest.approx(0.005 * lacking[:, 1].sum() / count)
            assert angle == 0.0


def test_nothing_counted_is_nan_and_no_warning(take):
    nowhere = {"status": Status.LOST, "rms": np.nan, "qpos": np.full(NUM_QPOS, np.nan)}
    report = report_of(take, lambda _, frame: with_hand(with_hand(frame, 0, **nowhere), 1, **nowhere))
    figures = report.figures()
    assert figures["valid"] == 0.0
    assert np.isnan([figures["right_of_valid"], figures["joint_error"], figures["angle_error"]]).all()


def test_true_users_wear_what_was_worn_and_usual_ones_what_was_designed(take):
    rms = {}
    for kind, users in (("true", true_users(take)), ("usual", nominal_users(take))):
        assert [user.side for user in users] == [hand.shape.side for hand in take.hands]
        fits = [
            PoseSolver(user).solve(take.observed(label)[:5])
            for user, label in zip(users, take.hand_labels, strict=True)
        ]
        rms[kind] = np.concatenate([fit.rms for fit in fits])
    assert (rms["true"] < 0.0005).all()
    assert (rms["usual"] > 0.001).all() and (rms["usual"] < 0.008).all()
    usual = nominal_users(take)[0].model.shape
    assert usual.length == pytest.approx(SIZES[nearest_size(take.hands[0].shape.length)][0])


@pytest.mark.parametrize(("length", "size"), [(0.15, "XS"), (0.184, "M"), (0.183, "S"), (0.25, "XL")])
def test_the_nearest_size_is_nearest_in_length(length, size):
    assert nearest_size(length) == size
