"""A user's hand and glove come back from their markers, and what the capture lacks is told."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from benchmarks.paper.hand_errors import hand_errors
from benchmarks.people import displace_markers
from gloves import GloveFit, MarkerLayout, MarkerPlace, attach, load_layout
from gloves.fit import attach_markers, nominal_fit
from handsim import HandModel, HandSimError, join_qpos
from handsim.hand.shape import DIGITS, JOINT_NAMES, SIDES, named_shape
from handsim.space.transforms import MIRROR, axis_angle_matrix
from poses.motion import wrist_path
from track import Calibration, HeldOut, Status, TrackedFrame, TrackedHand, User, load_user
from track.calibration.energy import first_estimate
from track.calibration.user_calibration import MotionGuide, calibrate_hand, independent_count, learn_arch
from train.simulation.scenes import CalibrationTakeConfig, calibration_angles

LAYOUT = load_layout("dense19")
RATE = 30.0
RING = np.array([number for number, name in enumerate(JOINT_NAMES) if name.startswith("ring")])


@cache
def somebody():
    """A right hand unlike the mean one, its glove 5 mm off, and the angles of a short capture."""
    rng = np.random.default_rng(5)
    mean = named_shape("M")
    shape = dataclasses.replace(
        mean,
        length=1.07 * mean.length,
        bone_lengths=1.07 * mean.bone_lengths * np.exp(rng.normal(scale=0.04, size=(5, 3))),
        knuckles=1.06 * mean.knuckles,
        breadth=1.05 * mean.breadth,
        radii=1.03 * mean.radii,
    )
    model = HandModel(shape)
    worn = displace_markers(attach_markers(LAYOUT, model), shape, 0.005, rng=rng)
    angles = calibration_angles(model, CalibrationTakeConfig(free=12.0, rounds=1), rng=rng)
    angles = angles[::4]
    where = wrist_path(len(angles), RATE, rng=rng)
    qpos = join_qpos(angles, position=where[0], quaternion=where[1])
    return GloveFit(model, worn), qpos


def markers_of(hand, qpos):
    return hand.attachment.centers(hand.model, hand.model.forward_kinematics(qpos))


@cache
def calibrated() -> dict[str, tuple[GloveFit, Calibration, list]]:
    """Somebody's two hands calibrated, and the steps that were told.

    Some labels of the right hand are wrong; the left one is alike, but its ring finger does not move.
    """
    rng = np.random.default_rng(6)
    right, qpos = somebody()
    still = qpos.copy()
    still[:, 7 + RING] = np.deg2rad([0.0, 20.0, 25.0, 15.0])
    markers = {"right": markers_of(right, qpos), "left": markers_of(right, still) @ MIRROR}
    for side in SIDES:
        markers[side] += rng.normal(scale=0.0001, size=markers[side].shape)
        markers[side][rng.random(markers[side].shape[:2]) < 0.01] = np.nan
    wrong = rng.random(markers["right"].shape[:2]) < 0.01
    markers["right"][wrong] += rng.normal(scale=0.03, size=(int(wrong.sum()), 3))
    results = {}
    for side in SIDES:
        told = []
        start = nominal_fit(LAYOUT, "M", side)
        result = calibrate_hand(markers[side], start, RATE, progress=told.append)
        results[side] = right.with_side(side), result, told
    return results


@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
def test_a_hand_and_its_glove_come_back(side):
    true, result, _ = calibrated()[side]
    before, after = hand_errors(result.start, true), hand_errors(result.hand, true)
    moving = [0, 1, 2, 4] if side == "left" else [0, 1, 2, 3, 4]  # digits, the thumb first
    assert result.hand.side == side
    assert before.positions.mean() > 0.004
    assert after.positions.mean() < 0.0008
    assert np.abs(before.lengths).mean() > 0.06
    assert np.abs(after.lengths[moving]).mean() < 0.015
    assert result.rms_before > 0.003
    assert result.rms_after < 0.0005
    assert 0.004 < result.shifts.mean() < 0.006


def test_errors_are_as_large_as_told():
    true, result, _ = calibrated()["right"]
    errors = hand_errors(result.hand, true).wrist_positions
    assert (errors < 2.5 * result.position_errors).mean() > 0.75
    off = np.abs(result.hand.model.shape.bone_lengths - true.model.shape.bone_lengths)[:, :2]
    assert (off < 2.5 * result.length_errors[:, :2]).mean() > 0.75
    assert result.length_errors.max() < 0.005


@pytest.mark.slow
def test_samples_that_follow_one_another_count_less(rng):
    kept = np.array([0.0, 0.9])  # of each sample in the next one; such samples count (1 - kept) / (1 + kept)
    noise = rng.normal(size=(20_000, 8, 1)) * np.sqrt(1.0 - kept**2)
    values = noise.copy()
    for number in range(1, len(values)):
        values[number] += kept * values[number - 1]
    for column, share in enumerate((1.0, 0.1 / 1.9)):
        count = independent_count(values[..., column])
        assert 0.8 * share * len(values) < count <= 1.2 * share * len(values)
    assert independent_count(np.ones((50, 3))) == 50.0


def test_touches_are_found_and_closed():
    _, result, _ = calibrated()["right"]
    fingers = {touch.finger for touch in result.touches if touch.weight > 0.5}
    assert len(fingers) >= 3
    before, after = result.gaps()
    assert after < 0.0007 < before
    assert result.significant_touches


def test_progress_is_told():
    _, result, told = calibrated()["right"]
    assert told == list(range(1, len(told) + 1)) and len(told) > 1
    assert result.rms_after < 0.1 * result.rms_before


def test_a_finger_that_does_not_move_is_told():
    _, result, _ = calibrated()["left"]
    still = {JOINT_NAMES[number] for number in RING}
    assert still <= set(result.still_joints)
    assert not {"index_PIP_flexion", "middle_PIP_flexion"} & set(result.still_joints)
    advice = " / ".join(result.suggestions())
    assert "move the ring more, through the whole range of MCP abduction, MCP flexion, PIP" in advice
    assert calibrated()["right"][1].length_errors[3, 0] < result.length_errors[3, 0]


def test_a_guide_asks_for_what_is_missing_until_every_joint_has_moved():
    hand, qpos = somebody()
    guide, said, number = MotionGuide((hand,)), [], 0

    def show(poses, *, hidden=()):
        nonlocal number
        filled = np.array(hidden, dtype=np.int64)
        for pose, markers in zip(poses, markers_of(hand, poses), strict=True):
            one = TrackedHand("right", Status.TRACKED, pose, 0.001, markers, filled)
            said.append(guide(TrackedFrame(number / RATE, (one,), np.empty(0), np.empty(0))))
            number += 1

    lost = TrackedHand(
        "right", Status.LOST, np.full(27, np.nan), np.nan, np.full((19, 3), np.nan), filled := np.arange(0)
    )
    assert guide(TrackedFrame(-2.0, (lost,), filled, filled)) == "no right hand is tracked yet"
    still = qpos.copy()
    still[:, 7 + RING] = np.deg2rad([0.0, 20.0, 25.0, 15.0])
    show(still)
    assert said[-1] == (
        "right hand: move the ring more, through the whole range of MCP abduction, MCP flexion, PIP flexion, "
        "DIP flexion"
    )
    ring = [k for k, name in enumerate(LAYOUT.names) if name.startswith("Ring")]
    show(qpos, hidden=ring[-1:])
    assert "move the ring" in said[-1], "its markers were not all seen"
    show(qpos)
    assert said[-1] is None and number / RATE > 30.0
    assert None not in said[: round(30.0 * RATE)]


def test_touches_are_asked_for_before_half_a_minute_is_over():
    hand, qpos = somebody()
    guide, said = MotionGuide((hand,)), []
    poses = qpos[np.arange(round(29.0 * RATE)) % len(qpos)]
    for number, (pose, markers) in enumerate(zip(poses, markers_of(hand, poses), strict=True)):
        one = TrackedHand("right", Status.TRACKED, pose, 0.001, markers, np.arange(0))
        said.append(guide(TrackedFrame(number / RATE, (one,), np.empty(0), np.empty(0))))
    assert said[-1] == "touch the thumb to the tip of each finger and hold still"


def test_the_result_can_be_kept(tmp_path):
    _, result, _ = calibrated()["left"]
    User((result.hand,)).save(tmp_path / "user.json")
    (again,) = load_user(tmp_path / "user.json")
    np.testing.assert_array_equal(again.attachment.points, result.hand.attachment.points)


@pytest.mark.slow
def test_a_glove_stays_as_designed_where_motion_does_not_tell(rng):
    hand, qpos = somebody()
    hand = attach(LAYOUT, hand.model)
    still = join_qpos(
        np.tile(qpos[300, 7:], (200, 1)) + rng.normal(scale=0.02, size=(200, 20)),
        position=qpos[:200, :3],
        quaternion=qpos[:200, 3:7],
    )
    result = calibrate_hand(markers_of(hand, still), nominal_fit(LAYOUT, "M", "right"), RATE)
    errors = hand_errors(result.hand, hand).wrist_positions
    assert len(result.still_joints) > 10
    assert errors.mean() < 0.0025, "a spread of 6 mm made it 4"
    assert 0.001 < result.place_error < 0.004
    assert result.place_error > 2.0 * calibrated()["right"][1].place_error


def test_what_is_told_is_of_held_out_frames():
    _, result, _ = calibrated()["right"]
    assert not result.is_better and "it stays as it was" in str(result)
    better = dataclasses.replace(result, held_out=HeldOut(0.004, 0.0002, 80))
    places = f"their places known to {1e3 * better.place_error:.1f} mm"
    off = "markers 4.00 mm off before and 0.20 mm after calibration, on 80 frames held out"
    assert str(better) == f"{off}, {places}"
    shape = dataclasses.replace(result.hand.shape, arch=[0.05, 0.3])
    arched = dataclasses.replace(better, hand=GloveFit(HandModel(shape), result.hand.attachment))
    arch = "metacarpals of ring and little finger flex 0.05 and 0.30 times as far as the MCP joints"
    assert str(arched) == f"{off}, {places}, {arch}"
    alike = dataclasses.replace(result, held_out=HeldOut(0.004, 0.00395, 80))
    assert not alike.is_better and "no better, so that it stays as it was" in str(alike)


@pytest.mark.parametrize(
    ("markers", "rate", "told"),
    [
        (
            np.zeros((20, 19, 3)),
            120.0,
            "20 of 20 frames have 14 or more of the right hand's 19 markers, expected at least 100",
        ),
        (np.full((100, 19, 3), np.nan), 120.0, "0 of 100 frames"),
    ],
)
def test_what_cannot_be_calibrated_is_told(markers, rate, told):
    with pytest.raises(HandSimError, match=told):
        calibrate_hand(markers, nominal_fit(LAYOUT, "M", "right"), rate)


def knuckle_layout():
    """A glove with markers on the back and on the knuckles, and one on each middle joint."""
    fingers = ("index", "middle", "ring", "little")
    back = [MarkerPlace("B1", "palm", 0.3, 0.0, 0.15), MarkerPlace("B2", "palm", 0.3, 0.0, -0.2)]
    rest = [
        MarkerPlace(f"{finger}{along}", f"{finger}_proximal", along, 0.0)
        for finger in fingers
        for along in (0.02, 0.95)
    ]
    return MarkerLayout("knuckles", (*back, *rest), 0.002)


def arched_capture(layout, arch, rng):
    """Noisy markers and poses of a closing hand with this arch; metacarpals carry the knuckles' markers."""
    shape = dataclasses.replace(named_shape("M"), arch=arch)
    fit = attach(layout, shape)
    angles = np.zeros((120, 20))
    angles[:, 1::4] = np.deg2rad(rng.uniform(0.0, 50.0, size=(120, 5)))
    qpos = join_qpos(angles)
    markers = markers_of(fit, qpos)
    for digit, ratio in zip((3, 4), arch, strict=True):
        name = f"{DIGITS[digit]}0.02"
        if name in layout.names:
            marker, base = layout.names.index(name), 0.38 * shape.knuckles[digit]
            turns = axis_angle_matrix(np.array([0.0, 1.0, 0.0]), ratio * angles[:, 4 * digit + 1])
            markers[:, marker] = base + turns @ (fit.attachment.points[marker] - base)
    return markers + rng.normal(scale=0.0002, size=markers.shape), qpos


def learned_arch(layout, arch, rng):
    markers, qpos = arched_capture(layout, arch, rng)
    start = nominal_fit(layout, "M", "right")
    problem, estimate = first_estimate(start, markers, qpos, noise=0.001, robust_scale=0.03)
    learn_arch(problem, estimate)
    return problem.shape.arch


@pytest.mark.parametrize("arch", [[0.1, 0.4], [0.0, 0.8]])
def test_knuckles_show_how_far_metacarpals_flex(arch, rng):
    """A bone between markers on skin turns by a tenth less than the joint, so that ratios are too large."""
    np.testing.assert_allclose(learned_arch(knuckle_layout(), arch, rng), arch, rtol=0.2, atol=0.03)


def test_markers_further_out_do_not_show_it(rng):
    layout = knuckle_layout()
    places = [dataclasses.replace(one, along=max(one.along, 0.12)) for one in layout.markers]
    layout = dataclasses.replace(layout, markers=tuple(places))
    np.testing.assert_array_equal(learned_arch(layout, [0.1, 0.4], rng), 0.0)


def test_a_glove_without_markers_on_knuckles_does_not_show_it(rng):
    np.testing.assert_array_equal(learned_arch(LAYOUT, [0.1, 0.4], rng), 0.0)
