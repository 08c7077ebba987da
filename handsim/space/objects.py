"""Rigid objects that a hand holds: the surface that cameras see, the parts that fingers touch, the markers.

Five objects come with handsim, in `data/objects.json`; any closed mesh can be loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_array, check_choice
from handsim.errors import ArgumentError, ObjectError, shortened
from handsim.files.inputs import check_regular
from handsim.files.json_files import package_data
from handsim.space import solids as object_solids
from handsim.space.solids import Part

MARKER_RADIUS: Final = 0.0032
"""Radius [m] of an object's own markers; their centers lie this far above the surface."""
MESH_SUFFIXES: Final = (".stl", ".obj", ".ply", ".glb")
_LARGEST: Final = 1.0  # [m]
_SMALLEST: Final = 0.002
_MOST_BYTES: Final = 1 << 26


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
    marker_names: tuple[str, ...]
    markers: Float[np.ndarray, "Q 3"]
    """Centers of its own retro-reflective markers [m]; none for most objects."""
    marker_normals: Float[np.ndarray, "Q 3"]
    """Outward unit normals of the surface under them."""
    mass: float
    """Mass [kg]."""
    shiny: Float[np.ndarray, "S 7"]
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
        if not 0.0 < self.mass < np.inf:
            raise ArgumentError(f"{self.name}: the mass is {self.mass:g} kg, expected a positive number")
        if not self.parts:
            raise ArgumentError(f"{self.name}: an object needs parts that fingers can touch")


def object_names() -> tuple[str, ...]:
    """Names of the objects that come with handsim."""
    return tuple(_library())


def named_object(name: str) -> RigidObject:
    """One of the objects that come with handsim."""
    library = _library()
    check_choice(name, library, noun="object")
    return _build(name, library[name])


def load_object(path: str | Path, *, mass: float = 0.1) -> RigidObject:
    """An object of your own, from a mesh file in meters.

    Cameras see the mesh as it is; fingers touch its convex hull, so they cannot reach into hollows. The
    object carries no markers. A file with several meshes makes one object.

    Args:
        path: An .stl, .obj, .ply or .glb file, in meters.
        mass: Its mass [kg].

    Raises:
        ObjectError: The file cannot be read, or is not a closed surface of a size that a hand can hold.
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
    hull = _close(mesh, path)
    return RigidObject(
        name=path.name,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        parts=(hull,),
        marker_names=(),
        markers=np.empty((0, 3)),
        marker_normals=np.empty((0, 3)),
        mass=mass,
        shiny=np.empty((0, 7)),
    )


def _read_mesh(path: Path) -> Any:
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ObjectError(f"{path}: expected a mesh file that ends in {', '.join(MESH_SUFFIXES)}")
    check_regular(path, error=ObjectError, most=_MOST_BYTES)
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


def _close(mesh: Any, path: Path) -> Part:
    """Join the seams of a mesh, turn its inside in, and give its hull; an `ObjectError` if it is open."""
    try:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # a closed surface may come with seams
        closed = bool(mesh.is_watertight)
        if closed and mesh.volume < 0.0:
            mesh.invert()
        hull = object_solids.hull_part(mesh.vertices) if closed else None
    except Exception as error:  # odd triangles fail in many ways
        raise ObjectError(
            f"{path}: not a closed surface ({shortened(' '.join(str(error).split()), 80)})"
        ) from error
    if hull is None:
        raise ObjectError(f"{path}: the mesh is not watertight; close its holes, so that it has an inside")
    return hull


def _library() -> dict[str, Any]:
    library: dict[str, Any] = package_data("handsim", "objects")["objects"]
    return library


def _build(name: str, entry: dict[str, Any]) -> RigidObject:
    import trimesh

    parts: list[Part] = []
    surfaces: list[Any] = []
    for kind, numbers in entry["solids"]:
        solid_parts, surface = object_solids.build_solid(kind, numbers)
        parts += solid_parts
        surfaces.append(surface)
    mesh = trimesh.util.concatenate(surfaces)
    rows = np.array(list(entry["markers"].values()), dtype=np.float64).reshape(-1, 6)
    normals = _unit(rows[:, 3:])
    shiny = np.array(entry["shiny"], dtype=np.float64).reshape(-1, 7)
    shiny[:, :3] *= 1e-3
    shiny[:, 3:6] = _unit(shiny[:, 3:6])
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


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
