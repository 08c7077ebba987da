"""From a point on the skin back to a marker's place in a layout: the inverse of `gloves.attachment`."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.attachment import attach_markers
from gloves.layout import ACROSS_RANGE, ALONG_RANGE, MarkerLayout, MarkerPlace
from handsim.errors import LayoutError
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, PALM
from handsim.hand.skin import vertex_normals

_STEPS: Final = 12
_NEAR: Final = 1e-5  # [m]
_REACHED: Final = 5e-4  # [m]
_POINTED: Final = 2e-4  # [m]
_CURVATURE_RADIUS: Final = 0.006  # of the skin of a finger's tip [m]
_SPACING: Final = 4e-3  # [m] between the skin's vertices, about


def place_marker(
    layout: MarkerLayout, index: int, model: HandModel, point: Float[np.ndarray, "3"]
) -> MarkerLayout:
    """The layout with one marker moved to the place on the skin that is nearest to a point.

    The marker stays on its bone where that reaches the point, or else goes to the one that carries the skin
    there. On the palm it lies straight above or below its place in the palm's plane.

    Args:
        index: The marker to move.
        model: The hand that the point is meant on.
        point: Where the marker's center shall be, in the wrist's frame of the flat hand [m]. A marker on a
            stalk keeps its height, and comes to stand where the stalk points at this.

    Raises:
        LayoutError: No marker can be put there.
    """
    height = layout.markers[index].height
    placed = _place_on_skin(_with_height(layout, index, 0.0), index, model, point)
    return placed if height == 0.0 else _stand_up(placed, index, height, model, point)


def _stand_up(
    layout: MarkerLayout, index: int, height: float, model: HandModel, point: NDArray[np.float64]
) -> MarkerLayout:
    """A marker that lies near its place, put on its stalk and moved until the stalk points at a point."""
    foot = attach_markers(layout, model).points[index]
    best, least = layout, math.inf
    for _ in range(_STEPS):
        standing = _with_height(layout, index, height)
        worn = attach_markers(standing, model)
        missed = point - worn.points[index]
        missed -= (missed @ worn.normals[index]) * worn.normals[index]
        distance = float(np.linalg.norm(missed))
        if distance < least:
            best, least = standing, distance
        if least < _POINTED:
            break
        # On skin as curved as a finger's tip the end of the stalk moves more than its foot.
        foot = foot + missed * _CURVATURE_RADIUS / (_CURVATURE_RADIUS + height)
        layout = _place_on_skin(layout, index, model, foot)
    return best


def _with_height(layout: MarkerLayout, index: int, height: float) -> MarkerLayout:
    marker = dataclasses.replace(layout.markers[index], height=height)
    return dataclasses.replace(
        layout, markers=(*layout.markers[:index], marker, *layout.markers[index + 1 :])
    )


def _place_on_skin(
    layout: MarkerLayout, index: int, model: HandModel, point: NDArray[np.float64]
) -> MarkerLayout:
    """The layout with a marker without a stalk on the skin that is nearest to a point."""
    surface = model.surface
    nearest = int(((surface.vertices - point) ** 2).sum(axis=1).argmin())
    normal = vertex_normals(surface.vertices, surface.faces)[nearest]
    aside = point - surface.vertices[nearest]
    aside -= (aside @ normal) * normal
    aside *= min(1.0, _SPACING / max(float(np.linalg.norm(aside)), _NEAR))
    center = surface.vertices[nearest] + aside + layout.radius * normal
    bones = (BONE_NAMES.index(layout.markers[index].bone), int(surface.bone_indices[nearest, 0]))
    best, least = layout, math.inf
    for bone in dict.fromkeys(bones):
        candidate, missed = _place_on(layout, index, bone, model, center)
        if missed < least:
            best, least = candidate, missed
        if least < _REACHED:
            break
    if math.isinf(least):
        raise LayoutError(f"marker '{layout.names[index]}' meets no skin there; move it nearer to the hand")
    return best


def _place_on(
    layout: MarkerLayout, index: int, bone: int, model: HandModel, center: NDArray[np.float64]
) -> tuple[MarkerLayout, float]:
    """The layout with a marker's center on one bone as near to a place as can be, and how far it misses [m].

    The layout is the given one, and the distance infinite, where the bone's rays meet no skin.
    """
    wanted, start = center, model.rest_transforms[bone]
    middle = start[:3, 3] + 0.5 * model.skeleton.lengths[bone] * start[:3, 0]
    best, least = layout, math.inf
    for _ in range(_STEPS):  # the center is one radius off the skin, not along the ray that finds the skin
        moved = _place(layout.markers[index], bone, model, wanted)
        markers = (*layout.markers[:index], moved, *layout.markers[index + 1 :])
        candidate = dataclasses.replace(layout, markers=markers)
        try:
            missed = center - attach_markers(candidate, model).points[index]
        except LayoutError:  # beside the skin, as beyond a finger's tip
            wanted = wanted + 0.1 * (middle - wanted)
            continue
        distance = float(np.linalg.norm(missed))
        if distance < least:
            least, best = distance, candidate
        if least < _NEAR:
            break
        wanted = wanted + missed
    return best, least


def _place(marker: MarkerPlace, bone: int, model: HandModel, point: NDArray[np.float64]) -> MarkerPlace:
    """The place on a bone whose ray goes through a point."""
    T_wrist_bone = model.rest_transforms[bone]
    x, y, z = T_wrist_bone[:3, :3].T @ (point - T_wrist_bone[:3, 3])
    y *= 1.0 if model.shape.side == "right" else -1.0
    along = float(np.clip(x / model.skeleton.lengths[bone], *ALONG_RANGE))
    if bone != PALM:
        return MarkerPlace(marker.name, BONE_NAMES[bone], along, math.atan2(y, z))
    across = float(np.clip(y / model.shape.breadth, *ACROSS_RANGE))
    return MarkerPlace(marker.name, BONE_NAMES[bone], along, 0.0 if z >= 0.0 else math.pi, across)
