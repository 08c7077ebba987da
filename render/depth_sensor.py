"""Simulates depth sensors: noise of disparity (structured light, stereo) and of time of flight.

Disparities follow Barron and Malik (CVPR 2013), who shift pixels, add noise and round to eighths of a
pixel, and Bohg, Romero, Herzog and Schaal (ICRA 2014), whose matching windows fail at edges. Noise of time
of flight grows with distance and angle, pixels at edges see two surfaces at once, and dark surfaces are not
measured.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Annotated, Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.kernels import kernel
from handsim.settings import Limits, Settings
from handsim.space.camera import Camera
from render.fields import normal_numbers, quantiles, random_words
from render.frames import Flags, Floats, Integers, at_rest

_DOTS: Final = (-3, 0, 3)  # one pixel in nine is a dot, so that a window of 9 x 9 holds these
_BYTE_VALUES: Final = np.arange(256)
_SHADOW_SLACK: Final = 2.0  # disparity by which a surface may shadow itself [px]
_WALL_REFLECTANCE: Final = 0.8  # reflectance of the white walls for which noise was published
_ANGLE_BINS: Final = 1024  # number of cosines in the table of `_angle_terms`
_FADING_ANGLE: Final = 0.09  # range of angles before the steepest where pixels are lost at random [rad]
_NO_DEPTH: Final = np.float32(1e6)  # stands for the depth of pixels without a surface
OTHER_NAMES: Final = {"realsense_d435": "d435"}


@dataclass(frozen=True, slots=True)
class StructuredLight(Settings):
    """Noise of a disparity sensor; see `docs/sensors.md` for the sources of the numbers."""

    sensor: str = "kinect1"
    baseline: Annotated[float, Limits(0.0, above=True)] = 0.075
    """Distance of the projector or second camera, which is to the right of the camera [m]."""
    step: Annotated[float, Limits(0.0)] = 0.125
    """Step to which disparities are rounded [px]; 0 for no rounding."""
    disparity_noise: Annotated[float, Limits(0.0)] = 0.125 / 6
    """Standard deviation before rounding [px]."""
    window: Annotated[int, Limits(1)] = 9
    """Width of the window that is matched [px]: windows that overlap have noise in common. 9 is BlenSor's
    for a Kinect (Gschwandtner et al., ISVC 2011), 7 Keselman et al.'s (CVPR workshops 2017) for a D435."""
    shift: Annotated[float, Limits(0.0, 10.0)] = 0.5
    """Standard deviation of the shift of pixels, along columns and rows [px], rounded to whole pixels."""
    support: float = 0.6
    """Mean share of a window's other dots that must agree with its middle."""
    wavering: float = 0.15
    """Standard deviation of the share of `support`, which is equal in patches of 3 x 3 pixels."""
    agreement: float = 1.0
    """Largest difference of disparity inside a window [px]."""
    steepest: float = 1.4
    """Largest angle between a surface's normal and the ray that comes back [rad]."""
    shadow: bool = True
    """Whether surfaces that the projector does not see are not measured."""
    nearest: float = 0.4
    """Least depth that is measured [m]."""
    farthest: float = 4.0
    """Largest depth that is measured [m]."""


def _measure_disparity(
    depth: Floats, cosines: Floats, noise: StructuredLight, focal: float, *, rng: np.random.Generator
) -> Floats:
    """Measured depth (H, W) [m], 0 where there is none; `focal` is the horizontal focal length [px]."""
    scale, height, width = np.float32(noise.baseline * focal), *depth.shape
    ideal, kept = np.zeros_like(depth), np.zeros(depth.shape, np.bool_)
    nearest, farthest = np.float32(noise.nearest), np.float32(noise.farthest)
    _write_ideal(depth, cosines, scale, nearest, farthest, float(np.cos(noise.steepest)), ideal, kept)
    offsets = np.rint(noise.shift * quantiles()[128::256]).astype(np.int64)
    beyond = max(_DOTS[-1], int(np.abs(offsets).max()))
    around = cv2.copyMakeBorder(ideal, beyond, beyond, beyond, beyond, cv2.BORDER_REPLICATE)
    if noise.support > 0.0:
        coarse = normal_numbers(((height + 2) // 3, (width + 2) // 3), rng=rng)
        needed = np.ceil((len(_DOTS) ** 2 - 1) * (noise.support + noise.wavering * coarse))
        _keep_supported(around, needed.repeat(3, axis=1), np.float32(noise.agreement), kept)
    if noise.shadow:
        keep_lit(ideal, kept)
    shifts = random_words((height, width) if noise.shift > 0.0 else (0, 0), rng=rng)
    blobs = _blobs((height, width), noise.window, noise.disparity_noise, rng=rng)
    measured = np.empty_like(depth)
    step, least = np.float32(noise.step), np.float32(0.5 * scale / noise.farthest)
    _match(around, kept, shifts, offsets, blobs, step, least, scale, measured)
    return measured


def _blobs(shape: tuple[int, int], window: int, sigma: float, *, rng: np.random.Generator) -> Floats:
    """Nearly normal noise (H, W), for each pixel the sum of random bytes in a window [px] around it.

    Two pixels that are k apart along a row or column have a correlation of 1 - k / window.
    """
    (rows, columns), half = (side + window for side in shape), window // 2
    numbers = random_words((rows, (columns + 1) // 2), rng=rng).view(np.uint8)
    sums = cv2.boxFilter(numbers, cv2.CV_32F, (window, window), normalize=False)
    sums -= np.float32(window**2 * _BYTE_VALUES.mean())
    sums *= np.float32(sigma / (window * _BYTE_VALUES.std()))
    return np.asarray(sums[half : half + shape[0], half : half + shape[1]])


@kernel
def _write_ideal(
    depth: Floats,
    cosines: Floats,
    scale: np.float32,
    nearest: np.float32,
    farthest: np.float32,
    flattest: float,
    disparity: Floats,
    kept: Flags,
) -> None:
    """Write disparities `scale / depth` (H, W) [px], and which surfaces are in range and not too steep."""
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            here = depth[row, column]
            if here > 0.0:
                disparity[row, column] = scale / here
                kept[row, column] = nearest <= here <= farthest and cosines[row, column] >= flattest


@kernel
def keep_lit(disparity: Floats, kept: Flags) -> None:
    """Clear pixels of `kept` (H, W) that a nearer surface hides from the projector, to the right in the row.

    A pixel of disparity d is d columns further left in the projector's picture. Where several pixels fall on
    one of its columns, the nearest one is visible to it.
    """
    height, width = disparity.shape
    most = np.float32(np.ceil(max(disparity.max(), np.float32(0.0))) + 1.5)  # cells are rounded
    first, cells = np.zeros(width + int(most) + 2, np.float32), np.empty(width, np.int32)
    around = np.zeros_like(first)
    for row in range(height):
        first[:] = 0.0
        near = disparity[row]
        for column in range(width):
            cells[column] = 1 + np.int32(np.float32(column) - near[column] + most)
        for column in range(width):
            cell = np.uint64(cells[column])  # saves a test for negative indices
            first[cell] = max(first[cell], near[column])
        for n in range(1, len(first) - 1):  # neighbors close what rounding left open
            around[n] = max(first[n - 1], first[n], first[n + 1])
        for column in range(width):
            kept[row, column] &= around[np.uint64(cells[column])] <= near[column] + np.float32(_SHADOW_SLACK)


@kernel
def _keep_supported(around: Floats, needed: Floats, most: np.float32, kept: Flags) -> None:
    """Clear those of `kept` (H, W) with fewer dots in the window that agree with its middle than are needed.

    Disparities go on beyond the picture, so that no window ends at its edge. `needed` has a row for three of
    the picture's, and `most` is the largest difference [px].
    """
    height, width = kept.shape
    border, agreed = (len(around) - height) // 2, np.empty(width, np.float32)
    zero, one, all_others = np.float32(0.0), np.float32(1.0), np.float32(len(_DOTS) ** 2 - 1)
    for row in range(border, border + height):
        middle = around[row, border:]
        agreed[:] = zero
        for down in _DOTS:
            for right in _DOTS:
                if down == right == 0:
                    continue
                other = around[row + down, border + right :]
                for n in range(width):
                    agreed[n] += one if abs(other[n] - middle[n]) <= most else zero
        least = needed[(row - border) // 3]
        for n in range(width):  # where all agree, nothing is lost
            kept[row - border, n] &= agreed[n] >= min(least[n], all_others)


@kernel
def _match(
    around: Floats,
    kept: Flags,
    shifts: NDArray[np.uint16],
    offsets: Integers,
    noise: Floats,
    step: np.float32,
    least: np.float32,
    scale: np.float32,
    depth: Floats,
) -> None:
    """Write the measured depth [m] of the pixels that are kept, and 0 for all others.

    Each takes its disparity from some whole pixels away, so that no value is made up between near and far;
    then come noise (H, W) [px] and rounding. Both bytes of random words pick offsets (256,) [px], as far as
    disparities go on beyond the picture; no words pick none. Less than the `least` disparity is nothing.
    """
    height, width = kept.shape
    values, tiny, zero = np.empty(width, np.float32), np.float32(1e-6), np.float32(0.0)
    flat, stride = around.reshape(-1), around.shape[1]
    border, down = (stride - width) // 2, stride * offsets
    for row in range(height):
        start = (row + border) * stride + border
        values[:] = flat[start : start + width]
        for column in range(width if len(shifts) else 0):
            word = np.uint64(shifts[row, column])
            place = start + column + down[word >> np.uint64(8)] + offsets[word & np.uint64(255)]
            values[column] = flat[np.uint64(place)]  # saves a test for negative indices
        for column in range(width):
            value = values[column] + noise[row, column]
            value = np.rint(value / step) * step if step > zero else value
            far = scale / (value if value > tiny else tiny)
            depth[row, column] = far if kept[row, column] and value > least else zero


@dataclass(frozen=True, slots=True)
class TimeOfFlight(Settings):
    """Noise of a time-of-flight sensor; see `docs/sensors.md` for the sources of the numbers."""

    sensor: str = "kinect2"
    sigma: tuple[float, float, float] = (1.5e-3, -0.5e-3, 0.3e-3)
    """Standard deviation of a white wall that faces the camera at depth z: c0 + c1 z + c2 z^2 [m]."""
    angle_sigma: float = 0.1e-3
    """Factor of what an angle a adds to it at depth z, z^1.5 (a / (pi/2 - a))^2 [m]."""
    window: Annotated[int, Limits(1)] = 3
    """Width of the square of pixels whose light gives one pixel its depth [px]: the filter of Kinect
    v2's phases in libfreenect2 has nearly even weights in 3 x 3 pixels."""
    offset: float = 0.0
    """Error of every depth [m]."""
    edge: float = 0.03
    """Step between neighboring pixels that makes an edge, as a share of the depth."""
    flying: float = 0.5
    """Share of pixels along edges that mix both surfaces."""
    dropped: float = 0.15
    """Share of pixels along edges that are not measured."""
    weakest: float = 0.0074
    """Least light that is measured: reflectance times the angle's cosine over the squared depth [1/m^2]."""
    steepest: float = 1.48
    """Largest angle between a surface's normal and the ray that comes back [rad]."""
    step: float = 0.001
    """Step to which depths are rounded [m]; 0 for no rounding."""
    nearest: float = 0.5
    """Least depth that is measured [m]."""
    farthest: float = 4.5
    """Largest depth that is measured [m]."""


def _measure_flight(
    depth: Floats, cosines: Floats, reflectance: Floats, noise: TimeOfFlight, *, rng: np.random.Generator
) -> Floats:
    """Measured depth (H, W) [m], 0 where there is none."""
    there = depth > 0.0
    measured = _with_flying_pixels(depth, noise, rng=rng)
    c0, c1, c2 = (np.float32(c) for c in noise.sigma)
    if any(noise.sigma) or noise.angle_sigma:
        sigma = (c2 * depth + c1) * depth + c0
        if noise.angle_sigma > 0.0:
            bands = (cosines * np.float32(_ANGLE_BINS - 1) + np.float32(0.5)).astype(np.uint16)
            sigma += depth * np.sqrt(depth) * _angle_terms(noise.angle_sigma).take(bands, mode="clip")
        # Shot noise goes with the root of the light.
        sigma *= np.sqrt(np.float32(_WALL_REFLECTANCE) / np.maximum(reflectance, np.float32(0.02)))
        measured += sigma * _blobs(depth.shape, noise.window, 1.0, rng=rng)
    measured += np.float32(noise.offset)
    if noise.step > 0.0:
        measured = np.rint(measured * np.float32(1.0 / noise.step)) / np.float32(1.0 / noise.step)
    there &= (measured >= noise.nearest) & (measured <= noise.farthest)
    _drop_unmeasured(there, depth, cosines, reflectance, noise, rng=rng)
    return np.where(there, measured, np.float32(0.0))


def _with_flying_pixels(depth: Floats, noise: TimeOfFlight, *, rng: np.random.Generator) -> Floats:
    """Add flying pixels along edges to depth, and 0 where an edge is not measured."""
    mixed = depth.copy()
    around = np.ones((3, 3), np.uint8)
    far = cv2.dilate(depth, around)
    near = cv2.erode(np.where(depth > 0.0, depth, _NO_DEPTH), around)
    bare = cv2.erode(depth, around) <= 0.0
    pixels = np.flatnonzero((depth > 0.0) & (bare | (far - near > np.float32(noise.edge) * depth)))
    here, near, far = depth.ravel()[pixels], near.ravel()[pixels], far.ravel()[pixels]
    fate, share = rng.random((2, len(pixels)), dtype=np.float32)
    other = np.where(here - near < far - here, far, near)
    # Light goes with the squared distance, and the phase follows the brighter part.
    own_light, other_light = (1.0 - share) / here**2, share / other**2
    flying_depth = (own_light * here + other_light * other) / (own_light + other_light)
    flies = (fate < noise.flying) & (far - near > noise.edge * here)
    value = np.where(flies, flying_depth, here)
    mixed.ravel()[pixels] = np.where(fate >= 1.0 - noise.dropped, np.float32(0.0), value)
    return mixed


def _drop_unmeasured(
    there: Flags,
    depth: Floats,
    cosines: Floats,
    reflectance: Floats,
    noise: TimeOfFlight,
    *,
    rng: np.random.Generator,
) -> None:
    """Drop pixels that are too steep, and at random those whose light is within half of the least light."""
    last = np.cos(noise.steepest - _FADING_ANGLE)
    steep = np.flatnonzero(there & (cosines < last))
    chance = (last - cosines.ravel()[steep]) / max(last - np.cos(noise.steepest), 1e-9)
    there.ravel()[steep] = rng.random(len(steep), dtype=np.float32) > chance
    if noise.weakest <= 0.0:
        return
    light = reflectance * cosines
    dim = np.flatnonzero(there & (light < np.float32(1.5 * noise.weakest) * depth * depth))
    chance = 1.5 - light.ravel()[dim] / depth.ravel()[dim] ** 2 / noise.weakest
    there.ravel()[dim] = rng.random(len(dim), dtype=np.float32) > chance


@functools.lru_cache(maxsize=16)
def _angle_terms(angle_sigma: float) -> Floats:
    angles = np.arccos(np.linspace(0.0, 1.0, _ANGLE_BINS))
    angles = np.minimum(angles, np.deg2rad(85.0))  # the formula grows without a limit, which noise does not
    return (angle_sigma * (angles / (np.pi / 2 - angles)) ** 2).astype(np.float32)


DepthNoise = StructuredLight | TimeOfFlight
# Numbers and their sources are in docs/sensors.md.
DEPTH_NOISES: Final[dict[str, DepthNoise]] = {
    "kinect1": StructuredLight(),
    "d435": StructuredLight(
        sensor="d435",
        baseline=0.05,
        step=1.0 / 32.0,
        disparity_noise=0.08,
        window=7,
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
SENSORS: Final = tuple(DEPTH_NOISES)


@dataclass(frozen=True, slots=True)
class DepthSensor(Settings):
    """A depth sensor whose noise is added to depth, or several, one of which is drawn each time.

    Raises:
        ArgumentError: A sensor is unknown, or a number is negative.
    """

    sensors: tuple[str, ...] = ("kinect2",)
    """Some of `SENSORS`; a name stands for itself alone."""
    noise: Annotated[float, Limits(0.0)] = 1.0
    """Factor on the sensor's published noise."""
    spread: Annotated[float, Limits(0.0)] = 0.2
    """Standard deviation of the logarithm of the noise of copies of a sensor."""
    offset: Annotated[float, Limits(0.0)] = 0.0035
    """Standard deviation of the offset of copies of a time-of-flight camera [m]."""

    def check(self) -> None:
        """Refuse names of sensors that are unknown."""
        names = tuple(OTHER_NAMES.get(name, name) for name in self.sensors)
        for name in names:
            check_choice(name, SENSORS, noun="depth sensor")
        object.__setattr__(self, "sensors", names)


def sample_depth_noise(config: DepthSensor, *, rng: np.random.Generator) -> DepthNoise | None:
    """Draw a copy of one of the sensors; None if there are none."""
    sensors = [DEPTH_NOISES[name] for name in config.sensors]
    if not sensors:
        return None
    noise = sensors[int(rng.integers(len(sensors)))]
    factor = config.noise * float(np.exp(config.spread * rng.standard_normal()))
    offset = float(rng.standard_normal())
    if isinstance(noise, StructuredLight):
        return dataclasses.replace(noise, disparity_noise=factor * noise.disparity_noise)
    c0, c1, c2 = (factor * c for c in noise.sigma)
    return dataclasses.replace(noise, sigma=(c0, c1, c2), offset=config.offset * offset)


def apply_depth_noise(
    depth: Float32[np.ndarray, "H W"],
    normals: Float32[np.ndarray, "H W 3"],
    noise: DepthNoise,
    *,
    camera: Camera,
    reflectance: Float32[np.ndarray, "H W"] | None,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "H W"]:
    """Simulate the depth along the camera's axis that a sensor measures [m], 0 where there is none.

    Normals are in the camera's axes. Only time of flight depends on the reflectance for infrared light.
    """
    cosines = _facing(normals, camera)
    if isinstance(noise, StructuredLight):
        return _measure_disparity(depth, cosines, noise, float(camera.K[0, 0]), rng=rng)
    assert reflectance is not None
    return _measure_flight(depth, cosines, reflectance, noise, rng=rng)


def _facing(normals: Floats, camera: Camera) -> Floats:
    """Cosines (H, W) between normals and the rays back to the camera."""
    if camera.lens.kind == "pinhole":
        (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
        return np.asarray(_facing_pinhole(normals, fx, fy, cx, cy))
    rays = _directions_to_camera(at_rest(camera))
    cosines: Floats = rays[0] * normals[..., 0]
    cosines += rays[1] * normals[..., 1]
    cosines += rays[2] * normals[..., 2]
    np.maximum(cosines, np.float32(0.0), out=cosines)
    return cosines


@kernel
def _facing_pinhole(normals: Floats, fx: float, fy: float, cx: float, cy: float) -> Any:
    """Cosines (H, W) between normals and the rays that come back to a pinhole; 0 without a surface."""
    height, width = normals.shape[:2]
    cosines, zero, one = np.empty((height, width), np.float32), np.float32(0.0), np.float32(1.0)
    across = ((np.arange(width) + 0.5 - cx) / fx).astype(np.float32)
    for row in range(height):
        y, into, of = np.float32((row + 0.5 - cy) / fy), cosines[row], normals[row]
        for n in range(width):
            along = -(across[n] * of[n, 0] + y * of[n, 1] + of[n, 2])
            into[n] = (along if along > zero else zero) / np.sqrt(across[n] * across[n] + (y * y + one))
    return cosines


@functools.lru_cache(maxsize=16)
def _directions_to_camera(camera: Camera) -> Floats:
    """Directions (3, H, W) from the pixels' surfaces to the camera."""
    return np.ascontiguousarray(-np.moveaxis(np.nan_to_num(camera.rays()), -1, 0), dtype=np.float32)


def reflectance_of(rgb: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Infrared reflectance of surfaces, estimated from their brightness in sRGB."""
    luminance = ((_BYTE_VALUES / 255.0) ** 2.2).astype(np.float32)
    return np.asarray(cv2.LUT(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), luminance))
