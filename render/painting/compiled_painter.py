"""Colors by our own compiled z-buffer and shading: fast on any processor, and without OpenGL.

A software OpenGL shades triangles in blocks of pixels, most of which are discarded for a fine mesh; here each
pixel is shaded once, after its nearest face is known, and four times only at edges of a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.space.camera import Camera
from render.painting.figures import Drawn
from render.painting.rasterizer import nearest_faces, project
from render.painting.shading import SPOT, TO_DISPLAY, TO_LINEAR, display, read_texels, shade
from render.painting.shadows import shadow_map
from render.scenery.lights import Lighting

_SMOOTH: Final = 0.006  # a pixel whose depths differ by less than this share shows one surface

_NO_TEXELS: Final = np.empty((0, 0, 8), dtype=np.uint8)


class _Mesh(NamedTuple):
    """One surface in the camera's axes, with its material."""

    begin: int
    """Number of its first face among those of all surfaces."""
    faces: NDArray[np.int64]
    vertices: NDArray[np.float64]
    """Rows (14) as in `shading.Spot`, the first three of `rasterizer.project` at twice the picture's size."""
    texels: NDArray[np.uint8]
    """Empty where there is no texture."""
    finish: NDArray[np.float64]
    """Color, roughness, glow and scatter."""


def paint_compiled(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    """See `render.painting.painter.paint`; the same bytes on every machine but for rounding."""
    width, height = camera.size
    meshes = _meshes(camera, drawn)
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, counts, strict=False)])
    vertices = np.concatenate([mesh.vertices[:, :6] for mesh in meshes])
    nearness, first = nearest_faces(vertices[:, :3], faces, (2 * width, 2 * height), farthest=0.0)
    lamps, around = _lamp_table(lighting), np.zeros((9, 3))
    around[: max(1, len(lighting.surroundings))] = lighting.surroundings or lighting.ambient
    shadows = shadow_map(vertices[:, 3:], faces, lamps[0, :3])
    sums = np.zeros((height, width, 4), dtype=np.float32)
    for mesh in meshes:
        _shade_surface(nearness, first, *mesh, lamps, around, *shadows, TO_LINEAR, TO_DISPLAY, sums)
    painted: NDArray[np.uint8] = np.rint(63.75 * sums).astype(np.uint8)
    return painted


def _meshes(camera: Camera, drawn: Sequence[Drawn]) -> list[_Mesh]:
    rotation = camera.T_world_camera[:3, :3]
    doubled = np.diag([2.0, 2.0, 1.0]) @ camera.K
    meshes, begin = [], 0
    for one in drawn:
        triangles, material = one.triangles, one.material()
        vertices = np.zeros((len(triangles.vertices), 14))
        vertices[:, 3:6] = camera.local(triangles.vertices)
        vertices[:, :3] = project(vertices[:, 3:6], doubled)
        vertices[:, 6:9] = triangles.normals @ rotation
        vertices[:, 9:12] = one.colors[:, :3]
        if one.uv is not None:
            vertices[:, 12:] = one.uv
        texels = _NO_TEXELS if material.texels is None else material.texels
        faces = np.ascontiguousarray(triangles.faces, dtype=np.int64)
        finish = np.array([*material.color, material.roughness, material.glow, *material.scatter])
        meshes.append(_Mesh(begin, faces, vertices, texels, finish))
        begin += len(faces)
    return meshes


def _lamp_table(lighting: Lighting) -> Float[np.ndarray, "L 9"]:
    """Rows for `shading.shade`; lamps in one direction share a row."""
    rows: dict[tuple[float, float, float], NDArray[np.float64]] = {}
    for number, lamp in enumerate(lighting.lamps):
        towards = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
        row = rows.setdefault(lamp.direction, np.concatenate([towards, np.zeros(6)]))
        row[3 if number == 0 else 6 :][:3] += np.pi * lamp.strength * np.array(lamp.color)
    if not rows:
        return np.array([[0.0, 0.0, -1.0, *[0.0] * 6]])
    return np.stack(list(rows.values()))


# Arrays come one by one: those in a tuple are counted at every access, which costs more than the shading.
@kernel
def _shade_surface(
    nearness: NDArray[np.float32],
    first: NDArray[np.int32],
    begin: int,
    faces: NDArray[np.int64],
    vertices: NDArray[np.float64],
    texels: NDArray[np.uint8],
    finish: NDArray[np.float64],
    lamps: NDArray[np.float64],
    ambient: NDArray[np.float64],
    to_map: NDArray[np.float64],
    nearest: NDArray[np.float32],
    bias: float,
    to_linear: NDArray[np.float64],
    to_display: NDArray[np.float64],
    sums: NDArray[np.float32],
) -> None:
    """Add one surface's colors, and how many of four samples per pixel it fills.

    Args:
        nearness: One over the depth (2 H, 2 W) [1/m].
        first: Nearest face of each sample (2 H, 2 W), counted over all surfaces; -1 for none.
        begin: Number of this surface's first face.
        faces: Triangles (F, 3).
        vertices: Rows (V, 14) of `_Mesh.vertices`.
        texels: Texture (h, w, 8), empty for none; see `Material.texels`.
        finish: Linear color (3), roughness, glow and scatter (3).
        lamps: Rows (L, 9) of `_lamp_table`.
        ambient: Ambient light by the normal (9, 3); see `surroundings.irradiance`.
        to_map: `ShadowMap.to_map` (3, 4).
        nearest: `ShadowMap.nearest` (N, N) [m].
        bias: `ShadowMap.bias` [m].
        to_linear: `shading.TO_LINEAR` (256,).
        to_display: `shading.TO_DISPLAY` (2048,).
        sums: Sums of display colors and samples (H, W, 4), added to.
    """
    spot, light = np.empty(SPOT), np.empty(3)
    for row in range(len(sums)):
        for column in range(sums.shape[1]):
            count, smooth = _samples(nearness, first, begin, begin + len(faces), row, column)
            if count == 0:
                continue
            for i in range(1 if smooth else 2):
                for j in range(1 if smooth else 2):
                    face = first[2 * row + i, 2 * column + j] - begin
                    if not 0 <= face < len(faces):
                        continue
                    x, y = (1.0, 1.0) if smooth else (j + 0.5, i + 0.5)
                    _interpolate(vertices, faces, face, 2 * column + x, 2 * row + y, spot)
                    spot[14:18] = finish[:4]
                    if len(texels):
                        read_texels(texels, to_linear, spot)
                        _apply_normal_map(vertices, faces, face, spot)
                    shade(spot, finish, lamps, ambient, to_map, nearest, bias, light)
                    share = 4.0 if smooth else 1.0
                    for k in range(3):
                        sums[row, column, k] += share * display(spot[9 + k] * light[k], to_display)
                    sums[row, column, 3] += share


@kernel
def _samples(
    nearness: NDArray[np.float32], first: NDArray[np.int32], begin: int, end: int, row: int, column: int
) -> Any:
    """How many of a pixel's four samples a surface fills, and whether it fills all with similar depths.

    Args:
        nearness: One over the depth (2 H, 2 W) [1/m].
        first: Nearest face of each sample (2 H, 2 W).
        begin: Number of the surface's first face.
        end: Number after its last face.
        row: Row of the pixel.
        column: Column of the pixel.
    """
    count, most, least = 0, 0.0, np.inf
    for i in range(2):
        for j in range(2):
            if begin <= first[2 * row + i, 2 * column + j] < end:
                count += 1
                most = max(most, nearness[2 * row + i, 2 * column + j])
                least = min(least, nearness[2 * row + i, 2 * column + j])
    return count, count == 4 and most - least < _SMOOTH * most


@kernel
def _interpolate(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    face: int,
    x: float,
    y: float,
    spot: NDArray[np.float64],
) -> None:
    """Write the surface point of a face behind a pixel: its corners' rows, interpolated with perspective.

    Args:
        vertices: Rows (V, 14) of `_Mesh.vertices`.
        faces: Triangles (F, 3).
        face: Index of the face.
        x: Column in the doubled picture [px].
        y: Row in the doubled picture [px].
        spot: See `shading.SPOT`; columns 3 to 13 are written.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    ax, ay = vertices[a, 0], vertices[a, 1]
    bx, by = vertices[b, 0] - ax, vertices[b, 1] - ay
    cx, cy = vertices[c, 0] - ax, vertices[c, 1] - ay
    scale = 1.0 / (bx * cy - by * cx)
    second = max(((x - ax) * cy - (y - ay) * cx) * scale, 0.0)
    third = max(((y - ay) * bx - (x - ax) * by) * scale, 0.0)
    first = max(1.0 - second - third, 0.0) * vertices[a, 2]
    second, third = second * vertices[b, 2], third * vertices[c, 2]
    scale = 1.0 / (first + second + third)
    first, second, third = first * scale, second * scale, third * scale
    for i in range(3, 14):
        spot[i] = first * vertices[a, i] + second * vertices[b, i] + third * vertices[c, i]
    _normalize(spot)


@kernel
def _apply_normal_map(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], face: int, spot: NDArray[np.float64]
) -> None:
    """Replace a normal (of `spot`) by the texture's, whose first axis is the direction in which u grows.

    Args:
        vertices: Rows (V, 14) of `_Mesh.vertices`.
        faces: Triangles (F, 3).
        face: Index of the face.
        spot: See `shading.SPOT`; the normal is written.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    bu, bv = vertices[b, 12] - vertices[a, 12], vertices[b, 13] - vertices[a, 13]
    cu, cv = vertices[c, 12] - vertices[a, 12], vertices[c, 13] - vertices[a, 13]
    sign = 1.0 if bu * cv - cu * bv >= 0.0 else -1.0
    bv, cv = sign * bv, sign * cv
    tx = cv * (vertices[b, 3] - vertices[a, 3]) - bv * (vertices[c, 3] - vertices[a, 3])
    ty = cv * (vertices[b, 4] - vertices[a, 4]) - bv * (vertices[c, 4] - vertices[a, 4])
    tz = cv * (vertices[b, 5] - vertices[a, 5]) - bv * (vertices[c, 5] - vertices[a, 5])
    nx, ny, nz = spot[6], spot[7], spot[8]
    along = nx * tx + ny * ty + nz * tz
    tx, ty, tz = tx - along * nx, ty - along * ny, tz - along * nz
    square = tx * tx + ty * ty + tz * tz
    if square == 0.0:
        return
    across, up, out = spot[18] / np.sqrt(square), spot[19] / np.sqrt(square), spot[20]
    spot[6] = across * tx + up * (ny * tz - nz * ty) + out * nx
    spot[7] = across * ty + up * (nz * tx - nx * tz) + out * ny
    spot[8] = across * tz + up * (nx * ty - ny * tx) + out * nz
    _normalize(spot)


@kernel
def _normalize(spot: NDArray[np.float64]) -> None:
    """Scale the normal of a surface point (see `shading.SPOT`) to unit length."""
    scale = 1.0 / np.sqrt(spot[6] * spot[6] + spot[7] * spot[7] + spot[8] * spot[8])
    for i in range(6, 9):
        spot[i] *= scale
