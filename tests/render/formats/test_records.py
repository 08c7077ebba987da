from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pycocotools import mask as coco_mask

from handsim import Camera, Lens
from handsim.hand.model import KEYPOINT_NAMES
from render import Pictures
from render.color_sensor import linear_of
from render.formats.records import (
    METERS_PER_UNIT,
    UMETRACK_JOINTS,
    encode_depth,
    encode_ids,
    encode_jpeg,
    encode_normals,
    run_lengths,
    to_json,
    write_exr,
)
from tests.render.formats.reading import depth_of, exr_content

# Names as the formats' own documents list them, in our words.
THUMB = ("thumb_CMC", "thumb_MCP", "thumb_IP", "thumb_tip")


@given(hnp.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12))))
def test_pycocotools_reads_run_lengths(mask):
    counts = run_lengths(mask)
    record = {"size": list(mask.shape), "counts": counts}
    np.testing.assert_array_equal(coco_mask.decode(record).astype(bool), mask)
    assert coco_mask.encode(np.asfortranarray(mask.view(np.uint8)))["counts"].decode() == counts


def test_nan_becomes_null() -> None:
    text = to_json({"a": np.array([1.5, np.nan]), 3: (np.int64(2), float("inf")), "t": np.bool_(True)})
    assert json.loads(text) == {"a": [1.5, None], "3": [2, None], "t": True}


def finger(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{part}" for part in ("MCP", "PIP", "DIP", "tip"))


INDEX, MIDDLE, RING, LITTLE = (finger(name) for name in ("index", "middle", "ring", "little"))
PUBLISHED = (
    *(THUMB[3], INDEX[3], MIDDLE[3], RING[3], LITTLE[3], "wrist", *THUMB[1:3]),
    *(*INDEX[:3], *MIDDLE[:3], *RING[:3], *LITTLE[:3]),
)


def test_the_order_of_umetrack_is_the_published_one() -> None:
    assert tuple(KEYPOINT_NAMES[place] for place in UMETRACK_JOINTS) == PUBLISHED


@settings(deadline=None)  # the first call compiles
@given(hnp.arrays(np.float32, (3, 5), elements=st.floats(0.0, 6.5, width=32)))
def test_depth_comes_back_to_half_a_unit(depth: np.ndarray) -> None:
    np.testing.assert_allclose(depth_of(encode_depth(depth)), depth, atol=METERS_PER_UNIT / 2 + 1e-6)


def test_what_is_too_far_is_a_hole() -> None:
    depth = np.array([[6.5535, 6.56, np.inf], [np.nan, -1.0, 0.0]], dtype=np.float32)
    np.testing.assert_allclose(depth_of(encode_depth(depth)), [[6.5535, 0, 0], [0, 0, 0]], atol=1e-6)


def test_ids_and_normals_come_back(make_frame) -> None:
    pictures = make_frame(sides=("right", "left")).ideal
    ids = cv2.imdecode(np.frombuffer(encode_ids(pictures), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    wanted = np.stack([pictures.parts, pictures.instances, pictures.markers], axis=-1)
    np.testing.assert_array_equal(ids, wanted)
    levels = cv2.imdecode(np.frombuffer(encode_normals(pictures.normals), np.uint8), cv2.IMREAD_COLOR)
    levels = levels[..., ::-1].astype(float)
    there = levels.any(axis=-1)
    np.testing.assert_array_equal(there, pictures.instances > 0)
    np.testing.assert_allclose((levels[there] - 128) / 127, pictures.normals[there], atol=0.5 / 127 + 1e-6)


def test_jpeg_keeps_the_colors_in_order() -> None:
    picture = np.full((16, 16, 3), (200, 100, 20), dtype=np.uint8)
    back = cv2.imdecode(np.frombuffer(encode_jpeg(picture), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(back.astype(int), picture, atol=4)


@pytest.mark.parametrize("noisy", [False, True])
def test_a_frame_comes_back(make_frame, camera: Camera, tmp_path: Path, noisy: bool) -> None:
    bent = Camera("bent", camera.size, camera.K, camera.T_world_camera, Lens("brown", (0.1, 0, 0, 0.01, 0)))
    frame = make_frame(sides=("right", "left"), camera=bent, noisy=noisy)
    write_exr(tmp_path / "new" / "a.exr", frame)
    header, channels = exr_content(tmp_path / "new" / "a.exr")
    assert header["camera"] == "bent" and json.loads(header["lens"]) == bent.record()["lens"]
    same(channels, "", frame.ideal)
    same(channels, "sensor.", frame.noisy)


def same(channels: dict[str, np.ndarray], layer: str, pictures: Pictures) -> None:
    names = {"depth": ("Z",), "parts": ("id.part",), "instances": ("id.instance",), "markers": ("id.marker",)}
    names |= {"rgb": ("R", "G", "B"), "normals": ("N.X", "N.Y", "N.Z")}
    for picture, parts in names.items():
        wanted = getattr(pictures, picture)
        found = [channels.get(layer + name) for name in parts]
        if wanted is None:
            assert found == [None] * len(parts)
            continue
        stacked = np.stack(found, axis=-1).reshape(wanted.shape)
        if picture == "rgb":
            stacked = np.rint(255.0 * srgb(stacked.astype(np.float64)))
        tolerance = 1e-3 if picture == "normals" else 0.0
        np.testing.assert_allclose(stacked, wanted, rtol=0.0, atol=tolerance)


def srgb(light: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def test_every_level_of_srgb_comes_back_from_half() -> None:
    levels = np.arange(256, dtype=np.uint8)
    halves = linear_of(levels).ravel().astype(np.float16).astype(np.float64)
    np.testing.assert_array_equal(np.rint(255.0 * srgb(halves)), levels)


def test_openexr_reads_meters_and_linear_light(make_frame, tmp_path: Path) -> None:
    frame = make_frame()
    write_exr(tmp_path / "a.exr", frame)
    header, channels = exr_content(tmp_path / "a.exr")
    assert header["units"] == "m"
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert channels["Z"].dtype == np.float32
    assert channels["R"].dtype == channels["N.X"].dtype == channels["id.part"].dtype == np.float16
    np.testing.assert_array_equal(channels["Z"], frame.ideal.depth)
    np.testing.assert_allclose(header["K"], frame.camera.K)
    np.testing.assert_allclose(header["T_world_camera"], frame.camera.T_world_camera)
    # A pixel and its depth are a point in the world, which is on the skin to the size of a drawn square.
    row, column = np.argwhere(channels["id.instance"] == 1)[0]
    ray = frame.camera.rays()[row, column]
    point = frame.camera.T_world_camera @ np.array([*(ray / ray[2] * channels["Z"][row, column]), 1.0])
    square = 3 * channels["Z"][row, column] / frame.camera.K[0, 0]
    assert np.linalg.norm(point[:3] - frame.hands[0].vertices, axis=1).min() < square * np.sqrt(0.5)
    assert channels["R"].max() == np.float16(linear_of(frame.ideal.rgb).max(axis=(0, 1))[0])
