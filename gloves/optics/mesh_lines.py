"""Lines past a mesh's triangles, compiled: refitting of the boxes, and the search of the tree."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from handsim.kernels.kernel import kernel

_PAD: Final = 1e-9  # around every box [m]: more than rounding, and flat boxes are no special case


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
