"""Pictures through a lens, resampled from pinhole pictures of the same position.

One pinhole picture suffices for a lens with a narrow field of view; other lenses take the faces of a cube
around the camera. Only the part of a face that the lens sees is drawn, at the lens's finest resolution.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from handsim.space.camera import Camera, Lens, camera_matrix

Interpolation = Literal["nearest", "linear"]
_MARGIN: Final = 2  # [px] around what is looked up
_WIDEST: Final = 1.4  # tangent up to which one flat picture suffices: 54 degrees
_ONE_SURFACE: Final = 0.01  # share of the depth by which neighboring pixels of one surface differ
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
class _Face:
    """A pinhole picture, and where in it a part of the lens's picture is."""

    size: tuple[int, int]
    focal: float
    center: tuple[float, float]
    rotation: NDArray[np.float64]
    """Rotation (3, 3): the face's axes in the camera's."""
    part: tuple[slice, slice]
    """Rows and columns of the lens's picture that hold all of this face's pixels."""
    mask: Bool[np.ndarray, "h w"]
    """Which of the part's pixels are this face's."""
    pixels: Float32[np.ndarray, "h w 2"]
    """Their pixels in the face, counted from the center of its first pixel [px]."""
    ahead: Float32[np.ndarray, "h w"]
    """Depth along the camera's axis of what has depth 1 along the face's; 0 for what is not ahead."""


def faces_for(camera: Camera) -> list[Camera]:
    """Pinhole cameras at the same position that together see what a camera sees.

    A pinhole camera is its only face.

    Raises:
        ArgumentError: The lens sees nothing, or its faces would be larger than pictures may be.
    """
    if camera.lens.kind == "pinhole":
        return [camera]
    cameras = []
    for number, face in enumerate(_faces(camera)):
        K = np.array([[face.focal, 0, face.center[0]], [0, face.focal, face.center[1]], [0, 0, 1.0]])
        pose = camera.T_world_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ face.rotation
        cameras.append(Camera(f"{camera.name}_face{number}", face.size, K, pose))
    return cameras


def warp(camera: Camera, pictures: Sequence[NDArray[Any]], interpolation: Interpolation) -> NDArray[Any]:
    """The picture through the lens, from one for each of `faces_for`; 0 where it sees nothing.

    The interpolation is `linear` for colors, `nearest` for ids.

    Raises:
        ArgumentError: The pictures are not those of the camera's faces.
    """
    if camera.lens.kind == "pinhole":
        return pictures[0].copy()
    width, height = camera.size
    whole = np.zeros((height, width, *pictures[0].shape[2:]), pictures[0].dtype)
    flag = cv2.INTER_LINEAR if interpolation == "linear" else cv2.INTER_NEAREST
    for face, picture in _matched(camera, pictures):
        _fill(whole, face, _resampled(picture, face, flag))
    return whole


def warp_depth(camera: Camera, depths: Sequence[Float32[np.ndarray, "h w"]]) -> Float32[np.ndarray, "H W"]:
    """Depth along the camera's axis [m] from depths along the axes of its faces, 0 where there is nothing.

    Between pixels of one surface the reciprocal is interpolated, which is exact for planes; at edges the
    nearest pixel counts. What is not ahead of the camera (a fisheye may see it) has depth 0.

    Raises:
        ArgumentError: The pictures are not those of the camera's faces.
    """
    if camera.lens.kind == "pinhole":
        return depths[0].copy()
    whole = np.zeros(camera.size[::-1], np.float32)
    for face, depth in _matched(camera, depths):
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
    """Normals in the camera's axes from those of its faces in theirs, of the nearest pixels; 0 for nothing.

    Raises:
        ArgumentError: The pictures are not those of the camera's faces.
    """
    if camera.lens.kind == "pinhole":
        return normals[0].copy()
    whole = np.zeros((*camera.size[::-1], 3), np.float32)
    for face, picture in _matched(camera, normals):
        resampled = _resampled(picture, face, cv2.INTER_NEAREST)
        _fill(whole, face, cv2.transform(resampled, face.rotation))
    return whole


def _matched(camera: Camera, pictures: Sequence[NDArray[Any]]) -> list[tuple[_Face, NDArray[Any]]]:
    faces = _faces(camera)
    expected, given = [face.size[::-1] for face in faces], [picture.shape[:2] for picture in pictures]
    if expected != given:
        raise ArgumentError(
            f"pictures of {given} rows and columns, expected camera '{camera.name}' faces': {expected}"
        )
    return list(zip(faces, pictures, strict=True))


def _resampled(picture: NDArray[Any], face: _Face, flag: int) -> NDArray[Any]:
    resampled: NDArray[Any] = cv2.remap(picture, face.pixels, None, flag, borderMode=cv2.BORDER_REPLICATE)
    return resampled


def _fill(whole: NDArray[Any], face: _Face, part: NDArray[Any]) -> None:
    mask = face.mask if part.ndim == 2 else face.mask[..., None]
    np.copyto(whole[face.part], part, where=mask)


def _faces(camera: Camera) -> tuple[_Face, ...]:
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    faces = _faces_of_lens(camera.size, (fx, fy, cx, cy), camera.lens)
    if not faces or max(max(face.size) for face in faces) > 8192:
        largest = max((face.size for face in faces), default=(0, 0))
        raise ArgumentError(
            f"camera '{camera.name}' needs flat pictures of up to {largest[0]} x {largest[1]} pixels, "
            "expected "
            "1 to 8192 each way: its lens sees nothing, or too much of a plane"
        )
    return faces


@functools.lru_cache(maxsize=16)
def _faces_of_lens(
    size: tuple[int, int], middle: tuple[float, float, float, float], lens: Lens
) -> tuple[_Face, ...]:
    rays = Camera("rays", size, camera_matrix(*middle), lens=lens).rays()
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


def _face(rays: NDArray[np.float64], mine: NDArray[np.bool_], rotation: NDArray[np.float64]) -> _Face | None:
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


def _finest(local: NDArray[np.float64], mine: NDArray[np.bool_]) -> float:
    """Focal length [px] at which no step between the lens's pixels is less than a pixel of the face."""
    near = local[..., 2] > 0.2  # a face's own pixels are, and their neighbors
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
