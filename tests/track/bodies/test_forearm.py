"""A forearm with markers beside a tracked hand: the wrist's angles, their deviations, and the axes."""

from __future__ import annotations

import csv
import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gloves import Capture, Take, attach, load_take, write_capture
from handsim import HandModel, sample_shape
from handsim.cli.main import main
from handsim.errors import ArgumentError, CalibrationError
from handsim.hand.angles import WRIST_NAMES
from handsim.space.transforms import MIRROR, random_quaternions, rotation_quaternions
from poses import sample_motion
from render.user_body import UserBody
from track import RigidTemplate, track_capture
from track.bodies.forearm import forearm_of_landmarks
from track.bodies.rigid_body import learn_body, load_bodies, load_body, save_body
from track.takes.take_figures import PageSettings
from track.takes.take_page import write_take_page
from train.simulation.training_frames import wear_gloves

RATE = 120.0
NOISE = 0.0003  # [m]
STRAIGHT = 60  # first frames, in which the wrist is straight
# Four markers on a right forearm: along the hand, to the thumb's side, out of the back.
CLUSTER = np.array(
    [[-0.06, 0.02, 0.03], [-0.10, -0.025, 0.028], [-0.14, 0.022, 0.033], [-0.075, -0.03, 0.02]]
)
NAMES = ("ArmA", "ArmB", "ArmC", "ArmD")


class Scene(NamedTuple):
    truth: Take
    capture: Capture
    angles: np.ndarray  # flexion and radial deviation (T, 2) [rad]
    arm: RigidTemplate


def wander(rng, frames: int, every: float, reach) -> np.ndarray:
    knots = frames // int(RATE * every) + 6
    values = rng.uniform(-1.0, 1.0, (knots, len(reach))) * reach
    return CubicSpline(np.arange(knots), values)(2.0 + np.arange(frames) / (RATE * every))


@functools.cache
def scene(side: str, frames: int = 360, person: int = 0) -> Scene:
    """A gloved hand that bends at the wrist; the bends are chosen, the forearm's markers follow from them."""
    rng = np.random.default_rng(7 + person)
    fit = attach("dense19", "M" if side == "right" else "L").with_side(side)
    if person:
        models = [HandModel(sample_shape(side=side, rng=rng))]
        (fit,) = wear_gloves(fit.layout, models, along=0.05, around=np.deg2rad(5.0), rng=rng)
    qpos = np.array(sample_motion(fit.model, (frames - 1) / RATE, rng=rng).qpos)
    bends = wander(rng, frames, 0.6, np.deg2rad([50.0, 18.0, 4.0]))
    bends[: STRAIGHT + 30] *= np.clip((np.arange(STRAIGHT + 30) - STRAIGHT) / 30.0, 0.0, 1.0)[:, None]
    flexion, radial, twist = bends.T
    # A right hand that flexes turns its x axis, along the third metacarpal, to -z, the palm's side.
    turns = (
        Rotation.from_rotvec(flexion[:, None] * [0.0, 1.0, 0.0])
        * Rotation.from_rotvec(radial[:, None] * [0.0, 0.0, 1.0])
        * Rotation.from_rotvec(twist[:, None] * [1.0, 0.0, 0.0])
    ).as_matrix()
    mirror = MIRROR if side == "left" else np.eye(3)
    forearm = Rotation.from_rotvec(wander(rng, frames, 1.0, [0.5, 0.5, 0.7])).as_matrix()
    qpos[:, :3] = wander(rng, frames, 1.0, [0.15, 0.15, 0.1])
    qpos[:, 3:7] = rotation_quaternions(forearm @ mirror @ turns @ mirror)
    poses = np.concatenate([qpos[:, :3], rotation_quaternions(forearm)], axis=1)[:, None]
    arm = RigidTemplate("arm", NAMES, CLUSTER @ mirror, None, side, has_axes=True)
    markers = np.einsum("tij,mj->tmi", forearm, arm.positions) + qpos[:, None, :3]
    points = np.concatenate([fit.markers(qpos)[0], markers], axis=1)
    labels = np.tile(np.arange(points.shape[1], dtype=np.int32), (frames, 1))
    truth = Take.of_truth(
        [fit], qpos[:, None], points, labels, labels, rate=RATE, bodies=[arm], body_poses=poses
    )
    seen = points + NOISE * rng.standard_normal(points.shape)
    for marker in range(points.shape[1]):
        for start in rng.integers(STRAIGHT, frames, 2):
            seen[start : start + rng.integers(2, 12), marker] = np.nan
    names = (*fit.layout.names, *NAMES)
    return Scene(truth, Capture(names, seen, RATE), bends[:, :2], arm)


@functools.cache
def tracked(side: str) -> Take:
    one = scene(side)
    return track_capture(one.capture, hands=one.truth.hands, bodies=[one.arm])


def wrist_of(take: Take, **options) -> np.ndarray:
    angles = take.angles(take.sides[0], convention="isb", **options)
    return np.stack([angles[name] for name in WRIST_NAMES], axis=1)


@pytest.mark.parametrize("side", ["right", "left"])
def test_true_poses_have_the_bends_that_were_chosen(side):
    np.testing.assert_allclose(wrist_of(scene(side).truth), scene(side).angles, atol=1e-9)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_tracked_wrist_bends_as_it_did_and_knows_how_well(side):
    take = tracked(side)
    spreads = np.stack([take.angle_spreads(side)[name] for name in WRIST_NAMES], axis=1)
    there = np.isfinite(spreads[:, 0])  # not where the forearm coasts
    assert there.mean() > 0.95
    off = np.rad2deg(wrist_of(take) - scene(side).angles)[there]
    assert np.sqrt((off**2).mean(axis=0)).max() < 1.0
    ratios = np.abs(off) / np.rad2deg(spreads[there])
    assert 0.3 < np.sqrt((ratios**2).mean()) < 1.0, "the hand is known better than the tracker knows"
    noise, gluing, flesh, person, _ = np.array(take.settings["wrist_budget"][side]).T
    assert (noise > 0.1).all() and (np.hypot(gluing, person) > noise).all() and (flesh < noise).all()


@pytest.mark.slow
def test_stated_deviations_of_measured_hands_hold():
    ratios = []
    for person, side in enumerate(("right", "left") * 6, 1):
        one = scene(side, 480, person)
        take = track_capture(one.capture, glove="dense19", hands=(side,), bodies=[one.arm])
        off = wrist_of(take) - one.angles
        assert np.rad2deg(np.sqrt(np.nanmean(off**2, axis=0))).max() < 3.0
        spreads = [take.angle_spreads(side)[name] for name in WRIST_NAMES]
        ratios.append(np.abs(off) / np.transpose(spreads))
    whole = np.concatenate(ratios)
    whole = whole[np.isfinite(whole)]
    assert 0.55 < (whole < 1.0).mean() < 0.82 and 0.89 < (whole < 2.0).mean() < 0.995


def test_every_label_of_the_arm_is_right():
    """With two of four markers in sight it has neither pose nor labels for a while."""
    take, first = tracked("right"), scene("right").truth.hand_labels[-1].stop
    there, labels = np.isfinite(take.points[:, first:, 0]), take.labels[:, first:]
    right = labels == np.where(there, np.arange(first, first + len(NAMES)), -1)
    assert right[there.sum(axis=1) > 2].mean() > 0.995 and right[labels >= 0].all()


def test_a_neutral_pose_gives_the_axes_of_a_forearm_without_any(rng):
    truth, bends = scene("right").truth, scene("right").angles
    turn = random_quaternions(1, rng=rng)[0]
    turned = Rotation.from_quat(truth.body_poses[:, 0, 3:], scalar_first=True) * Rotation.from_quat(
        turn, scalar_first=True
    )
    poses = truth.body_poses.copy()
    poses[:, 0, 3:] = turned.as_quat(scalar_first=True)
    plain = dataclasses.replace(
        truth, bodies=[dataclasses.replace(truth.bodies[0], has_axes=False)], body_poses=poses
    )
    assert np.isnan(wrist_of(plain)).all(), "nobody knows its axes"
    with pytest.warns(UserWarning, match="moves"):
        found = wrist_of(plain, neutral=(0.0, (STRAIGHT - 1) / RATE))
        trial = wrist_of(plain, neutral=plain.cut(0, STRAIGHT))
    np.testing.assert_allclose(found, bends, atol=1e-6)
    np.testing.assert_allclose(trial, found, atol=1e-12)
    assert "wrist_flexion" not in plain.without_body().angles("right", convention="isb")


def test_landmarks_give_the_axes(rng):
    one = scene("left")
    radial, ulnar, lateral, medial = np.array(
        [[0.0, 0.03, 0.0], [0.0, -0.03, 0.0], [-0.25, 0.035, 0.0], [-0.25, -0.035, 0.0]]
    ) @ np.diag([1.0, -1.0, 1.0])
    forearm = Rotation.from_quat(one.truth.body_poses[:, 0, 3:], scalar_first=True).as_matrix()
    places = np.stack([radial, ulnar, lateral, medial])
    landmarks = np.einsum("tij,mj->tmi", forearm, places) + one.truth.body_poses[:, :1, :3]
    capture = Capture(
        (*one.capture.names, "RS", "US", "EL", "EM"),
        np.concatenate([one.capture.positions, landmarks], axis=1),
        RATE,
    )
    body = learn_body(capture, "arm", NAMES, "left")
    assert body.marker_names == NAMES and not body.has_axes
    found = forearm_of_landmarks(body, capture, ("RS", "US", "EL", "EM"))
    np.testing.assert_allclose(found.positions, one.arm.positions, atol=2e-4)
    with pytest.raises(ArgumentError, match="expected the columns of the radial styloid"):
        forearm_of_landmarks(body, capture, ("RS", "US"))
    with pytest.raises(ArgumentError, match="expected the side of the hand"):
        forearm_of_landmarks(dataclasses.replace(body, forearm=None), capture, ("RS", "US", "EL"))
    with pytest.raises(CalibrationError, match="on one line"):
        forearm_of_landmarks(body, capture, ("RS", "EL", "EL"))
    hidden = capture.positions.copy()
    hidden[:, capture.names.index("EL")] = np.nan
    unseen = dataclasses.replace(capture, positions=hidden)
    with pytest.raises(CalibrationError, match="landmark EL is never seen"):
        forearm_of_landmarks(body, unseen, ("RS", "US", "EL"))


def test_a_file_keeps_whose_forearm_it_is(tmp_path):
    arm = scene("left").arm
    save_body(tmp_path / "arm.toml", arm)
    again = load_body(tmp_path / "arm.toml")
    assert (again.forearm, again.has_axes) == ("left", True)
    np.testing.assert_allclose(again.positions, arm.positions, atol=1e-11)
    with pytest.raises(ArgumentError, match="second left forearm"):
        load_bodies([arm, dataclasses.replace(arm, name="other")])
    with pytest.raises(ArgumentError, match="side of a forearm"):
        dataclasses.replace(arm, forearm="middle")


def test_commands_carry_the_wrist_to_tables_and_page(tmp_path):
    one, take = scene("right"), tracked("right")
    write_capture(tmp_path / "trial.trc", one.capture)
    options = "--markers", *NAMES, "--forearm", "right", "--out", f"{tmp_path}/arm.toml"
    main(["body", f"{tmp_path}/trial.trc", *options])
    assert load_body(tmp_path / "arm.toml").forearm == "right"
    take.save(tmp_path / "take.npz")
    again = load_take(tmp_path / "take.npz")
    np.testing.assert_array_equal(wrist_of(again), wrist_of(take))
    np.testing.assert_array_equal(again.wrist_spread, take.wrist_spread)
    again.export(tmp_path / "angles.csv")
    with (tmp_path / "angles.csv").open() as file:
        rows = list(csv.DictReader(file))
    column = [float(row["wrist_radial_deviation_isb_rad"] or "nan") for row in rows]
    np.testing.assert_allclose(column, wrist_of(take)[:, 1], atol=1e-8)
    write_take_page(tmp_path / "page.html", again, settings=PageSettings())
    assert "Right wrist" in (tmp_path / "page.html").read_text()
    with (tmp_path / "page.angles.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["joint"] == "wrist_flexion"]
    moved = np.ptp(np.nanpercentile(np.rad2deg(wrist_of(take)[:, 0]), (5.0, 95.0)))
    assert abs(float(rows[-1]["value [deg]"]) - moved) < 2.0
    assert float(rows[0]["SD"]) > float(rows[0]["SD constant"]) > 0.0 and not rows[0]["MDD"]


def test_arms_in_pictures_follow_the_forearm():
    take = scene("right").truth
    axes = Rotation.from_quat(take.body_poses[:, 0, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(UserBody(take).forearms[:, 0], -axes[..., 0], atol=1e-9)
