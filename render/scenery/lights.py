"""The light in a picture: one lamp that casts shadows, a few that do not, and ambient light.

Directions are in the camera's axes (x right, y down, z ahead)
and point from the hand to the lamp, so that the same lighting suits every view.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimError

_MOST_LAMPS: Final = 5  # pyrender's shader takes four lamps without a shadow


@dataclass(frozen=True, slots=True)
class Lamp:
    """A far lamp."""

    direction: tuple[float, float, float]
    """Direction towards the lamp in the camera's axes; of any length."""
    strength: float
    """Light that a white surface facing the lamp reflects, 1 for the picture's full white."""
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear color, about 1 in the mean."""


@dataclass(frozen=True, slots=True)
class Lighting:
    """All light of one picture.

    Raises:
        HandSimError: There are more than five lamps, or the surroundings do not have nine rows.
    """

    lamps: tuple[Lamp, ...]
    """The first casts shadows."""
    ambient: tuple[float, float, float]
    """Ambient light that a white surface reflects, linear."""
    surroundings: tuple[tuple[float, float, float], ...] = ()
    """Ambient light by the surface's normal, see `surroundings.irradiance`; OpenGL uses `ambient` instead."""

    def __post_init__(self) -> None:
        if len(self.lamps) > _MOST_LAMPS:
            raise HandSimError(f"{len(self.lamps)} lamps, expected at most {_MOST_LAMPS}")
        if len(self.surroundings) not in (0, 9):
            raise HandSimError(f"{len(self.surroundings)} rows of light from around, expected none or nine")


STUDIO: Final = Lighting(
    (
        Lamp((-0.45, -0.7, -1.0), 2.9 / np.pi),
        Lamp((0.85, -0.1, -0.5), 1.3 / np.pi),
        Lamp((0.15, -0.85, 0.5), 1.2 / np.pi),
    ),
    (0.16, 0.16, 0.16),
)
"""Even light of ready-made pictures: a key light, a fill and a rim."""


def sample_lighting(*, rng: np.random.Generator) -> Lighting:
    """Random light: a key lamp from in front or above, fill, sky and ground, each with its color."""
    exposure = float(np.exp(np.clip(rng.normal(0.06, 0.18), -0.35, 0.4)))
    warmth = rng.normal(0.06, 0.06)  # lamps are warm, and white balances keep some of it
    key_share, ambient_share = rng.uniform(0.40, 0.72), rng.uniform(0.16, 0.34)
    # From above more than from below, and seldom from behind the hand.
    key = np.array([rng.normal(0.0, 0.75), rng.normal(-0.65, 0.5), rng.normal(-0.9, 0.45)])
    fill = np.array([-np.sign(key[0]) * rng.uniform(0.4, 1.2), rng.normal(-0.2, 0.4), rng.uniform(-1.1, 0.1)])
    directions = (
        key,
        fill,
        np.array([rng.normal(0.0, 0.3), -1.0, rng.normal(0.1, 0.4)]),
        np.array([rng.normal(0.0, 0.3), 1.0, rng.normal(-0.2, 0.3)]),
    )
    rest = 1.15 - key_share - ambient_share
    shares = (
        key_share,
        rest * rng.uniform(0.4, 0.9),
        rest * rng.uniform(0.2, 0.7),
        rest * rng.uniform(0.05, 0.4),
    )
    lamps = []
    for number, (direction, share) in enumerate(zip(directions, shares, strict=True)):
        own = rng.normal(0.0, 0.03 if number == 0 else 0.08)
        lamps.append(Lamp(_triple(direction), float(exposure * share), _tint(warmth + own, rng)))
    # Lamps in rooms are wide and their shadows faint: part of the key light comes without any.
    hard, key_lamp = rng.uniform(0.25, 0.75), lamps[0]
    lamps[0] = dataclasses.replace(key_lamp, strength=hard * key_lamp.strength)
    lamps.append(dataclasses.replace(key_lamp, strength=(1.0 - hard) * key_lamp.strength))
    ambient = exposure * ambient_share * np.array(_tint(warmth + rng.normal(0.0, 0.06), rng))
    return Lighting(tuple(lamps), _triple(ambient))


def _tint(warmth: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """A lamp's color between candle and sky, as a white balance leaves it, a little green or magenta."""
    green = rng.normal(0.0, 0.015)
    return _triple(np.exp([warmth, green, -1.2 * warmth]))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    first, second, third = values
    return float(first), float(second), float(third)
