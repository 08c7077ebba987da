"""Touches: thumb and finger meet, pad to pad, on anybody's hand; MuJoCo measures the distance."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import HandModel, join_qpos, sample_shape
from handsim.errors import ArgumentError, PoseError
from handsim.hand.shape import SIDES, SIZES, bones_of
from poses.shapes import HIGH, LOW, MAX_PENETRATION, is_valid, resting_angles
from poses.touch import (
    FINGERS,
    MAX_OVERLAP,
    MIN_FACING,
    _nearest_points,
    is_touching,
    thumb_contact,
    touching_angles,
)
from tests.sentences import error_names


def _measured(model: HandModel, angles: np.ndarray, finger: str) -> tuple[float, np.ndarray]:
    """Distance [m] of the two last bones' capsules and the two nearest points (2, 3), by MuJoCo."""
    data = mujoco.MjData(model.mj_model)
    data.qpos[:] = join_qpos(angles[None])[0]
    mujoco.mj_forward(model.mj_model, data)
    geoms = [model.mj_model.geom(f"{digit}_distal_1").id for digit in ("thumb", finger)]
    line = np.zeros(6)
    return mujoco.mj_geomDistance(model.mj_model, data, *geoms, 1.0, line), line.reshape(2, 3)


def _surface_points(model: HandModel, angles: np.ndarray, finger: str) -> np.ndarray:
    """The points (2, 3) [m] of the surfaces of the two last bones that are nearest to the other one."""
    frames = model.forward_kinematics(join_qpos(angles[None]))
    capsules = [np.flatnonzero(model.capsules.bones == bone)[0] for bone in bones_of_pads(finger)]
    ends = _nearest_points(model.capsules.posed(frames)[:, capsules])[0]
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return ends + np.outer([1.0, -1.0] * model.capsules.radii[capsules], direction)


def bones_of_pads(finger: str) -> tuple[int, int]:
    """The last bones of the thumb and of a finger."""
    return bones_of("thumb")[2], bones_of(finger)[2]


def _check_touch(model: HandModel, angles: np.ndarray, finger: str) -> None:
    distance, _ = _measured(model, angles, finger)
    assert -MAX_OVERLAP <= distance <= 0.0
    assert abs(distance + MAX_OVERLAP / 2) <= 0.0003
    contact = thumb_contact(model, angles[None], finger)
    assert contact.overlap[0] == pytest.approx(-distance, abs=1e-7)
    assert (contact.facing >= MIN_FACING).all()
    assert is_touching(model, angles[None], finger)[0]
    assert is_valid(model, angles[None], max_penetration=MAX_PENETRATION)[0]
    assert (angles >= LOW).all()
    assert (angles <= HIGH).all()


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("size", SIZES)
def test_every_size_touches_with_every_finger(size, side):
    model = HandModel.named(size, side=side)
    for finger in FINGERS:
        angles = touching_angles(model, finger)
        _check_touch(model, angles, finger)


def test_nearly_everybody_touches_with_nearly_every_finger():
    rng = np.random.default_rng(7)
    done = asked = 0
    for number in range(20):
        model = HandModel(sample_shape(side=SIDES[number % 2], rng=rng))
        try:
            resting_angles(model)
        except PoseError:
            continue  # fingers too fat for this breadth; nobody's hand
        for finger in FINGERS:
            asked += 1
            try:
                angles = touching_angles(model, finger)
            except PoseError:
                continue
            _check_touch(model, angles, finger)
            done += 1
    assert asked >= 72
    assert done >= 0.95 * asked


@given(seed=st.integers(0, 10_000), finger=st.sampled_from(FINGERS))
@settings(max_examples=25, deadline=None)
def test_the_nearest_points_are_those_that_mujoco_finds(seed, finger):
    rng = np.random.default_rng(seed)
    model = HandModel.named("M", side=SIDES[seed % 2])
    angles = rng.uniform(LOW, HIGH)
    distance, points = _measured(model, angles, finger)
    contact = thumb_contact(model, angles[None], finger)
    assert contact.overlap[0] == pytest.approx(-distance, abs=1e-6)
    if distance > 1e-4:  # MuJoCo gives the middle of an overlap for both
        np.testing.assert_allclose(_surface_points(model, angles, finger), points, atol=1e-5)


def test_the_place_of_a_contact_is_on_both_pads():
    model = HandModel.named("L")
    for finger in FINGERS:
        angles = touching_angles(model, finger)
        frames = model.forward_kinematics(join_qpos(angles[None]))[0]
        for bone, point in zip(bones_of_pads(finger), _surface_points(model, angles, finger), strict=True):
            local = frames[bone, :3, :3].T @ (point - frames[bone, :3, 3])
            assert local[2] < 0.0  # the palm's side of the bone
            assert local[0] > 0.005  # not at its knuckle


def test_both_sides_touch_alike():
    right, left = (touching_angles(HandModel.named("M", side=side), "index") for side in ("right", "left"))
    np.testing.assert_allclose(right, left, atol=1e-5)


def test_only_thumb_and_finger_move_from_a_start():
    model = HandModel.named("M")
    start = touching_angles(model, "ring")
    start[:4] -= 0.05
    angles = touching_angles(model, "ring", start)
    rest = np.r_[4:12, 16:20]
    np.testing.assert_array_equal(angles[rest], start[rest])
    assert np.abs(angles - start).max() < 0.25


def test_bad_touches_are_told():
    model = HandModel.named("M")
    with error_names(ArgumentError, "unknown finger 'thumb'; valid names: index, middle, ring, little"):
        touching_angles(model, "thumb")
    with pytest.raises(ArgumentError, match=r"start has shape \(19,\), expected \(..., 20\)"):
        touching_angles(model, "index", np.zeros(19))
    shape = model.shape
    knuckles = shape.knuckles.copy()
    knuckles[0, 0] -= 0.08  # a thumb that sits behind the wrist
    stub = HandModel(dataclasses.replace(shape, knuckles=knuckles))
    with pytest.raises(PoseError, match="this hand's thumb and little finger could not be brought to touch"):
        touching_angles(stub, "little")
