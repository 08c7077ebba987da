"""Where a pose has its markers and how surely: the covariance that the fit leaves them, compiled.

A marker that is missing may still be nearly pinned down by its neighbours, or free along the arc of one
hinge; the normal matrix of the fit knows which.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from handsim.topology import NUM_JOINTS
from track.gloved_hand import NUM_UNKNOWNS, gather, place_markers, workspace
from track.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Float


class Expectation(NamedTuple):
    """Markers as a pose has them."""

    places: Float[np.ndarray, "M 3"]
    """[m] in the world."""
    covariances: Float[np.ndarray, "M 3 3"]
    """What the fit leaves open [m^2], in the world."""
    turns: Float[np.ndarray, "M 3 3"]
    """Rotations of the bones that carry most of each marker, in the world."""


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def expect_markers(
    hand: Any,
    on_digit: Any,
    pose: Any,
    there: Any,
    trust: Any,
    weight: Any,
    places: Any,
    covariances: Any,
    turns: Any,
) -> None:
    """Fill the arrays of an `Expectation`."""
    count = len(there)
    work, wrist, weights = workspace(count), np.empty((3, 3)), np.zeros(count)
    place_markers(hand, pose[7:], work)
    write_rotation(pose[3:7], wrist)
    seen = np.zeros(len(on_digit), dtype=np.int64)
    for marker in range(count):
        work.misses[marker] = 0.0
        if there[marker]:
            weights[marker] = weight
            if hand.digits[marker] >= 0:
                seen[hand.digits[marker]] += 1
    gather(hand, weights, work)
    normal = work.normal
    for hinge in range(NUM_JOINTS):
        normal[hinge, hinge] += trust[hinge] * (1.0 if seen[hinge // 4] < on_digit[hinge // 4] else 1e-4)
    for row in range(NUM_UNKNOWNS):
        normal[row, row] += 1e-9 * weight
        for column in range(row):
            normal[row, column] = normal[column, row]
    inverse = np.linalg.inv(normal)
    for marker in range(count):
        own = work.rotations[hand.bones[marker, 0]]
        slopes = wrist @ work.slopes[marker]
        covariances[marker] = slopes @ inverse @ slopes.T
        turns[marker] = wrist @ own
        places[marker] = pose[:3] + wrist @ work.markers[marker]
