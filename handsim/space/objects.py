"""Rigid objects that a hand holds: their surfaces for cameras, convex parts for fingers, and markers.

`data/objects.npz` has the five objects that come with handsim; `benchmarks/rigid_objects.py` builds them from
simple solids. Any closed mesh can be loaded.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_array, check_choice, check_number
from handsim.errors import ArgumentError, ObjectError, shortened
from handsim.files.arrays import read_npz
from handsim.files.inputs import check_regular

PartKind = Literal["sphere", "capsule", "cylinder", "box", "ellipsoid", "mesh"]
_SHIPPED_OBJECTS: Final = ("pen", "controller", "ball", "box", "mug")
_OBJECTS_FILE: Final = Path(__file__).parents[1] / "data" / "objects.npz"
MARKER_RADIUS: Final = 0.0032
"""Radius of the spheres of Han et al. 2018 (section 3) [m], for strays and for markers of objects. Centers of
the latter lie this far above the surface."""
MESH_SUFFIXES: Final = (".stl", ".obj", ".ply", ".glb")
_MIN_SIZE, _MAX_SIZE = 0.002, 1.0  # bounds of the longest side of a mesh [m]


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
    return _SHIPPED_OBJECTS


def named_object(name: str) -> RigidObject:
    """One of the objects that come with handsim."""
    check_choice(name, _SHIPPED_OBJECTS, noun="object")
    return _shipped_object(name)


def load_object(path: str | Path, *, mass: float = 0.1) -> RigidObject:
    """Load an object from a mesh file in meters.

    Cameras see the mesh as it is; fingers touch its convex hull, so they cannot reach into hollows. The
    object has no markers. A file with several meshes makes one object.
    """
    path = Path(path)
    mesh = _read_mesh(path)
    if not len(mesh.faces) or not np.size(mesh.vertices):
        raise ObjectError(f"{path}: the mesh is empty, expected a closed surface of triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ObjectError(f"{path}: the mesh has vertices that are NaN or infinite, expected finite meters")
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if size > _MAX_SIZE:
        raise ObjectError(
            f"{path}: the mesh is {size:.3g} m large, expected at most 1 m; is it in millimeters?"
        )
    if size < _MIN_SIZE:
        raise ObjectError(f"{path}: the mesh is {size:.3g} m large, expected at least 2 mm, in meters")
    hull = _convex_hull(mesh, path)
    return RigidObject(path.name, np.asarray(mesh.vertices), np.asarray(mesh.faces), (hull,), mass=mass)


def _read_mesh(path: Path) -> Any:
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ObjectError(f"{path}: expected a mesh file that ends in {', '.join(MESH_SUFFIXES)}")
    check_regular(path, error=ObjectError, max_bytes=1 << 26)
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
    """Merge a mesh's seams, orient its faces outwards, and return its convex hull; refuse an open mesh."""
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


@functools.cache
def _object_arrays() -> dict[str, NDArray[Any]]:
    """The arrays of all objects that come with handsim, by `object.array`."""
    return read_npz(_OBJECTS_FILE)


@functools.cache
def _shipped_object(name: str) -> RigidObject:
    arrays, prefix = _object_arrays(), f"{name}."
    own = {key.removeprefix(prefix): arrays[key] for key in arrays if key.startswith(prefix)}
    parts = zip(own.pop("kinds").tolist(), own.pop("sizes"), own.pop("poses"), strict=True)
    mass, marker_names = float(own.pop("mass")), tuple(own.pop("marker_names").tolist())
    return RigidObject(
        name, parts=tuple(Part(*one) for one in parts), mass=mass, marker_names=marker_names, **own
    )
