"""Lines of sight from markers to cameras: past capsules and triangle meshes, facing, and field of view."""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.hand.capsules import bounding_spheres
from handsim.hand.shape import named_shape
from handsim.hand.skin import build_surface
from handsim.kernels import kernel, segment_distance_squared
from handsim.space.camera import in_picture
from handsim.space.rig import CameraRig

_PAD: Final = 1e-9  # margin of every box [m]: exceeds rounding, and gives flat boxes a volume
_LEAF: Final = 4  # A leaf has at most this many triangles.
MAX_FACING: Final = np.deg2rad(85.0)
"""Largest angle between a marker's outward direction and the ray to a camera that still sees it [rad]."""


@kernel
def refit(vertices: Any, skip: Any, spots: Any, start: Any, boxes: Any) -> None:
    """Refit every box (N, 6) [m] to its triangles; written out, because loops over axes take longer.

    `skip`, `spots` and `start` are those of the `MeshTree`, the vertices those of the mesh (V, 3) [m].
    """
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


@kernel
def _meets(start: Any, end: Any, vertices: Any, nodes: Any, boxes: Any) -> bool:
    """Whether the line from `start` to `end`, each (3,) [m], meets a triangle of the tree."""
    faces, first, skip = nodes
    px, py, pz = start[0], start[1], start[2]
    d = (end[0] - px, end[1] - py, end[2] - pz)
    ix = 1.0 / d[0] if d[0] != 0.0 else 1e300
    iy = 1.0 / d[1] if d[1] != 0.0 else 1e300
    iz = 1.0 / d[2] if d[2] != 0.0 else 1e300
    # per axis, the index of the box side that the line meets first
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


@kernel(inline=True)
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


@kernel
def clear_lines(vertices: Any, lines: Any, nodes: Any, spots: Any, boxes: Any) -> Any:
    """Which lines (T, P, C) meet no triangle.

    Args:
        vertices: The mesh in every frame (T, V, 3) [m], or in one for all.
        lines: Starts (T, P, C or 1, 3) [m], ends (T or 1, C, 3) [m], and which lines are needed (T, P, C).
        nodes: `faces`, `first` and `skip` of the tree.
        spots: `spots` and `spots_start` of the tree; boxes are used as given if `spots` is empty.
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


class MeshTree:
    """A tree of axis-aligned boxes around a mesh's triangles.

    The surface-area heuristic splits the mesh as given here; later frames only refit the boxes. Only faces
    matter, so one tree serves all meshes that share them (`hand_tree` serves all hands).

    Nodes are stored in depth-first order, a left child right after its parent, and `skip` is the node that
    follows when a branch is left out: a search needs no stack, and a refit is one backward pass.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self.vertices: NDArray[np.float64] = np.ascontiguousarray(vertices, dtype=np.float64)
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


def clear_of_mesh(
    tree: MeshTree,
    vertices: Float[np.ndarray, "T V 3"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """Which of the needed lines from point to camera, in the world, meet no triangle of their frame's mesh.

    A line that starts inside a closed mesh is not clear. NaN points are never clear. Points [m] are one for
    all cameras, or one for each. Lines that are not needed cost nothing and count as not clear.
    """
    nodes, spots = (tree.faces, tree.first, tree.skip), (tree.spots, tree.spots_start)
    lines = (_starts(points), np.ascontiguousarray(cameras)[None], needed)
    mesh = np.ascontiguousarray(vertices, dtype=np.float64)
    return np.asarray(clear_lines(mesh, lines, nodes, spots, np.empty_like(tree.boxes)))


def clear_of_body(
    tree: MeshTree,
    T_world_body: Float[np.ndarray, "T 4 4"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """`clear_of_mesh` for a rigid body: lines are transformed into its frame, the tree is used as built."""
    rotations, positions = T_world_body[:, :3, :3], T_world_body[:, None, :3, 3]
    starts = np.ascontiguousarray((_starts(points) - positions[:, None]) @ rotations[:, None])
    ends = np.ascontiguousarray((cameras - positions) @ rotations)
    nodes, no_refit = (tree.faces, tree.first, tree.skip), (tree.spots[:0], tree.spots_start)
    return np.asarray(clear_lines(tree.vertices[None], (starts, ends, needed), nodes, no_refit, tree.boxes))


def _starts(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Starts (T, P, 1 or C, 3) of lines."""
    starts = np.ascontiguousarray(points, dtype=np.float64)
    return starts[:, :, None] if starts.ndim == 3 else starts


def free_rays(
    markers: Float[np.ndarray, "T M 3"],
    cameras: Float[np.ndarray, "C 3"],
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T M C"]:
    """Which straight lines from marker to camera, in the world [m], meet no capsule.

    A ray meets a capsule exactly when the segment marker-camera comes nearer to the capsule's axis than its
    radius, so one distance between two segments decides it.
    """
    free = np.ones((*markers.shape[:2], len(cameras)), dtype=np.bool_)
    _keep_free(markers, cameras, segments, radii, free)
    return free


def visible_cameras(
    markers: Float[np.ndarray, "T M 3"],
    normals: Float[np.ndarray, "T M 3"],
    rig: CameraRig,
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
) -> Bool[np.ndarray, "T M C"]:
    """Which cameras see each marker: in view, facing, and not occluded by the hand."""
    seen = facing_cameras(markers, normals, rig)
    _keep_free(markers, rig.positions, segments, radii, seen)
    return seen


def facing_cameras(
    markers: Float[np.ndarray, "T M 3"], normals: Float[np.ndarray, "T M 3"], rig: CameraRig
) -> Bool[np.ndarray, "T M C"]:
    """Which cameras would see each marker without occlusion: in view, and on its outward side."""
    seen: NDArray[np.bool_] = _facing(
        np.ascontiguousarray(markers, dtype=np.float64),
        np.ascontiguousarray(normals, dtype=np.float64),
        rig.arrays,
        np.cos(MAX_FACING),
    )
    return seen


def pack_cameras(visible: Bool[np.ndarray, "*batch C"]) -> NDArray[np.uint32]:
    """Visibility as one bit per camera: bit c is set where camera c sees."""
    bits = visible.astype(np.uint32) << np.arange(visible.shape[-1], dtype=np.uint32)
    return np.asarray(bits.sum(axis=-1, dtype=np.uint32))


@kernel
def _facing(markers: Any, normals: Any, cameras: Any, facing: float) -> Any:
    """Which cameras (T, M, C) have a marker in view and on its outward side; see `facing_cameras`."""
    frames, count = markers.shape[:2]
    seen = np.empty((frames, count, len(cameras.sizes)), dtype=np.bool_)
    for c in range(len(cameras.sizes)):
        pose, inner = cameras.T_world_camera[c], cameras.intrinsics[c]
        size, lens = cameras.sizes[c], cameras.lenses[c]
        for t in range(frames):
            for m in range(count):
                marker, normal = markers[t, m], normals[t, m]
                x, y, z = marker[0] - pose[0, 3], marker[1] - pose[1, 3], marker[2] - pose[2, 3]
                distance = np.sqrt(x * x + y * y + z * z)
                ahead = -(x * normal[0] + y * normal[1] + z * normal[2])
                seen[t, m, c] = ahead > facing * distance and in_picture(
                    inner, size, lens,
                    x * pose[0, 0] + y * pose[1, 0] + z * pose[2, 0],
                    x * pose[0, 1] + y * pose[1, 1] + z * pose[2, 1],
                    x * pose[0, 2] + y * pose[1, 2] + z * pose[2, 2],
                )  # fmt: skip
    return seen


@kernel
def _keep_free(
    markers: Float[np.ndarray, "T M 3"],
    cameras: Float[np.ndarray, "C 3"],
    segments: Float[np.ndarray, "T K 2 3"],
    radii: Float[np.ndarray, "K"],
    free: Bool[np.ndarray, "T M C"],
) -> None:
    """Set `free` (T, M, C) to False where a line meets a capsule; other arguments as in `free_rays`."""
    frames, count = markers.shape[:2]
    capsules = len(radii)
    centers, reach = np.empty((capsules, 3)), np.empty(capsules)
    offset, gap, margin = np.empty((3, capsules)), np.empty(capsules), np.empty(capsules)
    for t in range(frames):
        bounding_spheres(segments[t], radii, centers, reach)
        for m in range(count):
            marker = markers[t, m]
            for k in range(capsules):
                for i in range(3):
                    offset[i, k] = centers[k, i] - marker[i]
                gap[k] = offset[0, k] ** 2 + offset[1, k] ** 2 + offset[2, k] ** 2 - reach[k] ** 2
            for c in range(len(cameras)):
                if not free[t, m, c]:
                    continue
                dx, dy, dz = (cameras[c, 0] - marker[0], cameras[c, 1] - marker[1], cameras[c, 2] - marker[2])
                squared = dx * dx + dy * dy + dz * dz
                inverse = 1.0 / squared
                for k in range(capsules):  # a capsule whose bounding sphere the ray misses cannot be met
                    along = offset[0, k] * dx + offset[1, k] * dy + offset[2, k] * dz
                    share = min(1.0, max(0.0, along * inverse))
                    margin[k] = gap[k] - share * (2.0 * along - share * squared)
                for k in range(capsules):
                    if margin[k] < 0.0 and (
                        segment_distance_squared(marker, cameras[c], segments[t, k, 0], segments[t, k, 1])
                        < radii[k] * radii[k]
                    ):
                        free[t, m, c] = False
                        break
