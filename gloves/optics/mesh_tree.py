"""A bounding-volume tree over a triangle mesh whose vertices move, compiled."""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.optics.mesh_lines import refit
from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.shape import named_shape
from handsim.hand.skin import build_surface
from handsim.kernels.kernel import kernel

_LEAF: Final = 4  # triangles of a leaf at most


class MeshTree:
    """A tree of axis-aligned boxes around a mesh's triangles.

    The surface-area heuristic splits the mesh as given here; later frames only refit the boxes. Only faces
    matter, so one tree serves all meshes that share them (`hand_tree` serves all hands).

    Nodes are stored in depth-first order, a left child right after its parent, and `skip` is the node that
    follows when a branch is left out: a search needs no stack, and a refit is one backward pass.

    Args:
        vertices: Rest positions [m].
        faces: Triangles of either winding.

    Raises:
        ArgumentError: There is no triangle, an array has another shape, or a face names no vertex.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self.vertices: NDArray[np.float64] = np.ascontiguousarray(
            check_array("vertices", vertices, (None, 3))
        )
        faces = np.asarray(faces)
        if self.vertices.ndim != 2 or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise ArgumentError(
                f"vertices {self.vertices.shape} and faces {faces.shape}, expected (V, 3) and (F, 3)"
            )
        if faces.min() < 0 or faces.max() >= len(self.vertices):
            raise ArgumentError(
                f"faces name vertices {faces.min()} to {faces.max()}, expected 0 to {len(self.vertices) - 1}"
            )
        corners = self.vertices[faces]
        order, self.first, self.skip = _build(corners.min(axis=1), corners.max(axis=1))
        self.faces: NDArray[np.int32] = np.ascontiguousarray(faces[order], dtype=np.int32)
        """Triangles, those of leaf n from `first[n]` to `first[n + 1]`; other nodes own none."""
        self.spots, self.spots_start = _leaf_vertices(self.faces, self.first)
        self.boxes: NDArray[np.float64] = np.empty((len(self.skip), 6))
        """Low and high corner of each node [m] around the vertices given here."""
        refit(self.vertices, self.skip, self.spots, self.spots_start, self.boxes)


@functools.cache
def hand_tree() -> MeshTree:
    """The tree of every hand's skin: size, side and pose change only the positions of its vertices."""
    surface = build_surface(named_shape("M"))
    return MeshTree(surface.vertices, surface.faces)


@kernel
def _build(low: Any, high: Any) -> Any:
    """Order of the triangles (F,) by their boxes, first triangle of every node (N + 1,), and `skip` (N,)."""
    count = len(low)
    centers = low + high
    order = np.arange(count)
    first = np.zeros(2 * count + 1, dtype=np.int32)
    skip = np.zeros(2 * count, dtype=np.int32)
    stack = [(0, count, -1)]  # begin, end, the left sibling
    nodes = 0
    while len(stack) > 0:
        begin, end, left = stack.pop()
        if left >= 0:
            skip[left] = nodes
        first[nodes] = begin
        if end - begin > _LEAF:
            middle = begin + _split(order[begin:end], low, high, centers)
            stack.append((middle, end, nodes + 1))
            stack.append((begin, middle, -1))
        nodes += 1
    first[nodes] = count
    skip[0] = nodes
    for node in range(nodes):  # a right child is left out together with its parent
        if first[node + 1] == first[node]:
            right = skip[node + 1]
            skip[right] = skip[node]
    return order, first[: nodes + 1], skip[:nodes]


@kernel
def _split(order: Any, low: Any, high: Any, centers: Any) -> int:
    """Sort a node's triangles along an axis and return where to cut them: least sum of count x box area."""
    count = len(order)
    least, cut = np.inf, _LEAF
    best = order.copy()
    after = np.empty(count)
    for axis in range(3):
        sequence = order[np.argsort(centers[order, axis], kind="mergesort")]
        for backwards in (True, False):
            box_low, box_high = np.full(3, np.inf), np.full(3, -np.inf)
            for step in range(count):
                index = count - 1 - step if backwards else step
                for i in range(3):
                    box_low[i] = min(box_low[i], low[sequence[index], i])
                    box_high[i] = max(box_high[i], high[sequence[index], i])
                x, y, z = box_high - box_low
                area = x * y + y * z + z * x
                if backwards:
                    after[index] = area
                elif (step + 1) % _LEAF == 0 and step + 1 < count:
                    cost = area * (step + 1) + after[step + 1] * (count - step - 1)
                    if cost < least:
                        least, cut = cost, step + 1
                        best[:] = sequence
    order[:] = best
    return cut


@kernel
def _leaf_vertices(faces: Any, first: Any) -> Any:
    """The vertices of every node's own triangles, each once, and where each node's list starts (N + 1,)."""
    nodes = len(first) - 1
    spots = np.empty(faces.size, dtype=np.int32)
    start = np.zeros(nodes + 1, dtype=np.int32)
    found = 0
    for node in range(nodes):
        start[node] = found
        for face in range(first[node], first[node + 1]):
            for corner in range(3):
                vertex, known = faces[face, corner], False
                for other in range(start[node], found):
                    known = known or spots[other] == vertex
                if not known:
                    spots[found] = vertex
                    found += 1
    start[nodes] = found
    return spots[:found].copy(), start
