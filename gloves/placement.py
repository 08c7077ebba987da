"""From a point on the skin back to a marker's place in a layout: the inverse of `gloves.attachment`."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.attachment import attach_markers
from gloves.layout import ACROSS_RANGE, ALONG_RANGE, MarkerLayout, MarkerPlace
from handsim.errors import LayoutError
from handsim.hand.model import HandModel
from handsim.hand.topology import BONE_NAMES, PALM

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_STEPS: Final = 6
_NEAR: Final = 1e-5  # [m]


def place_marker(
    layout: MarkerLayout, index: int, model: HandModel, point: Float[np.ndarray, "3"]
) -> MarkerLayout:
    """The layout with one marker moved to the place on the skin that is nearest to a point.

    The marker goes to the bone that carries the skin there. On the palm it lies straight above or below its
    place in the palm's plane.

    Args:
        layout: The glove.
        index: The marker to move.
        model: The hand that the point is meant on.
        point: Where the marker's center shall be, in the wrist's frame of the flat hand [m].

    Raises:
        LayoutError: No marker can be put there.
    """
    surface = model.surface
    nearest = int(((surface.vertices - point) ** 2).sum(axis=1).argmin())
    bone = int(surface.bone_indices[nearest, 0])
    wanted, best = np.array(point, dtype=np.float64), None
    least = math.inf
    for _ in range(_STEPS):  # the center is one radius off the skin, not along the ray that finds the skin
        moved = _place(layout.markers[index], bone, model, wanted)
        markers = (*layout.markers[:index], moved, *layout.markers[index + 1 :])
        candidate = dataclasses.replace(layout, markers=markers)
        try:
            center = attach_markers(candidate, model).points[index]
        except LayoutError:
            break
        missed = point - center
        if np.linalg.norm(missed) < least:
            least, best = float(np.linalg.norm(missed)), candidate
        if least < _NEAR:
            break
        wanted = wanted + missed
    if best is None:
        raise LayoutError(f"marker '{layout.names[index]}' meets no skin there; move it nearer to the hand")
    return best


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
