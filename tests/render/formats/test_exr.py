from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from handsim.errors import DatasetError, HandSimError
from handsim.space.camera import Camera
from handsim.space.lens import Lens
from render.formats.exr import linear_light, read_exr, srgb, write_exr
from render.frames import Pictures


def same(first: Pictures, second: Pictures) -> None:
    for name in ("rgb", "depth", "parts", "instances", "markers"):
        wanted = getattr(second, name)
        if wanted is None:
            assert getattr(first, name) is None
        else:
            np.testing.assert_array_equal(getattr(first, name), wanted)
    if second.normals is not None:
        np.testing.assert_allclose(first.normals, second.normals, atol=1e-3)


@pytest.mark.parametrize("noisy", [False, True])
def test_a_frame_comes_back(make_frame, camera: Camera, tmp_path: Path, noisy: bool) -> None:
    bent = Camera("bent", camera.size, camera.K, camera.T_world_camera, Lens("brown", (0.1, 0, 0, 0.01, 0)))
    frame = make_frame(sides=("right", "left"), camera=bent, noisy=noisy)
    write_exr(tmp_path / "new" / "a.exr", frame)
    back = read_exr(tmp_path / "new" / "a.exr")
    assert back.camera.record() == bent.record()
    same(back.ideal, frame.ideal)
    same(back.sensor, frame.noisy)


def test_openexr_reads_meters_and_linear_light(make_frame, tmp_path: Path) -> None:
    frame = make_frame()
    write_exr(tmp_path / "a.exr", frame)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header, channels = dict(file.header()), {name: x.pixels for name, x in file.channels().items()}
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


def test_every_level_of_srgb_comes_back_from_half() -> None:
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb(linear_light(levels).astype(np.float16)), levels)
    assert linear_light(np.array([188], np.uint8))[0] == pytest.approx(0.5, abs=0.005)


def test_the_same_frame_gives_the_same_bytes(make_frame, tmp_path: Path) -> None:
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, make_frame(3))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_damaged_and_foreign_files_are_told(make_frame, tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, make_frame())
    data = path.read_bytes()
    for content in (data[: len(data) // 2], data[:40], b"hello", b""):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match="damaged or no OpenEXR file"):
            read_exr(path)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.ones((4, 5), np.float32)}).write(str(path))
    with pytest.raises(DatasetError, match="not written by handsim: its header lacks units, camera"):
        read_exr(path)
    with pytest.raises(DatasetError, match="no such file"):
        read_exr(tmp_path / "b.exr")


def test_a_wrong_name_or_place_is_told(make_frame, tmp_path: Path) -> None:
    with pytest.raises(HandSimError, match=r"ends in \.exr"):
        write_exr(tmp_path / "a.png", make_frame())
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        write_exr(tmp_path / "file" / "a.exr", make_frame())
