from __future__ import annotations

import hashlib
import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from render.formats.png import encode_png

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 300))


def decoded(file: bytes) -> np.ndarray:
    """What OpenCV reads, red first."""
    picture = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else picture[..., ::-1]


@settings(deadline=None)
@given(SIZES.flatmap(lambda size: hnp.arrays(np.uint8, (*size, 3), elements=st.integers(0, 255))))
def test_readers_see_equal_colors(picture: np.ndarray) -> None:
    file = encode_png(picture)
    np.testing.assert_array_equal(decoded(file), picture)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(file))), picture)


@settings(deadline=None)
@given(SIZES.flatmap(lambda size: hnp.arrays(np.uint16, size, elements=st.integers(0, 65535))))
def test_readers_see_equal_depth(picture: np.ndarray) -> None:
    np.testing.assert_array_equal(decoded(encode_png(picture)), picture)


@pytest.mark.parametrize("kind", ["noise", "ramp", "empty", "sparse", "skewed"])
def test_large_pictures_come_back(kind: str, rng: np.random.Generator) -> None:
    shape = (480, 640, 3)
    picture = np.zeros(shape, np.uint8)
    if kind == "noise":
        picture = rng.integers(0, 256, shape, dtype=np.uint8)
    elif kind == "ramp":
        picture += np.arange(640, dtype=np.uint16).astype(np.uint8)[:, None]
    elif kind == "sparse":
        picture[rng.random(shape) < 0.001] = 7
    elif kind == "skewed":  # counts like Fibonacci's numbers, whose codes would be longer than PNG allows
        values = np.repeat(np.arange(24), np.round(1.618 ** np.arange(24)).astype(int))
        picture = np.resize(rng.permutation(values), shape).astype(np.uint8).cumsum(axis=0, dtype=np.uint8)
    np.testing.assert_array_equal(decoded(encode_png(picture)), picture)


def test_texts_are_stored_and_checksums_hold() -> None:
    file = encode_png(np.eye(5, dtype=np.uint16), text={"unit": "0.1"})
    with Image.open(io.BytesIO(file)) as picture:
        picture.verify()
    with Image.open(io.BytesIO(file)) as picture:
        assert picture.text == {"unit": "0.1"}


def test_a_picture_has_the_same_bytes_on_every_machine() -> None:
    across, down = np.meshgrid(np.arange(200), np.arange(100))
    picture = np.stack([across, down, across * down // 37], axis=-1).astype(np.uint8)
    file = encode_png(picture)
    assert len(file) == 16618
    assert hashlib.sha256(file).hexdigest()[:16] == "92b7950288d015a2"
    assert len(zlib.compress(picture.tobytes())) > len(file)
