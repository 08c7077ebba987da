"""The light of a scene: one lamp that casts shadows, a few that do not, and ambient light.

Directions are in the world's axes and point from the hand to the lamp. Random light is drawn in the axes of a
viewer before the hands (x right, y down, z ahead), and then stays where it is for all cameras.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from handsim._checks import check_count, check_type
from handsim.files.outputs import atomic_write, check_ending
from render.frames import Doubles, Integers, triple
from render.photographs import MAP_SUFFIXES
from render.scenery.backgrounds import (
    LUMINANCE,
    Background,
    Backgrounds,
    Enclosure,
    enclose,
    kept_background,
    light_in,
    sample_background,
)

_SIZE: Final = (64, 48)  # size of the picture that gives light [px]
_DIRECTIONS: Final = 1024  # directions in which the picture's light is sampled
_PICTURE_SHARE: Final = (0.1, 0.5)  # range of the share of ambient light that has the picture's colors
_USUAL_LIGHT: Final = 1.44  # usual light of a white surface before all lamps, 1 for the picture's full white
_MAP_SIZE: Final = (1024, 512)  # size of a written map [px]
_LAMP_SHARPNESS: Final = 300.0  # sharpness of a lamp in it, a spot with a standard deviation of 3.3 degrees
_ALONG_Y: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # axes of a viewer along y
_LAMP_RATIO: Final = 3.0  # ratio to the mean luminance from which on light of a map is a lamp's
# For each function of `_sphere`, the share that a matt surface keeps, and the integral of its square.
_MATT_SHARES: Final = np.array([1.0, *[2.0 / 3.0] * 3, *[0.25] * 5])
_SQUARE_NORMS: Final = np.pi * np.array([4.0, *[4.0 / 3.0] * 3, *[4.0 / 15.0] * 3, 16.0 / 15.0, 16.0 / 5.0])


@dataclass(frozen=True, slots=True)
class Lamp:
    """A far lamp."""

    direction: tuple[float, float, float]
    """Direction towards the lamp in the world's axes; of any length."""
    strength: float
    """Light that a white surface facing the lamp reflects, 1 for the picture's full white."""
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  # linear color, about 1 in the mean


@dataclass(frozen=True, slots=True)
class Lighting:
    """All light of one scene."""

    lamps: tuple[Lamp, ...]  # the first casts shadows
    ambient: tuple[float, float, float]  # ambient light that a white surface reflects, linear
    surroundings: tuple[tuple[float, float, float], ...] = ()
    """Ambient light by the surface's normal, see `irradiance`; OpenGL uses `ambient` instead."""

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> Lighting:
        """This light seen from other axes, to which the rotation turns vectors."""
        lamps = (
            dataclasses.replace(lamp, direction=triple(rotation @ lamp.direction)) for lamp in self.lamps
        )
        rows = turned_irradiance(np.reshape(self.surroundings, (-1, 3)), rotation)
        return Lighting(tuple(lamps), self.ambient, tuple(map(triple, rows)))


STUDIO: Final = Lighting(
    (
        Lamp((-0.45, -0.7, -1.0), 2.9 / np.pi),
        Lamp((0.85, -0.1, -0.5), 1.3 / np.pi),
        Lamp((0.15, -0.85, 0.5), 1.2 / np.pi),
    ),
    (0.16, 0.16, 0.16),
)
"""Even light of ready-made pictures in the viewer's axes: a key light, a fill and a rim."""


def sample_lighting(*, rng: np.random.Generator) -> Lighting:
    """Random light: a key lamp from in front or above, fill, sky and ground, each with its color."""
    # At this level the back of a hand has the brightness of its own color in the median of views.
    exposure = _USUAL_LIGHT * float(np.exp(np.clip(rng.normal(0.0, 0.18), -0.4, 0.4)))
    warmth = rng.normal(0.0, 0.06)  # lamps are warm or cold, and white balances keep some of it
    # These shares give an open palm the standard deviation of lightness that photographs have, 3.6.
    key_share, ambient_share = rng.uniform(0.5, 0.8), rng.uniform(0.09, 0.19)
    # The key light comes from above more often than from below, and seldom from behind the hand.
    key = np.array([rng.normal(0.0, 0.6), rng.normal(-0.6, 0.45), rng.normal(-1.05, 0.3)])
    fill = np.array([-np.sign(key[0]) * rng.uniform(0.4, 1.2), rng.normal(-0.2, 0.4), rng.uniform(-1.1, 0.1)])
    sky = np.array([rng.normal(0.0, 0.3), -1.0, rng.normal(0.1, 0.4)])
    ground = np.array([rng.normal(0.0, 0.3), 1.0, rng.normal(-0.2, 0.3)])
    rest = 1.15 - key_share - ambient_share
    shares = key_share, *(rest * rng.uniform((0.4, 0.2, 0.05), (0.9, 0.7, 0.4)))
    lamps = []
    for number, (direction, share) in enumerate(zip((key, fill, sky, ground), shares, strict=True)):
        own = rng.normal(0.0, 0.03 if number == 0 else 0.08)
        lamps.append(Lamp(triple(direction), float(exposure * share), _tint(warmth + own, rng)))
    # Lamps in rooms are wide and their shadows faint: part of the key light comes without any.
    hard, key_lamp = rng.uniform(0.25, 0.75), lamps[0]
    lamps[0] = dataclasses.replace(key_lamp, strength=hard * key_lamp.strength)
    lamps.append(dataclasses.replace(key_lamp, strength=(1.0 - hard) * key_lamp.strength))
    ambient = exposure * ambient_share * np.array(_tint(warmth + rng.normal(0.0, 0.06), rng))
    return Lighting(tuple(lamps), triple(ambient))


def _tint(warmth: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """A lamp's color after white balance: warm or cool, and a little green or magenta."""
    return triple(np.exp([warmth, rng.normal(0.0, 0.015), -1.2 * warmth]))


def sample_surroundings(
    config: Backgrounds,
    viewer: Float[np.ndarray, "3 3"],
    size: tuple[int, int] = _SIZE,
    around: Float[np.ndarray, "N 3"] | None = None,
    *,
    rng: np.random.Generator,
) -> tuple[Background, Lighting, Enclosure | None]:
    """A random background and its light for a viewer with these axes, as columns in the world's.

    Cameras and hands at positions `around` [m] are in an enclosure. Otherwise the background is a picture,
    which is painted once if `size` is that of the camera's [px].
    """
    background, lighting = sample_background(config, rng=rng), sample_lighting(rng=rng).turned(viewer)
    share = float(rng.uniform(*_PICTURE_SHARE))
    if background.is_map:
        enclosure = enclose(np.zeros((1, 3)) if around is None else around, background.seed, viewer[:, 2])
        return background, _light_of_map(light_in(background, enclosure, _sphere()[0])), enclosure
    if around is None:
        picture = cv2.resize(kept_background(background, size), _SIZE, interpolation=cv2.INTER_AREA)
        return background, surround(lighting, turned_irradiance(irradiance(picture), viewer), share), None
    enclosure = enclose(around, background.seed, np.array(lighting.lamps[0].direction))
    light = light_in(background, enclosure, _sphere()[0])
    return background, surround(lighting, _to_irradiance(light), share), enclosure


def write_environment_map(file: str | Path, *, seed: int = 0) -> None:
    """Write the light in a random room as an environment map (.hdr): its walls and furniture, and its lamps.

    The map has 1024 x 512 [px] of linear light. Pictures take it from their folder of photographs, and other
    programs as the light of their world, z up. Lamps have the strength that hands in such a room see, and
    walls the light that pictures show.

    Raises:
        ArgumentError: The file's name does not end in .hdr, or the seed is negative.
    """
    check_type("file", file, (str, Path), "a path")
    check_count("seed", seed, 0)
    check_ending(Path(file), MAP_SUFFIXES[0], option="file")
    rng, here = np.random.default_rng(seed), np.zeros((1, 3))
    room_config = Backgrounds({"room": 1.0})
    background, lighting, room = sample_surroundings(room_config, _ALONG_Y, around=here, rng=rng)
    assert room is not None
    (width, height), sides = _MAP_SIZE, [np.pi * (np.arange(side) + 0.5) / side for side in _MAP_SIZE]
    azimuth, polar = np.pi - 2.0 * sides[0], sides[1][:, None]
    ways = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)
    rays = np.stack(np.broadcast_arrays(*ways), axis=-1).reshape(-1, 3)
    light = light_in(background, room, rays)
    for lamp in lighting.lamps:
        beside = rays @ np.array(lamp.direction) / np.linalg.norm(lamp.direction) - 1.0
        spot = np.exp(_LAMP_SHARPNESS * beside)[:, None]
        light = light + 0.5 * _LAMP_SHARPNESS * lamp.strength * spot * lamp.color
    written = light.reshape(height, width, 3)[..., ::-1].astype(np.float32)
    with atomic_write(file) as temporary:
        temporary.write_bytes(cv2.imencode(MAP_SUFFIXES[0], written)[1].tobytes())


def _light_of_map(light: Doubles) -> Lighting:
    """A lamp where the light (D, 3) from the directions of `_sphere` is strongest, and ambient light."""
    luminance = np.maximum(light @ LUMINANCE, 1e-6)
    beyond = light * np.maximum(1.0 - _LAMP_RATIO * luminance.mean() / luminance, 0.0)[:, None]
    lamp = 4.0 / len(light) * beyond.sum(axis=0) + 1e-6  # what a white surface that faces it reflects
    rows = _to_irradiance(light - beyond)
    towards = (beyond @ LUMINANCE) @ _sphere()[0] + [0.0, 0.0, 1e-6]
    key = Lamp(triple(towards), float(lamp.mean()), triple(lamp / lamp.mean()))
    return Lighting((key,), triple(rows[0]), tuple(map(triple, rows)))


def surround(lighting: Lighting, rows: Float[np.ndarray, "9 3"], share: float) -> Lighting:
    """Give a share of the ambient light the colors of an irradiance; its luminance stays."""
    ambient = np.array(lighting.ambient)
    rows = rows * share * (ambient @ LUMINANCE) / max(float(rows[0] @ LUMINANCE), 1e-4)
    rows[0] += (1.0 - share) * ambient
    table = tuple(map(triple, rows))
    return dataclasses.replace(lighting, ambient=table[0], surroundings=table)


def irradiance(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "9 3"]:
    """Light of a white matt surface in a picture's light, by its normal (x, y, z) in the viewer's axes.

    Rows are factors of 1, x, y, z, xy, yz, xz, x^2 - y^2 and 3 z^2 - 1.
    """
    height, width = picture.shape[:2]
    light = picture.reshape(-1, 3).take(_pixels_of_directions(width, height), axis=0)
    return _to_irradiance(light.astype(np.float64))


def _to_irradiance(light: Doubles) -> Doubles:
    """What `irradiance` returns (9, 3), of light (D, 3) from the directions of `_sphere`."""
    functions = _sphere()[1]
    factors = (_MATT_SHARES / _SQUARE_NORMS)[:, None]
    return np.asarray(factors * (functions.T @ light) * (4.0 * np.pi / len(functions)))


def turned_irradiance(rows: Float[np.ndarray, "N 3"], rotation: Float[np.ndarray, "3 3"]) -> Doubles:
    """Rows of `irradiance`, or no rows, for normals in the axes that the rotation turns to."""
    if not len(rows):
        return rows
    square = np.empty((3, 3, 3))  # the quadratic part as a symmetric matrix for each color
    square[[0, 1, 0], [1, 2, 2]] = square[[1, 2, 2], [0, 1, 0]] = 0.5 * rows[4:7]
    square[[0, 1, 2], [0, 1, 2]] = rows[7] - rows[8], -rows[7] - rows[8], 2.0 * rows[8]
    square = np.einsum("ij,jkc,lk->ilc", rotation, square, rotation)
    mixed = 2.0 * square[[0, 1, 0], [1, 2, 2]]
    differences = [0.5 * (square[0, 0] - square[1, 1]), 0.5 * square[2, 2]]
    return np.concatenate([rows[:1], rotation @ rows[1:4], mixed, differences])


@functools.lru_cache(maxsize=4)
def _pixels_of_directions(width: int, height: int) -> Integers:
    """Pixel of a picture for each direction of `_sphere` (D,)."""
    directions, _ = _sphere()
    away = np.arccos(np.abs(directions[:, 2])) / (np.pi / 2)
    aside = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1, keepdims=True), 1e-9)
    points = 0.5 + 0.5 * away[:, None] * aside
    columns, rows = np.minimum((points * (width, height)).astype(int), (width - 1, height - 1)).T
    return np.asarray(rows * width + columns)


@functools.cache
def _sphere() -> tuple[Doubles, Doubles]:
    """Even directions (D, 3) on the sphere, and their nine functions (D, 9)."""
    number = np.arange(_DIRECTIONS)
    z = 1.0 - (2.0 * number + 1.0) / _DIRECTIONS
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * number
    x, y = np.sqrt(1.0 - z * z) * np.cos(azimuth), np.sqrt(1.0 - z * z) * np.sin(azimuth)
    functions = [np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0]
    return np.stack([x, y, z], axis=1), np.stack(functions, axis=1)
