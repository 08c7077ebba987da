"""Lines of sight past moving triangle meshes: a bounding-volume tree, refitted in every frame, compiled."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.shape import named_shape
from handsim.hand.skin.surface import build_surface

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

_LEAF: Final = 4
_PAD: Final = 1e-9  # around every box [m]: more than rounding, and flat boxes are no special case


class MeshTree:
    """Boxes in boxes around a mesh's triangles.

    The surface-area heuristic cuts the mesh as it is given here; later frames only move the boxes. What
    counts is the faces, so one tree serves all meshes that share them (`hand_tree` all hands).

    Nodes stand in depth-first order, a left child right after its parent, and `skip` is the node that follows
    once a branch is left out: a search needs no stack, and a refit is one pass backwards.

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
                f"vertices {self.vertices.shape} and faces {faces.shape} are no (V, 3) and (F, 3) of a mesh"
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
        _refit(self.vertices, self.skip, self.spots, self.spots_start, self.boxes)


@functools.cache
def hand_tree() -> MeshTree:
    """The tree of every hand's skin: size, side and pose change only where its vertices are."""
    surface = build_surface(named_shape("M"))
    return MeshTree(surface.vertices, surface.faces)


def clear_of_mesh(
    tree: MeshTree,
    vertices: Float[np.ndarray, "T V 3"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    wanted: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """Which wanted lines from point to camera meet no triangle of their frame's mesh.

    A line that starts inside a closed mesh is not clear. NaN points are never clear.

    Args:
        tree: Tree over the mesh's faces.
        vertices: The mesh in every frame, in the world [m].
        points: Where lines start [m]: one place for all cameras, or one for each.
        cameras: Where lines end [m].
        wanted: The lines that matter; the others cost nothing and count as not clear.

    Raises:
        ArgumentError: Shapes do not fit together, or the vertices or cameras are not finite.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    starts, ends = _check_lines(points, cameras, wanted)
    wanted_shape = (len(wanted), *tree.vertices.shape)
    if vertices.shape != wanted_shape:
        raise ArgumentError(f"vertices has shape {vertices.shape}, expected {wanted_shape}")
    if not np.isfinite(vertices.sum()):
        raise ArgumentError("vertices holds NaN or infinite values, expected finite numbers")
    nodes, spots = (tree.faces, tree.first, tree.skip), (tree.spots, tree.spots_start)
    lines = (starts, ends[None], np.asarray(wanted, dtype=np.bool_))
    clear: NDArray[np.bool_] = _clear_lines(vertices, lines, nodes, spots, np.empty_like(tree.boxes))
    return clear


def clear_of_body(
    tree: MeshTree,
    T_world_body: Float[np.ndarray, "T 4 4"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    wanted: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """`clear_of_mesh` for a rigid body: lines are carried into its frame, the tree is used as built.

    Args:
        tree: Tree over the body's mesh in the body's own frame.
        T_world_body: Its pose in every frame.
        points: Where lines start, in the world [m]: one place for all cameras, or one for each.
        cameras: Where lines end, in the world [m].
        wanted: The lines that matter; the others count as not clear.

    Raises:
        ArgumentError: Shapes do not fit together, a pose is not rigid, or poses or cameras are not finite.
    """
    poses = check_array("T_world_body", T_world_body, (len(wanted), 4, 4))
    starts, ends = _check_lines(points, cameras, wanted)
    turns, places = poses[:, :3, :3], poses[:, None, :3, 3]
    if not np.allclose(turns.transpose(0, 2, 1) @ turns, np.eye(3), atol=1e-6):
        raise ArgumentError("T_world_body scales or shears, expected rotations and translations alone")
    starts = np.ascontiguousarray((starts - places[:, None]) @ turns[:, None])
    ends = np.ascontiguousarray((ends - places) @ turns)
    nodes, no_refit = (tree.faces, tree.first, tree.skip), (tree.spots[:0], tree.spots_start)
    lines = (starts, ends, np.asarray(wanted, dtype=np.bool_))
    clear: NDArray[np.bool_] = _clear_lines(tree.vertices[None], lines, nodes, no_refit, tree.boxes)
    return clear


def _check_lines(
    points: NDArray[np.float64], cameras: NDArray[np.float64], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starts (T, P, 1 or C, 3), which may be NaN, and ends (C, 3) of the lines."""
    starts = np.ascontiguousarray(points, dtype=np.float64)
    ends = np.ascontiguousarray(check_array("cameras", cameras, (None, 3)))
    shapes = ((*wanted.shape[:2], 3), (*wanted.shape, 3))
    if wanted.ndim != 3 or starts.shape not in shapes or ends.shape != (wanted.shape[2], 3):
        raise ArgumentError(
            f"points {starts.shape}, cameras {ends.shape} and wanted {wanted.shape} do not fit together, "
            "expected (T, P, 3) or (T, P, C, 3), (C, 3) and (T, P, C)"
        )
    return (starts[:, :, None] if starts.ndim == 3 else starts), ends


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _build(low: Any, high: Any) -> Any:
    """Order of the triangles, first triangle of every node (one more at the end), and `skip`."""
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


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _split(order: Any, low: Any, high: Any, centers: Any) -> int:
    """Sorts `order` and says where to cut it: least sum of triangles x box area, leaves full."""
    count = len(order)
    least, cut = np.inf, _LEAF
    best = order.copy()
    after = np.empty(count)
    for axis in range(3):
        sequence = order[np.argsort(centers[order, axis], kind="mergesort")]
        for backwards in (True, False):
            box_low, box_high = np.full(3, np.inf), np.full(3, -np.inf)
            for step in range(count):
                place = count - 1 - step if backwards else step
                for i in range(3):
                    box_low[i] = min(box_low[i], low[sequence[place], i])
                    box_high[i] = max(box_high[i], high[sequence[place], i])
                x, y, z = box_high - box_low
                area = x * y + y * z + z * x
                if backwards:
                    after[place] = area
                elif (step + 1) % _LEAF == 0 and step + 1 < count:
                    cost = area * (step + 1) + after[step + 1] * (count - step - 1)
                    if cost < least:
                        least, cut = cost, step + 1
                        best[:] = sequence
    order[:] = best
    return cut


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _leaf_vertices(faces: Any, first: Any) -> Any:
    """The vertices of every node's own triangles, each once, and where each node's list starts."""
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


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _refit(vertices: Any, skip: Any, spots: Any, start: Any, boxes: Any) -> None:
    """Moves every box to where its triangles are; spelled out, because loops over axes take longer."""
    for back in range(len(skip)):
        node = len(skip) - 1 - back
        if start[node] == start[node + 1]:
            left = node + 1
            right = skip[left]
            for i in range(3):
                a, b = boxes[left, i], boxes[right, i]
                boxes[node, i] = a if a < b else b
                a, b = boxes[left, 3 + i], boxes[right, 3 + i]
                boxes[node, 3 + i] = a if a > b else b
            continue
        lx, ly, lz, hx, hy, hz = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
        for spot in range(start[node], start[node + 1]):
            v = spots[spot]
            x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
            lx, hx = (x if x < lx else lx), (x if x > hx else hx)
            ly, hy = (y if y < ly else ly), (y if y > hy else hy)
            lz, hz = (z if z < lz else lz), (z if z > hz else hz)
        boxes[node, 0], boxes[node, 1], boxes[node, 2] = lx - _PAD, ly - _PAD, lz - _PAD
        boxes[node, 3], boxes[node, 4], boxes[node, 5] = hx + _PAD, hy + _PAD, hz + _PAD


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _meets(start: Any, end: Any, vertices: Any, nodes: Any, boxes: Any) -> bool:
    """Whether the line from start to end meets a triangle."""
    faces, first, skip = nodes
    px, py, pz = start[0], start[1], start[2]
    d = (end[0] - px, end[1] - py, end[2] - pz)
    ix = 1.0 / d[0] if d[0] != 0.0 else 1e300
    iy = 1.0 / d[1] if d[1] != 0.0 else 1e300
    iz = 1.0 / d[2] if d[2] != 0.0 else 1e300
    # which sides of all boxes this line comes to first
    nx, ny, nz = (0 if ix > 0.0 else 3), (1 if iy > 0.0 else 4), (2 if iz > 0.0 else 5)
    node = 0
    while node < len(skip):
        near = max(0.0, (boxes[node, nx] - px) * ix)
        far = min(1.0, (boxes[node, 3 - nx] - px) * ix)
        t = (boxes[node, ny] - py) * iy
        near = t if t > near else near
        t = (boxes[node, 5 - ny] - py) * iy
        far = t if t < far else far
        t = (boxes[node, nz] - pz) * iz
        near = t if t > near else near
        t = (boxes[node, 7 - nz] - pz) * iz
        far = t if t < far else far
        if near > far:
            node = skip[node]
            continue
        for face in range(first[node], first[node + 1]):
            if _meets_triangle((px, py, pz), d, vertices, faces[face]):
                return True
        node += 1
    return False


@numba.njit(cache=True, inline="always")  # type: ignore[untyped-decorator]
def _meets_triangle(p: Any, d: Any, vertices: Any, face: Any) -> bool:
    """Moeller and Trumbore 1997, without a division and for both windings; edges count as met."""
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    fx, fy, fz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    hx, hy, hz = d[1] * fz - d[2] * fy, d[2] * fx - d[0] * fz, d[0] * fy - d[1] * fx
    determinant = ex * hx + ey * hy + ez * hz
    sx, sy, sz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    qx, qy, qz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    u = sx * hx + sy * hy + sz * hz
    v = d[0] * qx + d[1] * qy + d[2] * qz
    t = fx * qx + fy * qy + fz * qz
    if determinant < 0.0:
        determinant, u, v, t = -determinant, -u, -v, -t
    return bool(
        determinant > 0.0 and u >= 0.0 and v >= 0.0 and u + v <= determinant and 0.0 <= t <= determinant
    )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _clear_lines(vertices: Any, lines: Any, nodes: Any, spots: Any, boxes: Any) -> Any:
    starts, ends, wanted = lines
    clear = np.zeros(wanted.shape, dtype=np.bool_)
    for t in range(wanted.shape[0]):
        mesh, cameras = vertices[min(t, len(vertices) - 1)], ends[min(t, len(ends) - 1)]
        if len(spots[0]) > 0:
            _refit(mesh, nodes[2], spots[0], spots[1], boxes)
        for p in range(wanted.shape[1]):
            for c in range(wanted.shape[2]):
                start = starts[t, p, min(c, starts.shape[2] - 1)]
                if wanted[t, p, c] and np.isfinite(start[0] + start[1] + start[2]):
                    clear[t, p, c] = not _meets(start, cameras[c], mesh, nodes, boxes)
    return clear
