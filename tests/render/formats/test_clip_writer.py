"""A reader after the published fields: crops of a square picture, counted from the first pixel's center."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim.space.camera import Camera, look_at, pinhole
from handsim.space.transforms import quaternion_matrix
from render.formats.annotations.common import to_json
from render.formats.clip_writer import crop_camera, crops_record

PIXELS = 128


def pixels_in_crop(entry: dict, points: np.ndarray) -> np.ndarray:
    """Where the crop's picture has points of the world; NaN behind it."""
    pose = entry["T_world_from_crop_camera"]
    rotation = quaternion_matrix(np.array(pose["quaternion_wxyz"]))
    x, y, z = ((points - pose["translation_xyz"]) @ rotation).T
    focal = PIXELS / 2 / np.tan(entry["crop_camera_fov"] / 2)
    pixels = np.stack([x / z, y / z], axis=1) * focal + (PIXELS - 1) / 2
    return np.where(z[:, None] > 0, pixels, np.nan)


def test_each_seen_hand_has_a_crop_in_each_stream(make_frame, camera: Camera) -> None:
    other = dataclasses.replace(camera, name="other").at(look_at(np.array([0.1, -0.5, -0.3]), np.zeros(3)))
    frames = [make_frame(3, ("right", "left"), camera=view) for view in (camera, other)]
    record = json.loads(to_json(crops_record(frames)))
    for frame in frames:
        for hand in frame.hands:
            entry = record[hand.shape.side][frame.camera.name]
            pixels = pixels_in_crop(entry, hand.keypoints_world)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            np.testing.assert_allclose((low + high) / 2, (PIXELS - 1) / 2, atol=0.01)  # in the middle
            np.testing.assert_allclose((high - low).max(), 0.8 * PIXELS, atol=0.01)  # with room around
            np.testing.assert_allclose(
                entry["T_world_from_crop_camera"]["translation_xyz"], frame.camera.T_world_camera[:3, 3]
            )


def test_hands_that_are_not_seen_have_none(make_frame) -> None:
    assert crops_record([make_frame(away=True)]) == {"left": {}, "right": {}}


@given(
    spot=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.3, 1.5)),
    spread=st.floats(0.01, 0.1),
    seed=st.integers(0, 99),
)
def test_all_points_are_inside_wherever_the_hand_is(
    spot: tuple[float, float, float], spread: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    camera = pinhole("c", (64, 48), 60.0, (32.0, 24.0)).at(look_at(rng.normal(size=3), rng.normal(size=3)))
    local = np.array(spot) + rng.uniform(-spread, spread, (21, 3))
    points = local @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    crop = crop_camera(camera, points)
    assert crop is not None
    T_world_crop, angle = crop
    np.testing.assert_allclose(T_world_crop[:3, :3] @ T_world_crop[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T_world_crop[:3, :3]) > 0
    turned = (points - T_world_crop[:3, 3]) @ T_world_crop[:3, :3]
    angles = np.arctan2(np.abs(turned[:, :2]).max(axis=1), turned[:, 2])
    assert angles.max() < angle / 2
    # Level as the stream's camera: the crop's x axis has no part along the camera's y axis.
    assert abs(T_world_crop[:3, 0] @ camera.T_world_camera[:3, 1]) < 1e-9


@pytest.mark.parametrize("spot", [(0.0, 0.0, -0.4), (0.0, 0.0, 0.01), (0.0, 0.4, 0.0)])
def test_hands_behind_and_around_the_camera_have_none(camera: Camera, spot: tuple[float, ...]) -> None:
    local = np.array(spot) + np.random.default_rng(0).uniform(-0.08, 0.08, (21, 3))
    local -= (0.0, 0.0, 1e-9 + max(0.0, local[:, 2].mean())) if spot[1] else 0.0
    points = local @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    assert crop_camera(camera, points) is None
