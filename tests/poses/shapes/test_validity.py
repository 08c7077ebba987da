"""Every sampled pose is one a body could strike."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import EVERYBODY, SIDES, sample_shape
from poses.shapes import (
    HIGH,
    LOW,
    MAX_PENETRATION,
    PoseMix,
    all_gestures,
    apply_couplings,
    gesture,
    gesture_names,
    is_valid,
    make_valid,
    resting_angles,
    sample_angles,
    sample_valid_angles,
)


@given(seed=st.integers(0, 10_000), side=st.sampled_from(SIDES))
@settings(max_examples=10, deadline=None)
def test_sampled_poses_are_inside_ranges_and_hardly_touch(seed, side):
    rng = np.random.default_rng(seed)
    model = HandModel(sample_shape(EVERYBODY, side=side, rng=rng))
    try:
        resting_angles(model)
    except PoseError:
        return  # fingers too fat for this breadth; the generator draws another hand
    angles = sample_valid_angles(model, 300, rng=rng)
    assert (angles >= LOW).all()
    assert (angles <= HIGH).all()
    assert model.penetration(join_qpos(angles)).max() <= MAX_PENETRATION == 0.001


def test_valid_poses_stay_as_they_are_and_tight_ones_open_only_so_far(rng):
    model = HandModel.named("M")
    angles = sample_angles(500, rng=rng)
    valid = is_valid(model, angles)
    made = make_valid(model, angles)
    np.testing.assert_array_equal(made[valid], angles[valid])
    resting = resting_angles(model)
    towards = (made - angles) * (resting - angles)
    assert (towards >= -1e-12).all(), "a joint may only move towards rest"
    assert not (made == resting).all(axis=1).any()


def test_couplings_are_a_projection(rng):
    angles = rng.uniform(LOW - 0.5, HIGH + 0.5, size=(500, 20))
    once = apply_couplings(angles)
    np.testing.assert_allclose(apply_couplings(once), once, atol=1e-12)
    bent, straight = np.zeros((1, 20)), np.zeros((1, 20))
    bent[0, [4, 5, 9, 13]] = np.deg2rad([22.0, 90.0, 90.0, 90.0])
    straight[0, 4] = np.deg2rad(22.0)
    assert apply_couplings(bent)[0, 4] < 0.3 * apply_couplings(straight)[0, 4]


def test_each_source_of_poses_differs_from_the_others(rng):
    spreads = [
        sample_angles(3000, mix, rng=rng).std(axis=0)
        for mix in (PoseMix(1, 0, 0), PoseMix(0, 1, 0), PoseMix(0, 0, 1))
    ]
    assert all((spread > 0.01).all() for spread in spreads)
    assert spreads[2].mean() > spreads[0].mean()


def test_neighboring_fingers_move_together(rng):
    flexion = sample_angles(5000, rng=rng).reshape(-1, 5, 4)[:, 1:, 1]
    correlation = np.corrcoef(flexion.T)
    assert correlation[1, 2] > 0.4
    assert correlation[0, 3] < correlation[1, 2]


def test_gestures_are_inside_ranges_and_named():
    assert len(gesture_names()) == len(all_gestures()) > 40
    assert (all_gestures() >= LOW).all()
    assert (all_gestures() <= HIGH).all()
    with pytest.raises(ArgumentError, match=r"unknown gesture 'fits' .*did you mean 'fist'"):
        gesture("fits")


@pytest.mark.parametrize("name", gesture_names())
def test_gestures_can_be_struck_by_the_mean_hand(name):
    model = HandModel.named("M")
    depth = model.penetration(join_qpos(gesture(name)[None]))[0]
    assert depth <= MAX_PENETRATION


def test_a_hand_without_room_for_its_fingers_is_told():
    import dataclasses

    shape = HandModel.named("M").shape
    fat = dataclasses.replace(shape, radii=shape.radii * 1.6)
    with pytest.raises(PoseError, match="fingers overlap at rest"):
        resting_angles(HandModel(fat))
