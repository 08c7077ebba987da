"""Pictures as bytes of PNG and JPEG files; depth as 16-bit PNG that contains its unit.

Depth counts tenths of a millimeter up to 6.5535 m, and 0 is nothing, as sensors have it. What is farther
becomes 0 too: a hole means "unknown", whereas 65535 would look like a wall.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.formats.annotations.common import as_sensed
from render.frames import Pictures, RenderedFrame

METERS_PER_UNIT: Final = 1e-4
"""Unit of a depth picture [m]."""
_KEYWORD: Final = b"metres_per_unit"
_FIRST_CHUNK: Final = slice(8, 33)  # IHDR: length, name, 13 bytes, checksum
_MOST: Final = 65535
_NORMAL_ZERO, _NORMAL_SCALE = 128, 127
_JPEG_QUALITY: Final = 95


def encode_png(picture: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """An sRGB picture as PNG."""
    return _encode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def encode_jpeg(picture: UInt8[np.ndarray, "H W *C"], *, quality: int = _JPEG_QUALITY) -> bytes:
    """An sRGB or gray picture as JPEG."""
    ordered = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    return _encode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_depth(depth: Float32[np.ndarray, "H W"]) -> bytes:
    """Depth [m] as 16-bit gray PNG, with its unit in a text chunk `metres_per_unit`.

    0, NaN and what does not fit into 65535 units become 0.
    """
    data = _encode(".png", _depth_steps(np.ascontiguousarray(depth)))
    text = _KEYWORD + b"\0" + repr(METERS_PER_UNIT).encode("ascii")
    end = _FIRST_CHUNK.stop
    return data[:end] + _chunk(b"tEXt", text) + data[end:]


@kernel
def _depth_steps(depth: NDArray[np.float32]) -> Any:
    """Depth (H, W) in whole units; 0 for what does not fit."""
    steps = np.zeros(depth.shape, np.uint16)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            step = np.rint(depth[row, column] / METERS_PER_UNIT)
            if 0.0 < step <= _MOST:  # never so for NaN
                steps[row, column] = int(step)
    return steps


def encode_ids(pictures: Pictures) -> bytes | None:
    """Parts, instances and markers as red, green and blue of one PNG; None when there are none of them."""
    layers = (pictures.parts, pictures.instances, pictures.markers)
    known = [layer for layer in layers if layer is not None]
    if not known:
        return None
    return encode_png(np.stack([np.zeros_like(known[0]) if x is None else x for x in layers], axis=-1))


def encode_normals(normals: Float32[np.ndarray, "H W 3"]) -> bytes:
    """Unit normals as 8-bit PNG: x, y, z are (red, green, blue - 128) / 127; black is nothing."""
    return _encode(".png", _normal_levels(np.ascontiguousarray(normals)))


@kernel
def _normal_levels(normals: NDArray[np.float32]) -> Any:
    """Normals (H, W, 3) as bytes, z first as OpenCV has blue."""
    levels = np.zeros(normals.shape, np.uint8)
    for row in range(normals.shape[0]):
        for column in range(normals.shape[1]):
            x, y, z = normals[row, column]
            if x != 0.0 or y != 0.0 or z != 0.0:
                levels[row, column, 2] = int(np.rint(x * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 1] = int(np.rint(y * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 0] = int(np.rint(z * _NORMAL_SCALE)) + _NORMAL_ZERO
    return levels


def encode_pictures(frame: RenderedFrame, *, lossless: bool) -> dict[str, bytes]:
    """Files of a frame's pictures as its camera has them, and of ideal depth beside noisy, by suffix.

    Args:
        frame: Its colors have the suffix `.png` or `.jpg`; then come `.depth.png`, `.depth_ideal.png`,
            `.normals.png` and `.ids.png`, as far as there are such pictures.
        lossless: Whether colors are PNG instead of JPEG.
    """
    pictures = as_sensed(frame)
    files: dict[str, bytes] = {}
    if pictures.rgb is not None:
        files[".png" if lossless else ".jpg"] = (encode_png if lossless else encode_jpeg)(pictures.rgb)
    if pictures.depth is not None:
        files[".depth.png"] = encode_depth(pictures.depth)
    if frame.noisy.depth is not None and frame.ideal.depth is not None:
        files[".depth_ideal.png"] = encode_depth(frame.ideal.depth)
    if pictures.normals is not None:
        files[".normals.png"] = encode_normals(pictures.normals)
    ids = encode_ids(pictures)
    if ids is not None:
        files[".ids.png"] = ids
    return files


def _encode(suffix: str, picture: NDArray[Any], options: list[int] | None = None) -> bytes:
    done, data = cv2.imencode(suffix, np.ascontiguousarray(picture), options or [])
    assert done, "these formats take any picture"
    return data.tobytes()


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)
