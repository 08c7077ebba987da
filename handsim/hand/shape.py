"""A hand: its bones and joints, its measures [m], five named sizes, and a population to sample from.

With the free joint of the wrist, sixteen bones and twenty joints (four per digit) make the hand of Han et al.
2018, section 4.1, which has 26 degrees of freedom. Axes are those of the right hand in the frame of the
joint's bone: x along the bone, y towards the thumb side, z out of the back (nail) side. At zero angles the
hand is flat.

Sources, in docs/poses.md with their tables: bone lengths from Buryanov and Kotiuk 2010 (Int. J. Morphol.
28:755), hand length and breadth from ANSUR II (2012), finger girths from Greiner 1991 (NATICK/TR-92/011).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array, check_choice, check_rng, check_type
from handsim.errors import ArgumentError
from handsim.settings import Limits, Settings

Side = Literal["left", "right"]
Size = Literal["XS", "S", "M", "L", "XL"]
SIDES: Final[tuple[Side, Side]] = ("left", "right")
DIGITS: Final = ("thumb", "index", "middle", "ring", "little")
_ABDUCTION_AXIS: Final = (0.0, 0.0, 1.0)
"""Positive abduction moves a finger towards the thumb, and the thumb away from the palm."""
_FLEXION_AXIS: Final = (0.0, 1.0, 0.0)
"""Positive flexion moves a digit towards the palm."""
PALM: Final = 0
# Active ranges of the AAOS and e-hand tables, with MCP extension and PIP flexion of the wider published set
# (docs/angles.md lists the sets side by side). The thumb's first two angles count from its rest.
_RANGES_DEG: Final = {
    "thumb": ((-33.0, 35.0), (-42.0, 45.0), (-15.0, 65.0), (-20.0, 85.0)),
    "index": ((-22.0, 22.0), (-25.0, 95.0), (-8.0, 112.0), (-12.0, 85.0)),
    "middle": ((-16.0, 16.0), (-25.0, 95.0), (-8.0, 112.0), (-12.0, 85.0)),
    "ring": ((-16.0, 16.0), (-25.0, 98.0), (-8.0, 115.0), (-12.0, 85.0)),
    "little": ((-32.0, 22.0), (-25.0, 100.0), (-8.0, 115.0), (-12.0, 85.0)),
}
_JOINT_SUFFIXES: Final = {
    "thumb": ("metacarpal_abduction", "metacarpal_flexion", "MCP_flexion", "IP_flexion"),
    "finger": ("MCP_abduction", "MCP_flexion", "PIP_flexion", "DIP_flexion"),
}
_BONE_PARTS: Final = (("metacarpal", "proximal", "distal"), *[("proximal", "middle", "distal")] * 4)
NUM_KEYPOINTS: Final = 1 + 4 * len(DIGITS)
"""Number of keypoints: the wrist, and three joints and the tip of each digit."""
# A man of hand length 193.9 mm (Buryanov's middle ray on a 37 mm carpus) and breadth 88.3 mm (ANSUR II mean).
REFERENCE_LENGTH: Final = 0.1939
REFERENCE_BREADTH: Final = 0.0883
# Moving bones: proximal, middle, distal with its soft tip; of the thumb metacarpal, proximal, distal.
_BONE_LENGTHS_MM: Final = np.array(
    [[46.2, 31.6, 27.3], [39.8, 22.4, 19.7], [44.6, 26.3, 21.4], [41.4, 25.7, 21.3], [32.7, 18.1, 19.7]]
)
# First joint of each digit in the wrist frame: thumb CMC joint, then the four MCP joints. x follows the
# metacarpal and carpus lengths, y spreads over the breadth, z is the transverse arch.
_KNUCKLES_MM: Final = np.array(
    [[26.0, 25.5, -17.5], [97.5, 27.0, -2.0], [98.0, 5.0, 2.0], [90.5, -15.5, 0.0], [80.5, -35.0, -8.0]]
)
# Direction of each digit at zero angles: yaw about z, pitch towards the palm, roll about its length. With
# these rolls, flexed fingers converge on the scaphoid, and the thumb's nail faces sideways.
_BASE_ANGLES_DEG: Final = np.array(
    [[30.0, 32.0, -87.0], [-1.0, -8.0, -10.0], [-5.0, -2.0, -3.0], [-10.0, -2.0, 4.0], [-18.0, -2.0, 12.0]]
)
# Skin radius at a digit's base, second and third joint and behind the tip: Greiner's girths over 2 pi.
_RADII_MM: Final = np.array(
    [
        [14.5, 11.8, 11.5, 8.6],
        [12.6, 10.9, 9.1, 7.4],
        [12.8, 11.1, 9.3, 7.6],
        [12.2, 10.3, 8.7, 7.2],
        [11.0, 9.2, 7.9, 6.5],
    ]
)
_PALM_THICKNESS_MM: Final = 28.0  # at the metacarpals, without the thenar
# ANSUR II: mean and SD of length and breadth, and their correlation, for women and men.
_MEASURES_MM: Final = {
    "female": ((181.1, 10.1), (78.2, 3.8), 0.57),
    "male": ((193.3, 9.9), (88.3, 4.4), 0.58),
}
# ANSUR II percentiles: women's p5 and p50, the even mixture's p50, men's p50 and p95.
_SIZES_MM: Final = {
    "XS": (165.0, 72.0),
    "S": (180.0, 78.0),
    "M": (187.0, 83.0),
    "L": (193.0, 88.0),
    "XL": (210.0, 96.0),
}
SIZES: Final = {size: (1e-3 * length, 1e-3 * breadth) for size, (length, breadth) in _SIZES_MM.items()}
"""Length and breadth of the named sizes [m]."""
ADULT_LENGTH: Final = (0.187, 0.012)
"""Mean and standard deviation of the length of adults' hands, ANSUR II [m]."""
FIRMNESS: Final = 0.8
"""Radius of the capsule that stands for a bone's flesh in collisions, over the skin's radius."""
_MAX_DIGIT_OVERLAP: Final = 0.00079  # largest overlap at knuckles and across phalanges in every pose [m]
_MAX_ARCH: Final = 4.0  # largest ratio of a metacarpal's flexion to that of its MCP joint
_MIN_LENGTH, _MAX_LENGTH = 1e-4, 1.0  # bounds of every length in a hand [m], far beyond those of people
HAND_DTYPE: Final = np.dtype(
    [
        ("left", "?"),
        ("length", "<f8"),
        ("breadth", "<f8"),
        ("bone_lengths", "<f8", (5, 3)),
        ("knuckles", "<f8", (5, 3)),
        ("base_angles", "<f8", (5, 3)),
        ("radii", "<f8", (5, 4)),
        ("palm_thickness", "<f8"),
    ]
)


class Bone(NamedTuple):
    """A rigid segment: its name, its parent's index in `BONES` (palm: -1), and its digit (palm: -1)."""

    name: str
    parent: int
    digit: int


class Joint(NamedTuple):
    """A hinge joint: its name, the index in `BONES` of the bone that it moves, its axis, and its range."""

    name: str
    bone: int
    axis: tuple[float, float, float]
    low_deg: float
    high_deg: float


BONES: Final[tuple[Bone, ...]] = (
    Bone("palm", -1, -1),
    *(
        Bone(f"{DIGITS[digit]}_{part}", 3 * digit + step if step else PALM, digit)
        for digit, parts in enumerate(_BONE_PARTS)
        for step, part in enumerate(parts)
    ),
)
BONE_NAMES: Final[tuple[str, ...]] = tuple(bone.name for bone in BONES)
NUM_BONES: Final = len(BONES)
DIGIT_OF_BONE: Final = np.array([bone.digit for bone in BONES])
"""Digit of each bone, -1 for the palm."""


JOINTS: Final[tuple[Joint, ...]] = tuple(
    Joint(
        f"{digit}_{suffix}",
        1 + 3 * number + max(0, index - 1),
        _ABDUCTION_AXIS if index == 0 else _FLEXION_AXIS,
        *_RANGES_DEG[digit][index],
    )
    for number, digit in enumerate(DIGITS)
    for index, suffix in enumerate(_JOINT_SUFFIXES["thumb" if number == 0 else "finger"])
)
JOINT_NAMES: Final[tuple[str, ...]] = tuple(joint.name for joint in JOINTS)
NUM_JOINTS: Final = len(JOINTS)
JOINTS_PER_DIGIT: Final = NUM_JOINTS // len(DIGITS)
NUM_QPOS: Final = 7 + NUM_JOINTS


def bones_of(digit: str) -> tuple[int, int, int]:
    """Indices in `BONES` of a digit's three bones, from the knuckle outwards."""
    first = 1 + 3 * DIGITS.index(digit)
    return first, first + 1, first + 2


@dataclass(frozen=True, slots=True, eq=False)
class HandShape:
    """One person's hand, always described as a right hand; `side` names the hand it is.

    Raises:
        ArgumentError: The side is unknown, an array has another shape or is not finite, a measure is no
            hand's, or the hand length is not between 0.05 and 0.35 m.
    """

    side: Side
    length: float
    """Hand length [m] that the mean proportions belong to. From the wrist to the tip of the middle finger the
    flat hand of a person of `sample_shape` has 3.6 mm less on average (standard deviation 3.8 mm)."""
    breadth: float
    """Hand breadth [m] across the metacarpal heads."""
    bone_lengths: Float[np.ndarray, "5 3"]
    """Lengths [m] of the three moving bones of each digit, the last one to the soft tip."""
    knuckles: Float[np.ndarray, "5 3"]
    """Position of each digit's first joint [m] in the wrist frame."""
    base_angles: Float[np.ndarray, "5 3"]
    """Direction of each digit at zero angles [rad]: yaw, pitch, roll."""
    radii: Float[np.ndarray, "5 4"]
    """Skin radius [m] at each digit's three joints and behind its tip."""
    palm_thickness: float
    """Thickness [m] of the palm at the metacarpals."""
    arch: Float[np.ndarray, "2"] = dataclasses.field(default_factory=lambda: np.zeros(2))
    """Flexion of the metacarpals of ring and little finger over that of their MCP joints; 0 where unknown."""

    def __post_init__(self) -> None:
        check_type("side", self.side, str, "the name of one", SIDES)
        check_choice(self.side, SIDES, noun="side")
        for name in ("bone_lengths", "knuckles", "base_angles", "radii"):
            measures = check_array(name, getattr(self, name), HAND_DTYPE[name].shape)
            object.__setattr__(self, name, measures)
        object.__setattr__(self, "arch", check_array("arch", self.arch, (2,)))
        if not ((self.arch >= 0.0) & (self.arch <= _MAX_ARCH)).all():
            raise ArgumentError(f"arch of a hand is {self.arch}, expected ratios from 0 to {_MAX_ARCH:g}")
        _check_measure("length", self.length, 0.05, 0.35)
        for name in ("breadth", "palm_thickness", "bone_lengths", "radii"):
            _check_measure(name, getattr(self, name), _MIN_LENGTH, _MAX_LENGTH)
        _check_measure("knuckles", self.knuckles, -_MAX_LENGTH, _MAX_LENGTH)
        _check_measure("knuckles along the hand", self.knuckles[1:, 0], _MIN_LENGTH, _MAX_LENGTH)
        if np.abs(self.base_angles).max() > 2.0 * np.pi:
            raise ArgumentError("base_angles of a hand are more than a turn, expected radians")

    def with_side(self, side: Side) -> HandShape:
        """The same hand on the other (or the same) arm."""
        return dataclasses.replace(self, side=side)


def _check_measure(name: str, values: float | NDArray[np.float64], low: float, high: float) -> None:
    """Refuse measures [m] beyond those of any hand, because no model can be built from them."""
    measures = np.asarray(values)
    wrong = measures[~((measures >= low) & (measures <= high))]  # also NaN
    if len(wrong):
        raise ArgumentError(f"{name} of a hand: {wrong[0]:g} m, expected {low:g} to {high:g} m")


def shape_from_measures(length: float, breadth: float, *, side: Side = "right") -> HandShape:
    """Hand of mean proportions with this length and breadth [m]; girths follow the breadth."""
    along, across = length / REFERENCE_LENGTH * 1e-3, breadth / REFERENCE_BREADTH * 1e-3
    return HandShape(
        side=side,
        length=length,
        breadth=breadth,
        bone_lengths=_BONE_LENGTHS_MM * along,
        knuckles=_KNUCKLES_MM * np.array([along, across, across]),
        base_angles=np.deg2rad(_BASE_ANGLES_DEG),
        radii=_RADII_MM * across,
        palm_thickness=_PALM_THICKNESS_MM * across,
    )


def named_shape(size: str, *, side: Side = "right") -> HandShape:
    """One of the five sizes XS, S, M, L, XL."""
    check_type("size", size, str, "the name of one", SIZES)
    check_choice(size, SIZES, noun="size")
    return shape_from_measures(*SIZES[size], side=side)


@dataclass(frozen=True, slots=True)
class Population(Settings):
    """The people whose hands `sample_shape` draws; spreads are standard deviations from mean proportions."""

    children: Annotated[float, Limits(0.0, 1.0)] = 0.0
    """Share of children: hand lengths from 0.6 of an adult's (about three years old) upwards."""
    digit_spread: Annotated[float, Limits(0.0)] = 0.035
    """Log spread of a whole digit's length."""
    bone_spread: Annotated[float, Limits(0.0)] = 0.045
    """Log spread of a single bone's length."""
    knuckle_spread: Annotated[float, Limits(0.0)] = 0.001
    """Spread of each knuckle's position [m]."""
    angle_spread: Annotated[float, Limits(0.0)] = 3.0
    """Spread of each finger's base angles [deg]; three times this for the thumb."""
    girth_spread: Annotated[float, Limits(0.0)] = 0.06
    """Log spread of a digit's girth."""


ADULTS: Final = Population()
EVERYBODY: Final = Population(children=0.2)


def sample_shape(
    population: Population = ADULTS, *, side: Side = "right", rng: np.random.Generator
) -> HandShape:
    """A random person's hand: length and breadth as ANSUR II correlates them, proportions varied on top.

    Args:
        population: The people to draw from; adults by default.
        side: Which hand.
        rng: Source of all randomness.

    Returns:
        The hand's length and breadth [m], bone lengths (5, 3) [m], digit directions (5, 3) [rad] and radii
        (5, 4) [m].

    Raises:
        ArgumentError: An argument is of another type, or there is no such side.
    """
    check_type("population", population, Population, "a Population")
    check_rng(rng)
    sex = "female" if rng.random() < 0.5 else "male"
    (length_mean, length_sd), (breadth_mean, breadth_sd), correlation = _MEASURES_MM[sex]
    first, second = np.clip(rng.standard_normal(2), -2.5, 2.5)
    length = length_mean + length_sd * first
    breadth = breadth_mean + breadth_sd * (correlation * first + np.sqrt(1 - correlation**2) * second)
    youth = rng.uniform(0.6, 1.0) if rng.random() < population.children else 1.0
    mean = shape_from_measures(youth * length * 1e-3, youth * breadth * 1e-3, side=side)

    def spread(scale: float, shape: tuple[int, ...]) -> np.ndarray:
        return scale * np.clip(rng.standard_normal(shape), -2.5, 2.5)

    angles = spread(np.deg2rad(population.angle_spread), (len(DIGITS), 3))
    angles[0] *= 3.0
    bones = np.exp(spread(population.digit_spread, (5, 1)) + spread(population.bone_spread, (5, 3)))
    knuckles = mean.knuckles + youth * spread(population.knuckle_spread, (5, 3))
    radii = mean.radii * np.exp(spread(population.girth_spread, (5, 1)))
    lengths = mean.bone_lengths * bones
    _slim_digits(knuckles, lengths, radii)
    return dataclasses.replace(
        mean,
        bone_lengths=lengths,
        knuckles=knuckles,
        base_angles=mean.base_angles + angles,
        radii=radii,
        palm_thickness=mean.palm_thickness * float(np.exp(spread(population.girth_spread, ()))),
    )


def _slim_digits(
    knuckles: Float[np.ndarray, "5 3"], lengths: Float[np.ndarray, "5 3"], radii: Float[np.ndarray, "5 4"]
) -> None:
    """Reduce radii of digits that overlap in every pose [m]: at knuckles, and across a short phalanx."""
    for finger in range(2, len(DIGITS)):
        pair = slice(finger - 1, finger + 1)
        room = np.linalg.norm(knuckles[finger] - knuckles[finger - 1]) + _MAX_DIGIT_OVERLAP
        radii[pair] *= min(1.0, room / (FIRMNESS * radii[pair, :2].mean(axis=1).sum()))
    across = FIRMNESS * 0.5 * radii.sum(axis=1)  # of the bones before and behind the middle one
    radii *= np.minimum(1.0, (lengths[:, 1] + _MAX_DIGIT_OVERLAP) / across)[:, None]


def pack_hand(shape: HandShape) -> tuple[Any, ...]:
    """A hand as one element of a `HAND_DTYPE` array."""
    return (shape.side == "left", *(getattr(shape, name) for name in (HAND_DTYPE.names or ())[1:]))


def unpack_hand(record: np.void) -> HandShape:
    """The hand of one element of a `HAND_DTYPE` array."""
    fields = {name: record[name] for name in (HAND_DTYPE.names or ())[1:]}
    fields = {name: float(value) if np.ndim(value) == 0 else value for name, value in fields.items()}
    return HandShape(side=SIDES[0] if record["left"] else SIDES[1], **fields)
