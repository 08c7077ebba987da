from __future__ import annotations

import dataclasses
import functools
from typing import get_args

import numpy as np
import pytest

from gloves import Take
from gloves.takes.take import LOST
from handsim import HandSimWarning, look_at
from handsim.errors import RigError
from handsim.hand.model import hand_keypoints
from handsim.space.camera import pinhole
from render import ViewConfig
from render.subject import subject_of_poses
from render.viewpoints import Framing, Placement, Viewpoints
from train import simulate_take
from train.simulation.takes import SimulatedKind

FRAMES, STEP = 480, 16
WHOLE, SIDE = 0.95, 0.30  # of pictures with all hands; a hand's longer side, of the height
APART = ("single-hand", "calibration", "free")  # kinds of takes with hands half a meter from each other
LEAST = {"rig": 0.2, "orbit": 0.25}  # of those, where cameras cannot stay where both are large
PLACED = [name for name in get_args(Placement) if name != "head"]


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=60)


@pytest.mark.parametrize("placement", get_args(Placement))
def test_every_placement_sees_the_hands(take, placement):
    config = ViewConfig(placement, "vga_wide", views=1 if placement == "rig" else 2)
    viewpoints = Viewpoints(config, take, rng=np.random.default_rng(1))
    centers = Framing(take).centers
    for frame in range(0, 60, 7):
        cameras = viewpoints.cameras(frame)
        assert len(cameras) == (6 if placement == "rig" else 2)
        assert len({camera.name for camera in cameras}) == len(cameras)
        for camera in cameras:
            pixels = camera.project(centers[frame])
            assert (pixels > 0).all() and (pixels < camera.size).all()


def test_the_same_seed_gives_the_same_places(take):
    config = ViewConfig("orbit", views=2)
    first, second = (Viewpoints(config, take, rng=np.random.default_rng(3)).cameras(5) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_a_lost_hand_is_aimed_at_where_it_was_between(take):
    qpos, status = take.qpos.copy(), take.status.copy()
    qpos[20:30], status[20:30] = np.nan, LOST
    centers = Framing(dataclasses.replace(take, qpos=qpos, status=status)).centers
    assert np.isfinite(centers).all()
    assert np.linalg.norm(centers[25] - Framing(take).centers[25]) < 0.1


def test_cameras_must_look_at_the_hands():
    take = subject_of_poses(np.zeros((3, 20)), model="M").take
    eye = np.array([0.0, -0.6, 0.0])
    seeing = pinhole("seeing", (640, 480), 600.0).at(look_at(eye, np.zeros(3)))
    blind = pinhole("blind", (640, 480), 600.0).at(look_at(eye, 2 * eye))

    def check(*cameras):
        config = ViewConfig(cameras=cameras)
        Viewpoints(config, take, rng=np.random.default_rng(0)).check_hands_in_view()

    check(seeing)
    with pytest.warns(HandSimWarning, match="camera 'blind' has no hand"):
        check(seeing, blind)
    with pytest.raises(RigError, match="no camera has a hand in its picture in any of 3 frames"):
        check(blind)
    with pytest.raises(RigError, match=r"camera 'far' stands 600 m from the origin.* are these millimeters"):
        check(pinhole("far", (640, 480), 600.0).at(look_at(1e3 * eye, np.zeros(3))))


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


def test_a_still_camera_stays_where_that_is_enough():
    quiet = subject_of_poses(np.linspace(np.zeros(20), np.full(20, 0.1), 30), model="M").take
    for take, moves in ((quiet, False), (a_take("free"), True)):
        viewpoints = Viewpoints(ViewConfig(), take, rng=np.random.default_rng(0))
        places = np.array([viewpoints.cameras(n)[0].T_world_camera for n in (0, take.num_frames - 1)])
        assert (places[0] != places[1]).any() == moves


def test_a_distance_is_kept_though_hands_leave_the_picture():
    whole, side = measured(a_take("hand-hand"), ViewConfig("orbit", distance=(0.3, 0.3)))
    assert whole < 1.0 and side > 1.5 * SIDE
