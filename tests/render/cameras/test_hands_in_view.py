"""All hands of a frame are in its pictures, and large: on keypoints alone, without drawing."""

from __future__ import annotations

import functools
from typing import get_args

import numpy as np
import pytest

from gloves.takes.take import Take
from handsim.hand.keypoints import hand_keypoints
from render.cameras.viewpoints import PLACEMENTS, ViewConfig, Viewpoints
from render.subject import subject_of_poses
from train.simulation.takes import SimulatedKind, simulate_take

FRAMES, STEP = 480, 8
WHOLE, SIDE = 0.95, 0.30  # of pictures with all hands; a hand's longer side, of the height
FULL = {"still": 0.75, "orbit": 0.75, "anywhere": 0.75, "rig": 0.5}  # of half a picture: hands reach as far
PLACED = [name for name in PLACEMENTS if name != "head"]


@functools.cache
def a_take(kind: str) -> Take:
    return simulate_take(kind=kind, num_frames=FRAMES, seed=5)


def measured(take: Take, config: ViewConfig, seed: int = 0) -> tuple[float, float, float]:
    """Share of pictures with all keypoints of all hands; medians of a hand's longer side over the height, and
    of how far hands reach from the middle, in half pictures."""
    viewpoints = Viewpoints(config, take, rng=np.random.default_rng(seed))
    whole, sides, reach = [], [], []
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
            reach.append(np.abs(2.0 * pixels / camera.size - 1.0).max())
    return float(np.mean(whole)), float(np.median(sides)), float(np.median(reach))


@pytest.mark.parametrize("placement", PLACED)
@pytest.mark.parametrize("kind", get_args(SimulatedKind))
def test_all_hands_are_in_the_picture_and_large(kind, placement):
    whole, side, reach = measured(a_take(kind), ViewConfig(placement))
    assert whole >= WHOLE, f"{whole:.1%} of pictures show all hands"
    if kind in ("hand-hand", "hand-pen", "real-like") and (kind, placement) != ("real-like", "rig"):
        assert side >= SIDE, f"a hand's longer side is {side:.1%} of the height"
    else:  # hands far apart are as large as the picture allows
        assert side >= SIDE or reach >= FULL[placement], f"{side:.1%} of the height, though there is room"


def test_a_share_is_kept():
    take = a_take("hand-hand")
    for share in (0.2, 0.4):
        whole, side, _ = measured(take, ViewConfig("anywhere", share=share))
        assert whole == 1.0 and share <= side <= 1.4 * share


def test_a_still_camera_stays_where_that_is_enough():
    quiet = subject_of_poses(np.linspace(np.zeros(20), np.full(20, 0.1), 30), model="M").take
    for take, moves in ((quiet, False), (a_take("free"), True)):
        viewpoints = Viewpoints(ViewConfig(), take, rng=np.random.default_rng(0))
        places = np.array([viewpoints.cameras(n)[0].T_world_camera for n in (0, take.num_frames - 1)])
        assert (places[0] != places[1]).any() == moves


def test_a_distance_is_kept_though_hands_leave_the_picture():
    whole, side, _ = measured(a_take("hand-hand"), ViewConfig("orbit", distance=(0.3, 0.3)))
    assert whole < 1.0 and side > 1.5 * SIDE
