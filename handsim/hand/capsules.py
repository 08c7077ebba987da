"""The hand's flesh as capsules, for contact and for occlusion.

A capsule's radius is a share of the skin's, because flesh yields where bone does not: fingers side by side
press into each other, and a marker on the skin must stay outside the capsule it sits on.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.hand.shape import HandShape
from handsim.hand.topology import BONES, DIGITS, PALM
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR

FIRMNESS: Final = 0.8
"""Capsule radius over skin radius."""
_CARPUS_SPREAD: Final = (
    0.42  # where the metacarpals begin: their sideways position at the carpus over the knuckles'
)
_CARPUS_RISE: Final = 0.28  # the carpus arches over the line from wrist to knuckles, in palm thicknesses


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """Capsules fixed to bones: K segments with a radius each."""

    bones: Int[np.ndarray, "K"]
    """The bone that carries each capsule, an index into `topology.BONES`."""
    starts: Float[np.ndarray, "K 3"]
    """One end of each axis in its bone's frame [m]."""
    ends: Float[np.ndarray, "K 3"]
    """The other end [m]."""
    radii: Float[np.ndarray, "K"]
    """Radius of each one [m]."""

    def posed(self, T_world_bone: Float[np.ndarray, "T L 4 4"]) -> NDArray[np.float64]:
        """Both ends of every axis in the world (T, K, 2, 3) [m]."""
        posed: NDArray[np.float64] = _posed(
            np.ascontiguousarray(T_world_bone), self.bones, self.starts, self.ends
        )
        return posed

    def touching_pairs(self) -> NDArray[np.int64]:
        """Pairs (P, 2) that may collide: of different bones without a common joint, MuJoCo's own rule."""
        return _touching_pairs(tuple(self.bones.tolist()))


@functools.cache
def _touching_pairs(bones: tuple[int, ...]) -> NDArray[np.int64]:
    parents = np.array([bone.parent for bone in BONES])
    first, second = np.triu_indices(len(bones), 1)
    a, b = np.array(bones)[first], np.array(bones)[second]
    apart = (a != b) & (parents[a] != b) & (parents[b] != a)
    pairs = np.stack([first[apart], second[apart]], axis=1)
    pairs.setflags(write=False)
    return pairs


@kernel
def _posed(
    transforms: Float[np.ndarray, "T L 4 4"],
    bones: Int[np.ndarray, "K"],
    starts: Float[np.ndarray, "K 3"],
    ends: Float[np.ndarray, "K 3"],
) -> Any:
    """Ends of the capsules' axes (T, K, 2, 3) in the world, from both ends in their bones' frames [m]."""
    posed = np.empty((len(transforms), len(bones), 2, 3))
    for frame in range(len(transforms)):
        for capsule in range(len(bones)):
            pose, a, b = transforms[frame, bones[capsule]], starts[capsule], ends[capsule]
            for i in range(3):
                x, y, z, shift = pose[i, 0], pose[i, 1], pose[i, 2], pose[i, 3]
                posed[frame, capsule, 0, i] = x * a[0] + y * a[1] + z * a[2] + shift
                posed[frame, capsule, 1, i] = x * b[0] + y * b[1] + z * b[2] + shift
    return posed


@kernel
def bounding_spheres(
    segments: Float[np.ndarray, "K 2 3"],
    radii: Float[np.ndarray, "K"],
    centers: Float[np.ndarray, "K 3"],
    sizes: Float[np.ndarray, "K"],
) -> None:
    """Write the bounding spheres of one frame's capsules: centers (K, 3) and sizes (K,), their radii [m]."""
    for k in range(len(radii)):
        squared = 0.0
        for i in range(3):
            centers[k, i] = 0.5 * (segments[k, 0, i] + segments[k, 1, i])
            half = 0.5 * (segments[k, 1, i] - segments[k, 0, i])
            squared += half * half
        sizes[k] = np.sqrt(squared) + radii[k]


def build_capsules(shape: HandShape) -> Capsules:
    """Capsules of a hand: one per phalanx and metacarpal, two for the wrist; mirrored for a left hand."""
    rows: list[tuple[int, NDArray[np.float64], NDArray[np.float64], float]] = []
    firm = FIRMNESS * shape.radii
    for number, bone in enumerate(BONES):
        if bone.digit < 0:
            continue
        index = (number - 1) % 3
        length, tip = shape.bone_lengths[bone.digit, index], shape.radii[bone.digit, 3]
        far = length - tip if index == 2 else length
        radius = float(firm[bone.digit, index : index + 2].mean())
        rows.append((number, np.zeros(3), np.array([far, 0.0, 0.0]), radius))
    thickness = FIRMNESS * shape.palm_thickness / 2
    for digit in range(1, len(DIGITS)):
        knuckle = shape.knuckles[digit]
        carpus = np.array(
            [0.2 * shape.knuckles[2, 0], _CARPUS_SPREAD * knuckle[1], _CARPUS_RISE * shape.palm_thickness]
        )
        rows.append((PALM, carpus, knuckle, min(thickness, float(firm[digit, 0]) * 1.1)))
    for sideways in (-0.1, 0.1):
        across = sideways * shape.breadth
        wrist = np.array([[-0.15 * shape.length, across, 0.0], [0.05 * shape.length, across, 0.0]])
        rows.append((PALM, wrist[0], wrist[1], FIRMNESS * 0.2 * shape.breadth))
    mirror = MIRROR if shape.side == "left" else np.eye(3)
    return Capsules(
        bones=np.array([row[0] for row in rows]),
        starts=np.array([row[1] for row in rows]) @ mirror,
        ends=np.array([row[2] for row in rows]) @ mirror,
        radii=np.array([row[3] for row in rows]),
    )
