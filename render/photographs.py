"""Checks and reads the files of users' photographs and environment maps; no other module does.

A photograph has levels of sRGB, an environment map the linear light of all directions.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageOps

from handsim.errors import FileError, HandSimError
from handsim.files.inputs import check_regular, read_bytes
from handsim.files.outputs import plain_path
from render.frames import Bytes, Floats

MAP_SUFFIXES: Final = (".hdr", ".exr")
"""Files of environment maps: the light of all directions, longitudes across and latitudes down, z up."""
PHOTO_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", *MAP_SUFFIXES)
_FORMATS: Final = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "PPM", "GIF", "JPEG2000")
_MOST_PIXELS: Final = 100_000_000  # largest number of pixels of a photograph
_MOST_BYTES: Final = 1 << 29  # largest file of a photograph or map, of about four bytes a pixel
_MOST_LEVEL: Final = 65535  # highest level of 16 bits
_LEAST_PEAK: Final = 17  # least brightest level, of 255; files of 16 bits with only 10 or 12 do not reach it
_HDR_SIZE: Final = re.compile(rb"\n-Y ([0-9]{1,9}) \+X ([0-9]{1,9})\n")


def is_map(file: Path) -> bool:
    """Whether a file is an environment map, by its ending."""
    return file.suffix.lower() in MAP_SUFFIXES


def check_photograph(file: Path) -> None:
    """Refuse a file that does not begin as a photograph does, or an environment map that is no regular file.

    Raises:
        FileError: The sentence names the file and the reason.
    """
    if is_map(file):
        check_regular(file, error=FileError, max_bytes=_MOST_BYTES)
    else:
        with _open_photograph(file):
            pass


def read_photograph(file: Path) -> UInt8[np.ndarray, "H W 3"]:
    """The levels of a photograph, upright as its EXIF data say, transparent pixels over white.

    Gray, palettes, CMYK and 16 bits are read, too, and the first picture of several.

    Raises:
        FileError: The file is no regular file, damaged, too large, black, or of floating-point levels.
    """
    with _open_photograph(file) as picture:
        upright = ImageOps.exif_transpose(picture)
        if upright.mode.startswith("I"):
            upright = Image.fromarray(_eight_bits(file, np.asarray(upright)))
        if upright.has_transparency_data:
            over = Image.new("RGBA", upright.size, "white")
            over.alpha_composite(upright.convert("RGBA"))
            upright = over
        levels = np.asarray(upright.convert("RGB"))
        if levels.max() < _LEAST_PEAK:
            raise FileError(
                f"{file}: its brightest level is {levels.max()} of 255, expected {_LEAST_PEAK} or more; "
                "are these 10 or 12 bits in a file of 16?"
            )
        return levels


def read_map(file: Path) -> Float32[np.ndarray, "H W 3"]:
    """The linear light of an environment map, black in the parts of an .exr that have no data.

    Raises:
        FileError: The file is no regular file, damaged, too large, without colors or light, or it has light
            that is NaN, negative or infinite.
    """
    check_photograph(file)
    light = _read_hdr(file) if file.suffix.lower() == ".hdr" else _read_exr(file)
    wrong = int((~(np.isfinite(light) & (light >= 0.0))).any(axis=-1).sum())
    if wrong:
        raise FileError(f"{file}: {wrong} pixels are NaN, negative or infinite, expected an amount of light")
    if not light.any():
        raise FileError(f"{file}: an environment map without any light")
    return light


@contextmanager
def _open_photograph(file: Path) -> Iterator[Image.Image]:
    """Open a photograph and read its header; its levels are read in the block."""
    check_regular(file, error=FileError, max_bytes=_MOST_BYTES)
    Image.init()  # so that all formats are known by name
    with _decoder_errors(file):
        try:
            with warnings.catch_warnings(action="ignore"), Image.open(file, formats=_FORMATS) as picture:
                _check_size(file, picture.width, picture.height)
                if picture.mode == "F":
                    raise FileError(
                        f"{file}: a photograph of floating-point levels, expected 8 or 16 bits, or light as "
                        f"{' or '.join(MAP_SUFFIXES)}"
                    )
                yield picture
        except Image.DecompressionBombError as error:
            raise FileError(f"{file}: {error}".partition(", could be")[0]) from error


@contextmanager
def _decoder_errors(file: Path) -> Iterator[None]:
    """Turn any exception of a decoder in the block into a sentence that names the file."""
    try:
        yield
    except HandSimError:
        raise
    except Exception as error:  # files are damaged in many ways
        why = getattr(error, "strerror", None)
        what = "environment map" if is_map(file) else "photograph"
        raise FileError(f"{file}: not a readable {what}{f': {why}' if why else ''}") from error


def _check_size(file: Path, width: int, height: int) -> None:
    if not 0 < width * height <= _MOST_PIXELS:
        raise FileError(f"{file}: {width} x {height} pixels, expected 1 to {_MOST_PIXELS} in all")


def _eight_bits(file: Path, levels: NDArray[Any]) -> Bytes:
    """Convert levels of 16 bits to 8 bits."""
    low, high = int(levels.min()), int(levels.max())
    if low < 0 or high > _MOST_LEVEL:
        raise FileError(f"{file}: levels from {low} to {high}, expected 0 to {_MOST_LEVEL}")
    return np.asarray(np.rint(levels * (255.0 / _MOST_LEVEL)).astype(np.uint8))


def _read_hdr(file: Path) -> Floats:
    content = read_bytes(file, error=FileError, max_bytes=_MOST_BYTES)
    size = _HDR_SIZE.search(content)
    if not content.startswith(b"#?") or size is None:
        raise FileError(f"{file}: not a readable environment map: no header of Radiance's with -Y and +X")
    _check_size(file, int(size[2]), int(size[1]))
    with _decoder_errors(file), quiet_decoder():
        bgr = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if bgr is None:
        raise FileError(f"{file}: not a readable environment map: cut or damaged")
    return np.asarray(bgr[..., ::-1], dtype=np.float32)


def _read_exr(file: Path) -> Floats:
    import OpenEXR

    with _decoder_errors(file), quiet_decoder():
        shown, stored = _exr_windows(file)
        with plain_path(file) as plain, OpenEXR.File(str(plain)) as opened:
            channels = {name: one.pixels for name, one in opened.channels().items()}
        colors = next((pixels for name, pixels in channels.items() if name in ("RGB", "RGBA")), None)
        if colors is None:
            raise FileError(f"{file}: the channels {', '.join(channels)}, expected R, G and B")
        light = np.zeros((*(shown[1] - shown[0])[::-1], 3), np.float32)
        low, high = np.maximum(shown[0], stored[0]), np.minimum(shown[1], stored[1])
        if (high > low).all():
            (left, top), (right, bottom) = low - stored[0], high - stored[0]
            (first, above), (last, below) = low - shown[0], high - shown[0]
            light[above:below, first:last] = colors[top:bottom, left:right, :3]
        return light


def _exr_windows(file: Path) -> NDArray[np.int64]:
    """First and end (2, 2, 2) of the columns and rows that an .exr displays, and of those that it stores."""
    import OpenEXR

    with plain_path(file) as plain, OpenEXR.File(str(plain), header_only=True) as opened:
        windows = np.array([opened.header()[f"{name}Window"] for name in ("display", "data")], dtype=np.int64)
    windows[:, 1] += 1
    for low, high in windows:
        _check_size(file, *(high - low).tolist())
    return windows


@contextmanager
def quiet_decoder() -> Iterator[None]:
    """Silence stderr in the block, because OpenCV and OpenEXR write there on damaged files."""
    if sys.stderr is None:  # a daemon has no stderr
        yield
        return
    stderr, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(devnull)
