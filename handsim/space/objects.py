"""Rigid objects that a hand holds: the surface that cameras see, the parts that fingers touch, the markers.

Five objects come with handsim, in `data/objects.json`, made of simple solids; any closed mesh can be loaded.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_array, check_choice, check_number
from handsim.errors import ArgumentError, ObjectError, shortened
from handsim.files.inputs import check_regular, package_data
from handsim.space.transforms import axis_angle_matrix, frame_with_z, rigid, unit

PartKind = Literal["sphere", "capsule", "cylinder", "box", "ellipsoid", "mesh"]
_AROUND: Final = 16  # sides of a capsule
MARKER_RADIUS: Final = 0.0032
"""Radius of the spheres of Han et al. 2018 (section 3) [m]: of strays, and of an object's own markers; their
centers lie this far above the surface."""
MESH_SUFFIXES: Final = (".stl", ".obj", ".ply", ".glb")
_LARGEST: Final = 1.0  # [m]
_SMALLEST: Final = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A convex piece of an object, one MuJoCo geom."""

    kind: PartKind
    size: Float[np.ndarray, "3"]
    """MuJoCo's sizes [m]: radius; radius and half length along z; three half sizes; zeros for a mesh."""
    T_object_part: Float[np.ndarray, "4 4"]
    """The part's frame seen from the object [m]."""
    vertices: Float[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Corners of a mesh [m], in the part's frame; none for the other kinds."""


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


@dataclass(frozen=True, slots=True, eq=False)
class RigidObject:
    """An object in its own frame: meters, markers one radius above the surface.

    Raises:
        ArgumentError: An array has another shape, a face names no vertex, the mass is not positive, or
            there are no parts.
    """

    name: str
    vertices: Float[np.ndarray, "V 3"]
    """What cameras see [m]: one or more closed surfaces."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    parts: tuple[Part, ...]
    """Convex pieces that fingers touch."""
    marker_names: tuple[str, ...] = ()
    markers: Float[np.ndarray, "Q 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Centers of its own retro-reflective markers [m]; none for most objects."""
    marker_normals: Float[np.ndarray, "Q 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Outward unit normals of the surface under the markers."""
    mass: float = 0.1
    """Mass [kg]."""
    shiny: Float[np.ndarray, "S 7"] = field(default_factory=lambda: np.empty((0, 7)))
    """Mirror-like patches: a point [m], its outward unit normal, the patch's radius [m]."""

    def __post_init__(self) -> None:
        count = len(self.marker_names)
        for name, shape in (
            ("vertices", (None, 3)),
            ("markers", (count, 3)),
            ("marker_normals", (count, 3)),
            ("shiny", (None, 7)),
        ):
            object.__setattr__(self, name, check_array(name, getattr(self, name), shape))
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise ArgumentError(f"faces has shape {faces.shape}, expected whole numbers (F, 3)")
        if faces.size and not 0 <= faces.min() <= faces.max() < len(self.vertices):
            raise ArgumentError(
                f"faces name vertices {faces.min()} to {faces.max()}, expected 0 to {len(self.vertices) - 1}"
            )
        check_number(f"{self.name}: the mass [kg]", self.mass, 0.0, above=True)
        if not self.parts:
            raise ArgumentError(f"{self.name}: an object needs parts that fingers can touch")


def object_names() -> tuple[str, ...]:
    """Names of the objects that come with handsim."""
    return tuple(_library())


def named_object(name: str) -> RigidObject:
    """One of the objects that come with handsim."""
    check_choice(name, _library(), noun="object")
    return _build(name)


def load_object(path: str | Path, *, mass: float = 0.1) -> RigidObject:
    """An object of your own, from a mesh file in meters.

    Cameras see the mesh as it is; fingers touch its convex hull, so they cannot reach into hollows. The
    object carries no markers. A file with several meshes makes one object.
    """
    path = Path(path)
    mesh = _read_mesh(path)
    if not len(mesh.faces) or not np.size(mesh.vertices):
        raise ObjectError(f"{path}: the mesh is empty, expected a closed surface of triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ObjectError(f"{path}: the mesh has vertices that are NaN or infinite, expected finite meters")
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if size > _LARGEST:
        raise ObjectError(
            f"{path}: the mesh is {size:.3g} m large, expected at most 1 m; is it in millimeters?"
        )
    if size < _SMALLEST:
        raise ObjectError(f"{path}: the mesh is {size:.3g} m large, expected at least 2 mm, in meters")
    hull = _convex_hull(mesh, path)
    return RigidObject(path.name, np.asarray(mesh.vertices), np.asarray(mesh.faces), (hull,), mass=mass)


def _read_mesh(path: Path) -> Any:
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ObjectError(f"{path}: expected a mesh file that ends in {', '.join(MESH_SUFFIXES)}")
    check_regular(path, error=ObjectError, most=1 << 26)
    if not path.is_file():
        raise ObjectError(f"{path}: no such file")
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # readers of damaged files fail in many ways
        reason = " ".join(str(error).split())[:80]
        raise ObjectError(f"{path}: not a readable {path.suffix} mesh ({reason})") from error
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ObjectError(f"{path}: a triangle names a vertex that is not among the {len(mesh.vertices)}")
    return mesh


def _convex_hull(mesh: Any, path: Path) -> Part:
    """Join a mesh's seams, make its faces look outwards, and return its convex hull; refuse an open mesh."""
    try:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # a closed surface may come with seams
        closed = bool(mesh.is_watertight)
        if closed and mesh.volume < 0.0:
            mesh.invert()
        hull = mesh.convex_hull if closed else None
    except Exception as error:  # odd triangles fail in many ways
        raise ObjectError(
            f"{path}: not a closed surface ({shortened(' '.join(str(error).split()), 80)})"
        ) from error
    if hull is None:
        raise ObjectError(f"{path}: the mesh is not watertight; close its holes, so that it has an inside")
    return Part("mesh", np.zeros(3), np.eye(4), np.asarray(hull.vertices))


def _library() -> dict[str, Any]:
    library: dict[str, Any] = package_data("handsim", "objects")["objects"]
    return library


@functools.cache
def _build(name: str) -> RigidObject:
    import trimesh

    entry = _library()[name]
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
    return RigidObject(
        name=name,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        parts=tuple(parts),
        marker_names=tuple(entry["markers"]),
        markers=1e-3 * rows[:, :3] + MARKER_RADIUS * normals,
        marker_normals=normals,
        mass=entry["mass"],
        shiny=shiny,
    )
