"""Colors of surfaces before backgrounds, by our own compiled painter or by OpenGL.

A software OpenGL shades triangles in blocks of pixels, most of which are discarded for a fine mesh. Our
painter shades each pixel once, after its nearest face is known, and four times only where a surface ends.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from handsim.kernels import kernel
from handsim.space.camera import Camera
from render.frames import Bytes, Doubles, Floats, Integers
from render.painting.figures import Drawn
from render.painting.opengl import opengl_has_hardware, paint_opengl
from render.painting.rasterizer import NEAR, cut_off, faces_for, nearest_faces, project, warp
from render.painting.shading import (
    BUMP,
    COLOR,
    NORMAL,
    POSITION,
    ROUGHEST,
    SPOT,
    TANGENT,
    TINT,
    TO_DISPLAY,
    TO_LINEAR,
    display,
    shade,
    shadow_map,
)
from render.scenery.lights import Lighting, turned_irradiance

_SMOOTH: Final = 0.006  # largest difference of depth in a pixel of one surface, as a share of the depth
_SHADED_AROUND: Final = 0.1  # border whose vertices may have faces in the picture, as a share of its size
_BLOCK: Final = 1000  # points shaded at a time: they fit into the cache, and rows are no power of two apart

_NO_TEXELS: Final = np.empty((0, 0, 2), dtype=np.uint32)
_STEP: Final = 64  # windows' sizes are multiples of it, because OpenGL reallocates buffers for new sizes [px]


class _Mesh(NamedTuple):
    """One surface in the camera's axes, with its material."""

    begin: int  # number of its first face among those of all surfaces
    faces: Integers
    corners: Doubles  # vertices (V, 3) as `rasterizer.project` has them, at twice the picture's size
    rows: Floats  # position [m], normal, tint and texture coordinates of each vertex (V, 11)
    texels: NDArray[np.uint32]  # two words a texel (h, w, 2); empty where there is no texture
    finish: Doubles  # color, roughness, glow and scatter


def paint_compiled(
    cameras: Sequence[Camera],
    drawn: Sequence[Drawn],
    lighting: Lighting,
    *,
    bright: bool = False,
    blurred: bool = False,
) -> list[NDArray[Any]]:
    """Colors and coverage, as `paint` has them, by our own code; machines differ by rounding alone.

    The cameras have one shadow map, so that shadows go on from one face of a lens to the next. Only what is
    in focus is painted, where nothing else hides it, or what is not, `blurred` as if it were alone.
    """
    shown = [one for one in drawn if one.out_of_focus or not blurred]
    views = [_meshes(camera, shown) for camera in cameras]
    points = np.concatenate([one.triangles.vertices for one in drawn]).astype(np.float32, copy=False)
    counts = np.cumsum([0, *(len(one.triangles.vertices) for one in drawn)])
    casting = np.concatenate([one.casting + first for one, first in zip(drawn, counts, strict=False)])
    seen = np.full(len(points), blurred)  # soft shadows do with room for all that casts any
    for camera, meshes in () if blurred else zip(cameras, views, strict=True):
        given = [mesh.corners[: len(one.triangles.vertices)] for mesh, one in zip(meshes, drawn, strict=True)]
        sides = 2.0 * np.array(camera.size)
        with np.errstate(invalid="ignore"):  # NaN behind the camera
            inside = np.abs(np.concatenate(given)[:, :2] - 0.5 * sides) < (0.5 + _SHADED_AROUND) * sides
        seen |= inside[:, 0] & inside[:, 1]
    for one, first in zip(drawn, counts, strict=False):
        if not len(one.casting):  # what casts no shadow leaves the map to what does
            seen[first : first + len(one.triangles.vertices)] = False
    lamps, around = _lamp_table(lighting), np.zeros((9, 3))
    around[: max(1, len(lighting.surroundings))] = lighting.surroundings or lighting.ambient
    shadows = shadow_map(points, casting, lamps[0, :3], seen)
    pictures = []
    for camera, meshes in zip(cameras, views, strict=True):
        rotation, turned = camera.T_world_camera[:3, :3], lamps.copy()
        turned[:, :3] = lamps[:, :3] @ rotation
        ambient = turned_irradiance(around, rotation.T)
        own = shadows._replace(to_map=shadows.to_map @ camera.T_world_camera)
        width, height = camera.size
        surfaces = [(mesh.corners, mesh.faces) for mesh in meshes]
        nearness, first = nearest_faces(surfaces, (2 * width, 2 * height), farthest=0.0)
        covered = _covered(first)
        sums = np.zeros((len(covered), 4), dtype=np.float32)  # sums over the four samples of a pixel
        table = TO_DISPLAY[:0] if bright else TO_DISPLAY
        for mesh, one in zip(meshes, shown, strict=True):
            if one.out_of_focus == blurred:
                _add_surface(nearness, first, covered, *mesh, TO_LINEAR, turned, ambient, *own, table, sums)
        painted = np.zeros((height * width, 4), dtype=np.float32 if bright else np.uint8)
        if bright:
            painted[covered] = np.float32(63.75) * sums
        else:
            _write_means(sums, covered, painted)
        pictures.append(painted.reshape(height, width, 4))
    return pictures


@kernel
def _write_means(sums: Floats, covered: NDArray[np.int32], painted: Bytes) -> None:
    """Write sums of colors in [0, 1] over four samples (N, 4) as bytes of the covered pixels."""
    for n in range(len(covered)):
        for channel in range(4):
            painted[covered[n], channel] = np.int32(np.rint(np.float32(63.75) * sums[n, channel]))


def _meshes(camera: Camera, drawn: Sequence[Drawn]) -> list[_Mesh]:
    """The surfaces in the camera's axes."""
    rotation = camera.T_world_camera[:3, :3]
    doubled = np.diag([2.0, 2.0, 1.0]) @ camera.K
    meshes, begin = [], 0
    for one in drawn:
        triangles, material = one.triangles, one.material()
        local = camera.local(triangles.vertices)
        cut = cut_off(local, triangles.faces)
        rows = np.zeros((len(local), 11), dtype=np.float32)
        rows[:, :3], rows[:, 3:6] = local, triangles.normals @ rotation
        rows[:, 6:9] = one.colors[:, :3]
        if one.uv is not None:
            rows[:, 9:] = one.uv
        texels = _NO_TEXELS if material.texels is None else material.texels.view(np.uint32)
        finish = np.array([*material.color, material.roughness, material.glow, *material.scatter])
        corners = project(cut.local, doubled)
        meshes.append(_Mesh(begin, cut.faces, corners, cut.mixed(rows), texels, finish))
        begin += len(cut.faces)
    return meshes


@functools.lru_cache(maxsize=4)
def _lamp_table(lighting: Lighting) -> Doubles:
    """Rows (L, 9) for `shading.shade`; lamps in one direction share a row. They are not to be written to."""
    rows: dict[tuple[float, float, float], Doubles] = {}
    for number, lamp in enumerate(lighting.lamps):
        towards = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
        row = rows.setdefault(lamp.direction, np.concatenate([towards, np.zeros(6)]))
        row[3 if number == 0 else 6 :][:3] += np.pi * lamp.strength * np.array(lamp.color)
    if not rows:
        return np.array([[0.0, 0.0, -1.0, *[0.0] * 6]])
    return np.stack(list(rows.values()))


@kernel
def _covered(first: NDArray[np.int32]) -> Any:
    """Numbers (N,) of the pixels with a face in one of their four samples (2 H, 2 W); -1 is none."""
    height, width = first.shape[0] // 2, first.shape[1] // 2
    covered, count = np.empty(height * width, np.int32), 0
    for row in range(height):
        upper, lower = first[2 * row], first[2 * row + 1]
        for column in range(width):
            both = (upper[2 * column] & upper[2 * column + 1]) & (lower[2 * column] & lower[2 * column + 1])
            covered[count] = row * width + column
            count += both >= 0  # all bits of -1 are set, so that `both` is -1 only where all four are
    return covered[:count]


# Arrays are separate arguments: numba counts references to each array of a tuple, which costs time per call.
@kernel
def _add_surface(
    nearness: Floats,
    first: NDArray[np.int32],
    covered: NDArray[np.int32],
    begin: int,
    faces: Integers,
    corners: Doubles,
    rows: Floats,
    texels: NDArray[np.uint32],
    finish: Doubles,
    to_linear: Floats,
    lamps: Doubles,
    ambient: Doubles,
    to_map: Doubles,
    nearest: Floats,
    bias: float,
    to_display: Floats,
    sums: Floats,
) -> None:
    """Add one surface's colors, and the number of samples that it fills, to `sums` (N, 4) of covered pixels.

    `nearness` (2 H, 2 W) is one over the depth [1/m], `first` the nearest face of each sample, -1 for none.
    The surface's faces have numbers from `begin` on. `lamps` are `_lamp_table`, `nearest` and `bias` those of
    the `ShadowMap` [m]; `texels` is empty without a texture.
    """
    width, end = first.shape[1] // 2, begin + len(faces)
    block = np.zeros((SPOT, _BLOCK), np.float32)
    places, shares = np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.float32)
    spot = row = start = 0
    for place in range(len(covered) + 1):
        if spot > _BLOCK - 4 or place == len(covered):
            # A full block is not copied; its last columns hold points of an earlier block, or zeros.
            spots = block if spot > _BLOCK - 4 else np.ascontiguousarray(block[:, :spot])
            light = shade(spots, texels, finish, to_linear, lamps, ambient, to_map, nearest, bias)
            for k in range(3):
                display(light[k], spots[TINT + k], to_display)
            for n in range(spot):
                for k in range(3):
                    sums[places[n], k] += shares[n] * light[k, n]
                sums[places[n], 3] += shares[n]
            spot = 0
        if place == len(covered):
            break
        pixel = covered[place]
        while pixel - start >= width:  # quicker than a division for each pixel
            start += width
            row += 1
        column = pixel - start
        count, smooth = _samples(nearness, first, begin, end, row, column)
        if count == 0:
            continue
        for i in range(1 if smooth else 2):
            for j in range(1 if smooth else 2):
                face = first[2 * row + i, 2 * column + j] - begin
                if not 0 <= face < len(faces):
                    continue
                x, y = (1.0, 1.0) if smooth else (j + 0.5, i + 0.5)
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                x, y = 2 * column + x, 2 * row + y
                _write_spot(corners, rows, a, b, c, x, y, texels, finish, block, spot)
                places[spot], shares[spot] = place, 4.0 if smooth else 1.0
                spot += 1


@kernel(inline=True)
def _samples(nearness: Floats, first: NDArray[np.int32], begin: int, end: int, row: int, column: int) -> Any:
    """How many of a pixel's four samples a surface fills, and whether it fills all with similar depths."""
    i, j = 2 * row, 2 * column
    count = (begin <= first[i, j] < end) + (begin <= first[i, j + 1] < end)
    count += (begin <= first[i + 1, j] < end) + (begin <= first[i + 1, j + 1] < end)
    if count < 4:
        return count, False
    a, b, c, d = nearness[i, j], nearness[i, j + 1], nearness[i + 1, j], nearness[i + 1, j + 1]
    most, least = np.float64(max(a, b, c, d)), np.float64(min(a, b, c, d))
    return count, most - least < _SMOOTH * most


@kernel(inline=True)
def _write_spot(
    corners: Doubles,
    rows: Floats,
    a: int,
    b: int,
    c: int,
    x: float,
    y: float,
    texels: NDArray[np.uint32],
    finish: Doubles,
    spots: Floats,
    spot: int,
) -> None:
    """Write a surface point of the face (a, b, c): its vertices' rows, interpolated with perspective.

    The point is seen at column x and row y of a picture of twice the size [px].
    """
    ax, ay = corners[a, 0], corners[a, 1]
    bx, by = corners[b, 0] - ax, corners[b, 1] - ay
    cx, cy = corners[c, 0] - ax, corners[c, 1] - ay
    whole = by * cx - bx * cy  # positive, as of all faces that are drawn
    second = max((y - ay) * cx - (x - ax) * cy, 0.0)
    third = max((x - ax) * by - (y - ay) * bx, 0.0)
    first = max(whole - second - third, 0.0) * corners[a, 2]
    second, third = second * corners[b, 2], third * corners[c, 2]
    scale = 1.0 / (first + second + third)
    first, second, third = (np.float32(first * scale), np.float32(second * scale), np.float32(third * scale))
    px = first * rows[a, 0] + second * rows[b, 0] + third * rows[c, 0]
    py = first * rows[a, 1] + second * rows[b, 1] + third * rows[c, 1]
    pz = first * rows[a, 2] + second * rows[b, 2] + third * rows[c, 2]
    spots[POSITION, spot], spots[POSITION + 1, spot], spots[POSITION + 2, spot] = px, py, pz
    for i in range(3):
        spots[NORMAL + i, spot] = first * rows[a, 3 + i] + second * rows[b, 3 + i] + third * rows[c, 3 + i]
        spots[TINT + i, spot] = first * rows[a, 6 + i] + second * rows[b, 6 + i] + third * rows[c, 6 + i]
    if len(texels):
        for i in range(2):
            spots[BUMP + i, spot] = first * rows[a, 9 + i] + second * rows[b, 9 + i] + third * rows[c, 9 + i]
        bu, bv = rows[b, 9] - rows[a, 9], rows[b, 10] - rows[a, 10]
        cu, cv = rows[c, 9] - rows[a, 9], rows[c, 10] - rows[a, 10]
        sign = np.float32(1.0 if bu * cv - cu * bv >= 0.0 else -1.0)
        for i in range(3):
            spots[TANGENT + i, spot] = sign * (
                cv * (rows[b, i] - rows[a, i]) - bv * (rows[c, i] - rows[a, i])
            )
    else:
        for i in range(4):
            spots[COLOR + i, spot] = np.float32(finish[i] if i < 3 else max(finish[i], ROUGHEST))


Painter = Literal["compiled", "bright", "opengl"]
_BLUR: Final = 0.006  # spread of what is out of focus, as a share of the picture's height


def choose_painter() -> Literal["compiled", "opengl"]:
    """OpenGL where it draws on hardware, and our own painter elsewhere."""
    return "opengl" if opengl_has_hardware() else "compiled"


def paint(
    camera: Camera,
    drawn: Sequence[Drawn],
    lighting: Lighting,
    painter: Painter = "compiled",
    *,
    blurred: bool = False,
) -> NDArray[Any]:
    """Colors over black (sRGB), and as fourth channel the covered share of each pixel, through any lens.

    The picture (H, W, 4) has bytes; that of the painter "bright" has floats, which may exceed 255. It shows
    what is in focus or what is to be `blurred`; OpenGL has everything in focus.
    """
    bright = painter == "bright"
    faces, parts, inner = faces_for(camera), [], []
    pictures = [np.zeros((*face.size[::-1], 4), np.float32 if bright else np.uint8) for face in faces]
    for face, picture in zip(faces, pictures, strict=True):
        left, top, right, bottom = _window(face, [one for one in drawn if one.out_of_focus or not blurred])
        if left < right and top < bottom:
            inner.append(face.part(left, top, right - left, bottom - top))
            parts.append(picture[top:bottom, left:right])
    if painter == "opengl":
        painted = [paint_opengl(one, drawn, lighting) for one in inner]
    else:
        painted = paint_compiled(inner, drawn, lighting, bright=bright, blurred=blurred) if inner else []
    for part, colors in zip(parts, painted, strict=True):
        part[:] = colors
    return np.asarray(warp(camera, pictures, cv2.INTER_LINEAR))


def paint_blurred(
    camera: Camera, drawn: Sequence[Drawn], lighting: Lighting, painter: Painter = "compiled"
) -> NDArray[Any]:
    """What is out of focus, as `paint` has the rest; it is painted at half of the size."""
    width, height = camera.size
    half = dataclasses.replace(
        camera, size=(-(-width // 2), -(-height // 2)), K=np.diag([0.5, 0.5, 1.0]) @ camera.K
    )
    soft = cv2.GaussianBlur(paint(half, drawn, lighting, painter, blurred=True), (0, 0), _BLUR * half.size[1])
    whole = cv2.resize(soft, (2 * half.size[0], 2 * half.size[1]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[:height, :width])


def _window(camera: Camera, drawn: Sequence[Drawn]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of the picture with surfaces [px]."""
    if not drawn:
        return 0, 0, 0, 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for one in drawn:
        _widen(camera.local(one.triangles.vertices), camera.K, low, high)
    if low[2] < NEAR:
        return 0, 0, *camera.size
    low, high = np.floor(low[:2] - 1.0), np.ceil(high[:2] + 1.0)
    left, top = (np.clip(low, 0, camera.size) // _STEP * _STEP).astype(int)
    ends = np.minimum(np.ceil(np.clip(high, 0, camera.size) / _STEP) * _STEP, camera.size)
    return int(left), int(top), int(ends[0]), int(ends[1])


@kernel
def _widen(local: Doubles, K: Doubles, low: Doubles, high: Doubles) -> None:
    """Widen a range (3,) of columns, rows [px] and depths [m] to hold points (V, 3) in the camera's axes."""
    for point in range(len(local)):
        depth = local[point, 2]
        low[2], high[2] = min(low[2], depth), max(high[2], depth)
        for axis in range(2):
            place = local[point, axis] / depth * K[axis, axis] + K[axis, 2]
            low[axis], high[axis] = min(low[axis], place), max(high[axis], place)


def put_before(painted: NDArray[Any], background: NDArray[Any]) -> NDArray[Any]:
    """A picture of `paint` over a background (H, W, 3) of levels from 0 to 255."""
    if painted.dtype == np.float32:  # it is a bright one
        return np.asarray(painted[..., :3] + (1.0 - np.rint(painted[..., 3:]) / 255.0) * background)
    mixed = background.astype(np.uint8)
    _mix(painted.reshape(-1, 4), background.reshape(-1, 3), mixed.reshape(-1, 3))
    return mixed


@kernel
def _mix(painted: Bytes, background: Floats | Bytes, mixed: Bytes) -> None:
    """Blend painted colors with coverage (P, 4) over the background (P, 3) that `mixed` holds, in place."""
    for pixel in range(len(mixed)):
        if painted[pixel, 3]:
            clear = 1.0 - painted[pixel, 3] / 255.0
            for channel in range(3):
                value = painted[pixel, channel] + clear * background[pixel, channel]
                mixed[pixel, channel] = int(min(value, 255.0))
