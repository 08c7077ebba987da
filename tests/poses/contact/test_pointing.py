"""A pen that points: where its tip is, how it stands, that it never jumps, and that hands stay apart."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gloves.fit import attach_markers
from gloves.layout import load_layout
from handsim.errors import PoseError
from handsim.hand.model import HandModel, HandMotion, join_qpos
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices
from poses.grasps import object_penetration
from poses.object_motion import (
    DISTANCE,
    PATH,
    RETREAT,
    SPEED,
    TURNING,
    keep_apart,
    point_pen,
    pointing_path,
    sample_object_motion,
)
from poses.shapes import resting_angles
from poses.two_hands import two_hands_penetration

RATE = 120.0
FRAMES = 600


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
    low, high = DISTANCE
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
    lifting = 2.6 * RETREAT / PATH[0] * 1.875
    assert speeds(path[:, :3, 3]).max() < SPEED + lifting + 0.1
    assert turns(path).max() < 2.0 * TURNING


def test_it_follows_places_that_move(rng):
    hand = hands()[1]
    motion = resting(hand, FRAMES)
    places, outward = markers_of(hand, motion)
    shift = np.linspace(0.0, 0.3, FRAMES)[:, None] * [1.0, 0.0, 0.0]
    seed = int(rng.integers(1000))
    still = pointing_path(places, outward, RATE, speed=50.0, rng=np.random.default_rng(seed))
    moving = pointing_path(
        places + shift[:, None], outward, RATE, speed=50.0, rng=np.random.default_rng(seed)
    )
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


def test_the_same_seed_leads_the_same_way():
    places, outward = markers_of(hands()[1], resting(hands()[1], 100))
    first, again, other = (
        pointing_path(places, outward, RATE, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


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
    assert two_hands_penetration(right, left, motion.qpos, other.qpos).max() <= 0.001
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
    assert two_hands_penetration(right, left, held[0].qpos, other.qpos).max() > 0.01
    aside = np.tile([1.0, 0.0, 0.0], (FRAMES, 1))
    moved, carried = keep_apart(right, left, controller, held, other, aside)
    assert two_hands_penetration(right, left, moved.qpos, other.qpos).max() <= 0.001
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
