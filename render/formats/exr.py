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

import errno
import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray

from handsim.errors import DatasetError, HandSimError
from handsim.files.atomic import atomic_write
from handsim.space.camera import Camera, camera_from_record
from render.frames import Pictures, RenderedFrame

_RGB: Final = ("R", "G", "B")
_NORMALS: Final = ("N.X", "N.Y", "N.Z")
_IDS: Final = {"parts": "id.part", "instances": "id.instance", "markers": "id.marker"}
_SENSOR: Final = "sensor."
_HEADER: Final = ("units", "camera", "K", "T_world_camera", "lens")
# The two branches of sRGB (IEC 61966-2-1).
_TOE, _TOE_SLOPE, _POWER, _SCALE, _SHIFT = 0.04045, 12.92, 2.4, 1.055, 0.055


@dataclass(frozen=True, slots=True, eq=False)
class ExrFrame:
    """The content of an OpenEXR file of a frame."""

    camera: Camera
    ideal: Pictures
    sensor: Pictures


def linear_light(picture: UInt8[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Linear light in [0, 1] of 8-bit sRGB."""
    levels = np.arange(256) / 255.0
    light = np.where(levels <= _TOE, levels / _TOE_SLOPE, ((levels + _SHIFT) / _SCALE) ** _POWER)
    values: NDArray[np.float32] = light.astype(np.float32)[picture]
    return values


def srgb(light: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """8-bit sRGB of linear light; what is beyond [0, 1] is cut off."""
    light = np.clip(np.nan_to_num(np.asarray(light, dtype=np.float64)), 0.0, 1.0)
    levels = np.where(light <= _TOE / _TOE_SLOPE, light * _TOE_SLOPE, _SCALE * light ** (1 / _POWER) - _SHIFT)
    picture: NDArray[np.uint8] = np.rint(255.0 * levels).astype(np.uint8)
    return picture


def write_exr(path: str | Path, frame: RenderedFrame) -> None:
    """Write all pictures of a frame and its camera.

    Raises:
        HandSimError: The name does not end in .exr, or there are no pictures.
        OSError: The file cannot be written.
    """
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
    with atomic_write(path) as temporary:
        try:
            OpenEXR.File(header, channels).write(str(temporary))
        except RuntimeError as error:  # raised on a full disk
            raise OSError(errno.EIO, str(error), str(path)) from error


def read_exr(path: str | Path) -> ExrFrame:
    """Read what `write_exr` wrote.

    Raises:
        DatasetError: The file is missing, damaged, or not written by handsim.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise DatasetError(f"{path}: no such file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header = dict(file.header())  # its own is emptied when the file is closed
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise DatasetError(f"{path}: damaged or no OpenEXR file") from error
    missing = [name for name in _HEADER if name not in header]
    if missing:
        raise DatasetError(f"{path}: not written by handsim: its header lacks {', '.join(missing)}")
    height, width = next(iter(channels.values())).shape
    record = {
        "name": header["camera"],
        "size": (width, height),
        "K": header["K"],
        "T_world_camera": header["T_world_camera"],
        "lens": json.loads(header["lens"]),
    }
    sensor = {name.removeprefix(_SENSOR): x for name, x in channels.items() if name.startswith(_SENSOR)}
    return ExrFrame(camera_from_record(record), _pictures(channels), _pictures(sensor))


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


def _pictures(channels: dict[str, NDArray[Any]]) -> Pictures:
    found: dict[str, Any] = {field.name: None for field in fields(Pictures)}
    if set(_RGB) <= channels.keys():
        found["rgb"] = srgb(np.stack([channels[name] for name in _RGB], axis=-1))
    found["depth"] = channels.get("Z")
    if set(_NORMALS) <= channels.keys():
        found["normals"] = np.stack([channels[name] for name in _NORMALS], axis=-1).astype(np.float32)
    for field, name in _IDS.items():
        if name in channels:
            found[field] = channels[name].astype(np.uint8)
    return Pictures(**found)
