from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from render.formats.png_depth import (
    METERS_PER_UNIT,
    encode_depth,
    encode_ids,
    encode_jpeg,
    encode_normals,
    encode_pictures,
)
from tests.render.formats.reading import depth_of


@settings(deadline=None)  # the first call compiles
@given(hnp.arrays(np.float32, (3, 5), elements=st.floats(0.0, 6.5, width=32)))
def test_depth_comes_back_to_half_a_unit(depth: np.ndarray) -> None:
    np.testing.assert_allclose(depth_of(encode_depth(depth)), depth, atol=METERS_PER_UNIT / 2 + 1e-6)


def test_what_is_too_far_is_a_hole() -> None:
    depth = np.array([[6.5535, 6.56, np.inf], [np.nan, -1.0, 0.0]], dtype=np.float32)
    np.testing.assert_allclose(depth_of(encode_depth(depth)), [[6.5535, 0, 0], [0, 0, 0]], atol=1e-6)


def test_others_read_depth_and_its_unit() -> None:
    image = pytest.importorskip("PIL.Image")
    data = encode_depth(np.full((2, 3), 0.5, dtype=np.float32))
    picture = image.open(io.BytesIO(data))
    assert float(picture.text["metres_per_unit"]) == 1e-4
    np.testing.assert_array_equal(np.asarray(picture), np.full((2, 3), 5000))
    raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16
    assert (raw == 5000).all()


def test_the_same_depth_gives_the_same_bytes(rng: np.random.Generator) -> None:
    depth = rng.random((8, 9)).astype(np.float32)
    assert encode_depth(depth) == encode_depth(depth.copy())


def test_ids_and_normals_come_back(make_frame) -> None:
    pictures = make_frame(sides=("right", "left")).ideal
    ids = cv2.imdecode(np.frombuffer(encode_ids(pictures), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    for layer, wanted in zip(
        np.moveaxis(ids, -1, 0), (pictures.parts, pictures.instances, pictures.markers), strict=True
    ):
        np.testing.assert_array_equal(layer, wanted)
    levels = cv2.imdecode(np.frombuffer(encode_normals(pictures.normals), np.uint8), cv2.IMREAD_COLOR)
    levels = levels[..., ::-1].astype(float)
    there = levels.any(axis=-1)
    np.testing.assert_array_equal(there, pictures.instances > 0)
    np.testing.assert_allclose((levels[there] - 128) / 127, pictures.normals[there], atol=0.5 / 127 + 1e-6)


def test_jpeg_keeps_the_colors_in_order() -> None:
    picture = np.full((16, 16, 3), (200, 100, 20), dtype=np.uint8)
    back = cv2.imdecode(np.frombuffer(encode_jpeg(picture), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(back.astype(int), picture, atol=4)


def test_pictures_are_the_sensor_s(make_frame) -> None:
    plain, noisy = make_frame(), make_frame(noisy=True)
    assert set(encode_pictures(plain, lossless=True)) == {".png", ".depth.png", ".normals.png", ".ids.png"}
    files = encode_pictures(noisy, lossless=False)
    assert set(files) == {".jpg", ".depth.png", ".depth_ideal.png", ".normals.png", ".ids.png"}
    np.testing.assert_allclose(depth_of(files[".depth.png"]), noisy.noisy.depth, atol=1e-4)
    np.testing.assert_allclose(depth_of(files[".depth_ideal.png"]), noisy.ideal.depth, atol=1e-4)
