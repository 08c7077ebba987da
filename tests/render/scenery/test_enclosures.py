"""Backgrounds of several cameras: what one camera sees, another sees at the same place."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from handsim.space.camera import Camera, look_at, preset
from handsim.space.rig import named_rig
from render.cameras.viewpoints import ViewConfig
from render.config import RenderConfig
from render.drawing import draw
from render.frames import Pictures, RenderedFrame
from render.scenery.backgrounds import KINDS, Background
from render.scenery.enclosures import Enclosure, draw_surroundings, enclose
from train.simulation.takes import simulate_take

DRAWN = [kind for kind in KINDS if kind != "photo"]
MIDDLE = np.array([0.1, -0.2, 1.1])
POSITIONS = MIDDLE + np.array([[0.0, 0.0, 0.0], [0.5, -0.6, 0.3], [0.56, -0.55, 0.3], [-1.0, 0.3, 0.9]])


def pair(name: str = "vga") -> list[Camera]:
    return [preset(name).at(look_at(position, MIDDLE)) for position in POSITIONS[1:3]]


def background(kind: str, seed: int = 3) -> Background:
    return Background(kind, ((0.7, 0.5, 0.3), (0.1, 0.2, 0.4)), seed)  # type: ignore[arg-type]


def seen_twice(first: Camera, second: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of one camera's depth in the other: pixels (H, W, 2) and depth there, and which are inside."""
    rays = first.rays()
    points = rays / np.where(depth > 0.0, rays[..., 2], 1.0)[..., None] * depth[..., None]
    world = points @ first.T_world_camera[:3, :3].T + first.T_world_camera[:3, 3]
    pixels = second.project(world.reshape(-1, 3)).reshape(*depth.shape, 2)
    inside = ((pixels >= 1.0) & (pixels < np.array(second.size) - 1.0)).all(axis=-1) & (depth > 0.0)
    return pixels.astype(np.float32), second.local(world)[..., 2], inside


def looked_up(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return cv2.remap(picture, np.nan_to_num(pixels) - 0.5, None, cv2.INTER_LINEAR)


@pytest.mark.parametrize("camera", ["vga", "headset_fisheye"])
@pytest.mark.parametrize("kind", DRAWN)
def test_two_cameras_see_one_place(kind: str, camera: str) -> None:
    box = enclose(POSITIONS, 5)
    first, second = pair(camera)
    one, two = (draw_surroundings(background(kind), box, view) for view in (first, second))
    pixels, depth, inside = seen_twice(first, second, one.depth)
    assert inside.mean() > (0.5 if camera == "vga" else 0.3)
    there = looked_up(two.depth, pixels)
    same = inside & (np.abs(there - depth) < 0.01 * depth)
    assert same.sum() > 0.9 * inside.sum(), "but for what furniture hides"
    difference = np.abs(looked_up(two.rgb, pixels).astype(int) - one.rgb).max(axis=-1)[same]
    assert np.median(difference) <= 3 and np.percentile(difference, 90) <= (40 if kind == "noise" else 12)
    rows, columns = np.mgrid[: one.depth.shape[0], : one.depth.shape[1]] + 0.5
    moved = np.linalg.norm(pixels - np.stack([columns, rows], axis=-1), axis=-1)[same]
    assert np.ptp(moved) > 3.0, "parallax: what is near moves more"


def test_an_empty_box_is_where_it_says() -> None:
    box = Enclosure((-1.0, -2.0, 0.0), (2.0, 1.5, 2.5), ((-0.5,) * 3, (0.5,) * 3))
    camera = preset("vga").at(look_at(np.array([0.0, 0.0, 1.2]), np.array([0.5, 0.9, 1.0])))
    seen = draw_surroundings(background("gradient"), box, camera)
    rays = camera.rays()
    points = rays / rays[..., 2:] * seen.depth[..., None]
    world = points @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    off = np.minimum(np.abs(world - box.low), np.abs(world - box.high)).min(axis=-1)
    assert off.max() < 1e-5
    assert (world > np.array(box.low) - 1e-5).all() and (world < np.array(box.high) + 1e-5).all()
    height, width = seen.depth.shape
    empty = np.zeros((height, width), dtype=np.uint8)
    bare = np.zeros((height, width, 3), dtype=np.float32)
    filled = seen.put_behind(Pictures(None, empty.astype(np.float32), bare, empty, empty, empty), camera)
    assert filled.normals is not None and filled.depth is not None
    np.testing.assert_array_equal(filled.depth, seen.depth)
    np.testing.assert_allclose(np.linalg.norm(filled.normals, axis=-1), 1.0, atol=1e-6)
    assert ((filled.normals * rays).sum(axis=-1) < 0.0).all(), "surfaces face the camera"


def test_furniture_keeps_away_from_hands_and_cameras() -> None:
    for seed in range(8):
        box = enclose(POSITIONS, seed)
        for camera in pair("headset_fisheye"):
            seen = draw_surroundings(background("room", seed), box, camera)
            ahead = seen.depth > 0.0
            assert (seen.depth[ahead] / camera.rays()[ahead][:, 2]).min() > 0.4
            assert (np.array(box.low) < POSITIONS.min(axis=0) - 0.7).all()


@pytest.mark.parametrize(
    "view", [ViewConfig(views=2), ViewConfig("head", views=2), ViewConfig("rig", rig="six")]
)
def test_takes_of_several_cameras_have_one_background(view: ViewConfig) -> None:
    take = simulate_take(kind="hand-hand", num_frames=13)
    config = RenderConfig(view=view, depth_sensor=None, color_sensor=None, painter="compiled", vary="frame")
    frames = list(draw(take, config=config, frames=[0, 12]))
    cameras = len(frames) // 2
    assert cameras == (6 if view.placement == "rig" else 2) == len({frame.camera.name for frame in frames})
    for group in (frames[:cameras], frames[cameras:]):
        assert len({str(frame.choices["enclosure"]) for frame in group}) == 1
        if view.placement != "rig":  # whose long lenses see other walls
            check_pair(group[0], group[1])
    assert frames[0].choices["enclosure"] != frames[-1].choices["enclosure"]


def check_pair(one: RenderedFrame, two: RenderedFrame) -> None:
    assert one.ideal.depth is not None and two.ideal.depth is not None
    pixels, depth, inside = seen_twice(one.camera, two.camera, one.ideal.depth)
    there = looked_up(two.ideal.depth, pixels)
    assert one.ideal.instances is not None
    behind = inside & (one.ideal.instances == 0) & (np.abs(there - depth) < 0.01 * depth)
    if not inside.sum() > 1000:
        return  # cameras of a rig may look past one another
    assert behind.sum() > 0.5 * (inside & (one.ideal.instances == 0)).sum()
    off = np.abs(looked_up(two.ideal.rgb, pixels).astype(int) - one.ideal.rgb).max(axis=-1)[behind]
    assert np.median(off) <= 4


def test_a_rig_sees_photographs_on_the_walls(tmp_path) -> None:
    picture = np.zeros((300, 400, 3), dtype=np.uint8)
    picture[:, ::8] = 255
    file = tmp_path / "stripes.png"
    assert cv2.imwrite(str(file), picture)
    photo = dataclasses.replace(background("photo"), photo=str(file))
    rig = named_rig("six")
    box = enclose(np.concatenate([rig.positions, MIDDLE[None]]), 0)
    seen = draw_surroundings(photo, box, preset("vga").at(rig.T_world_camera[0]))
    assert seen.rgb.min() < 60 and seen.rgb.max() > 200 and (seen.depth > 0.5).all()
