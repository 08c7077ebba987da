"""The simple solids that objects are made of: convex parts for fingers, and a mesh for cameras."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.space.transforms import axis_angle_matrix

PartKind = Literal["sphere", "capsule", "cylinder", "box", "ellipsoid", "mesh"]
_AROUND: Final = 16  # sides of a capsule
_TUBE_SIDES: Final = 8
_CUP_SIDES: Final = 40


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A convex piece of an object, one MuJoCo geom."""

    kind: PartKind
    size: Float[np.ndarray, "3"]
    """MuJoCo's sizes [m]: radius; radius and half length along z; three half sizes; zeros for a mesh."""
    T_object_part: Float[np.ndarray, "4 4"]
    """The part's frame seen from the object [m]."""
    vertices: Float[np.ndarray, "N 3"]
    """Corners of a mesh [m], in the part's frame; none for the other kinds."""


Solid = tuple[list[Part], Any]


def build_solid(kind: str, numbers: Sequence[float]) -> Solid:
    """Parts and mesh of one entry of `data/objects.json` (millimeters and degrees there, meters here)."""
    return _SOLIDS[kind](np.asarray(numbers, dtype=np.float64))


def hull_part(vertices: Float[np.ndarray, "N 3"]) -> Part:
    """The convex hull of some points [m] as a part."""
    import trimesh

    hull = trimesh.convex.convex_hull(np.asarray(vertices))
    return Part("mesh", np.zeros(3), np.eye(4), np.asarray(hull.vertices))


def _part(kind: PartKind, size: Sequence[float] | NDArray[np.float64], pose: NDArray[np.float64]) -> Part:
    return Part(kind, np.asarray(size, dtype=np.float64), pose, np.empty((0, 3)))


def _at(position: NDArray[np.float64], rotation: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def _along(start: NDArray[np.float64], end: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Pose whose z axis goes from one point to another, at the middle, and their distance."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return _at((start + end) / 2, rotation), float(np.linalg.norm(end - start))


def _sphere(numbers: NDArray[np.float64]) -> Solid:
    import trimesh

    position, radius = 1e-3 * numbers[:3], 1e-3 * numbers[3]
    pose = _at(position)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return [_part("sphere", (radius, 0.0, 0.0), pose)], mesh.apply_transform(pose)


def _capsule(numbers: NDArray[np.float64]) -> Solid:
    import trimesh

    radius = 1e-3 * numbers[6]
    pose, length = _along(1e-3 * numbers[:3], 1e-3 * numbers[3:6])
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[_AROUND, _AROUND // 2])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return [_part("capsule", (radius, length / 2, 0.0), pose)], mesh.apply_transform(pose)


def _box(numbers: NDArray[np.float64]) -> Solid:
    import trimesh

    pose = _at(1e-3 * numbers[:3], axis_angle_matrix(np.eye(3)[1], np.deg2rad(numbers[6])))
    mesh = trimesh.creation.box(extents=2e-3 * numbers[3:6])
    return [_part("box", 1e-3 * numbers[3:6], pose)], mesh.apply_transform(pose)


def _ellipsoid(numbers: NDArray[np.float64]) -> Solid:
    import trimesh

    pose = _at(1e-3 * numbers[:3], axis_angle_matrix(np.eye(3)[1], np.deg2rad(numbers[6])))
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale(1e-3 * numbers[3:6])
    return [_part("ellipsoid", 1e-3 * numbers[3:6], pose)], mesh.apply_transform(pose)


def _cup(numbers: NDArray[np.float64]) -> Solid:
    """A hollow cup to cameras, a full cylinder to fingers."""
    import trimesh

    low, high, radius, wall, depth = 1e-3 * numbers
    inner, floor = radius - wall, high - depth
    profile = [(0, low), (radius, low), (radius, high), (inner, high), (inner, floor), (0, floor)]
    mesh = trimesh.creation.revolve(profile, sections=_CUP_SIDES)
    pose = _at(np.array([0.0, 0.0, (low + high) / 2]))
    return [_part("cylinder", (radius, (high - low) / 2, 0.0), pose)], mesh


def _arc(numbers: NDArray[np.float64]) -> Solid:
    """A bent tube: a chain of capsules to fingers."""
    center, radius, tube = 1e-3 * numbers[:3], 1e-3 * numbers[9], 1e-3 * numbers[10]
    first, second = (axis / np.linalg.norm(axis) for axis in (numbers[3:6], numbers[6:9]))
    angles = np.deg2rad(np.linspace(numbers[11], numbers[12], int(numbers[13]) + 1))
    outward = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    points = center + radius * outward
    parts = []
    for start, end in itertools.pairwise(points):
        pose, length = _along(start, end)
        parts.append(_part("capsule", (tube, length / 2, 0.0), pose))
    return parts, _tube_mesh(points, outward, np.cross(first, second), tube, bool(np.ptp(angles) > 6.28))


def _tube_mesh(
    points: NDArray[np.float64],
    outward: NDArray[np.float64],
    across: NDArray[np.float64],
    tube: float,
    ring: bool,
) -> Any:
    """Mesh around a polyline: closed upon itself, or with flat ends."""
    import trimesh

    angle = np.linspace(0.0, 2 * np.pi, _TUBE_SIDES, endpoint=False)
    cross = np.cos(angle)[:, None, None] * outward + np.sin(angle)[:, None, None] * across
    rows = (points + tube * cross).swapaxes(0, 1)  # (points, sides, 3)
    if ring:
        rows = rows[:-1]
    count, sides = rows.shape[:2]
    quads = []
    for row in range(count if ring else count - 1):
        for side in range(sides):
            here, there = row * sides, (row + 1) % count * sides
            after = (side + 1) % sides
            quads.append((here + side, here + after, there + after, there + side))
    faces = [(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads]
    vertices = rows.reshape(-1, 3)
    if not ring:
        last = (count - 1) * sides
        faces += [(0, side + 1, side) for side in range(1, sides - 1)]
        faces += [(last, last + side, last + side + 1) for side in range(1, sides - 1)]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


_SOLIDS: Final[dict[str, Callable[[NDArray[np.float64]], Solid]]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "ellipsoid": _ellipsoid,
    "cup": _cup,
    "arc": _arc,
}
