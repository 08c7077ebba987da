"""The objects that come with handsim: `handsim/data/objects.npz` of the solids in `rigid_objects.json`.

python -m benchmarks.rigid_objects
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import handsim
from handsim.files.arrays import Member, write_npz
from handsim.files.outputs import atomic_write
from handsim.space.objects import MARKER_RADIUS, Part
from handsim.space.transforms import axis_angle_matrix, frame_with_z, rigid, unit

DATA: Final = Path(handsim.__file__).parent / "data" / "objects.npz"
_AROUND: Final = 16  # sides of a capsule
Solid = tuple[list[Part], Any]


def _along(start: NDArray[np.float64], end: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Pose in the middle of two points, its z axis from one to the other, and their distance."""
    return rigid(frame_with_z(end - start), (start + end) / 2), float(np.linalg.norm(end - start))


def _sphere(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    position, radius = 1e-3 * numbers[:3], 1e-3 * numbers[3]
    pose = rigid(np.eye(3), position)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return [Part("sphere", np.array([radius, 0.0, 0.0]), pose)], mesh.apply_transform(pose)


def _capsule(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    radius = 1e-3 * numbers[6]
    pose, length = _along(1e-3 * numbers[:3], 1e-3 * numbers[3:6])
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[_AROUND, _AROUND // 2])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return [Part("capsule", np.array([radius, length / 2, 0.0]), pose)], mesh.apply_transform(pose)


def _box(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    pose = rigid(axis_angle_matrix(np.eye(3)[1], np.deg2rad(numbers[6])), 1e-3 * numbers[:3])
    mesh = trimesh.creation.box(extents=2e-3 * numbers[3:6])
    return [Part("box", 1e-3 * numbers[3:6], pose)], mesh.apply_transform(pose)


def _ellipsoid(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    pose = rigid(axis_angle_matrix(np.eye(3)[1], np.deg2rad(numbers[6])), 1e-3 * numbers[:3])
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale(1e-3 * numbers[3:6])
    return [Part("ellipsoid", 1e-3 * numbers[3:6], pose)], mesh.apply_transform(pose)


def _cup(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    """A cup, which cameras see hollow and fingers touch as a full cylinder."""
    low, high, radius, wall, depth = 1e-3 * numbers
    inner, floor = radius - wall, high - depth
    profile = [(0, low), (radius, low), (radius, high), (inner, high), (inner, floor), (0, floor)]
    mesh = trimesh.creation.revolve(profile, sections=40)
    pose = rigid(np.eye(3), (0.0, 0.0, (low + high) / 2))
    return [Part("cylinder", np.array([radius, (high - low) / 2, 0.0]), pose)], mesh


def _arc(numbers: NDArray[np.float64], trimesh: Any) -> Solid:
    """A bent tube, which fingers touch as a chain of capsules."""
    center, radius, tube = 1e-3 * numbers[:3], 1e-3 * numbers[9], 1e-3 * numbers[10]
    first, second = (axis / np.linalg.norm(axis) for axis in (numbers[3:6], numbers[6:9]))
    angles = np.deg2rad(np.linspace(numbers[11], numbers[12], int(numbers[13]) + 1))
    outward = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    points = center + radius * outward
    pieces = [_along(start, end) for start, end in itertools.pairwise(points)]
    parts = [Part("capsule", np.array([tube, length / 2, 0.0]), pose) for pose, length in pieces]
    return parts, _tube_mesh(
        trimesh, points, outward, np.cross(first, second), tube, bool(np.ptp(angles) > 6.28)
    )


def _tube_mesh(
    trimesh: Any,
    points: NDArray[np.float64],
    outward: NDArray[np.float64],
    across: NDArray[np.float64],
    tube: float,
    ring: bool,
) -> Any:
    """Mesh around a polyline: closed upon itself, or with flat ends."""
    angle = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    cross = np.cos(angle)[:, None, None] * outward + np.sin(angle)[:, None, None] * across
    rows = (points + tube * cross).swapaxes(0, 1)  # (points, sides, 3)
    if ring:
        rows = rows[:-1]
    count, sides = rows.shape[:2]
    numbers = np.arange(count * sides).reshape(count, sides)
    here = numbers if ring else numbers[:-1]
    there = np.roll(numbers, -1, axis=0)[: len(here)]
    corners = [here, np.roll(here, -1, axis=1), np.roll(there, -1, axis=1), there]
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    faces = [*quads[:, [0, 1, 2]].tolist(), *quads[:, [0, 2, 3]].tolist()]
    vertices = rows.reshape(-1, 3)
    if not ring:
        last = (count - 1) * sides
        faces += [(0, side + 1, side) for side in range(1, sides - 1)]
        faces += [(last, last + side, last + side + 1) for side in range(1, sides - 1)]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


_SOLIDS: Final[dict[str, Callable[[NDArray[np.float64], Any], Solid]]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "ellipsoid": _ellipsoid,
    "cup": _cup,
    "arc": _arc,
}


def objects() -> dict[str, NDArray[Any]]:
    """The arrays of the file by their names, `object.array`."""
    library = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))["objects"]
    return {
        f"{name}.{key}": array for name, entry in library.items() for key, array in _arrays(entry).items()
    }


def _arrays(entry: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """The arrays of one object."""
    import trimesh

    parts: list[Part] = []
    surfaces: list[Any] = []
    for kind, numbers in entry["solids"]:
        solid_parts, surface = _SOLIDS[kind](np.asarray(numbers, dtype=np.float64), trimesh)
        parts += solid_parts
        surfaces.append(surface)
    mesh = trimesh.util.concatenate(surfaces)
    rows = np.array(list(entry["markers"].values()), dtype=np.float64).reshape(-1, 6)
    normals = unit(rows[:, 3:])
    shiny = np.array(entry["shiny"], dtype=np.float64).reshape(-1, 7)
    shiny[:, :3] *= 1e-3
    shiny[:, 3:6] = unit(shiny[:, 3:6])
    shiny[:, 6] *= 1e-3
    return {
        "kinds": np.array([part.kind for part in parts]),
        "sizes": np.array([part.size for part in parts]),
        "poses": np.array([part.T_object_part for part in parts]),
        "mass": np.array(float(entry["mass"])),
        "vertices": np.asarray(mesh.vertices),
        "faces": np.asarray(mesh.faces),
        "marker_names": np.array(list(entry["markers"]), dtype=str),
        "markers": 1e-3 * rows[:, :3] + MARKER_RADIUS * normals,
        "marker_normals": normals,
        "shiny": shiny,
    }


if __name__ == "__main__":
    with atomic_write(DATA) as temporary:
        write_npz(temporary, [Member.of(name, array) for name, array in objects().items()])
