"""A drawing of the resting hand in its glove: outline, bones and markers in the plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, PALM


class FlatHand(NamedTuple):
    """A right hand of size M at rest, seen from the back, in the plane [m]: thumb left, fingers up."""

    outlines: list[Float[np.ndarray, "N 2"]]
    bones: Float[np.ndarray, "L 2 2"]
    markers: Float[np.ndarray, "M 2"]
    below: NDArray[np.bool_]
    """Which markers face away, to the palm's side (M,)."""


def flat_hand(layout: MarkerLayout) -> FlatHand:
    """The drawing of a glove on the hand.

    Raises:
        LayoutError: A marker misses the skin.
    """
    model = HandModel.named("M")
    attachment = attach_markers(layout, model)
    starts = model.rest_transforms[:, :3, 3]
    ends = starts + model.skeleton.lengths[:, None] * model.rest_transforms[:, :3, 0]
    bones = [(starts[number], ends[number]) for number in range(1, len(BONES))]
    bones += [(starts[PALM], starts[number]) for number, bone in enumerate(BONES) if bone.parent == PALM]
    surface = model.surface
    return FlatHand(
        _outlines(_projected(surface.vertices), surface.faces),
        _projected(np.array(bones)),
        _projected(attachment.points),
        attachment.normals[:, 2] < 0.0,
    )


def _projected(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in the wrist's frame (..., 3) [m] as seen from the back of a right hand (..., 2)."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _outlines(
    vertices: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"]
) -> list[Float[np.ndarray, "N 2"]]:
    """Loops around the faces that face the viewer; holes in them run in the opposite direction."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    one, other = second - first, third - first
    seen = faces[one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0.0]
    ways = np.concatenate([seen[:, [0, 1]], seen[:, [1, 2]], seen[:, [2, 0]]])
    back = {(int(end), int(start)) for start, end in ways}
    edges = [(int(start), int(end)) for start, end in ways if (int(start), int(end)) not in back]
    follow: dict[int, list[int]] = {}
    for start, end in edges:
        follow.setdefault(start, []).append(end)
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while loop[-1] in follow:
            here = loop[-1]
            loop.append(follow[here].pop())
            if not follow[here]:
                del follow[here]
        loops.append(vertices[loop])
    return loops
