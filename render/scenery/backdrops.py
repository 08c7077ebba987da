"""`Backdrop`: the wall or table that a background without depth is a picture of, close behind the hands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

SHARE: Final = 0.6
"""Of backgrounds that could have a backdrop, those that do; the others are too far away for a shadow."""
_GAPS: Final = (0.02, 0.35)  # [m]
_STEEPEST: Final = 0.35  # slope of a backdrop against the picture's plane
_SOFTNESS: Final = (0.03, 0.25)  # lamps from a bare bulb to a window


@dataclass(frozen=True, slots=True)
class Backdrop:
    """A plane behind all of the hands that is in the picture; it catches their shadows."""

    gap: float
    """Its distance from the nearest point of them [m]."""
    recedes: tuple[float, float] = (0.0, 0.0)
    """By how much it recedes to the right and downwards, a length for a length."""
    softness: float = 0.1
    """Tangent of half the angle under which it sees the lamp."""


def sample_backdrop(*, rng: np.random.Generator) -> Backdrop | None:
    """A random backdrop, or none."""
    gap = float(np.exp(rng.uniform(*np.log(_GAPS))))
    right, down = rng.uniform(-_STEEPEST, _STEEPEST, 2)
    softness = float(np.exp(rng.uniform(*np.log(_SOFTNESS))))
    return Backdrop(gap, (float(right), float(down)), softness) if rng.random() < SHARE else None
