"""The one ordered list of bones and joints: sixteen bones, twenty joints, four per digit.

Together with the free joint of the wrist this is the 26 degree-of-freedom hand of Han et al. 2018,
section 4.1. Axes are given for the right hand in the frame of the joint's bone: x along the bone,
y towards the thumb side, z out of the back (nail) side. Zero angles are the flat hand.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

Side = Literal["left", "right"]
SIDES: Final[tuple[Side, Side]] = ("left", "right")
DIGITS: Final = ("thumb", "index", "middle", "ring", "little")


class Bone(NamedTuple):
    """A rigid segment: its name, its parent's index in `BONES` (palm: -1), and its digit (palm: -1)."""

    name: str
    parent: int
    digit: int


class Joint(NamedTuple):
    """A hinge joint: its name, the index in `BONES` of the bone it moves, its axis, its range [deg]."""

    name: str
    bone: int
    axis: tuple[float, float, float]
    low: float
    high: float


_ABDUCTION: Final = (0.0, 0.0, 1.0)  # positive: towards the thumb; for the thumb itself: away from the palm
_FLEXION: Final = (0.0, 1.0, 0.0)  # positive: towards the palm

PALM: Final = 0
BONES: Final[tuple[Bone, ...]] = (
    Bone("palm", -1, -1),
    Bone("thumb_metacarpal", 0, 0),
    Bone("thumb_proximal", 1, 0),
    Bone("thumb_distal", 2, 0),
    *(
        Bone(f"{digit}_{segment}", PALM if index == 0 else 1 + 3 * number + index - 1, number)
        for number, digit in enumerate(DIGITS)
        if number > 0
        for index, segment in enumerate(("proximal", "middle", "distal"))
    ),
)
BONE_NAMES: Final[tuple[str, ...]] = tuple(bone.name for bone in BONES)
NUM_BONES: Final = len(BONES)

# Ranges [deg]: active ranges of the AAOS and e-hand tables, MCP extension and PIP flexion as in the wider of
# the published sets (docs/anatomy.md lists them side by side). Thumb CMC angles count from the relaxed thumb.
_RANGES: Final = {
    "thumb": ((-33.0, 35.0), (-42.0, 45.0), (-15.0, 65.0), (-20.0, 85.0)),
    "index": ((-22.0, 22.0), (-25.0, 95.0), (-8.0, 112.0), (-12.0, 85.0)),
    "middle": ((-16.0, 16.0), (-25.0, 95.0), (-8.0, 112.0), (-12.0, 85.0)),
    "ring": ((-16.0, 16.0), (-25.0, 98.0), (-8.0, 115.0), (-12.0, 85.0)),
    "little": ((-32.0, 22.0), (-25.0, 100.0), (-8.0, 115.0), (-12.0, 85.0)),
}
_SUFFIXES: Final = {
    "thumb": ("CMC_abduction", "CMC_flexion", "MCP_flexion", "IP_flexion"),
    "finger": ("MCP_abduction", "MCP_flexion", "PIP_flexion", "DIP_flexion"),
}

JOINTS: Final[tuple[Joint, ...]] = tuple(
    Joint(
        f"{digit}_{suffix}",
        1 + 3 * number + max(0, index - 1),
        _ABDUCTION if index == 0 else _FLEXION,
        *_RANGES[digit][index],
    )
    for number, digit in enumerate(DIGITS)
    for index, suffix in enumerate(_SUFFIXES["thumb" if number == 0 else "finger"])
)
JOINT_NAMES: Final[tuple[str, ...]] = tuple(joint.name for joint in JOINTS)
NUM_JOINTS: Final = len(JOINTS)
NUM_QPOS: Final = 7 + NUM_JOINTS
NUM_KEYPOINTS: Final = 1 + 4 * len(DIGITS)
"""Of the wrist, and of three joints and the tip of each digit."""


def bones_of(digit: str) -> tuple[int, int, int]:
    """Indices in `BONES` of a digit's three bones, from the knuckle outwards."""
    first = 1 + 3 * DIGITS.index(digit)
    return first, first + 1, first + 2
