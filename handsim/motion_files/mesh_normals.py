"""Normals of objects: smooth over round surfaces, sharp at edges."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy import sparse

_SHARP: Final = np.cos(np.deg2rad(40.0))


def corner_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3 3"]:
    """Outward unit normal at each corner of each face: of the faces there that meet at less than 40 degrees.

    Args:
        faces: Triangles, counter-clockwise from outside.
    """
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    areas = np.cross(second - first, third - first)
    units = _unit(areas)
    count = faces.size
    at = sparse.csr_array((np.ones(count), (np.arange(count), faces.ravel())), shape=(count, len(vertices)))
    one, other = (at @ at.T).nonzero()  # pairs of corners at one vertex
    near = (units[one // 3] * units[other // 3]).sum(axis=1) > _SHARP
    near |= one == other  # a face without an area too
    sums = np.zeros((count, 3))
    np.add.at(sums, one[near], areas[other[near] // 3])
    return _unit(sums).reshape(-1, 3, 3)


def split_vertices(
    faces: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]
) -> tuple[Int[np.ndarray, "W"], Float[np.ndarray, "W 3"], Int[np.ndarray, "F 3"]]:
    """Vertices with one normal each, from triangles with one at each corner.

    Returns:
        The old vertex of each new one, its normal, and the triangles of the new ones.
    """
    keys = np.column_stack([faces.ravel(), np.round(normals.reshape(-1, 3), 4)])
    _, index, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return faces.ravel()[index], normals.reshape(-1, 3)[index], inverse.reshape(-1, 3)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
    unit[lengths[:, 0] == 0.0] = (0.0, 0.0, 1.0)
    return unit
