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

from handsim.hand.shape import BONES, DIGITS, FIRMNESS, PALM, HandShape
from handsim.kernels import kernel, segment_distance_squared
from handsim.space.transforms import MIRROR

_CARPUS_SPREAD: Final = 0.42  # sideways position of a metacarpal's near end, over that of its knuckle
_CARPUS_RISE: Final = 0.28  # the carpus arches over the line from wrist to knuckles, in palm thicknesses


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """Capsules fixed to bones: K segments with a radius each."""

    bones: Int[np.ndarray, "K"]
    """The bone that carries each capsule, an index into `handsim.hand.shape.BONES`."""
    starts: Float[np.ndarray, "K 3"]
    """One end of each axis in its bone's frame [m]."""
    ends: Float[np.ndarray, "K 3"]
    """The other end of each axis in its bone's frame [m]."""
    radii: Float[np.ndarray, "K"]
    """Radius of each capsule [m]."""

    def posed(self, T_world_bone: Float[np.ndarray, "T L 4 4"]) -> NDArray[np.float64]:
        """Both ends of every axis in the world (T, K, 2, 3) [m]."""
        return np.asarray(_posed(np.ascontiguousarray(T_world_bone), self.bones, self.starts, self.ends))

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
    bones, starts, ends, radii = (np.array(column) for column in zip(*rows, strict=True))
    return Capsules(bones, starts @ mirror, ends @ mirror, radii)


def penetration_depth(
    capsules: Capsules, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> Float[np.ndarray, "T"]:
    """Deepest overlap of any two capsules that may collide [m] in each frame; 0 where nothing touches."""
    return np.asarray(_deepest(capsules.posed(T_world_bone), capsules.radii, capsules.touching_pairs()))


def overlap_between(
    first: Capsules,
    T_world_first: Float[np.ndarray, "T L 4 4"],
    second: Capsules,
    T_world_second: Float[np.ndarray, "T L 4 4"],
) -> Float[np.ndarray, "T"]:
    """Deepest overlap of a capsule of one hand with one of another [m]; minus the gap where none touches."""
    return np.asarray(
        _overlap(first.posed(T_world_first), first.radii, second.posed(T_world_second), second.radii)
    )


@kernel
def _deepest(
    segments: Float[np.ndarray, "T K 2 3"], radii: Float[np.ndarray, "K"], pairs: Int[np.ndarray, "P 2"]
) -> Any:
    """Deepest overlap (T,) [m] of these pairs of capsules of one hand; 0 where nothing touches."""
    depth = np.zeros(len(segments))
    centers, sizes = np.empty((len(radii), 3)), np.empty(len(radii))
    for frame in range(len(segments)):
        bounding_spheres(segments[frame], radii, centers, sizes)
        for pair in range(len(pairs)):
            i, j = pairs[pair, 0], pairs[pair, 1]
            reach = radii[i] + radii[j] - depth[frame]
            near = sizes[i] + sizes[j] - depth[frame]  # capsules overlap by no more than their spheres do
            x, y = centers[i, 0] - centers[j, 0], centers[i, 1] - centers[j, 1]
            z = centers[i, 2] - centers[j, 2]
            if reach > 0.0 and x * x + y * y + z * z < near * near:
                squared = segment_distance_squared(
                    segments[frame, i, 0], segments[frame, i, 1], segments[frame, j, 0], segments[frame, j, 1]
                )
                if squared < reach * reach:
                    depth[frame] = radii[i] + radii[j] - np.sqrt(squared)
    return depth


@kernel
def _overlap(
    first: Float[np.ndarray, "T K 2 3"],
    first_radii: Float[np.ndarray, "K"],
    second: Float[np.ndarray, "T N 2 3"],
    second_radii: Float[np.ndarray, "N"],
) -> Any:
    """Deepest overlap (T,) [m] of capsules of two hands; minus the gap where nothing touches."""
    overlap = np.full(len(first), -np.inf)
    for frame in range(len(first)):
        for i in range(len(first_radii)):
            for j in range(len(second_radii)):
                squared = segment_distance_squared(
                    first[frame, i, 0], first[frame, i, 1], second[frame, j, 0], second[frame, j, 1]
                )
                reach = first_radii[i] + second_radii[j] - overlap[frame]
                if reach > 0.0 and squared < reach * reach:
                    overlap[frame] = first_radii[i] + second_radii[j] - np.sqrt(squared)
    return overlap
