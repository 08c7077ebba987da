"""Shadows of a far lamp: on the hands, by the lamp's own z-buffer, and on what is close behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy.typing import NDArray

from handsim.kernels import kernel
from handsim.space.camera import Camera
from render.painting.figures import Drawn
from render.painting.rasterizer import NEAR, nearest_faces, project
from render.scenery.backgrounds import Backdrop
from render.scenery.lights import Lighting

_TEXELS: Final = (
    256  # along a side; hands and forearms are half a meter across, edges a few millimeters soft as in rooms
)
_EDGE: Final = 3.0  # [texels] that reads of neighbors may go beyond what is drawn
_COARSE: Final = 4  # pixels of the picture a pixel of the shadow's mask: its edges are soft
_MARGIN: Final = 0.15  # of the picture around it where a hand still counts as being in it
_FLATTEST: Final = 0.15  # cosine between a lamp and a backdrop's normal below which there is no shadow
_SHADED: Final = 0.9  # of the light of a lamp; the rest comes back from the hand and all around


class ShadowMap(NamedTuple):
    """Nearness of the nearest surface to a far lamp."""

    to_map: Float[np.ndarray, "3 4"]
    """Maps positions [m] to columns and rows [texels] and nearness to the lamp [m]."""
    nearest: Float32[np.ndarray, "N N"]
    """Nearness [m], minus infinity where nothing is."""
    bias: float
    """How much nearer a surface must be to cast a shadow [m]: about a texel."""


def shadow_map(
    points: Float32[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    towards: Float[np.ndarray, "3"],
    seen: Bool[np.ndarray, "V"],
) -> ShadowMap:
    """The shadows on a surface.

    Args:
        points: Vertices [m], in any frame.
        towards: Unit vector to the lamp, in the same frame.
        seen: Around which of the vertices shadows are needed; all when none is.
    """
    aside = np.cross(np.eye(3)[np.abs(towards).argmin()], towards)
    aside /= np.linalg.norm(aside)
    rotation = np.stack([aside, np.cross(aside, towards), towards])  # rows run down, as in pictures
    corners, to_map, scale = _onto_map(points, rotation, seen if seen.any() else ~seen)
    nearest, _ = nearest_faces(corners, faces, (_TEXELS, _TEXELS), farthest=-np.inf)
    return ShadowMap(to_map, nearest, 1.5 / scale)


@kernel
def _onto_map(points: NDArray[np.float32], rotation: NDArray[np.float64], seen: NDArray[np.bool_]) -> Any:
    """Points in a map that has room for those seen (V, 3), `ShadowMap.to_map`, and its texels a meter."""
    corners = np.empty((len(points), 3))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for point in range(len(points)):
        for axis in range(3):
            value = rotation[axis, 0] * points[point, 0]
            value += rotation[axis, 1] * points[point, 1] + rotation[axis, 2] * points[point, 2]
            corners[point, axis] = value
            if seen[point]:
                low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
    scale = (_TEXELS - 2.0 * _EDGE) / max(high[0] - low[0], high[1] - low[1], 1e-6)
    to_map = np.zeros((3, 4))
    to_map[:, :3] = rotation
    to_map[:2] *= scale
    for axis in range(2):
        to_map[axis, 3] = _EDGE - scale * low[axis]
        for point in range(len(points)):
            corners[point, axis] = scale * corners[point, axis] + to_map[axis, 3]
    return corners, to_map, scale


@kernel
def lit_share(
    to_map: NDArray[np.float64], nearest: NDArray[np.float32], bias: float, x: float, y: float, z: float
) -> float:
    """Visible share of the lamp at (x, y, z) [m]: the mean over a square of three texels around it.

    The map is that of a `ShadowMap`, by its fields.
    """
    across = to_map[0, 0] * x + to_map[0, 1] * y + to_map[0, 2] * z + to_map[0, 3] - 0.5
    down = to_map[1, 0] * x + to_map[1, 1] * y + to_map[1, 2] * z + to_map[1, 3] - 0.5
    near = to_map[2, 0] * x + to_map[2, 1] * y + to_map[2, 2] * z + to_map[2, 3] + bias
    column, row = int(np.floor(across)) - 1, int(np.floor(down)) - 1
    size = len(nearest)
    if column < 0 or row < 0 or column + 4 > size or row + 4 > size:
        return 1.0
    right, below = across - np.floor(across), down - np.floor(down)
    lit = 0.0
    for i in range(4):
        high = 1.0 - below if i == 0 else below if i == 3 else 1.0
        for j in range(4):
            if nearest[row + i, column + j] <= near:
                lit += high * (1.0 - right if j == 0 else right if j == 3 else 1.0)
    return lit / 9.0


def light_behind(
    camera: Camera, drawn: Sequence[Drawn], lighting: Lighting, backdrop: Backdrop
) -> Float32[np.ndarray, "H W"] | None:
    """Share of its light that a backdrop keeps at each pixel; None where no shadow falls on it.

    The drawn surfaces cast the shadow of the first lamp, in the axes of a pinhole camera.
    """
    if not drawn or not lighting.lamps:
        return None
    normal = np.array([*backdrop.recedes, -1.0]) / np.linalg.norm([*backdrop.recedes, 1.0])
    towards = np.array(lighting.lamps[0].direction) / np.linalg.norm(lighting.lamps[0].direction)
    if normal @ towards < _FLATTEST:
        return None
    surfaces = [one.triangles for one in drawn]
    points = camera.local(np.concatenate([surface.vertices for surface in surfaces]))
    first = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = np.concatenate([one.casting + start for one, start in zip(drawn, first, strict=False)])
    size = np.array(camera.size, dtype=np.float64)
    fallen, distance = np.full_like(points, np.nan), np.zeros(2)
    _fall(points, normal, towards, backdrop.gap, camera.K, size, fallen, distance)
    if distance[1] == 0.0:
        return None
    width, height = (-(-side // _COARSE) for side in camera.size)
    corners = project(fallen, camera.K)
    corners[:, :2] /= _COARSE
    _, front = nearest_faces(corners, faces, (width, height), farthest=0.0)
    mask = (front >= 0).astype(np.float32)
    if not mask.any():
        return None
    blur = backdrop.softness * distance[0] / distance[1] * camera.K[0, 0] / _COARSE
    mask = cv2.GaussianBlur(mask, (0, 0), max(0.5, float(blur)))
    light = 1.0 - np.float32(_SHADED * _key_share(lighting, normal)) * mask
    whole = cv2.resize(light, (width * _COARSE, height * _COARSE), interpolation=cv2.INTER_LINEAR)
    shown: NDArray[np.float32] = whole[: camera.size[1], : camera.size[0]]
    return shown


@kernel
def _fall(
    points: NDArray[np.float64],
    normal: NDArray[np.float64],
    towards: NDArray[np.float64],
    gap: float,
    K: NDArray[np.float64],
    size: NDArray[np.float64],
    fallen: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> None:
    """Write where the shadows of points (V, 3) [m] fall on a backdrop, placed by those in the picture.

    All is in the camera's axes; `normal` is the backdrop's, towards the camera, and `gap` its distance from
    the nearest point in the picture [m]. Points behind the backdrop cast none and keep what stands there.
    `distance` (2,) gets the mean distance from the points to the backdrop, and the backdrop's mean depth
    there [m]; zeros where no point is in the picture.
    """
    seen = np.zeros(len(points), dtype=np.bool_)
    nearest = np.inf
    for number in range(len(points)):
        x, y, z = points[number]
        if z > NEAR:
            across = (K[0, 0] * x / z + K[0, 2]) / size[0]
            down = (K[1, 1] * y / z + K[1, 2]) / size[1]
            if -_MARGIN < across < 1.0 + _MARGIN and -_MARGIN < down < 1.0 + _MARGIN:
                seen[number] = True
                nearest = min(nearest, x * normal[0] + y * normal[1] + z * normal[2])
    steep = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
    count = 0
    for number in range(len(points)):
        x, y, z = points[number]
        height = x * normal[0] + y * normal[1] + z * normal[2] - nearest + gap
        if height >= 0.0:
            for axis in range(3):
                fallen[number, axis] = points[number, axis] - height / steep * towards[axis]
        if seen[number]:
            count += 1
            distance[0] += height
            distance[1] += fallen[number, 2]
    if count:
        distance /= count


def _key_share(lighting: Lighting, normal: NDArray[np.float64]) -> float:
    """Share of the first lamp in the light that falls on a plane."""
    falls = []
    for lamp in lighting.lamps:
        direction = np.array(lamp.direction)
        falls.append(lamp.strength * max(0.0, float(direction @ normal)) / float(np.linalg.norm(direction)))
    return falls[0] / max(sum(falls) + float(np.mean(lighting.ambient)), 1e-6)
