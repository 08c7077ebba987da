"""What is behind a hand, and the light that comes with it: from lamps, and from the picture all around.

Light from all around is irradiance in spherical harmonics up to the second order, nine numbers a color
(Ramamoorthi and Hanrahan 2001, An efficient representation for irradiance environment maps).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from render.scenery.backgrounds import Background, BackgroundConfig, draw_background, sample_background
from render.scenery.lights import Lighting, sample_lighting
from render.skin.look import SkinLook

_SIZE: Final = (64, 48)  # of the picture that gives light
_DIRECTIONS: Final = 1024
_MIDDLE_SKIN: Final = 0.3  # reflectance
_METERED: Final = 0.5
_SHARE: Final = (0.1, 0.5)  # of the light from everywhere that has the picture's colors, after white balance
_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
# What a matt surface makes of each order, and the integrals of the squared functions over the sphere.
_MATT: Final = np.array([1.0, *[2.0 / 3.0] * 3, *[0.25] * 5])
_SQUARES: Final = np.pi * np.array([4.0, *[4.0 / 3.0] * 3, *[4.0 / 15.0] * 3, 16.0 / 15.0, 16.0 / 5.0])


def sample_surroundings(
    config: BackgroundConfig, skin: SkinLook | None, *, rng: np.random.Generator
) -> tuple[Background, Lighting]:
    """A random background, and random lamps in the light that it gives.

    Args:
        config: Which backgrounds.
        skin: Whose hands the picture is exposed for; None for gloves.
        rng: Where the choices come from.

    Raises:
        HandSimError: There is no photograph that can be read.
    """
    background, lighting = sample_background(config, rng=rng), sample_lighting(rng=rng)
    lighting = surround(lighting, draw_background(background, _SIZE), rng.uniform(*_SHARE))
    return background, lighting if skin is None else expose_for(lighting, skin)


def expose_for(lighting: Lighting, skin: SkinLook) -> Lighting:
    """The lighting after automatic exposure for a hand: stronger for dark skin, weaker for light skin.

    Cameras meter the middle of the picture and its surroundings, so half of the difference between skins is
    compensated.
    """
    reflectance = ((skin.lightness + 16.0) / 116.0) ** 3  # CIELAB's definition
    gain = float((_MIDDLE_SKIN / reflectance) ** _METERED)
    lamps = tuple(dataclasses.replace(lamp, strength=gain * lamp.strength) for lamp in lighting.lamps)
    red, green, blue = (gain * level for level in lighting.ambient)
    around = tuple((gain * r, gain * g, gain * b) for r, g, b in lighting.surroundings)
    return Lighting(lamps, (red, green, blue), around)


def surround(lighting: Lighting, picture: Float[np.ndarray, "H W 3"], share: float) -> Lighting:
    """Give light from everywhere the colors of a picture; how much there is of it stays.

    Args:
        lighting: The light.
        picture: Linear light, taken for all that is before the hand, and mirrored for what is behind.
        share: How much of the light from everywhere comes from the picture.
    """
    ambient = np.array(lighting.ambient)
    rows = irradiance(picture)
    rows *= share * (ambient @ _LUMINANCE) / max(float(rows[0] @ _LUMINANCE), 1e-4)
    rows[0] += (1.0 - share) * ambient
    table = [(float(red), float(green), float(blue)) for red, green, blue in rows]
    return dataclasses.replace(lighting, ambient=table[0], surroundings=tuple(table))


def irradiance(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "9 3"]:
    """What a white matt surface sends back in a picture's light, by its normal in the camera's axes.

    Rows are the factors of 1, x, y, z, xy, yz, xz, x^2 - y^2 and 3 z^2 - 1.

    Args:
        picture: Linear light; its middle is straight ahead, its borders are at right angles to that.
    """
    directions, functions = _sphere()
    height, width = picture.shape[:2]
    away = np.arccos(np.abs(directions[:, 2])) / (np.pi / 2)
    aside = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1, keepdims=True), 1e-9)
    points = 0.5 + 0.5 * away[:, None] * aside
    columns, rows = np.minimum((points * (width, height)).astype(int), (width - 1, height - 1)).T
    light = picture[rows, columns].astype(np.float64)
    projected = functions.T @ light * (4.0 * np.pi / len(directions))
    coefficients: NDArray[np.float64] = (_MATT / _SQUARES)[:, None] * projected
    return coefficients


@functools.cache
def _sphere() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (D, 3) all around, evenly, and the nine functions there (D, 9)."""
    number = np.arange(_DIRECTIONS)
    z = 1.0 - (2.0 * number + 1.0) / _DIRECTIONS
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * number
    x, y = np.sqrt(1.0 - z * z) * np.cos(azimuth), np.sqrt(1.0 - z * z) * np.sin(azimuth)
    functions = [np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0]
    return np.stack([x, y, z], axis=1), np.stack(functions, axis=1)
