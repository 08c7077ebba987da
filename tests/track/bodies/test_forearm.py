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

from gloves import Capture, Take, attach, load_layout, load_take, write_capture
from gloves.fit import forearm_markers
from gloves.takes.points import Status
from handsim import HandModel, sample_shape
from handsim.cli.main import main
from handsim.errors import ArgumentError, CalibrationError
from handsim.hand.angles import WRIST_NAMES
from handsim.space.transforms import MIRROR, pose_matrices, random_quaternions, rotation_quaternions
from poses import sample_motion
from render.user_body import UserBody
from track import RigidTemplate, calibrate, label_capture, track_capture
from track.bodies.forearm import found_forearm, limb_of_landmarks, wrist_variances
from track.bodies.rigid_body import BodyTracker, learn_body, load_bodies, load_body, save_body
from track.takes.take_faults import find_faults
from track.takes.take_figures import PageSettings
from track.takes.take_page import write_take_page
from train import simulate_take
from train.simulation.training_frames import wear_gloves

RATE = 120.0
NOISE = 0.0003  # [m]
STRAIGHT = 60  # first frames, in which the wrist is straight
# Four markers on a right forearm: along the hand, to the thumb's side, out of the back.
CLUSTER = np.array(
    [[-0.06, 0.02, 0.03], [-0.10, -0.025, 0.028], [-0.14, 0.022, 0.033], [-0.075, -0.03, 0.02]]
)
NAMES = ("ArmA", "ArmB", "ArmC", "ArmD")
# Markers on the upper arm, from the middle of the epicondyles: lateral to them, medial, and two up the arm.
ELBOW = np.array([[0.0, 0.04, 0.01], [0.005, -0.042, 0.0], [-0.12, 0.02, 0.05], [-0.07, -0.03, 0.045]])
ELBOW_NAMES = ("Lateral", "Medial", "Upper", "Inner")
LENGTH = 0.25  # of the forearm [m]


class Scene(NamedTuple):
    truth: Take
    capture: Capture
    angles: np.ndarray  # flexion and radial deviation of the wrist, pronation of the forearm (T, 3) [rad]
    arm: RigidTemplate
    elbow: RigidTemplate


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
    # A right elbow that flexes turns about y, and a right forearm that pronates about minus its x axis.
    other = np.random.default_rng(person)
    late = np.clip((np.arange(frames) - STRAIGHT) / 30.0, 0.0, 1.0)[:, None]
    bent, carried, pronation = ([0.9, 0.1, 1.4] + late * wander(other, frames, 0.6, [0.6, 0.1, 1.2])).T
    held = (
        Rotation.from_rotvec(bent[:, None] * [0.0, 1.0, 0.0])
        * Rotation.from_rotvec(carried[:, None] * [0.0, 0.0, -1.0])
        * Rotation.from_rotvec(pronation[:, None] * [-1.0, 0.0, 0.0])
    ).as_matrix()
    upper = forearm @ mirror @ held.swapaxes(1, 2) @ mirror
    arm = RigidTemplate("arm", NAMES, CLUSTER @ mirror, None, side, has_axes=True)
    elbow = RigidTemplate("elbow", ELBOW_NAMES, ELBOW @ mirror, elbow=side)
    limbs = (arm, qpos[:, :3], forearm), (elbow, qpos[:, :3] - LENGTH * forearm[:, :, 0], upper)
    poses = [np.concatenate([place, rotation_quaternions(turn)], axis=1) for _, place, turn in limbs]
    placed = [np.einsum("tij,mj->tmi", turn, one.positions) + place[:, None] for one, place, turn in limbs]
    points = np.concatenate([fit.markers(qpos)[0], *placed], axis=1)
    labels = np.tile(np.arange(points.shape[1], dtype=np.int32), (frames, 1))
    moving = {"bodies": [arm, elbow], "body_poses": np.stack(poses, axis=1)}
    truth = Take.of_truth([fit], qpos[:, None], points, labels, labels, rate=RATE, **moving)
    seen = points.copy()
    for one, columns in ((rng, slice(-len(ELBOW))), (other, slice(-len(ELBOW), None))):
        seen[:, columns] += NOISE * one.standard_normal(seen[:, columns].shape)
        for marker in range(seen.shape[1])[columns]:
            for start in one.integers(STRAIGHT, frames, 2):
                seen[start : start + one.integers(2, 12), marker] = np.nan
    names = (*fit.layout.names, *NAMES, *ELBOW_NAMES)
    angles = np.column_stack([flexion, radial, pronation])
    return Scene(truth, Capture(names, seen, RATE), angles, arm, elbow)


@functools.cache
def tracked(side: str) -> Take:
    one = scene(side)
    return track_capture(one.capture, hands=one.truth.hands, bodies=[one.arm, one.elbow])


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
    assert (np.isfinite(spreads).mean(axis=0) > 0.9).all(), "all but where the forearm or the elbow coasts"
    off = np.where(np.isfinite(spreads), wrist_of(take) - scene(side).angles, np.nan)
    assert np.rad2deg(np.sqrt(np.nanmean(off**2, axis=0))).max() < 1.0
    of_wrist, of_pronation = (np.sqrt(np.nanmean((off / spreads)[:, one] ** 2)) for one in (slice(2), 2))
    assert 0.3 < of_wrist < 1.0, "the hand is known better than the tracker knows"
    assert 0.8 < of_pronation < 1.25
    *wrist, pronation = take.settings["wrist_budget"][side]
    assert pronation[0] > 0.0 and not any(pronation[1:]), "the hand has no part in it"
    noise, gluing, flesh, person, _ = np.array(wrist).T
    assert (noise > 0.1).all() and (np.hypot(gluing, person) > noise).all() and (flesh < noise).all()


@pytest.mark.slow
def test_stated_deviations_of_measured_hands_hold():
    ratios = []
    for person, side in enumerate(("right", "left") * 6, 1):
        one = scene(side, 480, person)
        take = track_capture(one.capture, glove="dense19", hands=(side,), bodies=[one.arm, one.elbow])
        off, spreads = wrist_of(take) - one.angles, take.angle_spreads(side)
        assert np.rad2deg(np.sqrt(np.nanmean(off**2, axis=0))).max() < 3.0
        ratios.append(np.abs(off) / np.transpose([spreads[name] for name in WRIST_NAMES]))
    for columns, once, twice in (slice(2), (0.55, 0.82), (0.89, 0.995)), (2, (0.62, 0.75), (0.92, 0.98)):
        whole = np.concatenate([ratio[:, columns].ravel() for ratio in ratios])
        whole = whole[np.isfinite(whole)]
        assert once[0] < (whole < 1.0).mean() < once[1] and twice[0] < (whole < 2.0).mean() < twice[1]


def test_gluing_and_person_of_a_palm_count_less_as_its_markers_are_many():
    take = tracked("right")
    parts = wrist_variances(take, "right", np.ones((take.num_frames, 3, 5)))[:, :2]
    np.testing.assert_allclose(np.nanmean(parts, axis=(0, 1))[1:], [0.36, 1.0, 0.36, 1.0])


@pytest.mark.slow
def test_stated_deviations_of_calibrated_hands_hold():
    ratios = []
    for person, side in enumerate(("left", "right") * 2, 101):
        one = scene(side, 2400, person)
        user = calibrate(one.capture, glove="dense19", hands=(side,))
        take = track_capture(one.capture, hands=user, bodies=[one.arm])
        off = (wrist_of(take) - one.angles)[:, :2]
        spreads = np.transpose([take.angle_spreads(side)[name] for name in WRIST_NAMES[:2]])
        ratios.append(np.abs(off / spreads)[np.isfinite(off).all(axis=1)].ravel())
    whole = np.concatenate(ratios)
    assert 0.6 < (whole < 1.0).mean() < 0.8 and 0.92 < (whole < 2.0).mean() < 0.99


def test_every_label_of_the_arm_is_right():
    """With two of four markers in sight it has neither pose nor labels for a while."""
    take, first = tracked("right"), scene("right").truth.hand_labels[-1].stop
    arm = slice(first, first + len(NAMES))
    there, labels = np.isfinite(take.points[:, arm, 0]), take.labels[:, arm]
    right = labels == np.where(there, np.arange(arm.start, arm.stop), -1)
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
        truth,
        bodies=[dataclasses.replace(truth.bodies[0], has_axes=False), truth.bodies[1]],
        body_poses=poses,
    )
    assert np.isnan(wrist_of(plain)).all(), "nobody knows its axes"
    with pytest.warns(UserWarning, match="moves"):
        found = wrist_of(plain, neutral=(0.0, (STRAIGHT - 1) / RATE))
        trial = wrist_of(plain, neutral=plain.cut(0, STRAIGHT))
    np.testing.assert_allclose(found, bends - bends[0], atol=1e-6)
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
    body = learn_body(capture, "arm", NAMES, forearm="left")
    assert body.marker_names == NAMES and not body.has_axes
    found = limb_of_landmarks(body, capture, ("RS", "US", "EL", "EM"))
    np.testing.assert_allclose(found.positions, one.arm.positions, atol=2e-4)
    with pytest.raises(ArgumentError, match="expected the columns of the radial styloid"):
        limb_of_landmarks(body, capture, ("RS", "US"))
    with pytest.raises(ArgumentError, match="expected the side of the hand"):
        limb_of_landmarks(dataclasses.replace(body, forearm=None), capture, ("RS", "US", "EL"))
    with pytest.raises(CalibrationError, match="on one line"):
        limb_of_landmarks(body, capture, ("RS", "EL", "EL"))
    hidden = capture.positions.copy()
    hidden[:, capture.names.index("EL")] = np.nan
    unseen = dataclasses.replace(capture, positions=hidden)
    with pytest.raises(CalibrationError, match="landmark EL is never seen"):
        limb_of_landmarks(body, unseen, ("RS", "US", "EL"))


@pytest.mark.parametrize("side", ["right", "left"])
def test_epicondyles_give_the_axis_of_an_elbow(side):
    one = scene(side)
    upper = Rotation.from_quat(one.truth.body_poses[:, 1, 3:], scalar_first=True).as_matrix()
    lateral, medial = 0.035, -0.035
    places = np.array([[0.0, lateral, 0.0], [0.0, medial, 0.0]]) * (1.0 if side == "right" else -1.0)
    landmarks = np.einsum("tij,mj->tmi", upper, places) + one.truth.body_poses[:, 1:, :3]
    capture = Capture(
        (*one.capture.names, "EL", "EM"), np.concatenate([one.capture.positions, landmarks], axis=1), RATE
    )
    body = learn_body(capture, "elbow", ELBOW_NAMES, elbow=side)
    found = limb_of_landmarks(body, capture, ("EL", "EM"))
    assert found.elbow == side and found.forearm is None and not found.has_axes
    np.testing.assert_allclose(found.positions[:, 1], one.elbow.positions[:, 1], atol=3e-4)
    np.testing.assert_allclose(found.distances, one.elbow.distances, atol=3e-4)
    with pytest.raises(ArgumentError, match="expected the columns of the lateral and the medial epicondyle"):
        limb_of_landmarks(body, capture, ())
    with pytest.raises(CalibrationError, match="on one line"):
        limb_of_landmarks(body, capture, ("EL", "EL"))


def test_pronation_is_not_told_without_an_elbow(tmp_path):
    one = scene("right")
    take = track_capture(one.capture, hands=one.truth.hands, bodies=[one.arm])
    np.testing.assert_array_equal(np.isnan(wrist_of(take)).all(axis=0), [False, False, True])
    assert np.isnan(take.wrist_spread[..., 2]).all() and len(take.settings["wrist_budget"]["right"]) == 2
    write_take_page(tmp_path / "page.html", take, settings=PageSettings())
    page = (tmp_path / "page.html").read_text()
    assert "unknown without markers at the elbow" in page and "wrist flexion" in page
    assert "forearm pronation" not in page


def test_exchanged_landmarks_and_a_wrong_side_are_told():
    take = tracked("right")

    def told(take: Take) -> list[str]:
        return [fault.words for fault in find_faults(take) if "the body" in fault.of]

    assert told(take) == []
    half = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
    for body, landmarks in ((0, "radial and ulnar styloid"), (1, "lateral and medial epicondyle")):
        poses, there = take.body_poses.copy(), np.isfinite(take.body_poses[:, body, 0])
        turned = Rotation.from_quat(poses[there, body, 3:], scalar_first=True) * half
        poses[there, body, 3:] = turned.as_quat(scalar_first=True)
        (fault,) = told(dataclasses.replace(take, body_poses=poses))
        assert take.bodies[body].name in fault and landmarks in fault
    arm = dataclasses.replace(take.bodies[0], forearm="left")
    (fault,) = told(dataclasses.replace(take, bodies=[arm, take.bodies[1]]))
    assert "is the forearm of a left hand, which the take does not have" in fault


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
    save_body(tmp_path / "elbow.toml", scene("left").elbow)
    elbow = load_body(tmp_path / "elbow.toml")
    assert (elbow.forearm, elbow.elbow) == (None, "left") and len(load_bodies([arm, elbow])) == 2
    with pytest.raises(ArgumentError, match="second left elbow"):
        load_bodies([elbow, dataclasses.replace(elbow, name="other")])
    with pytest.raises(ArgumentError, match="both forearm and elbow"):
        dataclasses.replace(elbow, forearm="left")


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
    page = (tmp_path / "page.html").read_text()
    assert "Right wrist" in page and "forearm pronation" in page
    with (tmp_path / "page.angles.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["joint"] == "wrist_flexion"]
    moved = np.ptp(np.nanpercentile(np.rad2deg(wrist_of(take)[:, 0]), (5.0, 95.0)))
    assert abs(float(rows[-1]["value [deg]"]) - moved) < 2.0
    assert float(rows[0]["SD"]) > float(rows[0]["SD constant"]) > 0.0 and not rows[0]["MDD"]


def test_arms_in_pictures_follow_the_forearm():
    take = scene("right").truth
    axes = Rotation.from_quat(take.body_poses[:, 0, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(UserBody(take).forearms[:, 0], -axes[..., 0], atol=1e-9)


@functools.cache
def worn_forearm(side: str) -> tuple[Take, Take, Take]:
    """A simulated take in a glove whose layout has a forearm, labeled and tracked from its points alone."""
    glove = dataclasses.replace(load_layout("dense19"), forearm=load_layout("clinical26").forearm)
    truth = simulate_take("free", glove=glove, hands=(side,), num_frames=360, seed=5)
    names = tuple(f"u{column}" for column in range(truth.points.shape[1]))
    options = {"glove": glove, "labeler": "dense19", "hands": (side,)}
    capture = Capture(names, truth.points, truth.rate)
    return truth, label_capture(capture, **options), track_capture(capture, **options)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_forearm_of_a_layout_is_found_among_points_without_names(side):
    truth, labeled, take = worn_forearm(side)
    assert truth.label_names == labeled.label_names == take.label_names
    beyond = truth.labels >= truth.hand_labels[-1].stop
    for one in (labeled, take):
        assert one.bodies[0].forearm == side and one.bodies[0].is_nominal
        assert (one.labels == truth.labels)[beyond].mean() > 0.995
        assert (one.labels == truth.labels)[truth.labels >= 0].mean() > 0.995
    arms = [np.linalg.norm(np.diff(one.bodies[0].positions, axis=0), axis=1) for one in (truth, take)]
    np.testing.assert_allclose(*arms, atol=5e-4)
    names = labeled.labeled_capture(sides=False).names
    assert names[: 19 + 4] == (*load_layout("dense19").names, *truth.bodies[0].marker_names)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_wrist_beside_a_forearm_of_a_layout_knows_how_well(side, tmp_path):
    truth, _, take = worn_forearm(side)
    off = (wrist_of(take) - wrist_of(truth))[:, :2]
    spreads = np.transpose([take.angle_spreads(side)[name] for name in WRIST_NAMES[:2]])
    assert np.nanmax(np.abs(off / spreads)) < 3.0 and np.rad2deg(np.nanstd(off, axis=0)).max() < 1.0
    assert np.rad2deg(np.nanmedian(spreads)) > 2.0, "axes of a layout are known no better than it is glued"
    take.save(tmp_path / "take.npz")
    again = load_take(tmp_path / "take.npz")
    assert again.bodies[0].is_nominal and again.hands[0].layout.forearm == take.hands[0].layout.forearm


def test_a_forearm_that_is_given_or_not_there_is_not_looked_for(rng):
    truth, _, take = worn_forearm("right")
    glove, names = take.hands[0].layout, tuple(f"u{column}" for column in range(truth.points.shape[1]))
    options = {"glove": glove, "labeler": "dense19", "hands": ("right",)}
    own = RigidTemplate("own", truth.bodies[0].marker_names, truth.bodies[0].positions, None, "right")
    given = track_capture(Capture(names, truth.points, truth.rate), bodies=[own], **options)
    assert [body.name for body in given.bodies] == ["own"]
    hand = np.where((truth.labels < truth.hand_labels[-1].stop)[..., None], truth.points, np.nan)
    with pytest.warns(UserWarning, match="the right forearm is not found, expected RadialStyloid"):
        bare = label_capture(Capture(names, hand, truth.rate), **options)
    assert (
        not bare.bodies
        and (bare.labels == np.where(np.isfinite(hand[..., 0]), truth.labels, -1)).mean() > 0.99
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_forearm_of_three_markers_at_its_hand_needs_no_confirmation(side):
    one = scene(side)
    positions = one.arm.positions[:3] * [[1.0], [1.0], [1.2]]  # that look different from two sides
    arm = dataclasses.replace(one.arm, marker_names=NAMES[:3], positions=positions)
    poses = pose_matrices(one.truth.body_poses[:, 0])
    points = np.einsum("tij,mj->tmi", poses[:, :3, :3], positions) + poses[:, None, :3, 3]
    ids = np.arange(3)
    alone, beside, wrong = BodyTracker(arm), BodyTracker(arm), BodyTracker(arm)
    wrist = one.truth.qpos[:, 0, :7]
    away = wrist + [0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    for frame in range(9):
        assert alone.step(points[frame], ids, frame / RATE).status == Status.LOST
        assert wrong.step(points[frame], ids, frame / RATE, away[frame]).status == Status.LOST
        found = beside.step(points[frame], ids, frame / RATE, wrist[frame])
        np.testing.assert_array_equal(found.labels, [0, 1, 2])
    plain = BodyTracker(dataclasses.replace(arm, has_axes=False))
    assert plain.step(points[0], ids, 0.0, wrist[0]).status == Status.LOST, "nobody knows where it ends"


@pytest.mark.parametrize("side", ["right", "left"])
def test_points_of_a_forearm_are_told_from_others_beside_it(side, rng):
    layout = load_layout("clinical26")
    positions, _ = forearm_markers(layout, 0.19, side)
    names = tuple(one.name for one in layout.forearm)
    nominal = RigidTemplate("arm", names, positions, None, side, has_axes=True)
    glued = positions + rng.normal(scale=0.003, size=positions.shape)
    turns = Rotation.from_rotvec(rng.normal(size=(30, 3)) * [0.05, 0.5, 0.2]).as_matrix()
    clouds = [
        rng.permutation(np.concatenate([glued @ turn.T, rng.uniform(-0.2, 0.2, (6, 3))])) for turn in turns
    ]
    found = found_forearm(nominal, np.tile(np.eye(4), (30, 1, 1)), clouds)
    apart = [np.linalg.norm(one[:, None] - one, axis=2) for one in (found.positions, glued)]
    np.testing.assert_allclose(*apart, atol=1e-4)
    loose = [cloud + rng.normal(scale=0.02, size=cloud.shape) for cloud in clouds]
    assert found_forearm(nominal, np.tile(np.eye(4), (30, 1, 1)), loose) is None
