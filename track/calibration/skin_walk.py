"""Places on the skin of a hand whose shape still changes, and how they slide from triangle to triangle.

The mesh is the hand's own, subdivided once more (Han et al. 2018, section 4.5), always a right hand's. A
place is a triangle, three barycentric coordinates and a height along the normal between the corners' normals,
as `gloves.attachment` measures a marker's radius; so a place goes with the skin when the shape changes.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import sparse

from gloves.attachment import Attachment
from gloves.layout import MarkerLayout
from handsim.hand.shape import HandShape, named_shape
from handsim.hand.skin.subdivision import catmull_clark
from handsim.hand.skin.surface import build_surface, vertex_normals
from handsim.hand.topology import NUM_BONES

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

_MOST_STEPS: Final = 40
_OUTSIDE: Final = -1e-9
_CLOSE: Final = 1e-8  # [m]


class SkinMesh(NamedTuple):
    """What the skins of all hands share."""

    subdivide: sparse.csr_array
    """From the vertices of `handsim.hand.skin.surface` to these (V, coarse V)."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    across: Int[np.ndarray, "F 3"]
    """The triangle on the other side of the edge that lies opposite to each corner."""
    around: Int[np.ndarray, "V A"]
    """Triangles around each vertex, the last one repeated."""
    weights: Float[np.ndarray, "V 16"]
    """Shares of all bones."""


class SkinPlaces(NamedTuple):
    """Places on the skin."""

    faces: Int[np.ndarray, "P"]
    bary: Float[np.ndarray, "P 3"]
    heights: Float[np.ndarray, "P"]
    """Above the skin, along the normal [m]."""


class Corners(NamedTuple):
    """The triangles of some places on one hand's skin."""

    points: Float[np.ndarray, "P 3 3"]
    normals: Float[np.ndarray, "P 3 3"]


class Skin(NamedTuple):
    """One hand's skin, subdivided, in the wrist's frame."""

    points: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]

    def corners(self, faces: Int[np.ndarray, "P"]) -> Corners:
        """Corners of some triangles of `skin_mesh`."""
        vertices = skin_mesh().faces[faces]
        return Corners(self.points[vertices], self.normals[vertices])


@cache
def skin_mesh() -> SkinMesh:
    """Triangles and weights of the skin, subdivided once."""
    coarse = build_surface(named_shape("M"))
    half = len(coarse.faces) // 2
    step, quads = catmull_clark(
        np.column_stack([coarse.faces[:half], coarse.faces[half:, 2]]), len(coarse.vertices)
    )
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    weights = np.zeros((len(coarse.vertices), NUM_BONES))
    np.add.at(weights, (np.arange(len(weights))[:, None], coarse.bone_indices), coarse.bone_weights)
    return SkinMesh(step, faces, _across(faces), _around(faces, step.shape[0]), step @ weights)


def _across(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Neighbors of each triangle of a closed mesh."""
    ends = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=-1).reshape(-1, 2)
    count = int(faces.max()) + 1
    there, back = ends[:, 0] * count + ends[:, 1], ends[:, 1] * count + ends[:, 0]
    order = np.argsort(there)
    neighbors: NDArray[np.int64] = order[np.searchsorted(there[order], back)] // 3
    return neighbors.reshape(faces.shape)


def _around(faces: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    vertex, face = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(vertex, kind="stable")
    number = np.bincount(vertex, minlength=count)
    first = np.cumsum(number) - number
    slots = np.minimum(np.arange(number.max()), number[:, None] - 1)
    around: NDArray[np.int64] = face[order][first[:, None] + slots]
    return around


class SkinPatch:
    """The part of the skin that some triangles and their normals need, for any shape.

    Args:
        faces: Triangles of `skin_mesh`.
    """

    def __init__(self, faces: Int[np.ndarray, "P"]) -> None:
        mesh = skin_mesh()
        needed = np.unique(mesh.around[mesh.faces[faces]])
        vertices, local = np.unique(mesh.faces[needed], return_inverse=True)
        self._rows = mesh.subdivide[vertices]
        self._faces = local.reshape(-1, 3)
        self._corners = np.searchsorted(vertices, mesh.faces[faces])

    def corners(self, vertices: Float[np.ndarray, "C 3"]) -> Corners:
        """Corners of the triangles on a hand whose surface has these vertices [m]."""
        points = self._rows @ vertices
        return Corners(points[self._corners], vertex_normals(points, self._faces)[self._corners])


def skin_of(shape: HandShape) -> Skin:
    """The skin of a hand of this shape [m]."""
    mesh = skin_mesh()
    points = mesh.subdivide @ build_surface(shape).vertices
    return Skin(points, vertex_normals(points, mesh.faces))


def place_points(
    places: SkinPlaces, corners: Corners
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Points [m] at these places and the normals there."""
    normals = np.einsum("pc,pci->pi", places.bary, corners.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    foot = np.einsum("pc,pci->pi", places.bary, corners.points)
    return foot + places.heights[:, None] * normals, normals


def place_weights(places: SkinPlaces) -> Float[np.ndarray, "P 16"]:
    """Shares of all bones at these places."""
    mesh = skin_mesh()
    weights: NDArray[np.float64] = np.einsum(
        "pc,pcb->pb", places.bary, mesh.weights[mesh.faces[places.faces]]
    )
    return weights


def wear_at(layout: MarkerLayout, places: SkinPlaces, shape: HandShape) -> Attachment:
    """A glove whose markers sit at these places of a right hand, each carried by its four strongest bones."""
    points, normals = place_points(places, skin_of(shape).corners(places.faces))
    weights = place_weights(places)
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    shares = np.clip(np.take_along_axis(weights, bones, axis=1), 0.0, None)
    return Attachment(layout, points, normals, bones, shares / shares.sum(axis=1, keepdims=True))


def slip(
    worn: Attachment, shape: HandShape, distance: float, lift: float = 0.0, *, rng: np.random.Generator
) -> Attachment:
    """A glove worn by a right hand with every marker moved along the skin, as real ones are.

    Args:
        worn: The glove as designed.
        shape: The hand.
        distance: How far each marker goes, in a direction of its own [m].
        lift: Standard deviation of its height over the skin [m].
        rng: Source of all randomness.
    """
    ways = rng.normal(size=worn.points.shape)
    ways -= (ways * worn.normals).sum(axis=1, keepdims=True) * worn.normals
    ways *= distance / np.linalg.norm(ways, axis=1, keepdims=True)
    places = slide(nearest_places(worn.points, shape), worn.points + ways, skin_of(shape))
    heights = worn.layout.radius + rng.normal(scale=lift, size=len(ways))
    return wear_at(worn.layout, places._replace(heights=heights), shape)


def weight_slopes(places: SkinPlaces, corners: Corners) -> Float[np.ndarray, "P 16 3"]:
    """How the shares change when the point at a place moves, by its coordinates [1/m]."""
    mesh = skin_mesh()
    shares = mesh.weights[mesh.faces[places.faces]]
    slopes = np.linalg.inv(_frames(places, corners))[:, :2]
    change: NDArray[np.float64] = np.einsum("pcb,pci->pbi", shares[:, 1:] - shares[:, :1], slopes)
    return change


def _frames(places: SkinPlaces, corners: Corners) -> NDArray[np.float64]:
    """Derivatives (P, 3, 3) of a place's point by its second and third coordinate and its height."""
    blended = np.einsum("pc,pci->pi", places.bary, corners.normals)
    length = np.linalg.norm(blended, axis=1)[:, None]
    normal = blended / length
    columns = []
    for corner in (1, 2):
        turn = corners.normals[:, corner] - corners.normals[:, 0]
        turn = (turn - (turn * normal).sum(axis=1, keepdims=True) * normal) / length
        columns.append(corners.points[:, corner] - corners.points[:, 0] + places.heights[:, None] * turn)
    return np.stack([*columns, normal], axis=-1)


def slide(places: SkinPlaces, targets: Float[np.ndarray, "P 3"], skin: Skin) -> SkinPlaces:
    """The places above which points lie, walking from triangle to neighbor.

    A point far outside gets the place nearest to it, its distance being the height; where the skin folds and
    a walk does not end, the place stays on the last edge.

    Args:
        places: Where to begin.
        targets: The points, in the wrist's frame [m].
        skin: A hand's.
    """
    mesh = skin_mesh()
    faces, bary, heights = (values.copy() for values in places)
    busy = np.arange(len(faces))
    for _ in range(_MOST_STEPS):
        here = SkinPlaces(faces[busy], bary[busy], heights[busy])
        corners = skin.corners(here.faces)
        miss = targets[busy] - place_points(here, corners)[0]
        step = np.linalg.solve(_frames(here, corners), miss[..., None])[..., 0]
        moved = here.bary + np.column_stack([-step[:, 0] - step[:, 1], step[:, :2]])
        heights[busy] = here.heights + step[:, 2]
        lowest = moved.argmin(axis=1)
        out = moved[np.arange(len(busy)), lowest] < _OUTSIDE
        bary[busy] = np.where(out[:, None], _on_edge(here.bary, moved), moved)
        done = ~out & (np.linalg.norm(miss, axis=1) < _CLOSE)
        _cross(mesh, faces, bary, busy[out], lowest[out])
        busy = busy[~done]
        if not len(busy):
            break
    return SkinPlaces(faces, bary, heights)


def _on_edge(bary: NDArray[np.float64], moved: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the coordinates that moved out of their triangle are nearest inside it."""
    inside = np.clip(moved, 0.0, None)
    edge: NDArray[np.float64] = inside / inside.sum(axis=1, keepdims=True)
    return np.where(np.isfinite(edge), edge, bary)


def _cross(
    mesh: SkinMesh,
    faces: NDArray[np.int64],
    bary: NDArray[np.float64],
    who: NDArray[np.int64],
    corner: NDArray[np.int64],
) -> None:
    """Go over the edge opposite to a corner, taking the coordinates along."""
    old = faces[who]
    new = mesh.across[old, corner]
    same = mesh.faces[new][:, :, None] == mesh.faces[old][:, None, :]
    shares = np.where(np.arange(3) == corner[:, None], 0.0, bary[who])
    carried = (same * shares[:, None, :]).sum(axis=2)
    faces[who], bary[who] = new, carried / np.maximum(carried.sum(axis=1, keepdims=True), 1e-12)


def nearest_places(points: Float[np.ndarray, "P 3"], shape: HandShape) -> SkinPlaces:
    """The places on the skin above which points lie, looked for over the whole hand."""
    skin = skin_of(shape)
    middles = skin.points[skin_mesh().faces].mean(axis=1)
    faces = np.array([((middles - point) ** 2).sum(axis=1).argmin() for point in points], dtype=np.int64)
    start = SkinPlaces(faces, np.full((len(faces), 3), 1 / 3), np.zeros(len(faces)))
    return slide(start, points, skin)
