"""The control cage of every hand's skin, written to `handsim/data/hand_cage.json`.

    python -m benchmarks.hand_cage

The palm of the cage is a flattened tube of eight rows from behind the wrist to the webs; a row's eighteen
vertices run over the back from the index side to the little one (columns 0 to 8) and return under the palm.
Columns 1, 3, 5 and 7 follow the four fingers, the even ones the webs between them and the two edges. On the
last row each finger takes the six vertices of its own three columns as its first ring; the thumb grows out of
a hole in the edge under the index. A ring's vertices stand at 30, 90, ... 330 degrees from the bone's y axis
about its x axis: 90 is the back, 270 the pad.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import handsim
from handsim.files.outputs import write_text
from handsim.hand.shape import NUM_BONES, PALM
from handsim.hand.skin import AROUND, NUM_ROWS, PALM_VERTICES, RINGS, catmull_clark, edge_table

DATA: Final = Path(handsim.__file__).parent / "data" / "hand_cage.json"
_WRIST, _CARPUS, _THENAR, _METACARPUS, _KNUCKLES, _PAST_KNUCKLES, _WEB = range(1, 8)  # rows of the palm
# The thumb has all of these rings, and a finger all but the first. The last two form the tip.
_RING_NAMES: Final = ("metacarpal", "before 1", "at 1", "after 1", "before 2", "after 2", "pad", "tip")
# Indices of the palm columns in a palm row; those of the back columns are their numbers.
_PALMAR: Final = range(AROUND)[::-1]
# Height of the back above, and depth of the palm under, the metacarpals, in palm thicknesses, by column.
_HEIGHTS: Final = np.array(
    [
        [0.24, 0.43, 0.52, 0.54, 0.54, 0.52, 0.48, 0.40, 0.20],
        [0.24, 0.43, 0.52, 0.54, 0.54, 0.52, 0.48, 0.40, 0.20],
        [0.30, 0.46, 0.52, 0.54, 0.54, 0.52, 0.50, 0.45, 0.22],
        [0.30, 0.47, 0.50, 0.52, 0.51, 0.50, 0.49, 0.44, 0.20],
        [0.26, 0.46, 0.47, 0.49, 0.46, 0.49, 0.46, 0.46, 0.20],
        [0.24, 0.57, 0.38, 0.58, 0.39, 0.56, 0.38, 0.53, 0.20],
    ]
)
_DEPTHS: Final = np.array(
    [
        [0.50, 0.80, 0.90, 0.92, 0.92, 0.92, 0.90, 0.80, 0.42],
        [0.50, 0.80, 0.88, 0.90, 0.90, 0.92, 0.92, 0.82, 0.42],
        [0.60, 1.00, 1.00, 0.95, 0.90, 0.92, 0.96, 0.90, 0.50],
        [0.80, 1.25, 0.95, 0.80, 0.70, 0.71, 0.82, 0.86, 0.55],
        [0.52, 0.66, 0.62, 0.58, 0.56, 0.60, 0.66, 0.70, 0.42],
        [0.40, 0.62, 0.64, 0.64, 0.64, 0.64, 0.64, 0.60, 0.38],
    ]
)
# Position of each palm row along the metacarpals: 0 at the wrist, 1 at the joints.
_ROW_POSITIONS: Final = np.array([-0.26, -0.05, 0.16, 0.42, 0.70, 0.97])
_WRIST_COLUMNS: Final = np.array([0.215, 0.075, -0.07, -0.205])  # y of the rays at the wrist, in breadths
_EDGES: Final = np.array([[0.15, 0.14, 0.12, 0.13, 0.13, 0.145], [0.15, 0.14, 0.16, 0.17, 0.155, 0.145]])

_ARCH: Final = np.array([0.0, 0.0, 0.04, 0.08, 0.08, 0.02])  # added to the back's height, by row
# Finger joints lie nearer to the back than to the pad: the middle (y, z) of a section, in radii.
_PALMWARD: Final = np.array([0.0, -0.14])
# Distance of the web row along each first phalanx, in its lengths; webs slope from the back to the palm.
_WEB_DISTANCES: Final = np.array(
    [
        [0.43, 0.43, 0.31, 0.38, 0.45, 0.43],
        [0.31, 0.43, 0.31, 0.38, 0.45, 0.38],
        [0.31, 0.43, 0.31, 0.38, 0.45, 0.38],
        [0.31, 0.43, 0.43, 0.43, 0.45, 0.38],
    ]
)

# Targets of the palm's vertices around the thumb's metacarpal: position along it in its lengths, sideways and
# upwards in its radii, and the share of the way that each vertex moves to its target.
_THUMB_BASE_ROWS: Final = np.repeat([_CARPUS, _THENAR, _METACARPUS], [4, 5, 3])
_THUMB_BASE_COLUMNS: Final = np.array([0, *_PALMAR[:3], 0, *_PALMAR[:4], *_PALMAR[:3]])
_THUMB_BASE: Final = np.array(
    [
        [-0.1, -0.9, 0.9, 0.5],
        [-0.03, 1.18, 0.47, 0.8],
        [-0.02, 1.68, -0.35, 0.75],
        [-0.11, 1.57, -1.36, 0.5],
        [0.25, -1.2, 0.5, 0.5],
        [0.48, 1.08, -0.78, 0.9],
        [0.50, 0.50, -1.32, 0.9],
        [0.41, 0.77, -1.94, 0.7],
        [0.29, 0.59, -2.77, 0.4],
        [0.65, -0.25, -1.20, 0.9],
        [0.68, -0.55, -1.75, 0.8],
        [0.69, -0.17, -2.31, 0.4],
    ]
)

_RING_ANGLES: Final = np.deg2rad(np.arange(30.0, 360.0, 60.0))
_ROUND: Final = np.stack([1.03 * np.cos(_RING_ANGLES), 0.97 * np.sin(_RING_ANGLES)], axis=-1)
# Sections (y, z) of the rings about the axis: knuckles stand out on the back, the nail is flat, the pad full.
_SECTIONS: Final = {
    "metacarpal": _ROUND,
    "before 1": _ROUND,
    "at 1": _ROUND * [1.0, 1.0] + [0.0, 0.03],
    "after 1": _ROUND,
    "before 2": _ROUND,
    "after 2": _ROUND * [1.02, 0.97],
    "pad": np.array([[0.92, 0.52], [0.0, 0.80], [-0.92, 0.52], [-0.86, -0.62], [0.0, -1.12], [0.86, -0.62]]),
    "tip": np.array([[0.52, 0.28], [0.0, 0.46], [-0.52, 0.28], [-0.46, -0.44], [0.0, -0.68], [0.46, -0.44]]),
}

# The thumb's first ring: its sections, and its vertices' positions along the metacarpal.
_THUMB_RING: Final = [[1.02, 0.6], [0.0, 1.1], [-1.1, 0.7], [-1.4, -0.6], [0.2, -1.0], [0.95, -0.62]]
_THUMB_RING_ALONG: Final = [0.55, 0.5, 0.55, 0.72, 0.77, 0.67]
_WAISTS: Final = {"before 1": 0.985, "at 1": 1.01, "after 1": 0.985}  # girth of a ring over the shape's
# Bone of the digit and its share on each ring past the web; the rest goes to the bone before it.
_BONE_OF_RINGS: Final = ((1, 0.0), (1, 0.5), (1, 1.0), (2, 0.0), (2, 1.0), (2, 1.0), (2, 1.0))
# Share of the thumb's metacarpal on the palm's rows around it: (row, index, share).
_THENAR_SHARES: Final = (
    (_CARPUS, 0, 0.25),
    (_CARPUS, _PALMAR[0], 0.35),
    (_CARPUS, _PALMAR[1], 0.15),
    (_THENAR, 0, 0.5),
    (_THENAR, 1, 0.05),
    (_THENAR, _PALMAR[0], 0.8),
    (_THENAR, _PALMAR[1], 0.6),
    (_THENAR, _PALMAR[2], 0.3),
    (_THENAR, _PALMAR[3], 0.05),
    (_METACARPUS, 0, 0.15),
    (_METACARPUS, _PALMAR[0], 0.4),
    (_METACARPUS, _PALMAR[1], 0.25),
)
# Share of the fingers' first bones on the palm's rows, on a finger's column and on a web's.
_KNUCKLE_SHARES: Final = {_KNUCKLES: (0.35, 0.25), _PAST_KNUCKLES: (0.9, 0.7), _WEB: (1.0, 0.9)}


def cage() -> dict[str, Any]:
    """All of the file: numbers of vertices and faces, shares of bones, and measures."""
    quads, tips = _faces()
    loops, tip_vertices = _after_two_steps(quads, tips)
    sections = np.array([_SECTIONS[name] for name in _RING_NAMES])
    sections[:-2] += _PALMWARD
    return {
        "quads": quads,
        "weights": _weights(),
        "ring_loops": loops[:-2],
        "knuckle_loop": loops[-2],
        "wrist_loop": loops[-1],
        "tips": tip_vertices,
        "back_and_palm": PALM_VERTICES[_METACARPUS, [3, _PALMAR[3]]],
        "finger_slots": np.array(_finger_slots()),
        "row_positions": _ROW_POSITIONS,
        "heights": _HEIGHTS + _ARCH[:, None],
        "depths": _DEPTHS[:, ::-1],
        "wrist_columns": _WRIST_COLUMNS,
        "edges": _EDGES,
        "web_distances": _WEB_DISTANCES,
        "base_section": _ROUND + _PALMWARD,
        "sections": sections,
        "waists": np.array([_WAISTS.get(name, 1.0) for name in _RING_NAMES]),
        "thumb_base": PALM_VERTICES[_THUMB_BASE_ROWS, _THUMB_BASE_COLUMNS],
        "thumb_base_targets": _THUMB_BASE,
        "thumb_ring": np.array(_THUMB_RING),
        "thumb_ring_along": np.array(_THUMB_RING_ALONG),
    }


def _finger_slots() -> list[list[int]]:
    """Indices in a palm row of the six vertices around each finger, in a ring's order."""
    columns = [range(2 * finger, 2 * finger + 3) for finger in range(4)]
    return [[*one, *(_PALMAR[column] for column in reversed(one))] for one in columns]


def _faces() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The cage's faces (Q, 4), counter-clockwise from outside, and the two (5, 2) that close each digit."""
    palm = PALM_VERTICES
    front, three = _PALMAR[0], (_CARPUS, _THENAR, _METACARPUS)
    hole = {(row, front) for row in three[:2]}
    quads = [
        [palm[row, index], palm[row, next_index], palm[row + 1, next_index], palm[row + 1, index]]
        for row in range(NUM_ROWS - 1)
        for index in range(AROUND)
        for next_index in [(index + 1) % AROUND]
        if (row, index) not in hole
    ]
    quads += [
        [palm[0, c], palm[0, _PALMAR[c]], palm[0, _PALMAR[c + 1]], palm[0, c + 1]]
        for c in range(AROUND // 2 - 1)
    ]
    a, b, c = (palm[row] for row in three)
    bases = [np.array([a[front], a[0], b[0], c[0], c[front], b[front]])]
    bases += [palm[_WEB, slots] for slots in _finger_slots()]
    tips = []
    for base, rings in zip(bases, [*RINGS[0], *RINGS[1]], strict=True):
        loops = [base, *rings]
        for near, far in itertools.pairwise(loops):
            quads += np.stack([near, np.roll(near, -1), np.roll(far, -1), far], axis=-1).tolist()
        tips.append([len(quads), len(quads) + 1])
        quads += loops[-1][[[1, 2, 3, 4], [4, 5, 0, 1]]].tolist()
    return np.array(quads), np.array(tips)


def _after_two_steps(
    quads: NDArray[np.int64], tips: NDArray[np.int64]
) -> tuple[NDArray[np.int64] | list[NDArray[np.int64]], NDArray[np.int64]]:
    """Loops of vertices after two steps of subdivision, and all vertices of each digit's closing faces.

    The loops are those of all rings, then of the palm's rows at the knuckles and at the wrist.
    """
    rings = [ring for digits in RINGS for digit in digits for ring in digit]
    loops = [*rings, PALM_VERTICES[_KNUCKLES], PALM_VERTICES[_WRIST]]
    fine, count = quads, int(quads.max()) + 1
    for _ in range(2):
        step, next_quads = catmull_clark(fine, count)
        loops = subdivided_loops(loops, fine, count)
        fine, count = next_quads, step.shape[0]
    children = np.arange(len(fine)).reshape(len(quads), -1)  # quads that came from each cage quad
    return loops, np.array([np.unique(fine[children[pair]]) for pair in tips])


def subdivided_loops(
    loops: Sequence[Int[np.ndarray, "K"]], quads: Int[np.ndarray, "Q 4"], num_vertices: int
) -> list[Int[np.ndarray, "2*K"]]:
    """The vertices that each closed loop of edges passes through after one `catmull_clark` step."""
    edges, _ = edge_table(quads)
    number = {(a, b): num_vertices + index for index, (a, b) in enumerate(edges.tolist())}
    results = []
    for loop in loops:
        result = []
        for first, second in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
            result += [first, number[min(first, second), max(first, second)]]
        results.append(np.array(result))
    return results


def _weights() -> NDArray[np.float64]:
    """Share of every bone in every cage vertex (K, 16); rows sum to one."""
    weights = np.zeros((int(RINGS[1].max()) + 1, NUM_BONES))
    for row, (on_finger, on_web) in _KNUCKLE_SHARES.items():
        for column in range(9):
            beside = (column // 2,) if column % 2 else (column // 2 - 1, column // 2)
            fingers = [finger for finger in beside if 0 <= finger < 4]
            share = on_finger if column % 2 or len(fingers) == 1 else on_web
            for index in (column, _PALMAR[column]):
                weights[PALM_VERTICES[row, index], [4 + 3 * f for f in fingers]] = share / len(fingers)
    for row, index, share in _THENAR_SHARES:
        weights[PALM_VERTICES[row, index], 1] = share
    for digit, rings in enumerate([*RINGS[0], *RINGS[1]]):
        first = 1 + 3 * digit
        if digit == 0:
            weights[rings[0], first] = 0.95
        for ring, (bone, share) in zip(rings[-len(_BONE_OF_RINGS) :], _BONE_OF_RINGS, strict=True):
            weights[ring, first + bone - 1] = 1.0 - share
            weights[ring, first + bone] = share
    weights[:, PALM] = 1.0 - weights[:, PALM + 1 :].sum(axis=1)
    return weights


def text() -> str:
    """The text of the file, a line for each of its entries."""
    lines = [f" {json.dumps(name)}: {json.dumps(np.array(one).tolist())}" for name, one in cage().items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


if __name__ == "__main__":
    write_text(DATA, text())
