"""The shadow of hands on what is close behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

from handsim.space.camera import Camera
from render.painting.figures import Drawn
from render.painting.rasterizer import NEAR, join, nearest_faces, project
from render.scenery.backdrops import Backdrop
from render.scenery.lights import Lighting

if TYPE_CHECKING:
    from jaxtyping import Float, Float32
    from numpy.typing import NDArray

_COARSE: Final = 4  # pixels of the picture a pixel of the shadow's mask: its edges are soft
_MARGIN: Final = 0.15  # of the picture around it where a hand still counts as being in it
_FLATTEST: Final = 0.15  # cosine between a lamp and a backdrop's normal below which there is no shadow
_SHADED: Final = 0.9  # of the light of a lamp; the rest comes back from the hand and all around


def light_behind(
    camera: Camera, drawn: Sequence[Drawn], lighting: Lighting, backdrop: Backdrop
) -> Float32[np.ndarray, "H W"] | None:
    """Share of its light that a backdrop keeps at each pixel; None where no shadow falls on it.

    Args:
        camera: A pinhole camera.
        drawn: The surfaces that cast the shadow.
        lighting: Light in the camera's axes; the first lamp casts the shadow.
        backdrop: Where it falls.
    """
    if not drawn or not lighting.lamps:
        return None
    surface = join([one.triangles for one in drawn])
    points = camera.local(surface.vertices)
    normal = np.array([*backdrop.recedes, -1.0]) / np.linalg.norm([*backdrop.recedes, 1.0])
    towards = np.array(lighting.lamps[0].direction) / np.linalg.norm(lighting.lamps[0].direction)
    steep = float(normal @ towards)
    near = _in_picture(camera, points)
    if steep < _FLATTEST or not near.any():
        return None
    heights = points @ normal
    heights += backdrop.gap - heights[near].min()
    # What is behind the backdrop, or so far aside that its shadow is too, casts none.
    heights[heights < 0.0] = np.nan
    fallen = points - (heights / steep)[:, None] * towards
    width, height = (-(-side // _COARSE) for side in camera.size)
    corners = project(fallen, camera.K)
    corners[:, :2] /= _COARSE
    _, first = nearest_faces(corners, surface.faces, (width, height), farthest=0.0)
    mask = (first >= 0).astype(np.float32)
    if not mask.any():
        return None
    blur = backdrop.softness * np.nanmedian(heights[near]) * camera.K[0, 0] / np.nanmedian(fallen[near, 2])
    mask = cv2.GaussianBlur(mask, (0, 0), max(0.5, float(blur) / _COARSE))
    whole = cv2.resize(mask, (width * _COARSE, height * _COARSE), interpolation=cv2.INTER_LINEAR)
    share = np.float32(_SHADED * _key_share(lighting, normal))
    light: NDArray[np.float32] = 1.0 - share * whole[: camera.size[1], : camera.size[0]]
    return light


def _in_picture(camera: Camera, points: Float[np.ndarray, "V 3"]) -> NDArray[np.bool_]:
    """Which points (V,) are in the picture, or a little beside it."""
    depth = np.maximum(points[:, 2], NEAR)
    pixels = points[:, :2] / depth[:, None] * np.diag(camera.K)[:2] + camera.K[:2, 2]
    margin = _MARGIN * np.array(camera.size)
    inside = (pixels > -margin) & (pixels < camera.size + margin)
    found: NDArray[np.bool_] = inside.all(axis=1) & (points[:, 2] > NEAR)
    return found


def _key_share(lighting: Lighting, normal: NDArray[np.float64]) -> float:
    """Share of the first lamp in the light that falls on a plane."""
    falls = []
    for lamp in lighting.lamps:
        direction = np.array(lamp.direction)
        falls.append(lamp.strength * max(0.0, float(direction @ normal)) / float(np.linalg.norm(direction)))
    return falls[0] / max(sum(falls) + float(np.mean(lighting.ambient)), 1e-6)
