"""Hands of a take are calibrated on two thirds of it; what fits the other third better is kept."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import Take, load_layout
from gloves.fit import nominal_fit
from gloves.takes.take import LOST
from handsim import HandSimWarning
from handsim.errors import CalibrationError
from track import User, track_capture
from track.kinematics.pose_solver import PoseSolver
from track.takes.take_calibration import calibrate_take, kept_user
from track.user import MEASURED, nominal_user
from train import simulate_take

FRAMES, FRESH = 900, 600


@pytest.fixture(scope="module")
def truth() -> Take:
    return simulate_take("free", num_frames=FRAMES + FRESH, seed=3, hands=("right",))


@pytest.fixture(scope="module")
def seen(truth) -> Take:
    return truth.cut(0, FRAMES)


def angle_error(take: Take, truth: Take) -> float:
    """Of the right hand's joint angles [deg]."""
    found, true = (one.qpos[:, one.hand_index("right"), 7:] for one in (take, truth))
    return float(np.rad2deg(np.sqrt(np.nanmean((found - true) ** 2))))


@pytest.mark.slow
def test_what_is_told_is_true_of_a_fresh_capture(truth, seen):
    start = nominal_user(load_layout("dense19"), "M", ("right", "left"))  # the take has a right one
    done = calibrate_take(seen, start, start)
    user = kept_user(seen, done, start, "from a test")
    (one,) = user.calibrations
    markers = truth.observed("right")[FRAMES:]
    fresh = markers[np.isfinite(markers[..., 0]).all(axis=1)][::4]
    before, after = (np.median(PoseSolver(hand).solve(fresh).rms) for hand in (start[0], user[0]))
    assert one.is_better and one.held_out.num_frames > 200
    assert 0.8 * one.held_out.before < before < 1.25 * one.held_out.before
    assert 0.8 * one.held_out.after < after < 1.25 * one.held_out.after
    assert user.notes == f"calibrated from a test, M to begin with; right hand: {one}"


@pytest.mark.slow
def test_a_hand_that_becomes_no_better_stays(seen):
    start, before = [nominal_fit("dense19", "M", "right")], User(seen.hands)
    done = calibrate_take(seen, start, before)
    user = kept_user(seen, done, before, "from a test")
    assert user[0] is before[0] and user.notes.endswith("it stays as it was") and user.is_calibrated("right")
    measured = kept_user(seen, done, User(seen.hands, f"{MEASURED}187 x 83 mm"), "from a test")
    assert measured.notes.endswith("it stays as it was, as measured")
    assert not measured.is_calibrated("right")


@pytest.mark.slow
def test_a_hand_stays_whose_labels_may_be_the_next_fingers():
    truth = simulate_take("hand-controller", glove="starter10", num_frames=FRAMES, seed=101)
    start = nominal_user(load_layout("starter10"), "M", ("right",))
    assert calibrate_take(truth, start, start)[0].is_better
    label = start.layout.names.index
    given = np.arange(-1, len(truth.label_names))  # by one finger too far: the little one's is hidden
    for name, other in (("MiddleTip", "RingTip"), ("RingTip", "PinkyTip"), ("PinkyTip", "MiddleTip")):
        given[1 + label(name)] = label(other)
    take = dataclasses.replace(truth, labels=given[1 + truth.labels])
    user = kept_user(take, calibrate_take(take, start, start), start, "from a test")
    (one,) = user.calibrations
    assert one.held_out.after < 0.5 * one.held_out.before and user[0] is start[0]
    told = "middle and ring are exchanged; ring and little are exchanged"
    assert str(one).endswith(f"held out, but it is likelier that {told}, so that it stays as it was")


@pytest.mark.slow
def test_a_marker_that_fell_off_is_no_doubt_where_the_others_tell_the_fingers(seen):
    start = nominal_user(load_layout("dense19"), "M", ("right",))
    lost = np.where(seen.labels == start.layout.names.index("RingTip"), -1, seen.labels)
    (one,) = calibrate_take(dataclasses.replace(seen, labels=lost), start, start)
    assert one.is_better and not one.held_out.other_labels


def test_a_take_without_a_hand_is_told(seen):
    no_pose = np.full_like(seen.qpos, np.nan)
    lost = dataclasses.replace(seen, qpos=no_pose, status=np.full_like(seen.status, LOST))
    with pytest.raises(CalibrationError, match="no right hand was found in the capture"):
        calibrate_take(lost, seen.hands, seen.hands)


@pytest.mark.slow
def test_a_take_is_calibrated_on_itself(seen):
    first = track_capture(seen, hands=["right"], smooth=False)
    steps, told = [], lambda *values: steps.append(values)
    second = track_capture(seen, hands=["right"], calibrate=True, smooth=False, progress=told)
    assert angle_error(second, seen) < 0.6 * angle_error(first, seen)
    assert np.nanmedian(second.rms) < 0.8 * np.nanmedian(first.rms)
    assert second.settings["user"].startswith("calibrated on the take itself, ")
    assert steps[0] == (1, FRAMES) and steps.count((FRAMES, FRAMES)) == 2


def test_a_take_too_short_to_be_calibrated_is_tracked_all_the_same(seen):
    with pytest.warns(HandSimWarning, match="not calibrated: .* at least 100 such frames"):
        take = track_capture(seen.cut(0, 59), hands=["right"], calibrate=True)
    assert take.settings["user"].startswith("auto, ") and np.isfinite(take.qpos).all()
