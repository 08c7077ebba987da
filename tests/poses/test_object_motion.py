"""Hands that hold objects, play with them and point with them."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gloves import load_layout
from gloves.fit import attach_markers
from handsim import HandModel, HandMotion, RigidObject, join_qpos, sample_shape
from handsim.errors import ArgumentError, PoseError
from handsim.hand.shape import DIGITS, bones_of, shape_from_measures
from handsim.space.objects import load_object, named_object, object_names
from handsim.space.transforms import MIRROR, pose_matrices
from poses import MotionConfig
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
from poses.object_motion import (
    PATH_TIMES,
    PEN_TURN_SPEED,
    RETREAT_DISTANCE,
    TIP_DISTANCE,
    TIP_SPEED,
    keep_apart,
    point_pen,
    pointing_path,
    sample_object_motion,
)
from poses.shapes import MAX_PENETRATION, is_valid, resting_angles
from tests.meshes import hands_overlap, winding

FACETS = 0.0008  # a mesh of few triangles lies inside the round part it stands for [m]
RATE = 120.0
FRAMES = 600


@pytest.fixture(scope="module")
def held() -> dict[str, tuple[HandModel, RigidObject, Hold]]:
    """Every object in a hand, left and right in turn, sizes in turn."""
    holds = {}
    for number, name in enumerate(object_names()):
        model = HandModel.named(("M", "XS", "XL", "S", "L")[number], side=("right", "left")[number % 2])
        obj = named_object(name)
        holds[name] = model, obj, settle_hold(model, obj, rng=np.random.default_rng(number))
    return holds


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
    with pytest.raises(ArgumentError, match=r"unknown hold of the pen 'tripood' \(did you mean 'tripod'\?\)"):
        settle_hold(model, pen, hold="tripood", rng=rng)
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


@functools.cache
def hands() -> tuple[HandModel, HandModel]:
    return HandModel.named("M"), HandModel.named("M", side="left")


def resting(hand: HandModel, frames: int, place: tuple[float, float, float] = (-0.2, 0.0, 1.1)) -> HandMotion:
    """Fingers along +y, palm down."""
    turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    angles = np.tile(resting_angles(hand), (frames, 1))
    return HandMotion(join_qpos(angles, position=np.array(place), quaternion=turn), RATE)


def markers_of(hand: HandModel, motion: HandMotion) -> tuple[np.ndarray, np.ndarray]:
    glove = attach_markers(load_layout("dense19"), hand)
    return glove.markers(hand, hand.forward_kinematics(motion.qpos))


def turns(poses: np.ndarray) -> np.ndarray:
    """Speed of turning between frames [rad/s]."""
    steps = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    return np.linalg.norm(Rotation.from_matrix(steps).as_rotvec(), axis=1) * RATE


def speeds(places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(places, axis=0), axis=1) * RATE


def test_the_tip_visits_its_places_at_its_distance(rng):
    places, outward = markers_of(hands()[1], resting(hands()[1], 2400))
    path = pointing_path(places, outward, RATE, rng=rng)
    tip, axis = path[:, :3, 3], path[:, :3, 2]
    still = np.concatenate([[False], speeds(tip) < 1e-9])
    assert 0.2 < still.mean() < 0.7
    distances = np.linalg.norm(tip[:, None] - places, axis=2)
    # A stay is at a place: straight along the pen at an allowed distance.
    straight = tip[:, None] - distances[..., None] * axis[:, None]
    aimed = np.linalg.norm(straight - places, axis=2) < 1e-9
    assert aimed[still].any(axis=1).all()
    target = aimed.argmax(axis=1)
    off = distances[np.arange(len(tip)), target][still]
    low, high = TIP_DISTANCE
    assert off.min() >= low - 1e-9 and off.max() <= high + 1e-9
    facing = np.einsum("ti,ti->t", axis, outward[np.arange(len(tip)), target])[still]
    assert facing.min() > 0.0, "the pen comes from outside"
    assert len(np.unique(target[still])) >= 6


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_whatever_it_points_at_the_pen_never_jumps(seed):
    rng = np.random.default_rng(seed)
    places = np.tile(rng.uniform(-0.2, 0.2, size=(6, 3)), (FRAMES, 1, 1))
    outward = rng.standard_normal((6, 3))
    outward = np.tile(outward / np.linalg.norm(outward, axis=1, keepdims=True), (FRAMES, 1, 1))
    path = pointing_path(places, outward, RATE, rng=rng)
    assert path.shape == (FRAMES, 4, 4) and np.isfinite(path).all()
    square = path[:, :3, :3] @ np.swapaxes(path[:, :3, :3], 1, 2)
    np.testing.assert_allclose(square, np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-9)
    assert (np.linalg.det(path[:, :3, :3]) > 0.0).all()
    lifting = 2.6 * RETREAT_DISTANCE / PATH_TIMES[0] * 1.875
    assert speeds(path[:, :3, 3]).max() < TIP_SPEED + lifting + 0.1
    assert turns(path).max() < 2.0 * PEN_TURN_SPEED


def test_it_follows_places_that_move(rng, monkeypatch):
    monkeypatch.setattr("poses.object_motion.TIP_SPEED", 50.0)
    hand = hands()[1]
    motion = resting(hand, FRAMES)
    places, outward = markers_of(hand, motion)
    shift = np.linspace(0.0, 0.3, FRAMES)[:, None] * [1.0, 0.0, 0.0]
    seed = int(rng.integers(1000))
    still = pointing_path(places, outward, RATE, rng=np.random.default_rng(seed))
    moving = pointing_path(places + shift[:, None], outward, RATE, rng=np.random.default_rng(seed))
    np.testing.assert_allclose(moving[:, :3, 3] - shift, still[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(moving[:, :3, :3], still[:, :3, :3], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_pen_keeps_steady_over_fingers_that_flutter(seed):
    """A finger that taps twice a second turns its markers by up to 10 rad/s; the pen must not go along."""
    rng = np.random.default_rng(seed)
    angle = 0.8 * np.sin(4.0 * np.pi * np.arange(FRAMES) / RATE)[:, None] + rng.uniform(-0.5, 0.5, size=6)
    outward = np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=-1)
    places = np.tile(rng.uniform(-0.1, 0.1, size=(6, 3)), (FRAMES, 1, 1))
    path = pointing_path(places, outward, RATE, rng=rng)
    assert turns(path).max() < 5.0


def test_a_hand_leads_the_pen_without_touching_the_other(rng):
    right, left = hands()
    pen = named_object("pen")
    held = sample_object_motion(right, pen, FRAMES / RATE, rng=rng)
    held = HandMotion(held[0].qpos[:FRAMES], RATE), type(held[1])(held[1].T_world_body[:FRAMES], RATE)
    other = resting(left, FRAMES)
    places, outward = markers_of(left, other)
    path = pointing_path(places, outward, RATE, rng=rng)
    motion, body = point_pen(right, left, pen, held, other, path)
    # What the fingers do, and how the pen lies in the hand, is as it was.
    np.testing.assert_array_equal(motion.qpos[:, 7:], held[0].qpos[:, 7:])
    before, after = (
        np.linalg.inv(pose_matrices(hand.qpos[:, :7])) @ thing.T_world_body
        for hand, thing in (held, (motion, body))
    )
    np.testing.assert_allclose(after, before, atol=1e-9)
    assert hands_overlap(right, left, motion.qpos, other.qpos).max() <= 0.001
    assert object_penetration(left, pen, other.qpos, body.T_world_body).max() <= 0.001
    tip = np.einsum("tij,j->ti", body.T_world_body, np.append(pen.markers[0], 1.0))[:, :3]
    assert (np.linalg.norm(tip[:, None] - places, axis=2).min(axis=1) < 0.025).mean() > 0.4
    # Drawn back only along the pen, as far as it takes and no jump.
    back = tip - path[:, :3, 3]
    wobble = before[:, :3, 3] - before[:, :3, 3].mean(axis=0)
    assert np.linalg.norm(np.cross(back, path[:, :3, 2]), axis=1).max() < 0.02 + np.abs(wobble).max()
    assert speeds(tip).max() < 1.4
    assert speeds(motion.qpos[:, :3]).max() < 2.0
    assert turns(body.T_world_body).max() < 7.0


def test_a_hand_makes_room_only_where_it_must_and_smoothly(rng):
    right, left = hands()
    controller = named_object("controller")
    motion, body = sample_object_motion(right, controller, FRAMES / RATE, rng=rng)
    held = HandMotion(motion.qpos[:FRAMES], RATE), type(body)(body.T_world_body[:FRAMES], RATE)
    # Where the other hand's wrist goes through the first one's in the middle of the motion.
    there = held[0].qpos[FRAMES // 2, :3]
    other = resting(left, FRAMES, tuple(there))
    assert hands_overlap(right, left, held[0].qpos, other.qpos).max() > 0.01
    aside = np.tile([1.0, 0.0, 0.0], (FRAMES, 1))
    moved, carried = keep_apart(right, left, controller, held, other, aside)
    assert hands_overlap(right, left, moved.qpos, other.qpos).max() <= 0.001
    assert object_penetration(left, controller, other.qpos, carried.T_world_body).max() <= 0.001
    np.testing.assert_array_equal(moved.qpos[:, 1:2], held[0].qpos[:, 1:2])
    np.testing.assert_array_equal(moved.qpos[:, 3:], held[0].qpos[:, 3:])
    shift = moved.qpos[:, 0] - held[0].qpos[:, 0]
    np.testing.assert_allclose(
        carried.T_world_body[:, 0, 3] - held[1].T_world_body[:, 0, 3], shift, atol=1e-12
    )
    assert shift.min() >= 0.0 and np.abs(np.diff(shift)).max() * RATE < 2.5
    far = HandMotion(np.concatenate([other.qpos[:, :3] - [1.0, 0.0, 0.0], other.qpos[:, 3:]], axis=1), RATE)
    same, _ = keep_apart(right, left, controller, held, far, aside)
    np.testing.assert_array_equal(same.qpos, held[0].qpos)


def test_hands_that_cannot_part_are_told(rng):
    right, left = hands()
    controller = named_object("controller")
    held = sample_object_motion(right, controller, 30 / RATE, rng=rng)
    other = resting(left, len(held[0].qpos), tuple(held[0].qpos[0, :3]))
    with pytest.raises(PoseError, match="however far one of them draws back"):
        keep_apart(right, left, controller, held, other, np.zeros((len(held[0].qpos), 3)))
