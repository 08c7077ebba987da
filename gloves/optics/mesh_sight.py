"""Lines of sight past moving triangle meshes, compiled: one search of the mesh's tree for each line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from gloves.optics.mesh_tree import MeshTree, refit
from handsim._checks import check_array
from handsim.errors import ArgumentError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray


def clear_of_mesh(
    tree: MeshTree,
    vertices: Float[np.ndarray, "T V 3"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """Which of the needed lines from point to camera meet no triangle of their frame's mesh.

    A line that starts inside a closed mesh is not clear. NaN points are never clear.

    Args:
        tree: Tree over the mesh's faces.
        vertices: The mesh in every frame, in the world [m].
        points: Where lines start, in the world [m]: one point for all cameras, or one for each.
        cameras: Where lines end, in the world [m].
        needed: The lines to test; the others cost nothing and count as not clear.

    Raises:
        ArgumentError: Shapes do not fit together, or the vertices or cameras are not finite.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    starts, ends = _check_lines(points, cameras, needed)
    expected_shape = (len(needed), *tree.vertices.shape)
    if vertices.shape != expected_shape:
        raise ArgumentError(f"vertices has shape {vertices.shape}, expected {expected_shape}")
    if not np.isfinite(vertices.sum()):
        raise ArgumentError("vertices holds NaN or infinite values, expected finite numbers")
    nodes, spots = (tree.faces, tree.first, tree.skip), (tree.spots, tree.spots_start)
    lines = (starts, ends[None], np.asarray(needed, dtype=np.bool_))
    clear: NDArray[np.bool_] = _clear_lines(vertices, lines, nodes, spots, np.empty_like(tree.boxes))
    return clear


def clear_of_body(
    tree: MeshTree,
    T_world_body: Float[np.ndarray, "T 4 4"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """`clear_of_mesh` for a rigid body: lines are transformed into its frame, the tree is used as built.

    Args:
        tree: Tree over the body's mesh in the body's own frame.
        T_world_body: Its pose in every frame.
        points: Where lines start, in the world [m]: one point for all cameras, or one for each.
        cameras: Where lines end, in the world [m].
        needed: The lines to test; the others count as not clear.

    Raises:
        ArgumentError: Shapes do not fit together, a pose is not rigid, or poses or cameras are not finite.
    """
    poses = check_array("T_world_body", T_world_body, (len(needed), 4, 4))
    starts, ends = _check_lines(points, cameras, needed)
    rotations, positions = poses[:, :3, :3], poses[:, None, :3, 3]
    if not np.allclose(rotations.transpose(0, 2, 1) @ rotations, np.eye(3), atol=1e-6):
        raise ArgumentError("T_world_body scales or shears, expected rotations and translations alone")
    starts = np.ascontiguousarray((starts - positions[:, None]) @ rotations[:, None])
    ends = np.ascontiguousarray((ends - positions) @ rotations)
    nodes, no_refit = (tree.faces, tree.first, tree.skip), (tree.spots[:0], tree.spots_start)
    lines = (starts, ends, np.asarray(needed, dtype=np.bool_))
    clear: NDArray[np.bool_] = _clear_lines(tree.vertices[None], lines, nodes, no_refit, tree.boxes)
    return clear


def _check_lines(
    points: NDArray[np.float64], cameras: NDArray[np.float64], needed: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starts (T, P, 1 or C, 3), which may be NaN, and ends (C, 3) of the lines."""
    starts = np.ascontiguousarray(points, dtype=np.float64)
    ends = np.ascontiguousarray(check_array("cameras", cameras, (None, 3)))
    shapes = ((*needed.shape[:2], 3), (*needed.shape, 3))
    if needed.ndim != 3 or starts.shape not in shapes or ends.shape != (needed.shape[2], 3):
        raise ArgumentError(
            f"points {starts.shape}, cameras {ends.shape} and needed {needed.shape} do not fit together, "
            "expected (T, P, 3) or (T, P, C, 3), (C, 3) and (T, P, C)"
        )
    return (starts[:, :, None] if starts.ndim == 3 else starts), ends


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _meets(start: Any, end: Any, vertices: Any, nodes: Any, boxes: Any) -> bool:
    """Whether the line from `start` to `end`, each (3,) [m], meets a triangle.

    Args:
        start: One end of the line.
        end: The other end.
        vertices: The mesh (V, 3) [m].
        nodes: `faces`, `first` and `skip` of the tree.
        boxes: Low and high corner of each node (N, 6) [m].
    """
    faces, first, skip = nodes
    px, py, pz = start[0], start[1], start[2]
    d = (end[0] - px, end[1] - py, end[2] - pz)
    ix = 1.0 / d[0] if d[0] != 0.0 else 1e300
    iy = 1.0 / d[1] if d[1] != 0.0 else 1e300
    iz = 1.0 / d[2] if d[2] != 0.0 else 1e300
    # the sides of all boxes that this line meets first
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
    """Moeller and Trumbore 1997, without a division, for both windings; edges count as hit."""
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
    """Which lines (T, P, C) meet no triangle.

    Args:
        vertices: The mesh in every frame (T, V, 3) [m], or in one for all.
        lines: Starts (T, P, C or 1, 3) [m], ends (T or 1, C, 3) [m], and which lines are needed (T, P, C).
        nodes: `faces`, `first` and `skip` of the tree.
        spots: `spots` and `spots_start` of the tree; no spots: the boxes are used as given.
        boxes: Low and high corner of each node (N, 6) [m], refitted in every frame.
    """
    starts, ends, needed = lines
    clear = np.zeros(needed.shape, dtype=np.bool_)
    for t in range(needed.shape[0]):
        mesh, cameras = vertices[min(t, len(vertices) - 1)], ends[min(t, len(ends) - 1)]
        if len(spots[0]) > 0:
            refit(mesh, nodes[2], spots[0], spots[1], boxes)
        for p in range(needed.shape[1]):
            for c in range(needed.shape[2]):
                start = starts[t, p, min(c, starts.shape[2] - 1)]
                if needed[t, p, c] and np.isfinite(start[0] + start[1] + start[2]):
                    clear[t, p, c] = not _meets(start, cameras[c], mesh, nodes, boxes)
    return clear
