"""Where cameras stand: they see the hands, and keep their distance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.takes.take import LOST, Take
from handsim.errors import ArgumentError, HandSimWarning, RigError
from handsim.space.camera import look_at, pinhole
from handsim.space.transforms import quaternion_matrix
from render.cameras.viewpoints import PLACEMENTS, ViewConfig, Viewpoints, check_hands_in_view, hand_centers
from render.subject import subject_of_poses
from train.simulation.takes import simulate_take


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=60)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_every_placement_sees_the_hands(take, placement):
    config = ViewConfig(placement, "vga_wide", views=2)
    viewpoints = Viewpoints(config, take, rng=np.random.default_rng(1))
    centers = hand_centers(take)
    for frame in range(0, 60, 7):
        cameras = viewpoints.cameras(frame)
        assert len(cameras) == (6 if placement == "rig" else 2)
        assert len({camera.name for camera in cameras}) == len(cameras)
        for camera in cameras:
            pixels = camera.project(centers[frame])
            assert (pixels > 0).all() and (pixels < camera.size).all()


def test_the_same_seed_gives_the_same_places(take):
    config = ViewConfig("anywhere", views=2)
    first, second = (Viewpoints(config, take, rng=np.random.default_rng(3)).cameras(5) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_cameras_anywhere_keep_their_distance(take):
    config = ViewConfig("anywhere", distance=(0.5, 0.6))
    viewpoints, centers = Viewpoints(config, take, rng=np.random.default_rng(0)), hand_centers(take)
    away = [np.linalg.norm(viewpoints.cameras(n)[0].T_world_camera[:3, 3] - centers[n]) for n in range(60)]
    assert min(away) >= 0.5 - 1e-9 and max(away) <= 0.6 + 1e-9


def test_cameras_anywhere_keep_clear_of_arms(take):
    viewpoints = Viewpoints(ViewConfig("anywhere", views=8), take, rng=np.random.default_rng(3))
    poses = take.qpos
    for frame in range(take.num_frames):
        for qpos in poses[frame][np.isfinite(poses[frame, :, 0])]:
            arm = qpos[:3] - np.linspace(0.0, 0.5, 51)[:, None] * quaternion_matrix(qpos[None, 3:7])[0, :, 0]
            for camera in viewpoints.cameras(frame):
                assert np.linalg.norm(arm - camera.T_world_camera[:3, 3], axis=1).min() > 0.2


def test_a_lost_hand_is_aimed_at_where_it_was_between(take):
    qpos, status = take.qpos.copy(), take.status.copy()
    qpos[20:30], status[20:30] = np.nan, LOST
    centers = hand_centers(dataclasses.replace(take, qpos=qpos, status=status))
    assert np.isfinite(centers).all()
    assert np.linalg.norm(centers[25] - hand_centers(take)[25]) < 0.1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"placement": "nowhere"}, "placement"),
        ({"views": 0}, "0 views"),
        ({"distance": (0.8, 0.5)}, "distances"),
    ],
)
def test_what_is_no_view_is_refused(wrong, said):
    with pytest.raises(ArgumentError, match=said):
        ViewConfig(**wrong)


def test_cameras_must_look_at_the_hands():
    take = subject_of_poses(np.zeros((3, 20)), model="M").take
    eye = np.array([0.0, -0.6, 0.0])
    seeing = pinhole("seeing", (640, 480), 600.0).at(look_at(eye, np.zeros(3)))
    blind = pinhole("blind", (640, 480), 600.0).at(look_at(eye, 2 * eye))
    check_hands_in_view("c.toml", [seeing], take)
    with pytest.warns(HandSimWarning, match="camera 'blind' has no hand"):
        check_hands_in_view("c.toml", [seeing, blind], take)
    with pytest.raises(RigError, match="no camera has a hand in its picture in any of 3 frames"):
        check_hands_in_view("c.toml", [blind], take)
