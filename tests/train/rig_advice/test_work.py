"""Hands at work: where they are, and what is taken of a take."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.layout import load_layout
from handsim.errors import CaptureError
from train.rig_advice.work import moved, sample_work, work_of_take
from train.simulation.takes import simulate_take


def test_people_walk_through_a_long_volume():
    center, sides = np.array([5.0, 1.0, 1.3]), np.array([4.0, 0.6, 0.6])
    rng = np.random.default_rng(0)
    work = sample_work(load_layout("tips8"), center, sides, 1500, 1, rng=rng)
    wrists = np.concatenate([hand.qpos[:, :3] for one in work.values() for hand in one[0].hands])
    away = wrists - center
    assert np.ptp(away[:, 0]) > 3.0 and np.abs(away[:, 0]).max() < 2.4
    assert np.abs(away[:, 1:]).max() < 0.6


def test_an_object_stays_in_the_hand(work):
    scene = work[-1]
    offset = np.tile([1.0, 2.0, 0.1], (scene.num_frames, 1))
    there = moved(scene, offset)
    before, after = (
        one.moving_object.motion.T_world_body[:, :3, 3] - one.hands[0].qpos[:, :3] for one in (scene, there)
    )
    assert after == pytest.approx(before)
    assert there.hands[1].qpos[:, :3] - scene.hands[1].qpos[:, :3] == pytest.approx(offset)


def test_a_take_keeps_its_place_and_its_stretches():
    take = simulate_take("hand-pen", num_frames=60, glove="tips8")
    (scene,) = work_of_take(take, None, 40)["the take"]
    assert scene.num_frames == 40 and scene.moving_object is not None
    assert scene.hands[0].qpos == pytest.approx(take.qpos[:40, 0])
    assert scene.hands[0].fit.layout.num_markers == 8
    take.qpos[20:30, 0] = np.nan
    parts = work_of_take(take, load_layout("dense19"), 1000)["the take"]
    assert [one.num_frames for one in parts] == [20, 30]
    assert parts[0].hands[1].fit.layout.num_markers == 19
    take.qpos[:, 1] = np.nan
    with pytest.raises(CaptureError, match="no 12 frames in a row"):
        work_of_take(take, None, 1000)
