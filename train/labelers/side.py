"""Left or right hand, from labeled points; the labelers themselves do not tell a hand from its mirror image.

Four labeled points span a tetrahedron, and a mirror inverts its orientation. Some groups of four have
the same orientation in almost every pose (thumb, knuckles and wrist), others do not. Poses of simulated right
hands measure this; each group votes with the log-odds of its orientation.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import attach_markers
from gloves.layout import MarkerLayout
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import Side
from handsim.kernels import kernel
from poses.shapes import sample_valid_angles

_MAX_FOURS: Final = 3000
_POSES: Final = 100  # of each size
_TOLD: Final = 0.98  # share of whole hands whose side is told in a layout unlike its mirror image; mostly all
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
        mean = _mean_orientation(markers, fours)
        self._fours: NDArray[np.int64] = fours
        self._votes: NDArray[np.float64] = np.arctanh(mean.clip(-0.999, 0.999))
        self._num_markers = layout.num_markers

    def classify(self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]) -> tuple[Side, float]:
        """The side of one hand, and the clearness of the vote [0, 1].

        Args:
            labels: Marker of each point, -1 for a ghost.

        Returns:
            "right" with a clearness of 0 where fewer than four points are labeled.
        """
        markers = np.full((self._num_markers, 3), np.nan)
        markers[labels[labels >= 0]] = points[labels >= 0]
        vote, most = _vote(markers, self._fours, self._votes)
        return ("left" if vote < 0.0 else "right"), abs(vote) / most if most else 0.0

    def recognized(self, hands: Float[np.ndarray, "T M 3"], side: Side) -> Bool[np.ndarray, "T"]:
        """Whether each hand of a side is classified as one of it, by its true labels; NaN where missing."""
        labels = np.arange(self._num_markers)
        return np.array([self.classify(hand, labels)[0] == side for hand in hands], dtype=np.bool_)


def is_mirror_like(layout: MarkerLayout) -> bool:
    """Whether a layout is nearly its own mirror image, so that the side of a whole hand is not always told.

    That is by its true labels; where they are unknown, sides are exchanged more often.
    """
    if any(one.bone.startswith("thumb") for one in layout.markers):
        return False  # a thumb tells, without a third of a second
    rng = np.random.default_rng(0)
    classifier = SideClassifier(layout, rng=rng)
    return bool(classifier.recognized(_right_hands(layout, "M", rng), "right").mean() < _TOLD)


def _right_hands(layout: MarkerLayout, size: str, rng: np.random.Generator) -> NDArray[np.float64]:
    hand = HandModel.named(size)
    qpos = join_qpos(sample_valid_angles(hand, _POSES, rng=rng))
    markers, _ = attach_markers(layout, hand).markers(hand, hand.forward_kinematics(qpos))
    return markers


@kernel
def _mean_orientation(
    hands: Float[np.ndarray, "T M 3"], fours: Int[np.ndarray, "F 4"]
) -> NDArray[np.float64]:
    """Mean over hands of the sign of the volume of each group of four (F,); markers in [m]."""
    mean = np.zeros(len(fours))
    for hand in range(len(hands)):
        for number in range(len(fours)):
            volume = _volume(hands[hand], fours[number])
            mean[number] += 1.0 if volume > 0.0 else -1.0 if volume < 0.0 else 0.0
    return mean / len(hands)


@kernel
def _vote(
    markers: Float[np.ndarray, "M 3"], fours: Int[np.ndarray, "F 4"], votes: Float[np.ndarray, "F"]
) -> tuple[float, float]:
    """The sum of the votes of all groups of four, and the greatest sum that they could have."""
    vote, most = 0.0, 0.0
    for number in range(len(fours)):
        volume = _volume(markers, fours[number])
        if volume > 0.0:
            vote += votes[number]
            most += abs(votes[number])
        elif volume < 0.0:
            vote -= votes[number]
            most += abs(votes[number])
    return vote, most


@kernel
def _volume(markers: Float[np.ndarray, "M 3"], four: Int[np.ndarray, "4"]) -> float:
    """Six times the signed volume [m^3] of the tetrahedron of four markers."""
    x, y, z = markers[four[0], 0], markers[four[0], 1], markers[four[0], 2]
    ax, ay, az = markers[four[1], 0] - x, markers[four[1], 1] - y, markers[four[1], 2] - z
    bx, by, bz = markers[four[2], 0] - x, markers[four[2], 1] - y, markers[four[2], 2] - z
    cx, cy, cz = markers[four[3], 0] - x, markers[four[3], 1] - y, markers[four[3], 2] - z
    return float((ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz)
