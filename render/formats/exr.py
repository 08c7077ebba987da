"""OpenEXR files of a frame: linear colors, depth in meters, normals and ids in one part.

Plain channels are the ideal picture's, the layer `sensor` what the camera makes of it:

- `R G B`, `sensor.R` ..: half, linear light of the sRGB picture;
- `Z`, `sensor.Z`: float, distance along the camera's axis [m], 0 where there is nothing;
- `N.X N.Y N.Z`: half, unit normals in the camera's axes (OpenCV's), 0 where there is nothing;
- `id.part`, `id.instance`, `id.marker`: half, which holds whole numbers up to 2048 and is read everywhere.

The header has `units` ("m"), `camera`, `K` (pixels from the corner), `T_world_camera` and `lens` (JSON).
Compression is ZIP: lossless, and every reader has it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.files.outputs import atomic_write, plain_path, unwritten
from render.frames import Pictures, RenderedFrame

_RGB: Final = ("R", "G", "B")
_NORMALS: Final = ("N.X", "N.Y", "N.Z")
_IDS: Final = {"parts": "id.part", "instances": "id.instance", "markers": "id.marker"}
_SENSOR: Final = "sensor."
# The two branches of sRGB (IEC 61966-2-1).
_TOE, _TOE_SLOPE, _POWER, _SCALE, _SHIFT = 0.04045, 12.92, 2.4, 1.055, 0.055


def linear_light(picture: UInt8[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Linear light in [0, 1] of 8-bit sRGB."""
    levels = np.arange(256) / 255.0
    light = np.where(levels <= _TOE, levels / _TOE_SLOPE, ((levels + _SHIFT) / _SCALE) ** _POWER)
    values: NDArray[np.float32] = light.astype(np.float32)[picture]
    return values


def write_exr(path: str | Path, frame: RenderedFrame) -> None:
    """Write all pictures of a frame and its camera."""
    import OpenEXR

    if Path(path).suffix.lower() != ".exr":
        raise HandSimError(f"{path}: expected a file name that ends in .exr")
    channels = {
        **_channels(frame.ideal),
        **{_SENSOR + name: values for name, values in _channels(frame.noisy).items()},
    }
    if not channels:
        raise HandSimError(f"{path}: frame {frame.number} has no pictures to write")
    record = frame.camera.record()
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "units": "m",
        "camera": frame.camera.name,
        "K": frame.camera.K,
        "T_world_camera": frame.camera.T_world_camera,
        "lens": json.dumps(record["lens"]),
    }
    with atomic_write(path) as temporary, plain_path(temporary) as plain:
        try:
            OpenEXR.File(header, channels).write(str(plain))
        except RuntimeError as error:  # raised on a full disk
            raise unwritten(temporary) from error


def _channels(pictures: Pictures) -> dict[str, NDArray[Any]]:
    channels: dict[str, NDArray[Any]] = {}
    if pictures.rgb is not None:
        light = linear_light(pictures.rgb).astype(np.float16)
        channels |= {name: light[..., index] for index, name in enumerate(_RGB)}
    if pictures.depth is not None:
        channels["Z"] = pictures.depth.astype(np.float32)
    if pictures.normals is not None:
        normals = pictures.normals.astype(np.float16)
        channels |= {name: normals[..., index] for index, name in enumerate(_NORMALS)}
    for field, name in _IDS.items():
        ids = getattr(pictures, field)
        if ids is not None:
            channels[name] = ids.astype(np.float16)
    return {name: np.ascontiguousarray(values) for name, values in channels.items()}
