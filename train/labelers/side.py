"""Left or right hand, from labeled points; the labelers themselves do not tell a hand from its mirror image.

Four labeled points span a tetrahedron, and a mirror inverts its orientation. Some groups of four have
the same orientation in almost every pose (thumb, knuckles and wrist), others do not. Poses of simulated right
hands measure this; each group votes with the log-odds of its orientation.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.attachment import attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import Side
from handsim.kernels.kernel import kernel
from poses.shapes.validity import sample_valid_angles

_MAX_FOURS: Final = 3000
_POSES: Final = 100  # of each size
_SIZES: Final = ("XS", "S", "M", "L", "XL")


class SideClassifier:
    """Classifies the hands of a layout as left or right, one frame at a time.

    Args:
        layout: The glove, the same on both hands.
        rng: Source of the poses that it learns from, and of the groups of four where there are over 3,000.
    """

    def __init__(self, layout: MarkerLayout, *, rng: np.random.Generator) -> None:
        fours = np.array(list(combinations(range(layout.num_markers), 4)))
        if len(fours) > _MAX_FOURS:
            fours = fours[rng.choice(len(fours), size=_MAX_FOURS, replace=False)]
        markers = np.concatenate([_right_hands(layout, size, rng) for size in _SIZES])
        mean = np.sign(_volumes(markers[:, fours])).mean(axis=0)
        self._fours: NDArray[np.int64] = fours
        self._votes: NDArray[np.float64] = np.arctanh(mean.clip(-0.999, 0.999))
        self._num_markers = layout.num_markers

    def classify(self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]) -> tuple[Side, float]:
        """The side of one hand, and the clearness of the vote [0, 1].

        Args:
            points: A frame's points [m].
            labels: Marker of each point, -1 for a ghost.

        Returns:
            "right" with a clearness of 0 where fewer than four points are labeled.
        """
        markers = np.full((self._num_markers, 3), np.nan)
        markers[labels[labels >= 0]] = points[labels >= 0]
        vote, most = _vote(markers, self._fours, self._votes)
        return ("left" if vote < 0.0 else "right"), abs(vote) / most if most else 0.0


def _right_hands(layout: MarkerLayout, size: str, rng: np.random.Generator) -> NDArray[np.float64]:
    hand = HandModel.named(size)
    qpos = join_qpos(sample_valid_angles(hand, _POSES, rng=rng))
    markers, _ = attach_markers(layout, hand).markers(hand, hand.forward_kinematics(qpos))
    return markers


def _volumes(fours: Float[np.ndarray, "*B 4 3"]) -> NDArray[np.float64]:
    """Six times the signed volume of each tetrahedron."""
    a, b, c = (fours[..., k, :] - fours[..., 0, :] for k in (1, 2, 3))
    volumes: NDArray[np.float64] = (np.cross(a, b) * c).sum(-1)
    return volumes


@kernel
def _vote(
    markers: NDArray[np.float64], fours: NDArray[np.int64], votes: NDArray[np.float64]
) -> tuple[float, float]:
    """The sum of the votes of all groups of four, and the greatest sum that they could have.

    Args:
        markers: Markers (M, 3) [m], NaN where missing.
        fours: Groups (F, 4) of markers.
        votes: Vote (F,) of each group, if its orientation is that of most right hands.
    """
    vote, most = 0.0, 0.0
    for number in range(len(fours)):
        corner = markers[fours[number, 0]]
        ax, ay, az = markers[fours[number, 1]] - corner
        bx, by, bz = markers[fours[number, 2]] - corner
        cx, cy, cz = markers[fours[number, 3]] - corner
        volume = (ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz
        if volume > 0.0:
            vote += votes[number]
            most += abs(votes[number])
        elif volume < 0.0:
            vote -= votes[number]
            most += abs(votes[number])
    return vote, most
