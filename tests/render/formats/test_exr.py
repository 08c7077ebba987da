from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from handsim.errors import HandSimError
from handsim.space.camera import Camera, Lens
from render.formats.exr import linear_light, write_exr
from render.frames import Pictures
from tests.render.formats.reading import exr_content


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


def test_middle_gray_is_half_the_light() -> None:
    assert linear_light(np.array([188], np.uint8))[0] == pytest.approx(0.5, abs=0.005)


def test_every_level_of_srgb_comes_back_from_half() -> None:
    levels = np.arange(256, dtype=np.uint8)
    halves = linear_light(levels).astype(np.float16).astype(np.float64)
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
    assert channels["R"].max() == np.float16(linear_light(frame.ideal.rgb).max(axis=(0, 1))[0])


def test_the_same_frame_gives_the_same_bytes(make_frame, tmp_path: Path) -> None:
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, make_frame(3))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_wrong_name_or_place_is_told(make_frame, tmp_path: Path) -> None:
    with pytest.raises(HandSimError, match=r"ends in \.exr"):
        write_exr(tmp_path / "a.png", make_frame())
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        write_exr(tmp_path / "file" / "a.exr", make_frame())
