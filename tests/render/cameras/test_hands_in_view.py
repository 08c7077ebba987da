"""All hands of a frame are in its pictures, and large: on keypoints alone, without drawing."""

from __future__ import annotations

import functools
from typing import get_args

import numpy as np
import pytest

from gloves.takes.take import Take
from handsim.hand.model import hand_keypoints
from render.cameras.viewpoints import PLACEMENTS, ViewConfig, Viewpoints
from render.subject import subject_of_poses
from train.simulation.takes import SimulatedKind, simulate_take

FRAMES, STEP = 480, 8
WHOLE, SIDE = 0.95, 0.30  # of pictures with all hands; a hand's longer side, of the height
APART = ("single-hand", "calibration", "free")  # kinds of takes with hands half a meter from each other
LEAST = {"rig": 0.2, "orbit": 0.25}  # of those, where cameras cannot stay where both are large
PLACED = [name for name in PLACEMENTS if name != "head"]


@functools.cache
def a_take(kind: str) -> Take:
    return simulate_take(kind=kind, num_frames=FRAMES, seed=5)


def measured(take: Take, config: ViewConfig, seed: int = 0) -> tuple[float, float]:
    """Share of pictures with all keypoints of all hands; median of a hand's longer side over the height."""
    viewpoints = Viewpoints(config, take, rng=np.random.default_rng(seed))
    whole, sides = [], []
    for frame in range(0, take.num_frames, STEP):
        hands = [
            hand_keypoints(hand.model, qpos[None])[0]
            for hand, qpos in zip(take.hands, take.qpos[frame], strict=True)
            if np.isfinite(qpos).all()
        ]
        for camera in viewpoints.cameras(frame) if hands else ():
            pixels = np.array([camera.project(points) for points in hands])
            whole.append(((pixels >= 0.0) & (pixels < camera.size)).all())
            sides += list(np.ptp(pixels, axis=1).max(axis=1) / camera.size[1])
    return float(np.mean(whole)), float(np.median(sides))


@pytest.mark.parametrize("placement", PLACED)
@pytest.mark.parametrize("kind", get_args(SimulatedKind))
def test_all_hands_are_in_the_picture_and_large(kind, placement):
    whole, side = measured(a_take(kind), ViewConfig(placement))
    assert whole >= WHOLE, f"{whole:.1%} of pictures show all hands"
    least = LEAST.get(placement, SIDE) if kind in APART else SIDE
    assert side >= least, f"a hand's longer side is {side:.1%} of the height"


def test_one_lens_serves_a_rig_unless_hands_would_be_small():
    for kind, zooms in (("hand-hand", False), ("single-hand", True)):
        viewpoints = Viewpoints(ViewConfig("rig"), a_take(kind), rng=np.random.default_rng(0))
        lenses = {
            (number, camera.K[0, 0])
            for frame in range(0, FRAMES, STEP)
            for number, camera in enumerate(viewpoints.cameras(frame))
        }
        assert (len(lenses) > viewpoints.num_cameras) == zooms


def test_a_share_is_kept():
    take = a_take("hand-hand")
    for share in (0.2, 0.4):
        whole, side = measured(take, ViewConfig("anywhere", share=share))
        assert whole == 1.0 and share <= side <= 1.4 * share


def test_a_still_camera_stays_where_that_is_enough():
    quiet = subject_of_poses(np.linspace(np.zeros(20), np.full(20, 0.1), 30), model="M").take
    for take, moves in ((quiet, False), (a_take("free"), True)):
        viewpoints = Viewpoints(ViewConfig(), take, rng=np.random.default_rng(0))
        places = np.array([viewpoints.cameras(n)[0].T_world_camera for n in (0, take.num_frames - 1)])
        assert (places[0] != places[1]).any() == moves


def test_a_distance_is_kept_though_hands_leave_the_picture():
    whole, side = measured(a_take("hand-hand"), ViewConfig("orbit", distance=(0.3, 0.3)))
    assert whole < 1.0 and side > 1.5 * SIDE
