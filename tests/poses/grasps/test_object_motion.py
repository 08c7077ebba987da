"""Grasps hold, dig in nowhere, and hands that play with things stay valid at every frame."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS, bones_of, sample_shape, shape_from_measures
from handsim.space.objects import RigidObject, load_object, named_object, object_names
from handsim.space.transforms import MIRROR
from poses.grasps import (
    MAX_OBJECT_PENETRATION,
    GraspScene,
    Hold,
    grasp_scene,
    hold_names,
    hold_style,
    object_penetration,
    place_object,
    retarget_angles,
    sample_held_poses,
    settle_hold,
)
from poses.motion import MotionConfig
from poses.object_motion import sample_object_motion
from poses.shapes import MAX_PENETRATION, is_valid

FACETS = 0.0008  # a mesh of few triangles lies inside the round part it stands for [m]


@pytest.fixture(scope="module")
def held() -> dict[str, tuple[HandModel, RigidObject, Hold]]:
    """Every object in a hand, left and right in turn, sizes in turn."""
    holds = {}
    for number, name in enumerate(object_names()):
        model = HandModel.named(("M", "XS", "XL", "S", "L")[number], side=("right", "left")[number % 2])
        obj = named_object(name)
        holds[name] = model, obj, settle_hold(model, obj, rng=np.random.default_rng(number))
    return holds


def winding(solid: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How often a closed surface goes around points (Van Oosterom and Strackee's solid angles): 1 inside."""
    a, b, c = (solid.triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    dot = np.einsum("pfi,pfi->pf", a, b) * lc + np.einsum("pfi,pfi->pf", b, c) * la
    dot += np.einsum("pfi,pfi->pf", c, a) * lb + la * lb * lc
    return 2 * np.arctan2(np.einsum("pfi,pfi->pf", a, np.cross(b, c)), dot).sum(axis=1) / (4 * np.pi)


def depth_in_mesh(model: HandModel, obj: RigidObject, angles: np.ndarray, pose: np.ndarray) -> float:
    """How deep capsules reach into an object's closed meshes [m], by points on their axes and trimesh."""
    bones = model.forward_kinematics(join_qpos(angles[None]))
    segments = model.capsules.posed(bones)[0]
    share = np.linspace(0.0, 1.0, 25)[:, None]
    points = segments[:, :1] + share * (segments[:, 1:] - segments[:, :1])
    local = (points.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
    radii = np.repeat(model.capsules.radii, len(share))
    deepest = 0.0
    for solid in trimesh.Trimesh(obj.vertices, obj.faces, process=False).split(only_watertight=False):
        distance = trimesh.proximity.closest_point_naive(solid, local)[1]
        inside = np.abs(winding(solid, local)) > 0.5
        deepest = max(deepest, float((radii - np.where(inside, -distance, distance)).max()))
    return deepest


@pytest.mark.parametrize("name", object_names())
def test_depth_agrees_with_the_mesh(held, name):
    model, obj, hold = held[name]
    angles = np.tile(hold.angles, (3, 1))
    poses = np.tile(hold.T_wrist_object, (3, 1, 1))
    poses[1, :3, 3] += (0.002, 0.001, 0.003)
    poses[2, 2, 3] -= 0.004
    ours = object_penetration(model, obj, join_qpos(angles), poses)
    for number in range(3):
        theirs = depth_in_mesh(model, obj, angles[number], poses[number])
        assert ours[number] - FACETS <= theirs + 1e-4
        assert theirs <= ours[number] + 3e-4


@pytest.mark.parametrize("name", object_names())
def test_holds_are_valid_and_name_what_touches(held, name):
    model, obj, hold = held[name]
    qpos = join_qpos(hold.angles[None])
    assert is_valid(model, hold.angles[None]).all()
    assert model.penetration(qpos)[0] <= MAX_PENETRATION
    assert object_penetration(model, obj, qpos, hold.T_wrist_object[None])[0] <= MAX_OBJECT_PENETRATION
    style = hold_style(model, obj, hold.name)
    for need in style.needs:
        assert any(contact.startswith(need) for contact in hold.contacts)
    away = hold.T_wrist_object.copy()
    away[2, 3] -= 1.0
    assert object_penetration(model, obj, qpos, away[None])[0] == 0.0


@pytest.mark.parametrize("name", object_names())
def test_holds_survive_gravity_from_every_side(held, name):
    """Gravity of the model itself, on hand and thing, a quarter of a second each way."""
    import mujoco

    model, obj, hold = held[name]
    scene = GraspScene(model, obj)  # not the shared one: its gravity changes
    style = hold_style(model, obj, hold.name)
    data = scene.new_data(hold.angles, hold.T_wrist_object)
    torque = style.strength * scene.mj_model.actuator_forcerange[:, 1]
    reach = torque / scene.mj_model.actuator_gainprm[:, 0]
    data.ctrl[:] = hold.angles + np.clip(style.closed - hold.angles, -reach, reach)
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        scene.mj_model.opt.gravity = 9.81 * direction
        mujoco.mj_step(scene.mj_model, data, nstep=125)
        moved = np.linalg.norm(scene.object_pose(data)[:3, 3] - hold.T_wrist_object[:3, 3])
        assert moved < 0.008
    scene.mj_model.opt.gravity = 0.0
    data.ctrl[:] = style.open  # let go: the same shaking now takes it away
    scene.mj_model.opt.gravity = (0.0, 0.0, -9.81)
    mujoco.mj_step(scene.mj_model, data, nstep=500)
    assert np.linalg.norm(scene.object_pose(data)[:3, 3] - hold.T_wrist_object[:3, 3]) > 0.02


def test_a_pen_is_held_by_three_digits_and_its_shaft_rests_beside_the_index(held):
    model, _, hold = held["pen"]
    assert {"thumb_distal_1", "index_distal_1", "middle_distal_1"} <= set(hold.contacts)
    tip, end = (hold.T_wrist_object @ np.array([0, 0, z, 1.0]) for z in (-0.07, 0.07))
    assert tip[2] < -0.04 < end[2], "the tip is on the palm's side, the end towards the back"
    assert (end - tip)[1] * (1 if model.shape.side == "right" else -1) > 0, (
        "the end leans to the thumb's side"
    )


def test_a_left_hand_places_things_as_the_mirror_image_does():
    mirror = np.diag([*np.diag(MIRROR), 1.0])
    for name in object_names():
        obj = named_object(name)
        right, left = (
            place_object(
                grasp_scene(model, obj),
                hold_style(model, obj, hold_names(obj)[0]),
                rng=np.random.default_rng(1),
            )
            for model in (HandModel.named("M"), HandModel.named("M", side="left"))
        )
        # The pen's roll about its own axis is free, and mirrored with it.
        np.testing.assert_allclose(left, mirror @ right @ mirror, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_random_adults_get_hold_of_things(seed):
    rng = np.random.default_rng(100 + seed)
    model = HandModel(sample_shape(rng=rng, side=("left", "right")[seed % 2]))
    for name in ("pen", "mug"):
        obj = named_object(name)
        hold = settle_hold(model, obj, rng=rng)
        assert object_penetration(model, obj, join_qpos(hold.angles[None]), hold.T_wrist_object[None])[0] <= (
            MAX_OBJECT_PENETRATION
        )


def test_retargeted_tips_are_where_the_mean_hand_has_them():
    rng = np.random.default_rng(4)
    mean = HandModel.named("M")
    angles = hold_style(mean, named_object("pen"), "tripod").open
    np.testing.assert_allclose(retarget_angles(mean, angles[None])[0], angles, atol=1e-9)
    misses, before = [], []
    for _ in range(5):
        shape = sample_shape(rng=rng)
        model = HandModel(shape)
        goal = _tips(HandModel(shape_from_measures(shape.length, shape.breadth)), angles)
        misses.append(
            np.linalg.norm(_tips(model, retarget_angles(model, angles[None])[0]) - goal, axis=1).mean()
        )
        before.append(np.linalg.norm(_tips(model, angles) - goal, axis=1).mean())
    assert np.mean(misses) < 0.35 * np.mean(before)
    assert np.mean(misses) < 0.004


def _tips(model: HandModel, angles: np.ndarray) -> np.ndarray:
    last = [bones_of(digit)[2] for digit in DIGITS]
    bones = model.forward_kinematics(join_qpos(angles[None]))[0, last]
    return bones[:, :3, 3] + model.skeleton.lengths[last, None] * bones[:, :3, 0]


@pytest.mark.parametrize("name", object_names())
def test_variants_of_a_hold_are_valid_and_vary(held, name, rng):
    model, obj, hold = held[name]
    angles, poses = sample_held_poses(model, obj, hold, 200, rng=rng)
    assert is_valid(model, angles).all()
    assert object_penetration(model, obj, join_qpos(angles), poses).max() <= MAX_OBJECT_PENETRATION
    free = [4 * DIGITS.index(digit) + 1 for digit in hold_style(model, obj, hold.name).free]
    assert (np.ptp(angles[:, free], axis=0) > np.deg2rad(5.0)).any(), "free digits must lift"
    assert len(np.unique(poses[:, 0, 3])) > 50
    assert np.abs(poses[:, :3, 3] - hold.T_wrist_object[:3, 3]).max() < 0.003


@pytest.mark.parametrize("name", object_names())
def test_every_frame_of_a_motion_is_valid(name):
    side = "left" if name in ("pen", "box") else "right"
    model, obj, config = HandModel.named("M", side=side), named_object(name), MotionConfig()
    hand, body = sample_object_motion(model, obj, 5.0, rng=np.random.default_rng(6))
    assert hand.qpos.shape == (601, 27)
    assert body.T_world_body.shape == (601, 4, 4)
    assert hand.rate == body.rate == 120.0
    assert is_valid(model, hand.qpos[:, 7:]).all()
    assert model.penetration(hand.qpos).max() <= MAX_PENETRATION
    assert object_penetration(model, obj, hand.qpos, body.T_world_body).max() <= MAX_OBJECT_PENETRATION
    speeds = hand.speeds()
    assert np.abs(speeds).max() <= config.max_speed
    assert np.abs(np.diff(speeds, axis=0) * hand.rate).max() <= config.max_acceleration
    assert np.ptp(body.T_world_body[:, :3, 3], axis=0).min() > 0.03, "the hand must carry it"
    assert np.ptp(hand.qpos[:, 7:], axis=0).max() > np.deg2rad(10.0), "fingers must play"
    step = np.linalg.norm(np.diff(body.T_world_body[:, :3, 3], axis=0), axis=1)
    assert step.max() * body.rate < 4.0, "no jumps"


def test_same_seed_same_motion():
    model, pen = HandModel.named("M"), named_object("pen")
    first, second = (sample_object_motion(model, pen, 0.5, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first[0].qpos, second[0].qpos)
    np.testing.assert_array_equal(first[1].T_world_body, second[1].T_world_body)


def test_a_thing_of_ones_own_is_held(tmp_path):
    mesh = trimesh.creation.cylinder(radius=0.022, height=0.11, sections=24)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.0, [1, 2, 3], [0.1, 0, 0]))
    mesh.export(tmp_path / "can.stl")
    model, obj = HandModel.named("M"), load_object(tmp_path / "can.stl")
    hold = settle_hold(model, obj, rng=np.random.default_rng(0))
    depth = object_penetration(model, obj, join_qpos(hold.angles[None]), hold.T_wrist_object[None])
    assert depth[0] <= MAX_OBJECT_PENETRATION


def test_bad_requests_are_told(held, rng):
    model, pen, hold = held["pen"]
    with pytest.raises(ArgumentError, match="the duration is 0 s, expected a positive number"):
        sample_object_motion(model, pen, 0.0, rng=rng)
    with pytest.raises(ArgumentError, match=r"unknown hold of the pen 'tripood' \(did you mean 'tripod'\?\)"):
        settle_hold(model, pen, hold="tripood", rng=rng)
    with pytest.raises(ArgumentError, match="qpos has 1 frames and T_world_object 2, expected equal numbers"):
        object_penetration(model, pen, np.eye(27)[3:4], np.tile(np.eye(4), (2, 1, 1)))
    inside = hold.T_wrist_object.copy()
    inside[:3, 3] = (0.05, 0.0, 0.0)
    bad = Hold(hold.name, hold.angles, inside, hold.contacts)
    with pytest.raises(PoseError, match="the hold 'tripod' is not valid for this hand and the pen"):
        sample_held_poses(model, pen, bad, 1, rng=rng)


def test_what_no_hand_can_hold_is_told(tmp_path, rng):
    trimesh.creation.icosphere(subdivisions=2, radius=0.4).export(tmp_path / "globe.stl")
    globe = load_object(tmp_path / "globe.stl", mass=5.0)
    with pytest.raises(PoseError, match=r"this hand does not get hold of the globe.stl in \d+ tries"):
        settle_hold(HandModel.named("XS"), globe, rng=rng)
