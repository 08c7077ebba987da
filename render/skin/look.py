"""`SkinLook` and `Forearm`: a person's skin and arm in plain values, and their distributions.

Tones go by the individual typology angle, arctan((L* - 50) / b*) in degrees, and its six classes (Chardon,
Cretois and Hourseau 1991, Int. J. Cosmet. Sci. 13:191). Redness and yellowness over that angle are our own
choice: chroma is highest in the middle and falls towards both ends. All palms hold little pigment, so that
dark hands have palms much lighter than their backs.

Girths of arms are shares of the hand's breadth: ANSUR II (2012) has wrists of 176 and 154 mm and flexed
forearms of 309 and 263 mm around for hands of 88.3 and 78.2 mm (men's and women's means); a forearm at rest
is about a tenth thinner. Elbows, 1.4 hand lengths behind the wrist, are a little thinner, and upper arms
thicker again (flexed biceps 358 and 305 mm, about a tenth less at rest).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from handsim._checks import check_choice, check_type
from handsim.errors import ArgumentError
from handsim.hand.shape import HandShape
from handsim.settings import Limits, Settings
from handsim.space.transforms import MIRROR, cross
from render.fields import smooth
from render.frames import Doubles, triple

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
_TABLE_ANGLES: Final = (-52.0, -30.0, 0.0, 20.0, 35.0, 50.0, 64.0)
_YELLOWNESS: Final = (12.0, 15.5, 18.5, 18.5, 17.5, 15.5, 12.5)  # CIELAB b* of the back of the hand
_REDNESS: Final = (8.8, 10.5, 12.0, 11.5, 10.5, 9.5, 8.5)  # CIELAB a*
_ARM_PLACES: Final = (0.0, 0.28, 0.62, 1.0, 1.42, 1.9, 2.6, 6.0)
"""Places behind the wrist [hand lengths]; the fifth is the elbow."""
_ARM_GIRTHS: Final = (1.92, 2.1, 2.7, 3.0, 2.85, 3.2, 3.6, 3.8)
"""Girths of the arm at these places [hand breadths]."""
CUFF: Final = 0.0004
"""Length of the step from an arm to its sleeve, between two rings [m]."""
_HEM_THICKNESS: Final = 0.0012  # thickness of a glove's hem [m]
_HEM_MARGIN: Final = 0.004  # distance of a hem from the next rings, so that shading does not round it [m]
_SECTION_POWER: Final = 0.8  # power of cosine and sine in an arm's section; 1 for an ellipse
_SECTION_GIRTH: Final = 1.04  # girth of an arm's section over that of the ellipse with the same axes
_BLEND_LENGTH: Final = 0.22  # length of the blend from the hand's section to the arm's [hand lengths]
BEND: Final = 0.32
"""Length of the bend of the wrist [hand lengths]."""
ELBOW: Final = _ARM_PLACES[4]
"""Place of the elbow behind the wrist [hand lengths]."""
ELBOW_BEND: Final = 0.05
"""Length on either side of the elbow that bends with it [m]."""
REACH: Final = 1.8
"""Length behind the elbow of arms that leave a picture [m]."""


def typology_angle(lightness: float, yellowness: float) -> float:
    """Individual typology angle [deg] of a color's L* and b*."""
    return float(np.rad2deg(np.arctan2(lightness - 50.0, yellowness)))


@dataclass(frozen=True, slots=True)
class SkinLook(Settings):
    """One person's skin. Colors are CIELAB (D65); strengths are factors, 1 for an average adult.

    Raises:
        ArgumentError: The lightness is not within 0 and 100, or the roughness not within 0 and 1.
    """

    lightness: Annotated[float, Limits(0.0, 100.0)] = 62.0
    """L* of the back of the hand."""
    redness: float = 10.5
    """a* of the back of the hand."""
    yellowness: float = 17.0
    """b* of the back of the hand."""
    palm_lightness: Annotated[float, Limits(0.0, 100.0)] = 66.0
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
    roughness: Annotated[float, Limits(0.0, 1.0)] = 0.55
    """Roughness of the microfacet model, from 0 (mirror) to 1 (chalk)."""
    seed: int = 0
    """Seed of blotches, veins and lines."""

    @property
    def typology_angle(self) -> float:
        """Individual typology angle of the back of the hand [deg]."""
        return typology_angle(self.lightness, self.yellowness)

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
    """The class of `TONES` of an individual typology angle [deg]; beyond all classes, the outer one."""
    return next((name for name, (low, _) in TONES.items() if angle > low), "dark")


def hyphened(tone: str) -> str:
    """The name of a class of `TONES` in options."""
    return tone.replace(" ", "-")


def named_tones(names: Sequence[str]) -> tuple[float, ...]:
    """Ranges of typology angles [deg] of some classes of `TONES`; classes side by side are one range."""
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
    """Draw a random person's skin."""
    angle = _draw_angle(tones, rng)
    yellowness = float(np.interp(angle, _TABLE_ANGLES, _YELLOWNESS)) * float(np.exp(rng.normal(0.0, 0.06)))
    redness = float(np.interp(angle, _TABLE_ANGLES, _REDNESS))
    redness += float(np.clip(rng.normal(0.0, 1.0), -2.0, 2.0))
    lightness = 50.0 + yellowness * float(np.tan(np.deg2rad(angle)))
    # The colors of all people's palms are alike, near the color of light skin on the back of the hand.
    paleness = rng.uniform(0.52, 0.68)
    palm = max(lightness, (1.0 - paleness) * lightness + paleness * 66.0) + rng.uniform(6.5, 8.0)
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
        nail=triple(nail),
        polish=float(polish),
        polish_color=triple(color),
        roughness=float(rng.uniform(0.5, 0.68)),
        seed=int(rng.integers(2**31)),
    )


def _draw_angle(tones: Sequence[float], rng: np.random.Generator) -> float:
    """Draw a typology angle [deg], uniformly over all ranges."""
    widths = np.diff(tones)[::2]
    ends = np.cumsum(widths)
    along = rng.uniform(0.0, ends[-1])
    number = int(np.searchsorted(ends[:-1], along, side="right"))
    return float(tones[::2][number] + along - (ends - widths)[number])


@dataclass(frozen=True, slots=True)
class Forearm:
    """A forearm in plain values."""

    length: float = 0.22  # length behind the wrist [m]
    flexion: float = 0.0  # flexion of the wrist towards the palm [rad]
    deviation: float = 0.0  # deviation of the wrist towards the thumb [rad]
    girth: float = 1.0  # factor on the mean girth for the hand's breadth
    sleeve: float = 1.0  # start of a sleeve, behind the wrist [m]; beyond `length` for a bare arm
    sleeve_color: tuple[float, float, float] = (0.2, 0.25, 0.35)  # sRGB in [0, 1]
    looseness: float = 1.2  # girth of the sleeve over the arm's in it
    cuff: float = 0.0  # end of a glove, behind the wrist [m]; 0 for a bare hand


def sample_forearm(*, rng: np.random.Generator) -> Forearm:
    """Draw a random forearm, its wrist bent within half the range; one in three has a sleeve.

    The arm reaches beyond the elbow, where `bent_rings` makes it leave the picture.
    """
    length = rng.uniform(0.62, 0.75)
    flexion, deviation = np.clip(rng.normal(0.0, np.deg2rad((12.0, 6.0))), -0.5, 0.5)
    girth = float(np.exp(np.clip(rng.normal(0.0, 0.06), -0.15, 0.15)))
    sleeve = rng.uniform(0.035, 0.12) if rng.random() < 1 / 3 else 1.0
    color = triple(np.clip(rng.uniform(0.05, 0.85) + rng.normal(0.0, 0.08, 3), 0.02, 0.95))
    loose = float(rng.uniform(1.1, 1.45))
    return Forearm(float(length), float(flexion), float(deviation), girth, float(sleeve), color, loose)


def forearm_rings(shape: HandShape, forearm: Forearm, wrist: Doubles, rings: int) -> Doubles:
    """Rings of skin (rings, R, 3) behind the wrist's (R, 3), nearest first, in the wrist's frame [m]."""
    mirror = MIRROR if shape.side == "left" else np.eye(3)
    right = wrist @ mirror
    center = right.mean(axis=0)
    section = (right - center)[:, 1:]
    lean = right[:, 0] - center[0]  # distance of the wrist's ring from its mean plane
    behind = arm_places(forearm, rings)[1:]
    width, depth = _half_axes(shape, forearm, behind)
    extent = np.abs(section).max(axis=0)
    angle = np.arctan2(section[:, 1] / extent[1], section[:, 0] / extent[0])
    axes_of = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if forearm.sleeve < forearm.length:
        loose = np.where(behind > forearm.sleeve + 0.5 * CUFF, forearm.looseness, 1.0)
        width, depth = loose * width, loose * depth
    half_axes = np.stack([width, depth], axis=-1)[:, None]
    round_section = half_axes * np.sign(axes_of) * np.abs(axes_of) ** _SECTION_POWER
    share = smooth(behind, 0.0, _BLEND_LENGTH * shape.length)[:, None, None]
    sections = (1.0 - share) * section + share * round_section
    thick = np.where(np.abs(behind - forearm.cuff) < 0.5 * CUFF, _HEM_THICKNESS, 0.0)[:, None, None]
    sections *= 1.0 + thick / np.linalg.norm(sections, axis=-1, keepdims=True)
    axes, middles = _arm_course(shape, forearm, behind)
    local = np.concatenate([((1.0 - share) * lean[None, :, None]), sections], axis=-1)
    points: Doubles = center + middles[:, None] + np.einsum("kij,krj->kri", axes, local)
    return points @ mirror


def arm_places(forearm: Forearm, rings: int) -> Doubles:
    """Places (rings + 1,) of the wrist's ring and those behind it along the arm [m].

    Rings are denser near the wrist, which bends, and two pairs of them lie at the end of a glove that no
    sleeve covers, and at the edge of a sleeve.
    """
    places: Doubles = forearm.length * np.linspace(0.0, 1.0, rings + 1) ** 1.7
    covered = min(forearm.sleeve, forearm.length) - 3.0 * _HEM_MARGIN
    steps = [forearm.cuff] * (0.0 < forearm.cuff < covered)
    steps += [forearm.sleeve] * (forearm.sleeve < forearm.length)
    start = 0
    for step in steps:
        edge = step + np.array([-_HEM_MARGIN, 0.0, CUFF, CUFF + _HEM_MARGIN])
        first = int(np.clip(np.abs(places - step).argmin() - 1, start + 1, rings - 4))
        before = places[start : first + 1] - places[start]
        places[start : first + 1] = places[start] + before * ((edge[0] - places[start]) / before[-1])
        last = first + len(edge) - 1
        ends = [edge[-1], max(forearm.length, edge[-1] + _HEM_MARGIN)]
        places[last:] = np.interp(places[last:], [places[last], places[-1]], ends)
        places[first : last + 1] = edge
        start = last
    return places


def bent_rings(
    rings: Doubles, at: float, half: float, towards: Doubles, reach: float | None = None
) -> Doubles:
    """Rings (K, R, 3) of an arm that bends to a direction, from `half` before to `half` behind a place.

    Places are behind the first ring, where the arm is straight beyond the bend; with `reach`, it ends so far
    behind the place [m].
    """
    middles = rings.mean(axis=1)
    ahead = middles[-1] - middles[-2]
    ahead /= np.linalg.norm(ahead)
    steps = np.linalg.norm(np.diff(middles, axis=0), axis=1)
    beyond = np.concatenate([[0.0], np.cumsum(steps)]) - at
    turned = np.flatnonzero(beyond > -half)
    start = middles[turned[0]] - (beyond[turned[0]] + half) * ahead
    if reach is not None:
        beyond = np.minimum(beyond, reach)
        beyond[-1] = reach
    axis = cross(ahead, towards)
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-6 else cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    most, aside = np.arctan2(sine, ahead @ towards), cross(axis, ahead)
    fine = np.concatenate([np.linspace(-half, half, 33), beyond[-1:]])
    angles = most * smooth(fine, -half, half)
    ways = np.cos(angles)[:, None] * ahead + np.sin(angles)[:, None] * aside
    course = np.zeros((len(fine), 3))
    course[1:] = np.cumsum(0.5 * (ways[1:] + ways[:-1]) * np.diff(fine)[:, None], axis=0)
    angle = np.interp(beyond[turned], fine, angles)[:, None]
    places = start + np.stack([np.interp(beyond[turned], fine, course[:, i]) for i in range(3)], axis=1)
    offsets = rings[turned] - middles[turned, None]
    across, along = (offsets @ aside)[..., None], (offsets @ ahead)[..., None]
    offsets += across * ((np.cos(angle) - 1.0) * aside - np.sin(angle) * ahead)[:, None]
    offsets += along * ((np.cos(angle) - 1.0) * ahead + np.sin(angle) * aside)[:, None]
    bent = rings.copy()
    bent[turned] = places[:, None] + offsets
    return bent


def _half_axes(shape: HandShape, forearm: Forearm, behind: Doubles) -> tuple[Doubles, Doubles]:
    """Half width and half depth of the arm's sections [m]: flat at the wrist, rounder and thicker behind."""
    from scipy.interpolate import PchipInterpolator

    girth = forearm.girth * shape.breadth * PchipInterpolator(_ARM_PLACES, _ARM_GIRTHS)(behind / shape.length)
    flatness = 0.70 + 0.18 * smooth(behind, 0.0, shape.length)
    # Ramanujan's formula gives the girth of an ellipse over its half width.
    h = ((1.0 - flatness) / (1.0 + flatness)) ** 2
    around = np.pi * (1.0 + flatness) * (1.0 + 3.0 * h / (10.0 + np.sqrt(4.0 - 3.0 * h)))
    around *= _SECTION_GIRTH
    return girth / around, flatness * girth / around


def _arm_course(shape: HandShape, forearm: Forearm, behind: Doubles) -> tuple[Doubles, Doubles]:
    """Axes (K, 3, 3) and middles (K, 3) of the sections of an arm that bends at the wrist alone."""
    fine = np.linspace(0.0, behind[-1], 200)
    share = smooth(fine, 0.0, BEND * shape.length)
    # Seen from a hand that bends towards its palm (-z) or thumb (y), the arm bends there, too.
    up, aside = forearm.flexion * share, forearm.deviation * share
    ahead = np.stack([np.cos(up) * np.cos(aside), -np.sin(aside), np.sin(up) * np.cos(aside)], axis=-1)
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(-ahead[:-1] * np.diff(fine)[:, None], axis=0)])
    middles = np.stack([np.interp(behind, fine, way[:, i]) for i in range(3)], axis=-1)
    x = np.stack([np.interp(behind, fine, ahead[:, i]) for i in range(3)], axis=-1)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    z = np.array([0.0, 0.0, 1.0]) - x[:, 2:] * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1), middles
