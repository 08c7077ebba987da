"""`SkinLook`, a person's skin in plain values, and its distribution.

Tones go by the individual typology angle, arctan((L* - 50) / b*) in degrees, and its six classes (Chardon,
Cretois and Hourseau 1991, Int. J. Cosmet. Sci. 13:191). Redness and yellowness over that angle are our own
choice: chroma is highest in the middle and falls towards both ends. All palms hold little pigment,
so that dark hands have palms much lighter than their backs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from handsim._checks import check_choice, check_type
from handsim.errors import ArgumentError, HandSimError

TONES: Final[dict[str, tuple[float, float]]] = {
    "very light": (55.0, 64.0),
    "light": (41.0, 55.0),
    "intermediate": (28.0, 41.0),
    "tan": (10.0, 28.0),
    "brown": (-30.0, 10.0),
    "dark": (-52.0, -30.0),
}
"""Individual typology angles [deg] of the classes; the outer two end at the limits of measured skin."""
ALL_TONES: Final = (TONES["dark"][0], TONES["very light"][1])
_ANGLES: Final = (-52.0, -30.0, 0.0, 20.0, 35.0, 50.0, 64.0)
_YELLOWNESS: Final = (12.0, 15.5, 18.5, 18.5, 17.5, 15.5, 12.5)  # CIELAB b* of the back of the hand
_REDNESS: Final = (8.8, 10.5, 12.0, 11.5, 10.5, 9.5, 8.5)  # CIELAB a*


@dataclass(frozen=True, slots=True)
class SkinLook:
    """One person's skin. Colors are CIELAB (D65); strengths are factors, 1 for an average adult.

    Raises:
        HandSimError: The lightness is not within 0 and 100, or the roughness not within 0 and 1.
    """

    lightness: float = 62.0
    """L* of the back of the hand."""
    redness: float = 10.5
    """a* of the back of the hand."""
    yellowness: float = 17.0
    """b* of the back of the hand."""
    palm_lightness: float = 66.0
    """L* of the palm."""
    flush: float = 1.0
    """Redness of finger tips, knuckles and the balls of the hand."""
    blotches: float = 1.0
    """Unevenness of the color."""
    creases: float = 1.0
    """Darkness of palm lines and knuckle wrinkles."""
    veins: float = 1.0
    """Visibility of veins on the back."""
    relief: float = 1.0
    """Height of tendons, knuckles and the skin's grain."""
    nail: tuple[float, float, float] = (3.0, 3.0, -2.0)
    """L*, a*, b* of the nails above the skin's."""
    polish: float = 0.0
    """Share of the nails' color that is `polish_color`."""
    polish_color: tuple[float, float, float] = (40.0, 50.0, 20.0)
    """CIELAB."""
    roughness: float = 0.55
    """Roughness of the microfacet model, from 0 (mirror) to 1 (chalk)."""
    seed: int = 0
    """Seed of blotches, veins and lines."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.lightness <= 100.0 and 0.0 <= self.palm_lightness <= 100.0):
            raise HandSimError(
                f"skin of lightness {self.lightness:g} and {self.palm_lightness:g}, "
                "expected CIELAB's 0 to 100"
            )
        if not 0.0 <= self.roughness <= 1.0:
            raise HandSimError(f"roughness is {self.roughness:g}, expected 0 to 1")

    @property
    def typology_angle(self) -> float:
        """Individual typology angle of the back of the hand [deg]."""
        return float(np.rad2deg(np.arctan2(self.lightness - 50.0, self.yellowness)))

    @property
    def infrared(self) -> float:
        """Reflectance near 850 nm, where tones differ little.

        Pigment absorbs less and less towards 1 um (Jacquez et al. 1955, J. Appl. Physiol. 8:297); the two
        ends are our choice.
        """
        return float(np.interp(self.lightness, (25.0, 75.0), (0.45, 0.6)))


def check_tones(tones: Sequence[float]) -> None:
    """Check the ranges of typology angles that `sample_skin_look` draws from."""
    limits = np.array([-90.0, *tones, 90.0], dtype=np.float64)
    if len(tones) < 2 or len(tones) % 2 or not (np.diff(limits) >= 0.0).all():
        raise ArgumentError(
            f"tones are {tuple(tones)}, expected the low and high ends [deg] of one range or more in "
            "ascending order"
        )


def tone_name(angle: float) -> str:
    """The class of `TONES` that an individual typology angle [deg] is in; beyond all, the outer one."""
    return next((name for name, (low, _) in TONES.items() if angle > low), "dark")


def hyphened(tone: str) -> str:
    """The name of a class of `TONES` as options have it."""
    return tone.replace(" ", "-")


def named_tones(names: Sequence[str]) -> tuple[float, ...]:
    """Ranges of typology angles [deg] of some classes of `TONES`; classes side by side are one range.

    Args:
        names: Of classes, with a space or a hyphen in very light.

    Raises:
        ArgumentError: A class is unknown.
    """
    known = {hyphened(name): angles for name, angles in TONES.items()}
    for name in names:
        check_type("a skin tone", name, str, "its name", known)
        check_choice(hyphened(name), known, noun="skin tone")
    ranges: list[float] = []
    for low, high in sorted({known[hyphened(name)] for name in names}):
        if ranges and low <= ranges[-1]:
            ranges[-1] = high
        else:
            ranges += [low, high]
    return tuple(ranges)


def sample_skin_look(tones: Sequence[float] = ALL_TONES, *, rng: np.random.Generator) -> SkinLook:
    """A random person's skin.

    Args:
        tones: Ends of ranges of typology angles [deg], drawn from uniformly; see `named_tones`.
    """
    angle = _draw_angle(tones, rng)
    yellowness = float(np.interp(angle, _ANGLES, _YELLOWNESS)) * float(np.exp(rng.normal(0.0, 0.06)))
    redness = float(np.interp(angle, _ANGLES, _REDNESS)) + float(np.clip(rng.normal(0.0, 1.0), -2.0, 2.0))
    lightness = 50.0 + yellowness * float(np.tan(np.deg2rad(angle)))
    # Palms of all people lie close together, near what light skin has on the back.
    paleness = rng.uniform(0.6, 0.75)
    palm = max(lightness, (1.0 - paleness) * lightness + paleness * 66.0) + rng.uniform(0.0, 2.0)
    polish = rng.uniform(0.75, 1.0) if rng.random() < 0.08 else 0.0
    color = rng.uniform((25.0, 10.0, -15.0), (75.0, 60.0, 30.0))
    strengths = np.exp(np.clip(rng.normal(0.0, 0.3, 5), -0.7, 0.7))
    nail = np.array([3.0, 3.0, -2.0]) + rng.normal(0.0, (1.5, 1.5, 1.0))
    return SkinLook(
        lightness=lightness,
        redness=redness,
        yellowness=yellowness,
        palm_lightness=float(palm),
        flush=float(strengths[0]),
        blotches=float(strengths[1]),
        creases=float(strengths[2]),
        veins=float(strengths[3]),
        relief=float(strengths[4]),
        nail=(float(nail[0]), float(nail[1]), float(nail[2])),
        polish=float(polish),
        polish_color=(float(color[0]), float(color[1]), float(color[2])),
        roughness=float(rng.uniform(0.5, 0.68)),
        seed=int(rng.integers(2**31)),
    )


def _draw_angle(tones: Sequence[float], rng: np.random.Generator) -> float:
    """A typology angle [deg], uniform over all ranges."""
    lows, widths = np.array(tones[::2]), np.diff(tones)[::2]
    along = rng.uniform(0.0, widths.sum())
    for low, width in zip(lows[:-1], widths[:-1], strict=True):
        if along < width:
            return float(low + along)
        along -= width
    return float(lows[-1] + along)
