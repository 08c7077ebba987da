"""Depth, normals and ids of triangles by a compiled z-buffer, and pictures through lenses.

Every pixel shows the surface behind its center, so that depth, normals and ids belong together and have the
same bytes on every machine (docs/decisions.md). A picture through a lens is resampled from pinhole
pictures of the same position: one for a narrow lens, the faces of a cube for others. Only the part of a
face that the lens sees is drawn, at the lens's finest resolution.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from handsim.kernels import kernel
from handsim.space.camera import Camera, camera_matrix
from render.frames import Bytes, Doubles, Flags, Floats, Geometry, Integers, at_rest

NEAR: Final = 0.01
"""Distance of the plane before the camera at which triangles are cut off [m]."""
_ROUNDING: Final = 1e-12  # of barycentric coordinates, so that a pixel on a common side belongs to a face
_MARGIN: Final = 2  # border of a face around the pixels that are looked up in it [px]
_WIDEST: Final = 1.4  # largest tangent of an angle from the axis in one flat picture: 54 degrees
_ONE_SURFACE: Final = 0.01  # largest difference of depth between neighbors of one surface, as a share of it
# Axes of the cube's faces in the camera's axes, as columns: ahead, right, left, down, up, back.
_FACE_AXES: Final = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
)


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """A surface to draw."""

    vertices: Float[np.ndarray, "V 3"]  # in the world [m]
    faces: Int[np.ndarray, "F 3"]  # counter-clockwise from outside
    normals: Float[np.ndarray, "V 3"]  # unit normals in the world
    parts: UInt8[np.ndarray, "F"]  # see `render.frames.Pictures`, as the next two
    instances: UInt8[np.ndarray, "F"]
    markers: UInt8[np.ndarray, "F"]


def see(camera: Camera, surfaces: Sequence[Triangles], *, with_normals: bool) -> Geometry:
    """Depth, normals and ids of surfaces through any lens."""
    if not surfaces:
        flat = np.zeros(camera.size[::-1], dtype=np.uint8)
        return Geometry(flat.astype(np.float32), np.zeros((*flat.shape, 3), np.float32), flat, flat, flat)
    whole = join(surfaces)
    faces = [rasterize(face, whole, with_normals=with_normals) for face in faces_for(camera)]
    depths, _, *ids = zip(*faces, strict=True)
    normals = [face.normals for face in faces if face.normals is not None]
    return Geometry(
        warp_depth(camera, depths),
        warp_normals(camera, normals) if with_normals else None,
        *(warp(camera, pictures) for pictures in ids),
    )


def join(surfaces: Sequence[Triangles]) -> Triangles:
    """Several surfaces as one."""
    counts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = [surface.faces + first for surface, first in zip(surfaces, counts[:-1], strict=True)]
    names = ("vertices", "normals", "parts", "instances", "markers")
    vertices, normals, parts, instances, markers = (
        np.concatenate([getattr(surface, name) for surface in surfaces]) for name in names
    )
    return Triangles(vertices, np.concatenate(faces), normals, parts, instances, markers)


def rasterize(camera: Camera, surface: Triangles, *, with_normals: bool = True) -> Geometry:
    """Depth, normals and ids as a pinhole camera sees them; `see` draws through other lenses.

    The surface is closed; the backs of its faces are not drawn.
    """
    width, height = camera.size
    cut = cut_off(camera.local(surface.vertices), surface.faces)
    faces, corners = cut.faces, project(cut.local, camera.K)
    inverse, first = nearest_faces([(corners, faces)], camera.size, farthest=0.0)
    depth = np.zeros((height, width), dtype=np.float32)
    normals = np.zeros((height, width, 3), dtype=np.float32) if with_normals else None
    parts, instances, markers = (np.zeros((height, width), dtype=np.uint8) for _ in range(3))
    labels = cut.owned(np.stack([surface.parts, surface.instances, surface.markers], axis=1))
    _write(inverse, first, labels, depth, parts, instances, markers)
    if normals is not None:
        local_normals = cut.mixed(surface.normals @ camera.T_world_camera[:3, :3])
        _interpolate(faces, local_normals, corners, first, normals)
    return Geometry(depth, normals, parts, instances, markers)


class CutOff(NamedTuple):
    """Triangles, followed by the visible pieces of those that the plane `NEAR` crosses."""

    local: Float[np.ndarray, "V 3"]  # vertices in the camera's axes, those on the plane last [m]
    faces: Int[np.ndarray, "F 3"]
    owners: Int[np.ndarray, "N"]  # the triangle that each piece is a part of
    ends: Int[np.ndarray, "M 2"]  # vertices between which those on the plane lie
    shares: Float[np.ndarray, "M 1"]  # places between them, from 0 to 1

    def mixed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (V, ...) of all vertices after the cut, from values (V - M, ...) of those before it."""
        if not len(self.ends):
            return values
        first, second = values[self.ends[:, 0]], values[self.ends[:, 1]]
        return np.concatenate([values, (first + self.shares * (second - first)).astype(values.dtype)])

    def owned(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of the triangles (F - N, ...), followed by those of the pieces."""
        return np.concatenate([values, values[self.owners]]) if len(self.owners) else values


def cut_off(local: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> CutOff:
    """Cut the triangles (in the camera's axes [m]) that the plane `NEAR` crosses."""
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    ahead = local[:, 2] >= NEAR
    crossed = none = np.empty(0, dtype=np.int64)
    if not ahead.all():
        first, second, third = ahead[faces.T]
        crossed = np.flatnonzero((first | second | third) & ~(first & second & third))
    if not len(crossed):
        return CutOff(local, faces, none, none.reshape(0, 2), np.empty((0, 1)))
    front = ahead[faces[crossed]]
    one = front.sum(axis=1) == 1  # one corner is ahead, otherwise two are
    lone = np.where(one, front.argmax(axis=1), front.argmin(axis=1))
    around = faces[crossed[:, None], (lone[:, None] + np.arange(3)) % 3]
    ends = np.sort(np.stack([around[:, :2], around[:, ::2]], axis=1).reshape(-1, 2), axis=1)
    depths = local[ends, 2]
    shares = ((NEAR - depths[:, 0]) / (depths[:, 1] - depths[:, 0]))[:, None]
    left = len(local) + 2 * np.arange(len(crossed))
    tips = np.stack([around[:, 0], left, left + 1], axis=1)
    bases = np.stack([left, around[:, 1], around[:, 2]], axis=1)
    rests = np.stack([left, around[:, 2], left + 1], axis=1)[~one]
    pieces = np.concatenate([faces, np.where(one[:, None], tips, bases), rests])
    cut = CutOff(local, pieces, np.concatenate([crossed, crossed[~one]]), ends, shares)
    whole = cut.mixed(local)
    whole[len(local) :, 2] = NEAR  # without rounding, so that `project` keeps them
    return cut._replace(local=whole)


def nearest_faces(
    surfaces: Sequence[tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]],
    size: tuple[int, int],
    *,
    farthest: float,
) -> tuple[Float32[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
    """Nearness behind the center of every pixel, and the number of the face there, -1 for none.

    Surfaces are corners and faces, whose numbers go on from one surface to the next. Faces that run
    counter-clockwise in the picture, where y is down, are drawn.
    """
    nearness = np.full(size[::-1], farthest, dtype=np.float32)
    first = np.full(size[::-1], -1, dtype=np.int32)
    begin = 0
    for corners, faces in surfaces:
        _draw(corners, faces, begin, nearness, first)
        begin += len(faces)
    return nearness, first


@kernel
def project(local: Doubles, K: Doubles) -> Any:
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


@kernel(inline=True)
def _narrowed(value: float, step: float, inverse: float, low: float, high: float) -> Any:
    """The part of low..high where `value + step * place` is not negative; `inverse` is one over the step."""
    bound = -value * inverse
    if step > 0.0:
        return bound if bound > low else low, high
    if step < 0.0:
        return low, bound if bound < high else high
    return low, high if value >= 0.0 else -1.0


@kernel
def _draw(corners: Doubles, faces: Integers, begin: int, nearness: Floats, first: NDArray[np.int32]) -> None:
    """Draw faces into a z-buffer `nearness` with their numbers `first`, both (H, W); see `nearest_faces`.

    The first face has the number `begin`.
    """
    height, width = nearness.shape
    nearest, numbers = nearness.reshape(-1), first.reshape(-1)
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
        step_u = -step_v - step_w
        # One division for each side of a face is quicker than one for each of its rows.
        inverse_v, inverse_w, inverse_u = 1.0 / step_v, 1.0 / step_w, 1.0 / step_u
        x = left + 0.5 - ax
        for row in range(top, bottom + 1):
            y = row + 0.5 - ay
            v, w = (x * cy - y * cx) * scale, (y * bx - x * by) * scale
            low, high = 0.0, float(right - left)
            low, high = _narrowed(v + _ROUNDING, step_v, inverse_v, low, high)
            low, high = _narrowed(w + _ROUNDING, step_w, inverse_w, low, high)
            low, high = _narrowed(1.0 - v - w + _ROUNDING, step_u, inverse_u, low, high)
            if low > high:
                continue
            start = row * width + left
            for column in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                near = az + (v + column * step_v) * bz + (w + column * step_w) * cz
                place = np.uint64(start + column)  # saves a test for negative indices
                if near > nearest[place]:
                    nearest[place] = near
                    numbers[place] = begin + face


@kernel
def _write(
    inverse: Floats,
    first: NDArray[np.int32],
    labels: Bytes,
    depth: Floats,
    parts: Bytes,
    instances: Bytes,
    markers: Bytes,
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
    faces: Integers, normals: Doubles, corners: Doubles, first: NDArray[np.int32], picture: Floats
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


@dataclass(frozen=True, slots=True, eq=False)
class _Face:
    """A pinhole picture, and where in it a part of the lens's picture is."""

    size: tuple[int, int]
    focal: float
    center: tuple[float, float]
    rotation: Doubles  # rotation (3, 3): the face's axes in the camera's
    part: tuple[slice, slice]
    """Rows and columns of the lens's picture that hold all of this face's pixels."""
    mask: Bool[np.ndarray, "h w"]  # which of the part's pixels are this face's
    pixels: Float32[np.ndarray, "h w 2"]
    """Their pixels in the face, counted from the center of its first pixel [px]."""
    ahead: Float32[np.ndarray, "h w"]
    """Depth along the camera's axis of what has depth 1 along the face's; 0 for what is not ahead."""


def faces_for(camera: Camera) -> list[Camera]:
    """Pinhole cameras at the same position that together see what a camera sees.

    A pinhole camera is its only face.
    """
    if camera.lens.kind == "pinhole":
        return [camera]
    cameras = []
    for number, face in enumerate(_faces(camera)):
        K = camera_matrix(face.focal, face.focal, *face.center)
        pose = camera.T_world_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ face.rotation
        cameras.append(Camera(f"{camera.name}_face{number}", face.size, K, pose))
    return cameras


def warp(camera: Camera, pictures: Sequence[NDArray[Any]], flag: int = cv2.INTER_NEAREST) -> NDArray[Any]:
    """The picture through the lens, from one for each of `faces_for`; 0 where it sees nothing.

    `flag` is one of OpenCV's methods of interpolation.
    """
    if camera.lens.kind == "pinhole":
        return pictures[0]
    width, height = camera.size
    whole = np.zeros((height, width, *pictures[0].shape[2:]), pictures[0].dtype)
    for face, picture in zip(_faces(camera), pictures, strict=True):
        _fill(whole, face, _resampled(picture, face, flag))
    return whole


def warp_depth(camera: Camera, depths: Sequence[Float32[np.ndarray, "h w"]]) -> Float32[np.ndarray, "H W"]:
    """Depth along the camera's axis [m] from depths along the axes of its faces, 0 where there is nothing.

    Between pixels of one surface the reciprocal is interpolated, which is exact for planes; at edges the
    nearest pixel counts. What is not ahead of the camera (a fisheye may see it) has depth 0.
    """
    if camera.lens.kind == "pinhole":
        return depths[0]
    whole = np.zeros(camera.size[::-1], np.float32)
    for face, depth in zip(_faces(camera), depths, strict=True):
        with np.errstate(divide="ignore"):
            reciprocal = np.where(depth > 0.0, np.float32(1.0) / depth, np.float32(0.0))
        nearest = _resampled(reciprocal, face, cv2.INTER_NEAREST)
        smooth = _resampled(reciprocal, face, cv2.INTER_LINEAR)
        whole_surface = np.abs(smooth - nearest) <= np.float32(_ONE_SURFACE) * nearest
        value = np.where(whole_surface, smooth, nearest)
        with np.errstate(divide="ignore", invalid="ignore"):
            _fill(whole, face, np.where(value > 0.0, face.ahead / value, np.float32(0.0)))
    return whole


def warp_normals(
    camera: Camera, normals: Sequence[Float32[np.ndarray, "h w 3"]]
) -> Float32[np.ndarray, "H W 3"]:
    """Normals in the camera's axes from those of its faces in theirs; 0 where there is nothing."""
    if camera.lens.kind == "pinhole":
        return normals[0]
    whole = np.zeros((*camera.size[::-1], 3), np.float32)
    for face, picture in zip(_faces(camera), normals, strict=True):
        resampled = _resampled(picture, face, cv2.INTER_NEAREST)
        _fill(whole, face, cv2.transform(resampled, face.rotation))
    return whole


def _resampled(picture: NDArray[Any], face: _Face, flag: int) -> NDArray[Any]:
    return np.asarray(cv2.remap(picture, face.pixels, None, flag, borderMode=cv2.BORDER_REPLICATE))


def _fill(whole: NDArray[Any], face: _Face, part: NDArray[Any]) -> None:
    mask = face.mask if part.ndim == 2 else face.mask[..., None]
    np.copyto(whole[face.part], part, where=mask)


def _faces(camera: Camera) -> tuple[_Face, ...]:
    faces = _faces_of_lens(at_rest(camera))
    if not faces or max(max(face.size) for face in faces) > 8192:
        largest = max((face.size for face in faces), default=(0, 0))
        raise ArgumentError(
            f"camera '{camera.name}' needs flat pictures of up to {largest[0]} x {largest[1]} pixels, "
            "expected 1 to 8192 each way: its lens sees nothing, or too much of a plane"
        )
    return faces


@functools.lru_cache(maxsize=16)
def _faces_of_lens(camera: Camera) -> tuple[_Face, ...]:
    rays = camera.rays()
    known = np.isfinite(rays).all(axis=-1)
    rays = np.where(known[..., None], rays, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.abs(rays[..., :2]).max(axis=-1) / rays[..., 2]
    if ((rays[..., 2] > 0.0) & (tangents <= _WIDEST))[known].all():
        owners = np.where(known, 0, -1)
    else:
        rotations = np.array(_FACE_AXES, dtype=np.float64)
        owners = np.where(known, (rays @ rotations[:, :, 2].T).argmax(axis=-1), -1)
    faces = (
        _face(rays, owners == number, np.array(axes, dtype=np.float64))
        for number, axes in enumerate(_FACE_AXES)
    )
    return tuple(face for face in faces if face is not None)


def _face(rays: Doubles, mine: Flags, rotation: Doubles) -> _Face | None:
    """The face that has some of a picture's pixels."""
    rows, columns = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
    if not len(rows):
        return None
    part = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    local = rays[part] @ rotation
    mask = mine[part]
    along = np.where(mask, local[..., 2], 1.0)
    flat = np.where(mask[..., None], local[..., :2] / along[..., None], 0.0)
    focal = _finest(rays @ rotation, mine)
    low, high = focal * flat[mask].min(axis=0) - _MARGIN, focal * flat[mask].max(axis=0) + _MARGIN
    size = np.ceil(high - low).astype(int)
    pixels = np.where(mask[..., None], focal * flat - low - 0.5, 0.0)
    ahead = np.where(mask & (rays[part][..., 2] > 1e-3), rays[part][..., 2] / along, 0.0)
    return _Face(
        size=(int(size[0]), int(size[1])),
        focal=focal,
        center=(float(-low[0]), float(-low[1])),
        rotation=rotation,
        part=part,
        mask=mask,
        pixels=np.ascontiguousarray(pixels, dtype=np.float32),
        ahead=ahead.astype(np.float32),
    )


def _finest(local: Doubles, mine: Flags) -> float:
    """Focal length [px] at which no step between the lens's pixels is less than a pixel of the face."""
    near = local[..., 2] > 0.2  # holds for a face's own pixels and their neighbors
    flat = np.full_like(local[..., :2], np.nan)
    flat[near] = local[near][:, :2] / local[near][:, 2:]
    finest = 1.0
    for step in (1, -1):  # differences to either side: a pixel may have a neighbor on one only
        down, right = np.roll(flat, step, axis=0) - flat, np.roll(flat, step, axis=1) - flat
        inside = mine.copy()
        inside[0 if step > 0 else -1] = inside[:, 0 if step > 0 else -1] = False
        # The smaller singular value of a pixel's steps (2 x 2).
        square = (down**2).sum(axis=-1) + (right**2).sum(axis=-1)
        determinant = down[..., 0] * right[..., 1] - down[..., 1] * right[..., 0]
        least = np.sqrt(0.5 * (square - np.sqrt(np.maximum(square**2 - 4.0 * determinant**2, 0.0))))
        least = least[inside & np.isfinite(least)]
        finest = max(finest, 1.0 / float(least.min(initial=np.inf)))
    return finest
