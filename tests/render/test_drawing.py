"""Pictures in memory: of takes and of poses, before one's own cameras."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from handsim import Camera, HandModel
from handsim.errors import ArgumentError, HandSimError
from handsim.hand.model import hand_keypoints, join_qpos
from poses import sample_poses
from render import Backgrounds, DepthSensor, RenderConfig, ViewConfig, draw
from render.cameras.viewpoints import PLACEMENTS, Viewpoints
from render.drawing import open_studio
from render.studio import Moment
from train.simulation.takes import simulate_take

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
ABOVE = Camera(
    "above", (320, 240), K, np.array([[1.0, 0, 0, 0.08], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])
)
BARE = RenderConfig(passes=("depth", "ids"), depth_sensor=None)
MODEL = HandModel.named("S", side="left")


@pytest.fixture(scope="module")
def qpos():
    return sample_poses(MODEL, 3, rng=np.random.default_rng(4))


def test_own_poses_are_where_their_camera_has_them(qpos):
    frames = list(draw(qpos, model=MODEL, camera=ABOVE, config=BARE, seed=0))
    assert [frame.number for frame in frames] == [0, 1, 2] and frames[0].rgb is None
    for frame in frames:
        hand, world = frame.hands[0], hand_keypoints(MODEL, qpos[frame.number][None])[0]
        np.testing.assert_array_equal(frame.camera.T_world_camera, ABOVE.T_world_camera)
        np.testing.assert_allclose(hand.keypoints, ABOVE.project(world), atol=1e-9)
        assert frame.depth.shape == (240, 320) and hand.shape.side == "left"
        columns, rows = hand.keypoints[hand.visible].astype(int).T
        ahead = ABOVE.local(world[hand.visible])[:, 2] - frame.depth[rows, columns]
        assert np.median(np.abs(ahead)) < 0.02, "joints lie under the skin that is seen there"


def test_a_frame_does_not_depend_on_the_others(qpos):
    config = dataclasses.replace(BARE, passes=("rgb",), background=RenderConfig().background, vary="frame")
    every = list(draw(qpos, model="M", config=config, seed=7))
    alone = next(draw(qpos, model="M", config=config, seed=7, frames=[2]))
    np.testing.assert_array_equal(alone.noisy.rgb, every[2].noisy.rgb)
    other = next(draw(qpos, model="M", config=config, seed=8, frames=[2]))
    assert (other.noisy.rgb != alone.noisy.rgb).any()


def test_frames_are_spread_over_the_poses():
    qpos = np.tile(np.eye(27)[3], (10, 1))
    qpos[0, 3] = np.nan  # no hand is there
    numbers = [frame.number for frame in draw(qpos, model=MODEL, camera=ABOVE, config=BARE, num_frames=3)]
    assert numbers == [1, 4, 7]


def test_settings_are_given_by_name_and_mixtures_whole(qpos):
    assert RenderConfig(background={"plain": 1.0}).background.shares["room"] == 0.0
    assert RenderConfig(background=("room", "plain")).background == Backgrounds({"room": 1, "plain": 1})
    assert RenderConfig(depth_sensor="realsense_d435").depth_sensor == DepthSensor(("d435",))
    loud, usual = (
        next(
            draw(
                qpos, model=MODEL, camera=ABOVE, depth_sensor=DepthSensor("d435", noise=noise), passes="depth"
            )
        )
        for noise in (5.0, 1.0)
    )
    off = [np.abs(frame.noisy.depth - frame.ideal.depth)[frame.noisy.depth > 0] for frame in (loud, usual)]
    assert np.median(off[0]) > 2.0 * np.median(off[1])
    with pytest.raises(ArgumentError, match="unknown setting of a rendering 'seeds'"):
        draw(qpos, model=MODEL, seeds=3)
    with pytest.raises(ArgumentError, match="unknown depth sensor 'lidar'"):
        RenderConfig(depth_sensor="lidar")


def test_angles_two_hands_several_cameras_and_missing_hands(qpos):
    angles = next(draw(qpos[:, 7:], model=MODEL, camera=ABOVE, config=BARE, frames=[1]))
    np.testing.assert_array_equal(angles.hands[0].qpos, join_qpos(qpos[1:2, 7:])[0])
    both = np.stack([qpos, qpos], axis=1)
    both[:, 1, 1] += 0.2
    both[0, 0] = np.nan
    pair = (MODEL, HandModel.named("S"))
    frames = list(draw(both, model=pair, camera=[ABOVE, ABOVE.at(ABOVE.T_world_camera)], config=BARE))
    assert [len(frame.hands) for frame in frames] == [1, 1, 2, 2, 2, 2]
    assert [hand.shape.side for hand in frames[-1].hands] == ["left", "right"]


def test_takes_are_drawn_from_memory_and_from_files_alike(tmp_path):
    take = simulate_take(kind="hand-pen", num_frames=12)
    take.save(tmp_path / "take.npz")
    config = dataclasses.replace(BARE, view=ViewConfig(camera="sr300"))
    pairs = zip(
        draw(take, config=config, frames=range(0, 12, 6)),
        draw(tmp_path / "take.npz", config=config, frames=(0, 6)),
        strict=True,
    )
    for one, other in pairs:
        np.testing.assert_array_equal(one.depth, other.depth)
        assert one.bodies[0].name == "pen" and one.ids.max() == len(one.hands) + 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": 3}, "model is 3, expected a HandModel"),
        ({"model": "XXL"}, "unknown size 'XXL'"),
        ({"model": ("M", "L")}, "the models are of 2 hands .right and right. and the poses of 1"),
        ({"camera": 7}, "camera is 7, expected a Camera"),
        ({"camera": "webcam"}, "unknown camera 'webcam'"),
        ({"frames": 2.5}, "frames is 2.5, expected numbers of frames"),
        ({"frames": ["a"]}, "a frame is 'a', expected a whole number"),
        ({"seed": "a"}, "seed is 'a', expected a whole number"),
        ({"frames": [3]}, "frame 3 was asked for, expected 0 to 2"),
    ],
)
def test_what_cannot_be_drawn_is_told(qpos, arguments, message):
    with pytest.raises(HandSimError, match=message):
        list(draw(qpos, config=BARE, **arguments))


def test_a_take_has_its_own_hands():
    with pytest.raises(ArgumentError, match="model belongs to poses of your own"):
        draw(simulate_take(num_frames=2), model="M")


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand"])
def test_no_arm_ends_in_a_picture(kind):
    take = simulate_take(kind=kind, num_frames=120, seed=2)
    studio = open_studio(take.hands, RenderConfig(painter="compiled"), rng=np.random.default_rng(0))
    pictures = 0
    for placement in PLACEMENTS:
        viewpoints = Viewpoints(ViewConfig(placement, "vga_wide"), take, rng=np.random.default_rng(1))
        for frame in range(0, 120, 20):
            cameras = viewpoints.cameras(frame)
            moment = studio.reaching(Moment(take, frame), cameras)
            ends = np.array([one.triangles.vertices[-1] for one in studio._drawn(moment, 0.0)])
            for camera in cameras:
                pixels, ahead = camera.project(ends), camera.local(ends)[:, 2] > 0.0
                inside = ((pixels >= 0.0) & (pixels <= camera.size)).all(axis=1) & ahead
                assert not inside.any(), f"{placement}, frame {frame}, {camera.name}"
                pictures += 1
    assert pictures >= 60
