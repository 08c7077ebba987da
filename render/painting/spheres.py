"""Many balls of one radius as one surface, because a mesh per ball would cost a draw call each."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int


class SphereSurface(NamedTuple):
    """Balls in a row, each with as many vertices and faces as the next."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


def sphere_surface(centers: Float[np.ndarray, "N 3"], radius: float, *, level: int) -> SphereSurface:
    """Balls around these centers [m].

    Args:
        centers: Centers; none of them NaN.
        radius: Of all of them [m].
        level: How often an icosahedron is refined: 20 times 4 to this power triangles a ball.
    """
    ball = _unit_ball(level)
    count, each = len(centers), len(ball.vertices)
    vertices = (centers[:, None] + radius * ball.vertices).reshape(-1, 3)
    faces = (ball.faces + each * np.arange(count)[:, None, None]).reshape(-1, 3)
    return SphereSurface(vertices, np.tile(ball.vertices, (count, 1)), faces)


@functools.cache
def _unit_ball(level: int) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=level)
