"""Scenes that are made faster: the same poses, fewer of them."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.layout import load_layout
from train.simulation.scenes import RATE
from train.simulation.takes import sample_scene


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_faster_scene_passes_through_the_same_poses(times, rng):
    scene = sample_scene("hand-controller", load_layout("dense19"), 31, rng=rng)
    fast = scene.faster(times)
    assert fast.rate == scene.rate == RATE
    assert fast.num_frames == -(-31 // times)
    for hand, before in zip(fast.hands, scene.hands, strict=True):
        assert hand.fit is before.fit
        np.testing.assert_array_equal(hand.qpos, before.qpos[::times])
    held, before = fast.moving_object, scene.moving_object
    np.testing.assert_array_equal(held.motion.T_world_body, before.motion.T_world_body[::times])
    assert held.motion.rate == RATE
