"""Depth of a hand's overlap with itself, and with another hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.hand.capsules import Capsules, bounding_spheres
from handsim.kernels import kernel, segment_distance_squared


def penetration_depth(
    capsules: Capsules, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> Float[np.ndarray, "T"]:
    """Deepest overlap of any two capsules that may collide [m] in each frame; 0 where nothing touches."""
    depth: NDArray[np.float64] = _deepest(
        capsules.posed(T_world_bone), capsules.radii, capsules.touching_pairs()
    )
    return depth


def overlap_between(
    first: Capsules,
    T_world_first: Float[np.ndarray, "T L 4 4"],
    second: Capsules,
    T_world_second: Float[np.ndarray, "T L 4 4"],
) -> Float[np.ndarray, "T"]:
    """Deepest overlap of a capsule of one hand with one of another [m]; minus the gap where none touches."""
    overlap: NDArray[np.float64] = _overlap(
        first.posed(T_world_first), first.radii, second.posed(T_world_second), second.radii
    )
    return overlap


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
            near = sizes[i] + sizes[j] - depth[frame]  # spheres apart by more hold capsules apart by more
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
