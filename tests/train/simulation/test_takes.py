"""Twins of the paper's captures: every kind, valid in every frame, and Table 3 near the paper's."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper.labeling_tables import count_gaps
from benchmarks.paper.printed import TABLE3
from gloves import Take, load_layout, load_take
from handsim import HandModel, load_rig
from handsim.errors import ArgumentError, PoseError
from handsim.space.objects import named_object
from handsim.space.rig import ROOM_CENTER, CameraRig
from handsim.space.transforms import pose_matrices, quaternion_matrix, rigid
from poses.grasps import object_penetration
from poses.motion import RATE
from poses.shapes import HIGH, LOW
from tests.meshes import hands_overlap
from tests.rigs import mixed_rig
from tests.sentences import error_names
from train import OpticsOptions, SimulateSettings, simulate_take
from train.simulation import takes
from train.simulation.scenes import KINDS
from train.simulation.takes import WRIST_VOLUME

FRAMES = 200
SELF_DEEPEST, DEEPEST = 0.001, 0.0015  # [m]


@functools.cache
def short(kind: str) -> Take:
    return simulate_take(kind=kind, num_frames=FRAMES)


@functools.cache
def whole() -> Take:
    return simulate_take(kind="hand-controller")


def models(take: Take) -> tuple[HandModel, HandModel]:
    right, left = (HandModel(hand.shape) for hand in take.hands)
    return right, left


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_and_settings(kind):
    take = short(kind)
    columns = take.points.shape[1]
    assert take.points.shape == (FRAMES, columns, 3)
    assert take.ids.shape == take.labels.shape == (FRAMES, columns)
    assert take.qpos.shape == (FRAMES, 2, 27)
    assert [hand.shape.side for hand in take.hands] == ["right", "left"]
    assert take.rate == RATE
    assert take.settings["kind"] == kind and take.settings["num_frames"] == FRAMES
    thing = {"hand-pen": "pen", "hand-controller": "controller"}.get(kind)
    assert [body.name for body in take.bodies] == ([thing] if thing else [])
    there = np.isfinite(take.points[..., 0])
    assert (take.labels[~there] == -1).all() and (take.ids[~there] == -1).all()
    for label in take.hand_labels:
        assert np.isfinite(take.observed(label)[..., 0]).mean() > 0.5, "clasped hands hide a lot"


@pytest.mark.parametrize("kind", [*KINDS, "the whole hand-controller"])
def test_every_frame_is_valid(kind):
    take = short(kind) if kind in KINDS else whole()
    right, left = models(take)
    for model, hand in zip((right, left), take.moving_hands(), strict=True):
        angles = hand.qpos[:, 7:]
        assert (angles >= LOW - 1e-9).all() and (angles <= HIGH + 1e-9).all()
        assert model.penetration(hand.qpos).max() <= SELF_DEEPEST + 1e-9
        assert np.abs(hand.qpos[:, :3] - ROOM_CENTER).max() <= WRIST_VOLUME, "where no camera may stand"
    assert hands_overlap(right, left, *(hand.qpos for hand in take.moving_hands())).max() <= DEEPEST
    for number, body in enumerate(take.bodies):
        thing, poses = named_object(body.name), pose_matrices(take.body_poses[:, number])
        for model, hand in zip((right, left), take.moving_hands(), strict=True):
            assert object_penetration(model, thing, hand.qpos, poses).max() <= DEEPEST


@pytest.mark.parametrize("kind", KINDS)
def test_hands_move_as_hands_do(kind):
    for hand in short(kind).moving_hands():
        wrist = np.linalg.norm(np.diff(hand.qpos[:, :3], axis=0), axis=1) * RATE
        assert wrist.max() < 3.0, "m/s"
        turns = quaternion_matrix(hand.qpos[:, 3:7])
        cosine = (np.einsum("tij,tij->t", turns[1:], turns[:-1]) - 1.0) / 2.0
        assert np.arccos(np.clip(cosine, -1.0, 1.0)).max() * RATE < 12.0, "rad/s"
        assert np.abs(np.diff(hand.qpos[:, 7:], axis=0)).max() * RATE < 15.0


def test_the_pen_points_at_markers_of_the_other_hand():
    take = short("hand-pen")
    tip = np.einsum(
        "tij,j->ti", pose_matrices(take.body_poses[:, 0]), np.append(named_object("pen").markers[0], 1.0)
    )
    away = np.linalg.norm(take.observed(take.hand_labels[1]) - tip[:, None, :3], axis=2)
    nearest = np.nanmin(away, axis=1)
    assert (nearest < 0.025).mean() > 0.4
    assert len(np.unique(np.nanargmin(away, axis=1)[nearest < 0.025])) >= 2


def test_a_seed_is_a_capture_and_a_glove_and_a_rig_may_be_others():
    config = SimulateSettings(kind="hand-hand", num_frames=40, glove="sparse13", rig="eight", seed=7)
    first, again = simulate_take(settings=config), simulate_take(settings=config)
    for name in ("points", "ids", "labels"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert first.hand_labels == (range(13), range(13, 26))


def test_a_rig_of_ones_own_is_kept_in_the_take_with_its_cameras(tmp_path):
    rig = mixed_rig()
    rig.save(tmp_path / "mixed.toml")
    takes = []
    for given in (rig, str(tmp_path / "mixed.toml")):
        take = simulate_take(num_frames=40, rig=given)
        take.save(tmp_path / "take.truth.npz")
        takes.append(load_take(tmp_path / "take.truth.npz"))
        assert load_rig(takes[-1].settings["rig"]) == rig
    np.testing.assert_array_equal(takes[0].points, takes[1].points)
    assert takes[0].markers_present().mean() > 0.4
    six = simulate_take(num_frames=40, rig=load_rig("six"))
    assert six.settings["rig"] == "six"
    np.testing.assert_array_equal(six.points, simulate_take(num_frames=40, rig="six").points)
    with pytest.raises(ArgumentError, match="rig is 3, expected a CameraRig, or the name or path of one"):
        simulate_take(num_frames=40, rig=3)


def thick_glove(folder: Path, radius_mm: float) -> str:
    file = folder / f"balls{radius_mm:g}.toml"
    dataclasses.replace(load_layout("dense19"), radius=radius_mm * 1e-3).save(file)
    return str(file)


def test_hands_move_where_the_center_is():
    shift = np.array([3.0, -2.0, 0.4])
    usual, rig = short("hand-pen"), load_rig("figure5")
    cameras = (camera.at(rigid(np.eye(3), shift) @ camera.T_world_camera) for camera in rig.cameras)
    options = dict(num_frames=usual.num_frames, rig=CameraRig("elsewhere", tuple(cameras)), others=0)
    take = simulate_take("hand-pen", center=tuple(ROOM_CENTER + shift), **options)
    np.testing.assert_allclose(take.qpos[..., :3], usual.qpos[..., :3] + shift, atol=1e-9)
    np.testing.assert_allclose(take.body_poses[..., :3], usual.body_poses[..., :3] + shift, atol=1e-9)
    assert take.settings["center"] == list(ROOM_CENTER + shift) and "center" not in usual.settings
    for one, other in zip(take.hand_labels, usual.hand_labels, strict=True):
        away = np.linalg.norm(take.observed(one) - shift - usual.observed(other), axis=-1)
        assert np.nanmedian(away) < 1e-6
        assert (np.isfinite(take.observed(one)) == np.isfinite(usual.observed(other))).mean() > 0.98
    with pytest.raises(ArgumentError, match="center is 51"):
        simulate_take("hand-pen", center=(51.0, 0.0, 1.0))


def test_the_gloves_radius_reaches_the_optics(tmp_path):
    """Balls of 16 mm merge where fingers lie side by side, and are told in the take's settings."""
    missing = {}
    for radius in (3.2, 8.0):
        config = SimulateSettings(kind="hand-hand", num_frames=120, glove=thick_glove(tmp_path, radius))
        take = simulate_take(settings=config)
        assert take.settings["room"]["optics"]["marker_radius"] == radius * 1e-3
        missing[radius] = 1.0 - take.markers_present().mean()
    assert missing[8.0] > 2.0 * missing[3.2]
    own = dataclasses.replace(config, optics=OpticsOptions(marker_radius=0.0032))
    assert 1.0 - simulate_take(settings=own).markers_present().mean() < missing[8.0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_single_frame_is_a_capture(kind):
    take = simulate_take(kind=kind, num_frames=1)
    assert take.num_frames == 1 and (take.labels >= 0).sum() > 30


def test_people_who_cannot_do_it_are_replaced_and_counted(monkeypatch):
    tried = []

    def out_of_reach(kind, fits, num_frames, *, rng):
        tried.append(fits)
        raise PoseError("this hand does not get hold of the pen")

    monkeypatch.setattr(takes, "sample_scene_motion", out_of_reach)
    with pytest.raises(PoseError, match="none of 10 people can do 'hand-pen'; the last: this hand does not"):
        simulate_take(kind="hand-pen", num_frames=5)
    assert len(tried) == 10

    def broken(kind, fits, num_frames, *, rng):
        raise ArgumentError("qpos has shape (3,), expected (..., 27)")

    monkeypatch.setattr(takes, "sample_scene_motion", broken)
    with pytest.raises(ArgumentError, match="qpos has shape"):
        simulate_take(kind="hand-pen", num_frames=5)


def test_the_whole_hand_controller_twin_is_near_table_3():
    take = whole()
    paper = TABLE3["hand-controller"]
    observed = np.concatenate([take.observed(label) for label in take.hand_labels], axis=1)
    ours = count_gaps(np.isfinite(observed[..., 0]))
    assert ours.frames == paper.frames == 2645
    for name in ("gaps", "average_length", "average_missing"):
        assert abs(getattr(ours, name) / getattr(paper, name) - 1.0) < 0.25, name


@pytest.mark.parametrize("kind", ["single-hand", "calibration", "free"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_one_hand_alone(kind, side):
    take = simulate_take(kind=kind, num_frames=FRAMES, hands=(side,))
    assert [hand.shape.side for hand in take.hands] == [side] and take.settings["hands"] == [side]
    assert take.num_frames == len(take.qpos) == FRAMES
    assert set(np.unique(take.labels)) <= {-1, *range(19)}
    assert np.isfinite(take.observed(take.hand_labels[0])).all(axis=-1).mean() > 0.8
    model = HandModel(take.hands[0].shape)
    assert model.penetration(take.qpos[:, 0]).max() <= SELF_DEEPEST + 1e-6
    assert np.ptp(take.qpos[:, 0][:, 7:], axis=0).max() > 0.1, "it moves"


def test_calibration_has_touches_and_free_motion_of_both_hands():
    take = simulate_take(kind="calibration", hands="right")
    assert take.num_frames > 45 * RATE, "40 s of free motion after the touches"
    for kind in ("calibration", "free"):
        take = simulate_take(kind=kind, num_frames=FRAMES)
        assert [hand.shape.side for hand in take.hands] == ["right", "left"] and "hands" not in take.settings
        assert take.num_frames == FRAMES
        assert np.linalg.norm(take.qpos[:, 0, :3] - take.qpos[:, 1, :3], axis=1).min() > 0.2


@pytest.mark.parametrize("kind", ["hand-hand", "hand-pen", "hand-controller", "real-like"])
def test_hands_that_belong_together_are_not_parted(kind):
    with error_names(ArgumentError, "hands are left, expected right and left, or one of them for the"):
        SimulateSettings(kind=kind, hands=("left",))
    with pytest.raises(ArgumentError, match="unknown hands 'both'"):
        SimulateSettings(hands=("both",))
