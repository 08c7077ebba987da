"""Vertices and faces of the skin's control cage: 360 quads that two subdivision steps round into a hand.

The palm is a flattened tube of eight rows from behind the wrist to the webs; a row's eighteen vertices run
over the back from the index side to the little one (columns 0 to 8) and return under the palm. Columns 1, 3,
5 and 7 follow the four fingers, the even ones the webs between them and the two edges. On the last row each
finger takes the six vertices of its own three columns as its first ring; the thumb grows out of a hole in
the edge under the index. A ring's vertices stand at 30, 90, ... 330 degrees from the bone's y axis about its
x axis: 90 is the back, 270 the pad.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Int

from handsim.hand.topology import DIGITS

WRIST_END, WRIST, CARPUS, THENAR, METACARPUS, KNUCKLES, PAST_KNUCKLES, WEB = range(8)
NUM_ROWS: Final = 8
AROUND: Final = 18
# Rings of a finger past the web, and of the thumb; the last two form the tip.
FINGER_RINGS: Final = ("before 1", "at 1", "after 1", "before 2", "after 2", "pad", "tip")
THUMB_RINGS: Final = ("metacarpal", *FINGER_RINGS)


@dataclass(frozen=True, slots=True, eq=False)
class CageTopology:
    """Vertex numbers of the cage; the same for every hand."""

    palm: Int[np.ndarray, "8 18"]
    """Rows of the palm."""
    rings: tuple[Int[np.ndarray, "R 6"], ...]
    """Rings of each digit, outwards; a finger's shared first ring on the web row is not among them."""
    quads: Int[np.ndarray, "Q 4"]
    """Faces, counter-clockwise from outside."""
    tips: Int[np.ndarray, "5 2"]
    """The two faces that close each digit."""

    @property
    def num_vertices(self) -> int:
        """Number of cage vertices."""
        return int(self.quads.max()) + 1


def dorsal(column: int) -> int:
    """Index of a back column in a palm row."""
    return column


def palmar(column: int) -> int:
    """Index of a palm column in a palm row."""
    return AROUND - 1 - column


def finger_slots(finger: int) -> list[int]:
    """Indices in a palm row of the six vertices around a finger (0 to 3), in a ring's order."""
    columns = range(2 * finger, 2 * finger + 3)
    return [dorsal(column) for column in columns] + [palmar(column) for column in reversed(columns)]


def cage_topology() -> CageTopology:
    """Vertices and faces of the cage."""
    palm = np.arange(NUM_ROWS * AROUND).reshape(NUM_ROWS, AROUND)
    rings, first = [], palm.size
    for digit in range(len(DIGITS)):
        count = len(THUMB_RINGS if digit == 0 else FINGER_RINGS)
        rings.append(first + np.arange(count * 6).reshape(count, 6))
        first += count * 6
    back, front, three = dorsal(0), palmar(0), (CARPUS, THENAR, METACARPUS)
    hole = {(row, front) for row in three[:2]}
    quads = [
        [palm[row, index], palm[row, next_index], palm[row + 1, next_index], palm[row + 1, index]]
        for row in range(NUM_ROWS - 1)
        for index in range(AROUND)
        for next_index in [(index + 1) % AROUND]
        if (row, index) not in hole
    ]
    quads += [
        [palm[0, dorsal(c)], palm[0, palmar(c)], palm[0, palmar(c + 1)], palm[0, dorsal(c + 1)]]
        for c in range(AROUND // 2 - 1)
    ]
    a, b, c = (palm[row] for row in three)
    bases = [np.array([a[front], a[back], b[back], c[back], c[front], b[front]])]
    bases += [palm[WEB, finger_slots(finger)] for finger in range(4)]
    tips = []
    for base, digit_rings in zip(bases, rings, strict=True):
        loops = [base, *digit_rings]
        for near, far in itertools.pairwise(loops):
            quads += np.stack([near, np.roll(near, -1), np.roll(far, -1), far], axis=-1).tolist()
        tips.append([len(quads), len(quads) + 1])
        quads += loops[-1][[[1, 2, 3, 4], [4, 5, 0, 1]]].tolist()
    return CageTopology(palm, tuple(rings), np.array(quads), np.array(tips))
