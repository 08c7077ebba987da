"""Simulates color sensors: exposure and noise of a picture, motion blur and rolling shutter.

The noise is that of the linear camera of EMVA 1288 (release 4.0): shot noise of the electrons and noise of
their readout, drawn as one normal number per pixel and channel with the variance of both.

A row of a picture is open for `exposure` seconds; the rows open one after the other, `readout` seconds from
the first to the last. Time 0 is the middle of the middle row's exposure: the time of a frame's ground
truth.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.fields import quantiles, random_words
from render.frames import Bytes, Floats

GAMMA: Final = 2.2
"""Exponent that makes linear light of the painters' display values."""
_ROOT_STEPS: Final = 4096  # entries of a table of the sRGB curve by the root of light, which fits in a cache
_BLUR_KERNEL: Final = (3, 3)  # pixels over which a point of light is spread
_MIDDLE_GRAY: Final = 0.25  # mean light of pictures that keep the nominal exposure
_METERING_LIMITS: Final = (0.25, 4.0)  # range of the ratio of light that metering corrects
_LIGHT_STEPS: Final = 65536  # entries of the table of the sRGB curve: twenty for its narrowest step


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure of one picture. The defaults change nothing."""

    stops: float = 0.0
    """Exposure over the nominal exposure, as a power of two."""
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on red, green and blue after the sensor."""
    white_electrons: float = 0.0
    """Electrons in a pixel that is just white: full well over the sensor's gain; 0: no noise at all."""
    read_noise: float = 0.0
    """Standard deviation of a pixel in the dark [electrons]."""
    vignetting: float = 0.0
    """Share of the light that is missing in the corners."""
    jpeg_quality: int | None = None
    """Quality of JPEG compression, 1 to 100; None without it."""
    blur: float = 0.0
    """Standard deviation of the spread of a point of light by lens and color filters [px]."""
    metering: float = 0.0
    """Share of the difference between a picture's mean light and middle gray that the camera corrects, a stop
    at most."""


@dataclass(frozen=True, slots=True)
class ExposureConfig:
    """Ranges of exposures; drawn uniformly unless stated."""

    stops: tuple[float, float] = (-0.5, 0.4)
    metering: float = 0.12
    """Share of the difference between a picture's mean light and middle gray that cameras correct."""
    balance: float = 0.05
    """Standard deviation of the logarithms of the factors of red and blue."""
    white_electrons: tuple[float, float] = (1000.0, 10000.0)
    """Drawn uniformly on a logarithmic scale."""
    read_noise: tuple[float, float] = (1.5, 6.0)
    vignetting: tuple[float, float] = (0.0, 0.3)
    jpeg_share: float = 0.5
    """Share of pictures with JPEG compression."""
    jpeg_quality: tuple[int, int] = (70, 98)
    blur: tuple[float, float] = (0.3, 0.7)
    """A lens in focus and the interpolation of a color filter's pixels [px]."""


def sample_exposure(config: ExposureConfig, *, rng: np.random.Generator) -> Exposure:
    """Draw a random exposure."""
    red, blue = np.exp(config.balance * rng.standard_normal(2))
    least, most = np.log(config.white_electrons)
    is_jpeg = bool(rng.random() < config.jpeg_share)
    quality = int(rng.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1))
    return Exposure(
        stops=float(rng.uniform(*config.stops)),
        metering=config.metering,
        balance=(float(red), 1.0, float(blue)),
        white_electrons=float(np.exp(rng.uniform(least, most))),
        read_noise=float(rng.uniform(*config.read_noise)),
        vignetting=float(rng.uniform(*config.vignetting)),
        jpeg_quality=quality if is_jpeg else None,
        blur=float(rng.uniform(*config.blur)),
    )


def linear_of(rgb: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Light of sRGB colors, 1 for white; clipped colors stay at white."""
    return np.asarray(cv2.LUT(rgb, light_of(np.arange(256)).astype(np.float32)))


def light_of(levels: NDArray[Any]) -> NDArray[Any]:
    """Linear light of sRGB levels (...,): IEC 61966-2-1 up to level 255, where it is 1; `GAMMA` above."""
    value = levels / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.where(value > 1.0, value**GAMMA, light)


def expose(
    linear: Float32[np.ndarray, "H W 3"], exposure: Exposure, *, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"]:
    """Simulate the sRGB picture that a sensor takes of light, which is 1 for white and may exceed it."""
    height, width = linear.shape[:2]
    rgb = np.empty((height, 3 * width), np.uint8)
    white = exposure.white_electrons
    words = random_words(linear.shape if white > 0.0 else (0, 0, 0), rng=rng)
    away = np.repeat((np.arange(width) + 0.5 - 0.5 * width) ** 2, 3).astype(np.float32)
    gain = np.float32(2.0**exposure.stops * _metering_gain(linear) ** exposure.metering)
    vignetting = np.float32(exposure.vignetting)
    shot = np.float32(1.0 / white if white > 0.0 else 0.0)
    dark = np.float32((exposure.read_noise / white) ** 2 if white > 0.0 else 0.0)
    balance = np.tile(np.array(exposure.balance, dtype=np.float32), width)
    light = np.ascontiguousarray(linear, dtype=np.float32)
    if exposure.blur > 0.0:
        light = cv2.GaussianBlur(light, _BLUR_KERNEL, exposure.blur)
    light = light.reshape(height, 3 * width)
    words, curve = words.reshape(-1, 3 * width), _root_curve()
    _expose(light, gain, vignetting, shot, dark, words, quantiles(), away, balance, curve, rgb)
    rgb = rgb.reshape(linear.shape)
    if exposure.jpeg_quality is None:
        return rgb
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    done, file = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, exposure.jpeg_quality])
    assert done
    return np.asarray(cv2.cvtColor(cv2.imdecode(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))


def _metering_gain(linear: Floats) -> float:
    """Ratio of middle gray to the mean of the light that the lens lets in."""
    values = linear.reshape(len(linear), -1)
    mean = cv2.sumElems(values)[0] / max(cv2.countNonZero(values), 1)
    return float(np.clip(_MIDDLE_GRAY / max(mean, 1e-6), *_METERING_LIMITS))


@kernel
def _expose(
    linear: Floats,
    gain: np.float32,
    vignetting: np.float32,
    shot: np.float32,
    dark: np.float32,
    words: NDArray[np.uint16],
    normal: Floats,
    away: Floats,
    balance: Floats,
    curve: Bytes,
    rgb: Bytes,
) -> None:
    """Write what a sensor makes of light (H, 3 W), row by row, in loops that compile to vector instructions.

    `gain` is a factor on the light in the middle, `vignetting` the share that is missing in the corners,
    `shot` one over the electrons of white, `dark` the variance of the noise in the dark; `words` are random,
    and empty for no noise; `away` is the squared distance of a row's values from the middle column [px^2],
    `balance` a factor on each.
    """
    height, width = linear.shape
    corner = np.float32(1.0 / (0.25 * (height * height + width * width / 9.0)))
    zero, one, half, top = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(_ROOT_STEPS - 1)
    light, noise = np.empty(width, np.float32), np.zeros(width, np.float32)
    level = np.empty(width, np.int32)
    for row in range(height):
        down = np.float32((row + 0.5 - 0.5 * height) ** 2)
        for n in range(width):
            light[n] = linear[row, n] * (gain * (one - vignetting * (down + away[n]) * corner))
        if len(words):
            for n in range(width):
                noise[n] = normal[words[row, n]]
            for n in range(width):
                signal = light[n] if light[n] > zero else zero
                light[n] += noise[n] * np.sqrt(signal * shot + dark)
        for n in range(width):
            value = light[n] * balance[n]
            value = value if value > zero else zero
            level[n] = int(np.sqrt(value if value < one else one) * top + half)
        for n in range(width):
            rgb[row, n] = curve[level[n]]


@functools.cache
def _root_curve() -> Bytes:
    """Table of the sRGB values of light, in even steps of its root: sixteen or more for each value."""
    light = np.arange(_LIGHT_STEPS) / (_LIGHT_STEPS - 1)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    roots = ((np.arange(_ROOT_STEPS) / (_ROOT_STEPS - 1)) ** 2).astype(np.float32)
    return np.rint(255.0 * value).astype(np.uint8)[
        (roots * np.float32(_LIGHT_STEPS - 1) + np.float32(0.5)).astype(np.uint16)
    ]


@dataclass(frozen=True, slots=True)
class Shutter:
    """Exposure times of a picture's rows."""

    exposure: float = 0.0
    """Exposure time of each row [s]."""
    readout: float = 0.0
    """Time from the first row's opening to the last row's [s]; 0 for a global shutter."""
    sub_frames: int = 1
    """Number of instants that are drawn."""


@dataclass(frozen=True, slots=True)
class ShutterConfig:
    """Ranges of shutters; drawn uniformly unless stated."""

    exposure: tuple[float, float] = (0.001, 0.016)
    """Drawn uniformly on a logarithmic scale [s]."""
    readout: tuple[float, float] = (0.005, 0.025)
    """Readout time of a rolling shutter [s]."""
    rolling_share: float = 0.5
    """Share of rolling shutters."""
    sub_frames: int = 8


def sample_shutter(config: ShutterConfig, *, rng: np.random.Generator) -> Shutter:
    """Draw a random shutter."""
    exposure = float(np.exp(rng.uniform(*np.log(config.exposure))))
    rolls, readout = bool(rng.random() < config.rolling_share), float(rng.uniform(*config.readout))
    return Shutter(exposure, readout if rolls else 0.0, config.sub_frames)


def shutter_times(
    exposure: float, readout: float, sub_frames: int, height: int
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "H S"]]:
    """Moments to draw, and the weight of each in each row of the picture.

    The time in which any row is open is cut into as many equal pieces; a moment is a piece's middle, and a
    row's weights are the shares of its exposure that fall into the pieces.
    """
    total = exposure + readout
    cuts = total * (np.arange(sub_frames + 1) / sub_frames - 0.5)
    times = 0.5 * (cuts[:-1] + cuts[1:])
    middles = readout * (np.arange(height) / max(height - 1, 1) - 0.5) if height > 1 else np.zeros(1)
    if exposure < 1e-9:  # each row is a moment, and has the piece that it falls into
        nearest = np.abs(middles[:, None] - times).argmin(axis=1)
        return times, np.eye(sub_frames)[nearest]
    opened, closed = middles[:, None] - 0.5 * exposure, middles[:, None] + 0.5 * exposure
    overlap = np.minimum(closed, cuts[1:]) - np.maximum(opened, cuts[:-1])
    weights = np.maximum(overlap, 0.0)
    weights[weights < 1e-9 * exposure] = 0.0
    return times, weights / weights.sum(axis=1, keepdims=True)


def combine(
    sub_frames: Iterable[UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]],
    weights: Float[np.ndarray, "H S"],
) -> Float32[np.ndarray, "H W 3"]:
    """Combine moments to the light of a shutter's picture, for `render.color_sensor.expose`.

    Moments come in their order, as sRGB bytes or as light; one is held at a time. Weights are those of
    `shutter_times`.
    """
    total: Floats | None = None
    for frame, share in zip(sub_frames, weights.T, strict=True):
        total = np.zeros(frame.shape, np.float32) if total is None else total
        (rows,) = np.nonzero(share)
        if len(rows):
            part = slice(rows[0], rows[-1] + 1)
            light = linear_of(np.ascontiguousarray(frame[part])) if frame.dtype == np.uint8 else frame[part]
            total[part] += light * share[part, None, None].astype(np.float32)
    assert total is not None
    return total
