"""Photographs and environment maps as other programs write them, damaged and odd ones among them."""

from __future__ import annotations

import os
import struct
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from handsim.errors import FileError, HandSimError, HandSimWarning
from render.photographs import check_photograph, read_map, read_photograph
from render.scenery.backgrounds import photo_files, pick_photo

RAMP = np.tile(np.linspace(0, 255, 40).round().astype(np.uint8), (30, 1))
COLORS = np.stack([RAMP, RAMP[:, ::-1], np.full_like(RAMP, 90)], axis=-1)
LIGHT = np.linspace(0.1, 30.0, 24 * 48 * 3, dtype=np.float32).reshape(24, 48, 3)


def gray_16(path):
    cv2.imwrite(str(path), RAMP.astype(np.uint16) * 257)


@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
def test_gray_photographs_of_16_bits_keep_their_levels(tmp_path, ending, capfd):
    gray_16(tmp_path / f"gray.{ending}")
    np.testing.assert_array_equal(read_photograph(tmp_path / f"gray.{ending}"), np.stack([RAMP] * 3, axis=-1))
    Image.fromarray(RAMP.astype(np.int32) * 257).save(tmp_path / "wide.tif")
    np.testing.assert_array_equal(read_photograph(tmp_path / "wide.tif")[..., 1], RAMP)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "save",
    [
        lambda path: Image.fromarray(COLORS).save(path.with_suffix(".png")),
        lambda path: cv2.imwrite(str(path.with_suffix(".png")), COLORS[..., ::-1].astype(np.uint16) * 257),
        lambda path: Image.fromarray(COLORS).save(path.with_suffix(".webp"), lossless=True),
        lambda path: Image.fromarray(COLORS).save(path.with_suffix(".bmp")),
        lambda path: Image.fromarray(COLORS).convert("CMYK").save(path.with_suffix(".tif")),
        lambda path: Image.fromarray(COLORS).convert("RGBA").save(path.with_suffix(".png")),
        lambda path: Image.fromarray(COLORS).quantize(256).save(path.with_suffix(".png")),
        lambda path: Image.fromarray(COLORS).save(
            path.with_suffix(".tif"), save_all=True, append_images=[Image.new("RGB", (9, 9))]
        ),
    ],
    ids=["png", "16 bits", "webp", "bmp", "cmyk", "alpha", "palette", "pages"],
)
def test_photographs_of_any_kind_look_alike(tmp_path, save):
    save(tmp_path / "p")
    (path,) = tmp_path.iterdir()
    np.testing.assert_allclose(read_photograph(path), COLORS, atol=2)


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_photographs_are_upright(tmp_path, orientation, turns):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(COLORS).save(tmp_path / "p.jpg", exif=exif, quality=100, subsampling=0)
    np.testing.assert_allclose(read_photograph(tmp_path / "p.jpg"), np.rot90(COLORS, turns), atol=8)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_pixels_are_white(tmp_path, mode):
    if mode == "P":
        Image.fromarray(COLORS).quantize(8).save(tmp_path / "p.png", transparency=bytes(8))
    else:
        picture = Image.fromarray(COLORS).convert(mode)
        picture.putalpha(0)
        picture.save(tmp_path / "p.png")
    assert (read_photograph(tmp_path / "p.png") == 255).all()


def header_of_png(width, height):
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    whole = struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return b"\x89PNG\r\n\x1a\n" + whole + struct.pack(">I", 99) + b"IDAT"


def cut(path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:-400])


@pytest.mark.parametrize(
    ("name", "make", "why"),
    [
        ("p.jpg", os.mkfifo, "this is a pipe, expected a regular file"),
        ("p.png", os.mkdir, "not a readable photograph: Is a directory"),
        ("p.png", lambda path: path.write_bytes(b""), "not a readable photograph"),
        (
            "p.jpg",
            lambda path: path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n"),
            "not a",
        ),
        ("p.jpg", cut, "not a readable photograph"),
        ("p.png", lambda path: path.write_bytes(header_of_png(60000, 60000)), "3600000000 pixels"),
        ("p.png", lambda path: path.write_bytes(header_of_png(11000, 11000)), "11000 x 11000 pixels"),
        ("p.tif", lambda path: cv2.imwrite(str(path), RAMP.astype(np.float32)), "floating-point levels"),
        (
            "p.tif",
            lambda path: cv2.imwrite(str(path), COLORS.astype(np.float32)),
            "not a readable photograph",
        ),
        (
            "p.png",
            lambda path: cv2.imwrite(str(path), RAMP.astype(np.uint16) * 16),
            "is 16 of 255, .* 10 or 12",
        ),
        ("p.png", lambda path: cv2.imwrite(str(path), COLORS.astype(np.uint16) * 4), "is 3 of 255"),
        (
            "p.tif",
            lambda path: Image.fromarray(RAMP.astype(np.int32) * 900).save(path),
            "0 to 229500, expected",
        ),
        (
            "p.tif",
            lambda path: Image.fromarray(RAMP.astype(np.int32) - 9).save(path),
            "levels from -9 to 246",
        ),
    ],
)
def test_what_is_no_photograph_is_told_by_name(tmp_path, name, make, why, capfd):
    make(tmp_path / name)
    with pytest.raises(FileError, match=rf"{name}: .*{why}"):
        read_photograph(tmp_path / name)
    assert capfd.readouterr().err == ""


def exr(path, light=LIGHT, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    OpenEXR.File(header, {"RGB": light}).write(str(path))


@pytest.mark.parametrize(
    ("first", "last", "inside"),
    [
        ((0, 0), (47, 23), np.s_[0:24, 0:48]),
        ((-10, -2), (99, 49), np.s_[2:26, 10:58]),  # a crop of a larger picture
        ((5, 3), (44, 19), None),  # more is stored than is shown
        ((60, 0), (99, 23), np.s_[0:0, 0:0]),  # nothing that is stored is shown
    ],
)
def test_an_exr_has_the_size_that_it_shows(tmp_path, first, last, inside):
    windows = (np.array(first, np.int32), np.array(last, np.int32))
    exr(tmp_path / "sky.exr", displayWindow=windows)
    if inside is not None and not LIGHT[inside].size:
        with pytest.raises(FileError, match=r"sky\.exr: an environment map without any light"):
            read_map(tmp_path / "sky.exr")
        return
    light = read_map(tmp_path / "sky.exr")
    assert light.shape == (last[1] - first[1] + 1, last[0] - first[0] + 1, 3)
    if inside is None:
        np.testing.assert_array_equal(light, LIGHT[3:20, 5:45])
    else:
        np.testing.assert_array_equal(light[inside], LIGHT)
        assert np.isclose(light.sum(dtype=float), LIGHT.sum(dtype=float))


def hdr(path):
    assert cv2.imwrite(str(path), LIGHT[..., ::-1])


def changed(path, change):
    hdr(path)
    path.write_bytes(change(path.read_bytes()))


def with_values(value):
    light = LIGHT.copy()
    light[4, 5] = value
    return light


@pytest.mark.parametrize(
    ("name", "make", "why"),
    [
        ("m.hdr", os.mkfifo, "this is a pipe"),
        ("m.exr", os.mkfifo, "this is a pipe"),
        ("m.hdr", os.mkdir, "Is a directory"),
        ("m.exr", os.mkdir, "not a readable environment map"),
        ("m.hdr", lambda path: changed(path, lambda data: data[:-900]), "cut or damaged"),
        ("m.hdr", lambda path: changed(path, lambda data: data[:30]), "no header of Radiance's"),
        ("m.hdr", lambda path: changed(path, lambda data: b""), "no header of Radiance's"),
        (
            "m.hdr",
            lambda path: changed(path, lambda data: data.replace(b"-Y 24 +X 48", b"-Y 60000 +X 60000")),
            "60000 x 60000 pixels",
        ),
        ("m.exr", lambda path: (exr(path), path.write_bytes(path.read_bytes()[:-900])), "not a readable"),
        ("m.exr", lambda path: exr(path, with_values(np.nan)), "1 pixels are NaN, negative or infinite"),
        ("m.exr", lambda path: exr(path, with_values(np.inf)), "1 pixels are NaN, negative or infinite"),
        ("m.exr", lambda path: exr(path, with_values(-1.0)), "1 pixels are NaN, negative or infinite"),
        ("m.exr", lambda path: exr(path, 0.0 * LIGHT), "without any light"),
        (
            "m.exr",
            lambda path: OpenEXR.File({}, {"Z": LIGHT[..., 0]}).write(str(path)),
            "channels Z, expected R",
        ),
        (
            "m.exr",
            lambda path: exr(path, displayWindow=(np.zeros(2, np.int32), np.full(2, 59999, np.int32))),
            "60000 x 60000 pixels",
        ),
    ],
)
def test_what_is_no_environment_map_is_told_by_name(tmp_path, name, make, why, capfd):
    make(tmp_path / name)
    with pytest.raises(FileError, match=rf"{name}: .*{why}"):
        read_map(tmp_path / name)
    assert capfd.readouterr().err == ""


def test_a_folder_tells_which_files_are_left_out(tmp_path, capfd):
    Image.fromarray(COLORS).save(tmp_path / "good.png")
    os.mkfifo(tmp_path / "a.jpg")
    (tmp_path / "b.png").mkdir()
    cut(tmp_path / "c.png")
    files, broken = photo_files(tmp_path)
    assert [file.name for file in files] == ["c.png", "good.png"]
    assert ["a.jpg: this is a pipe" in broken[0], "b.png: not a readable" in broken[1]] == [True, True]
    picked = set()
    with pytest.warns(HandSimWarning, match=r"left out: .*c.png: not a readable photograph"):
        for seed in range(8):
            picked.add(pick_photo(tmp_path, np.random.default_rng(seed)).name)
    assert picked == {"good.png"} and capfd.readouterr().err == ""
    (tmp_path / "good.png").unlink()
    (tmp_path / "c.png").unlink()
    photo_files.cache_clear()
    with pytest.raises(HandSimError, match=r"no photograph that can be read \(.*a.jpg: this is a pipe"):
        photo_files(tmp_path)


def test_a_photograph_that_begins_well_passes_the_first_look(tmp_path):
    cut(tmp_path / "c.png")
    check_photograph(tmp_path / "c.png")
