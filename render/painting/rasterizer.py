"""Depth, normals and ids of triangles, by a compiled z-buffer.

Every pixel shows the surface behind its center, so that depth, normals and ids belong together and have the
same bytes on every machine (see docs/decisions/pictures.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float32, Int, Int32, UInt8
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from handsim.kernels import kernel
from handsim.space.camera import Camera
from render.frames import Pictures

NEAR: Final = 0.01
"""Triangles nearer to the camera's plane are not drawn [m]."""
_ROUNDING: Final = 1e-12  # of barycentric coordinates, so that no pixel on a common side falls between faces
_NARROW: Final = 6  # [px] width of a triangle's box up to which each of its pixels is tested


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """A surface to draw."""

    vertices: Float[np.ndarray, "V 3"]
    """In the world [m]."""
    faces: Int[np.ndarray, "F 3"]
    """Counter-clockwise from outside."""
    normals: Float[np.ndarray, "V 3"]
    """Unit normals in the world."""
    parts: UInt8[np.ndarray, "F"]
    """See `render.frames.Pictures`, as the next two."""
    instances: UInt8[np.ndarray, "F"]
    markers: UInt8[np.ndarray, "F"]


def join(surfaces: Sequence[Triangles]) -> Triangles:
    """Several surfaces as one."""
    counts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = [surface.faces + first for surface, first in zip(surfaces, counts[:-1], strict=True)]
    names = ("vertices", "normals", "parts", "instances", "markers")
    vertices, normals, parts, instances, markers = (
        np.concatenate([getattr(surface, name) for surface in surfaces]) for name in names
    )
    return Triangles(vertices, np.concatenate(faces), normals, parts, instances, markers)


def rasterize(camera: Camera, surface: Triangles, *, with_normals: bool = True) -> Pictures:
    """Depth, normals, parts, instances and markers as a pinhole camera sees them; `cameras.warp` has others.

    The surface is closed; the backs of its faces are not drawn.

    Raises:
        ArgumentError: The camera's lens is not a pinhole.
    """
    if camera.lens.kind != "pinhole":
        raise ArgumentError(f"camera '{camera.name}' has a lens '{camera.lens.kind}', expected a pinhole")
    width, height = camera.size
    local = camera.local(surface.vertices)
    faces = np.ascontiguousarray(surface.faces, dtype=np.int64)
    corners = project(local, camera.K)
    inverse, first = nearest_faces(corners, faces, camera.size, farthest=0.0)
    depth = np.zeros((height, width), dtype=np.float32)
    normals = np.zeros((height, width, 3), dtype=np.float32) if with_normals else None
    parts, instances, markers = (np.zeros((height, width), dtype=np.uint8) for _ in range(3))
    labels = np.stack([surface.parts, surface.instances, surface.markers], axis=1)
    _write(inverse, first, labels, depth, parts, instances, markers)
    if normals is not None:
        local_normals = surface.normals @ camera.T_world_camera[:3, :3]
        _interpolate(faces, local_normals, corners, first, normals)
    return Pictures(depth=depth, normals=normals, parts=parts, instances=instances, markers=markers)


def nearest_faces(
    corners: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    size: tuple[int, int],
    *,
    farthest: float,
) -> tuple[Float32[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
    """Nearness behind the center of every pixel, and the number of the face there, -1 for none.

    Faces that run counter-clockwise in the picture, where y is down, are drawn.

    Args:
        corners: Pixels and nearness of the vertices; the nearness must be linear over a triangle's picture,
            as is one over the depth, or the depth itself where rays are parallel. NaN hides a vertex's faces.
        farthest: Nearness of nothing.
    """
    nearness = np.full(size[::-1], farthest, dtype=np.float32)
    first = np.full(size[::-1], -1, dtype=np.int32)
    _draw(corners, faces, nearness, first)
    return nearness, first


@kernel
def project(local: NDArray[np.float64], K: NDArray[np.float64]) -> Any:
    """Pixels [px] and one over the depth [1/m] (V, 3) of points; NaN for those nearer than `NEAR`.

    Args:
        local: Points (V, 3) in the camera's axes [m].
        K: Camera matrix (3, 3) [px].
    """
    corners = np.full_like(local, np.nan)
    for vertex in range(len(local)):
        depth = local[vertex, 2]
        if depth >= NEAR:
            corners[vertex, 0] = K[0, 0] * local[vertex, 0] / depth + K[0, 2]
            corners[vertex, 1] = K[1, 1] * local[vertex, 1] / depth + K[1, 2]
            corners[vertex, 2] = 1.0 / depth
    return corners


@kernel
def _where_positive(value: float, step: float, low: float, high: float) -> Any:
    """The part of low..high where `value + step * place` is positive, and one place more on either side."""
    if step > 0.0:
        return max(low, -value / step - 1.0), high
    if step < 0.0:
        return low, min(high, -value / step + 1.0)
    return low, high


@kernel
def _draw(
    corners: NDArray[np.float64],
    faces: NDArray[np.int64],
    nearness: NDArray[np.float32],
    first: NDArray[np.int32],
) -> None:
    """Draw faces into a z-buffer `nearness` with their numbers `first`, both (H, W); see `nearest_faces`."""
    height, width = nearness.shape
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, ay, az = corners[a, 0], corners[a, 1], corners[a, 2]
        bx, by, bz = corners[b, 0] - ax, corners[b, 1] - ay, corners[b, 2] - az
        cx, cy, cz = corners[c, 0] - ax, corners[c, 1] - ay, corners[c, 2] - az
        area = bx * cy - by * cx
        if not area < 0.0:
            continue  # the back of a face, or a face without area
        low_x, high_x = min(0.0, bx, cx) + ax, max(0.0, bx, cx) + ax
        low_y, high_y = min(0.0, by, cy) + ay, max(0.0, by, cy) + ay
        if high_x < 0.0 or high_y < 0.0 or low_x > width or low_y > height:
            continue
        left, right = max(0, int(np.ceil(low_x - 0.5))), min(width - 1, int(np.floor(high_x - 0.5)))
        top, bottom = max(0, int(np.ceil(low_y - 0.5))), min(height - 1, int(np.floor(high_y - 0.5)))
        scale = 1.0 / area
        step_v, step_w = cy * scale, -by * scale
        begin, end = left, right
        for row in range(top, bottom + 1):
            y = row + 0.5 - ay
            if right - left > _NARROW:  # most of a slanted triangle's box is outside of it
                x = left + 0.5 - ax
                v, w = (x * cy - y * cx) * scale, (y * bx - x * by) * scale
                low, high = _where_positive(v, step_v, 0.0, float(right - left))
                low, high = _where_positive(w, step_w, low, high)
                low, high = _where_positive(1.0 - v - w, -step_v - step_w, low, high)
                if low > high:
                    continue
                begin, end = left + int(low), left + int(high)
            x = begin + 0.5 - ax
            v, w = (x * cy - y * cx) * scale, (y * bx - x * by) * scale
            for column in range(begin, end + 1):
                if v >= -_ROUNDING and w >= -_ROUNDING and v + w <= 1.0 + _ROUNDING:
                    near = az + v * bz + w * cz
                    if near > nearness[row, column]:
                        nearness[row, column] = near
                        first[row, column] = face
                v += step_v
                w += step_w


@kernel
def _write(
    inverse: NDArray[np.float32],
    first: NDArray[np.int32],
    labels: NDArray[np.uint8],
    depth: NDArray[np.float32],
    parts: NDArray[np.uint8],
    instances: NDArray[np.uint8],
    markers: NDArray[np.uint8],
) -> None:
    """Write depth [m] and ids of the nearest faces, -1 for none; `inverse` is one over the depth (H, W)."""
    height, width = first.shape
    for row in range(height):
        for column in range(width):
            face = first[row, column]
            if face >= 0:
                depth[row, column] = 1.0 / inverse[row, column]
                parts[row, column] = labels[face, 0]
                instances[row, column] = labels[face, 1]
                markers[row, column] = labels[face, 2]


@kernel
def _interpolate(
    faces: NDArray[np.int64],
    normals: NDArray[np.float64],
    corners: NDArray[np.float64],
    first: NDArray[np.int32],
    picture: NDArray[np.float32],
) -> None:
    """Write the unit normals behind the centers of all pixels with a face into `picture` (H, W, 3)."""
    height, width = first.shape
    for row in range(height):
        for column in range(width):
            face = first[row, column]
            if face < 0:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ax, ay = corners[a, 0], corners[a, 1]
            bx, by = corners[b, 0] - ax, corners[b, 1] - ay
            cx, cy = corners[c, 0] - ax, corners[c, 1] - ay
            x, y, scale = column + 0.5 - ax, row + 0.5 - ay, 1.0 / (bx * cy - by * cx)
            v, w = (x * cy - y * cx) * scale, (y * bx - x * by) * scale
            p, q, r = (1.0 - v - w) * corners[a, 2], v * corners[b, 2], w * corners[c, 2]
            total = 0.0
            for i in range(3):
                value = p * normals[a, i] + q * normals[b, i] + r * normals[c, i]
                picture[row, column, i] = value
                total += value * value
            scale = 1.0 / np.sqrt(total)
            for i in range(3):
                picture[row, column, i] *= scale
