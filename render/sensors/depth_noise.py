"""Noise of depth sensors on perfect depth, by name of the sensor."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim._checks import check_choice, check_number
from handsim.errors import ArgumentError
from handsim.kernels import kernel
from handsim.space.camera import Camera, camera_matrix
from handsim.space.lens import Lens
from render.sensors import structured_light, time_of_flight
from render.sensors.structured_light import StructuredLight
from render.sensors.time_of_flight import TimeOfFlight

DepthNoise = StructuredLight | TimeOfFlight
# Numbers and their sources are in docs/sensors.md.
_SENSORS: Final[dict[str, DepthNoise]] = {
    "kinect1": StructuredLight(),
    "d435": StructuredLight(
        sensor="d435",
        baseline=0.05,
        step=1.0 / 32.0,
        disparity_noise=0.08,
        agreement=2.0,
        nearest=0.2,
        farthest=10.0,
    ),
    "kinect2": TimeOfFlight(),
    "azure_kinect": TimeOfFlight(
        sensor="azure_kinect",
        sigma=(0.0, 1.0e-3, 0.0),
        flying=0.1,
        dropped=0.6,
        weakest=0.0101,
        nearest=0.5,
        farthest=3.86,
    ),
}
SENSORS: Final = tuple(_SENSORS)


_OTHER_NAMES: Final = {"realsense_d435": "d435"}


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """A depth sensor whose noise is added to depth, or several, one of which is drawn each time.

    Raises:
        ArgumentError: A sensor is unknown, or a number is negative.
    """

    sensors: tuple[str, ...] = ("kinect2",)
    """Some of `SENSORS`; a name stands for itself alone."""
    noise: float = 1.0
    """Factor of the noise that was published of it."""
    spread: float = 0.2
    """Standard deviation of the logarithm of a copy's noise."""
    offset: float = 0.0035
    """Standard deviation of a time-of-flight camera's own offset [m]."""

    def __post_init__(self) -> None:
        given = (self.sensors,) if isinstance(self.sensors, str) else tuple(self.sensors)
        names = tuple(_OTHER_NAMES.get(name, name) for name in given)
        for name in names:
            check_choice(name, SENSORS, noun="depth sensor")
        for name in ("noise", "spread", "offset"):
            check_number(name, getattr(self, name), 0.0)
        object.__setattr__(self, "sensors", names)


def named_sensor(name: str) -> DepthNoise:
    """A depth sensor as it was published."""
    check_choice(name, _SENSORS, noun="depth sensor")
    return _SENSORS[name]


def sample_depth_noise(config: DepthSensor, *, rng: np.random.Generator) -> DepthNoise | None:
    """One copy of one of the sensors; None if there are none."""
    sensors = [named_sensor(name) for name in config.sensors]
    if not sensors:
        return None
    noise = sensors[int(rng.integers(len(sensors)))]
    louder = config.noise * float(np.exp(config.spread * rng.standard_normal()))
    offset = float(rng.standard_normal())
    if isinstance(noise, StructuredLight):
        return dataclasses.replace(noise, disparity_noise=louder * noise.disparity_noise)
    c0, c1, c2 = (louder * c for c in noise.sigma)
    return dataclasses.replace(noise, sigma=(c0, c1, c2), offset=config.offset * offset)


def apply_depth_noise(
    depth: Float32[np.ndarray, "H W"],
    normals: Float32[np.ndarray, "H W 3"] | None,
    noise: DepthNoise | None,
    *,
    camera: Camera,
    reflectance: Float32[np.ndarray, "H W"] | None = None,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "H W"]:
    """Depth along the camera's axis as a sensor has it [m], 0 where there is nothing or it has none.

    Without normals, in the camera's axes, all surfaces face the camera; without their reflectance for
    infrared light (`reflectance_of`), which time-of-flight sensors need, all are white. None as noise changes
    nothing.
    """
    shape = camera.size[1], camera.size[0]
    for name, picture in (("depth", depth), ("normals", normals), ("reflectance", reflectance)):
        if picture is not None and picture.shape[:2] != shape:
            raise ArgumentError(
                f"{name} has shape {picture.shape}, expected {shape} as camera '{camera.name}' has"
            )
    if noise is None:
        return depth.copy()
    cosines = None if normals is None else _facing(normals, camera)
    if isinstance(noise, StructuredLight):
        return structured_light.measure(depth, cosines, noise, float(camera.K[0, 0]), rng=rng)
    return time_of_flight.measure(depth, cosines, reflectance, noise, rng=rng)


def _facing(normals: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Cosines between normals and the rays that come back."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    if camera.lens.kind == "pinhole":
        return np.asarray(_facing_pinhole(normals, fx, fy, cx, cy))
    rays = _back(camera.size, (fx, fy, cx, cy), camera.lens)
    cosines: NDArray[np.float32] = rays[0] * normals[..., 0]
    cosines += rays[1] * normals[..., 1]
    cosines += rays[2] * normals[..., 2]
    np.maximum(cosines, np.float32(0.0), out=cosines)
    return cosines


@kernel
def _facing_pinhole(normals: NDArray[np.float32], fx: float, fy: float, cx: float, cy: float) -> Any:
    """Cosines (H, W) between normals and the rays that come back to a pinhole; 0 without a surface."""
    height, width = normals.shape[:2]
    cosines = np.zeros((height, width), np.float32)
    for row in range(height):
        y = (row + 0.5 - cy) / fy
        for column in range(width):
            nx, ny, nz = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
            if nx != 0.0 or ny != 0.0 or nz != 0.0:
                x = (column + 0.5 - cx) / fx
                along = -(x * nx + y * ny + nz)
                if along > 0.0:
                    cosines[row, column] = along / np.sqrt(x * x + y * y + 1.0)
    return cosines


@functools.lru_cache(maxsize=16)
def _back(
    size: tuple[int, int], middle: tuple[float, float, float, float], lens: Lens
) -> NDArray[np.float32]:
    """Directions (3, H, W) from what is seen to the camera."""
    rays = np.nan_to_num(Camera("rays", size, camera_matrix(*middle), lens=lens).rays())
    return np.ascontiguousarray(-np.moveaxis(rays, -1, 0), dtype=np.float32)


def reflectance_of(rgb: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Infrared reflectance of surfaces, estimated from their brightness in sRGB."""
    light: NDArray[np.float32] = cv2.LUT(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), _luminance())
    return light


@functools.cache
def _luminance() -> NDArray[np.float32]:
    return ((np.arange(256) / 255.0) ** 2.2).astype(np.float32)
