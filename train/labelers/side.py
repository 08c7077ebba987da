"""Left or right, from labeled points: the labeler is blind to mirrors, the points it names are not.

Four named points span a tetrahedron whose orientation a mirror turns round. Some four are turned the same
way in almost every pose (thumb, knuckles and wrist), others either way; poses of simulated right hands say
which, and each four votes with as much as it tells.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.attachment import attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import Side
from poses.shapes.validity import sample_valid_angles

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

_MOST_FOURS: Final = 3000
_POSES: Final = 100  # of each size
_SIZES: Final = ("XS", "S", "M", "L", "XL")


class SideTeller:
    """Tells a layout's left hands from its right ones, one frame at a time.

    Args:
        layout: The glove, the same on both hands.
        rng: Source of the poses that it learns from, and of the fours where a layout has more than 3,000.
    """

    def __init__(self, layout: MarkerLayout, *, rng: np.random.Generator) -> None:
        fours = np.array(list(combinations(range(layout.num_markers), 4)))
        if len(fours) > _MOST_FOURS:
            fours = fours[rng.choice(len(fours), size=_MOST_FOURS, replace=False)]
        markers = np.concatenate([_right_hands(layout, size, rng) for size in _SIZES])
        mean = np.sign(_volumes(markers[:, fours])).mean(axis=0)
        self._fours: NDArray[np.int64] = fours
        self._votes: NDArray[np.float64] = np.arctanh(mean.clip(-0.999, 0.999))
        self._num_markers = layout.num_markers

    def tell(self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]) -> tuple[Side, float]:
        """The side of one hand, and how clear the vote was [0, 1].

        Args:
            points: A frame's points.
            labels: Marker of each point, -1 for a ghost.

        Returns:
            With fewer than four named points nothing votes, and the answer is "right" with 0.
        """
        markers = np.full((self._num_markers, 3), np.nan)
        markers[labels[labels >= 0]] = points[labels >= 0]
        signs = np.nan_to_num(np.sign(_volumes(markers[self._fours])))
        most = float(np.abs(self._votes[signs != 0.0]).sum())
        vote = float(signs @ self._votes)
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
