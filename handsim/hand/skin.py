"""The hand's skin: a smooth closed mesh that is a function of the shape, and linear blend skinning.

A control cage of 360 quads is rounded by two steps of subdivision, which spread the weights of the bones as
they spread vertices. The palm of the cage is a flattened tube of eight rows from behind the wrist to the
webs; a row's eighteen vertices run over the back from the index side to the little one (columns 0 to 8) and
return under the palm. Columns 1, 3, 5 and 7 follow the four fingers, the even ones the webs between them and
the two edges. On the last row each finger takes the six vertices of its own three columns as its first ring;
the thumb grows out of a hole in the edge under the index. A ring's vertices stand at 30, 90, ... 330 degrees
from the bone's y axis about its x axis: 90 is the back, 270 the pad.

Skinning is compiled: the whole skin in every frame, fast enough to cast rays against it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.hand.shape import DIGITS, HAND_DTYPE, NUM_BONES, PALM, pack_hand
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR, euler_matrix, rigid

if TYPE_CHECKING:
    from scipy import sparse

    from handsim.hand.shape import HandShape


def edge_table(quads: Int[np.ndarray, "Q 4"]) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "Q 4"]]:
    """Edges of a quad mesh (lower vertex first) and the edge from each corner of a quad to the next one."""
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    count = int(quads.max()) + 1
    numbers, inverse = np.unique(ends.min(axis=1) * count + ends.max(axis=1), return_inverse=True)
    return np.stack(np.divmod(numbers, count), axis=1), inverse.reshape(quads.shape)


def catmull_clark(
    quads: Int[np.ndarray, "Q 4"], num_vertices: int
) -> tuple[sparse.csr_array, Int[np.ndarray, "Q4 4"]]:
    """One step of Catmull-Clark on a closed quad mesh."""
    from scipy import sparse

    edges, edge_of_corner = edge_table(quads)
    num_edges, num_quads = len(edges), len(quads)
    corner, quad = quads.ravel(), np.repeat(np.arange(num_quads), 4)

    faces = sparse.csr_array((np.full(corner.size, 0.25), (quad, corner)), (num_quads, num_vertices))
    sides = sparse.csr_array((np.ones(corner.size), (edge_of_corner.ravel(), quad)), (num_edges, num_quads))
    ends = sparse.csr_array(
        (np.ones(edges.size), (np.repeat(np.arange(num_edges), 2), edges.ravel())), (num_edges, num_vertices)
    )
    edge_points = 0.25 * (ends + sides @ faces)

    touching = sparse.csr_array((np.ones(corner.size), (corner, quad)), (num_vertices, num_quads))
    valence = np.asarray(touching.sum(axis=1))
    middles = sparse.diags_array(0.5 / valence**2) @ (ends.T @ ends)  # edge midpoints around each vertex
    vertex_points = (
        sparse.diags_array(1.0 / valence**2) @ (touching @ faces)
        + 2.0 * middles
        + sparse.diags_array((valence - 3.0) / valence)
    )

    here = num_vertices + edge_of_corner
    center = np.broadcast_to(num_vertices + num_edges + np.arange(num_quads)[:, None], quads.shape)
    new_quads = np.stack([quads, here, center, np.roll(here, 1, axis=1)], axis=-1).reshape(-1, 4)
    return sparse.csr_array(sparse.vstack([vertex_points, edge_points, faces])), new_quads


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


WRIST, CARPUS, THENAR, METACARPUS, KNUCKLES, PAST_KNUCKLES, WEB = range(1, 8)
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


def palmar(column: int) -> int:
    """Index of a palm column in a palm row; that of a back column is its number."""
    return AROUND - 1 - column


def finger_slots(finger: int) -> list[int]:
    """Indices in a palm row of the six vertices around a finger (0 to 3), in a ring's order."""
    columns = range(2 * finger, 2 * finger + 3)
    return [*columns, *map(palmar, reversed(columns))]


def cage_topology() -> CageTopology:
    """Vertices and faces of the cage."""
    palm = np.arange(NUM_ROWS * AROUND).reshape(NUM_ROWS, AROUND)
    rings, first = [], palm.size
    for digit in range(len(DIGITS)):
        count = len(THUMB_RINGS if digit == 0 else FINGER_RINGS)
        rings.append(first + np.arange(count * 6).reshape(count, 6))
        first += count * 6
    front, three = palmar(0), (CARPUS, THENAR, METACARPUS)
    hole = {(row, front) for row in three[:2]}
    quads = [
        [palm[row, index], palm[row, next_index], palm[row + 1, next_index], palm[row + 1, index]]
        for row in range(NUM_ROWS - 1)
        for index in range(AROUND)
        for next_index in [(index + 1) % AROUND]
        if (row, index) not in hole
    ]
    quads += [
        [palm[0, c], palm[0, palmar(c)], palm[0, palmar(c + 1)], palm[0, c + 1]]
        for c in range(AROUND // 2 - 1)
    ]
    a, b, c = (palm[row] for row in three)
    bases = [np.array([a[front], a[0], b[0], c[0], c[front], b[front]])]
    bases += [palm[WEB, finger_slots(finger)] for finger in range(4)]
    tips = []
    for base, digit_rings in zip(bases, rings, strict=True):
        loops = [base, *digit_rings]
        for near, far in itertools.pairwise(loops):
            quads += np.stack([near, np.roll(near, -1), np.roll(far, -1), far], axis=-1).tolist()
        tips.append([len(quads), len(quads) + 1])
        quads += loops[-1][[[1, 2, 3, 4], [4, 5, 0, 1]]].tolist()
    return CageTopology(palm, tuple(rings), np.array(quads), np.array(tips))


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

_CARPUS_RISE: Final = 0.42  # the carpus arches over the line from wrist to knuckles, in palm thicknesses
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
_THUMB_BASE_ROWS: Final = np.repeat([CARPUS, THENAR, METACARPUS], [4, 5, 3])
_THUMB_BASE_COLUMNS: Final = np.array(
    [0, *map(palmar, range(3)), 0, *map(palmar, range(4)), *map(palmar, range(3))]
)
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


_WAISTS: Final = {"before 1": 0.985, "at 1": 1.01, "after 1": 0.985}  # girth of a ring over the shape's
_THUMB, _FINGERS = slice(0, 1), slice(1, len(DIGITS))
_GROUPS: Final = ((_THUMB, THUMB_RINGS), (_FINGERS, FINGER_RINGS))  # digits with the same rings


class CageHands(NamedTuple):
    """Measures of B right hands, as in `handsim.hand.shape.HandShape`."""

    breadth: Float[np.ndarray, "B"]
    palm_thickness: Float[np.ndarray, "B"]
    bone_lengths: Float[np.ndarray, "B 5 3"]
    knuckles: Float[np.ndarray, "B 5 3"]
    radii: Float[np.ndarray, "B 5 4"]
    frames: Float[np.ndarray, "B 5 4 4"]
    """`T_wrist_bone` of each digit's first bone at zero angles."""

    @classmethod
    def of(cls, hands: NDArray[np.void]) -> Self:
        """The measures of some hands, of type `HAND_DTYPE`, whatever their sides."""
        measures = {name: hands[name].copy() for name in cls._fields[:-1]}  # copies are contiguous
        return cls(**measures, frames=rigid(euler_matrix(hands["base_angles"]), hands["knuckles"]))

    def ring_girths(self) -> Float[np.ndarray, "B R"]:
        """Girth of the skin at each ring [m]: a little more at the joints, a little less between them."""
        girths = []
        for digits, names in _GROUPS:
            waist = np.array([_WAISTS.get(name, 1.0) for name in names])
            radii = self._radius_at(digits, self._ring_distances(digits))
            girths.append((2.0 * np.pi * waist * radii).reshape(len(radii), -1))
        return np.concatenate(girths, axis=1)

    def cage_parts(self, topology: CageTopology) -> Float[np.ndarray, "3 B K 3"]:
        """Cage vertices in the wrist frame [m], affine in two scales: at zero, per width, per depth.

        Width scales rings and the palm's breadth; depth pushes the last rings out and scales the palm's
        thickness.
        """
        wide, deep = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        cages = np.empty((len(self.breadth), 3, topology.num_vertices, 3))
        cages[:, :, topology.palm] = self._palm(wide, deep)
        for digits, names in _GROUPS:
            distances = self._ring_distances(digits)[:, None]  # (B, 1, D, R)
            sections = np.array([_SECTIONS[name] for name in names])
            sections[:-2] += _PALMWARD
            radii = self._radius_at(digits, distances[:, 0])[:, None] * wide[:, None, None]  # (B, 3, D, R)
            along = np.repeat(distances, 3, axis=1)
            along[..., -1] += deep[:, None]
            rings = np.stack(topology.rings[digits])
            cages[:, :, rings] = self._around(digits, along[..., None], sections * radii[..., None, None])
        self._shape_thumb_base(cages, topology)
        parts = cages.swapaxes(0, 1)
        parts[1:] -= parts[0].copy()
        return parts

    def _ring_distances(self, digits: slice) -> NDArray[np.float64]:
        """Distance of each ring from its digit's first joint (B, D, R), along straight digits [m]."""
        first, second, third = np.moveaxis(self.bone_lengths[:, digits], -1, 0)
        _, radius_1, radius_2, radius_3 = np.moveaxis(self.radii[:, digits], -1, 0)
        joint_2, tip = first + second, first + second + third
        after_2 = joint_2 + 0.6 * radius_2
        distances = [
            first - 0.75 * radius_1,
            first,
            first + 0.75 * radius_1,
            joint_2 - 0.6 * radius_2,
            after_2,
            np.clip(tip - radius_3, after_2 + 0.35 * (tip - after_2), after_2 + 0.6 * (tip - after_2)),
            after_2 + 0.88 * (tip - after_2),
        ]
        return np.stack([0.5 * first, *distances] if digits == _THUMB else distances, axis=-1)

    def _radius_at(self, digits: slice, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Skin radius [m] at distances (B, D, R) along digits: straight between the shape's four radii."""
        first, second, third = np.moveaxis(self.bone_lengths[:, digits], -1, 0)
        radii = self.radii[:, digits]
        knots = np.stack(
            [np.zeros_like(first), first, first + second, first + second + third - radii[..., 3]], axis=-1
        )
        slopes = np.diff(radii) / np.diff(knots)
        between = radii[..., :1]
        for part in range(3):
            start = knots[..., part, None]
            line = slopes[..., part, None] * (distances - start) + radii[..., part, None]
            between = np.where(distances >= start, line, between)
        return np.where(distances >= knots[..., 3:], radii[..., 3:], between)

    def _around(
        self, digits: slice, distances: NDArray[np.float64], offsets: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Points at `offsets` (B, S, D, ..., 2) (y, z) [m] from digits' axes, `distances` along them."""
        along = np.broadcast_to(distances, offsets.shape[:-1])
        local = np.concatenate([along[..., None], offsets], axis=-1)
        frames = self.frames[:, None, digits]
        flat = local.reshape(*local.shape[:3], -1, 3) @ frames[..., :3, :3].swapaxes(-1, -2)
        return np.asarray((flat + frames[..., None, :3, 3]).reshape(local.shape))

    def _palm(self, wide: NDArray[np.float64], deep: NDArray[np.float64]) -> NDArray[np.float64]:
        """The palm's rows (B, 3, 8, 18, 3) at three scales of breadth and thickness [m]."""
        count = len(self.breadth)
        wrist = np.zeros((count, 1, 4, 3))
        wrist[..., 1] = _WRIST_COLUMNS * self.breadth[:, None, None]
        wrist[..., 2] = _CARPUS_RISE * self.palm_thickness[:, None, None]
        knuckles = self.knuckles[:, None, 1:]
        along = np.clip(_ROW_POSITIONS, 0.0, 1.0)[:, None, None]
        centers = (1.0 - along) * wrist + along * knuckles  # (B, 6, 4, 3)
        centers[..., 0] = _ROW_POSITIONS[:, None] * np.where(
            _ROW_POSITIONS[:, None] < 0.0, knuckles[:, :, 1:2, 0], knuckles[..., 0]
        )
        columns = np.empty((count, 1, 6, 9, 3))
        columns[:, 0, :, 1::2] = centers
        columns[:, 0, :, 2:-1:2] = 0.5 * (centers[:, :, :-1] + centers[:, :, 1:])
        columns[..., 0, :], columns[..., 8, :] = columns[..., 1, :], columns[..., 7, :]
        columns = np.repeat(columns, 3, axis=1)
        edges = _EDGES * self.breadth[:, None, None, None] * wide[:, None, None]  # (B, 3, 2, 6)
        columns[..., 0, 1] += edges[:, :, 0]
        columns[..., 8, 1] -= edges[:, :, 1]
        thickness = (self.palm_thickness[:, None] * deep)[..., None, None]
        rows = np.empty((count, 3, NUM_ROWS, AROUND, 3))
        rows[:, :, :6, :9], rows[:, :, :6, 9:] = columns, columns[..., ::-1, :]
        rows[:, :, :6, :9, 2] += (_HEIGHTS + _ARCH[:, None]) * thickness
        rows[:, :, :6, 9:, 2] -= _DEPTHS[:, ::-1] * thickness
        past = np.repeat(0.7 * self.radii[:, 1:, :1], 6, axis=2)
        rows[:, :, PAST_KNUCKLES] = self._finger_bases(past, 0.12)
        rows[:, :, WEB] = self._finger_bases(_WEB_DISTANCES * self.bone_lengths[:, 1:, :1], 0.0)
        return rows

    def _finger_bases(self, distances: NDArray[np.float64], deepen: float) -> NDArray[np.float64]:
        """A palm row (B, 1, 18, 3) across the fingers, `distances` (B, 4, 6) [m] past their first joints."""
        radius = 1.2 * self._radius_at(_FINGERS, distances)
        section = (_ROUND + _PALMWARD) * radius[..., None]
        section[..., 3:, 1] -= deepen * radius[..., 3:]
        bases = self._around(_FINGERS, distances[:, None], section[:, None])
        row, shared = np.zeros((len(distances), 1, AROUND, 3)), np.zeros(AROUND)
        for finger in range(len(DIGITS) - 1):
            slots = finger_slots(finger)
            row[:, :, slots] += bases[:, :, finger]
            shared[slots] += 1.0
        return row / shared[:, None]

    def _shape_thumb_base(self, cages: NDArray[np.float64], topology: CageTopology) -> None:
        """Thenar muscle and first web, in place: the palm's rows around the thumb's metacarpal."""
        length, radius = self.bone_lengths[:, None, :1, :1], self.radii[:, None, :1, :1]
        moved = topology.palm[_THUMB_BASE_ROWS, _THUMB_BASE_COLUMNS]
        along, across, share = np.split(_THUMB_BASE, [1, 3], axis=1)
        targets = self._around(_THUMB, along[:, 0] * length, radius[..., None] * across)[:, :, 0]
        cages[:, :, moved] = (1.0 - share) * cages[:, :, moved] + share * targets
        section = np.array([[1.02, 0.6], [0.0, 1.1], [-1.1, 0.7], [-1.4, -0.6], [0.2, -1.0], [0.95, -0.62]])
        along = np.array([0.55, 0.5, 0.55, 0.72, 0.77, 0.67]) * length
        ring = self._around(_THUMB, along, (1.12 * radius)[..., None] * section)
        cages[:, :, topology.rings[0][0]] = ring[:, :, 0]


_FIRST_RING, _FIRST_PALM = 1.2, 1.1  # scales that suit the mean hand
# Bone of the digit and its share on each ring past the web; the rest goes to the bone before it.
_FINGER_RINGS: Final = ((1, 0.0), (1, 0.5), (1, 1.0), (2, 0.0), (2, 1.0), (2, 1.0), (2, 1.0))
# Share of the thumb's metacarpal on the palm's rows around it: (row, index, share).
_THENAR: Final = (
    (CARPUS, 0, 0.25),
    (CARPUS, palmar(0), 0.35),
    (CARPUS, palmar(1), 0.15),
    (THENAR, 0, 0.5),
    (THENAR, 1, 0.05),
    (THENAR, palmar(0), 0.8),
    (THENAR, palmar(1), 0.6),
    (THENAR, palmar(2), 0.3),
    (THENAR, palmar(3), 0.05),
    (METACARPUS, 0, 0.15),
    (METACARPUS, palmar(0), 0.4),
    (METACARPUS, palmar(1), 0.25),
)
# Share of the fingers' first bones on the palm's rows, on a finger's column and on a web's.
_KNUCKLE_SHARES: Final = {KNUCKLES: (0.35, 0.25), PAST_KNUCKLES: (0.9, 0.7), WEB: (1.0, 0.9)}


@dataclass(frozen=True, slots=True, eq=False)
class HandSurface:
    """Skin of one hand at zero angles, in the wrist frame; faces and weights are the same for every shape."""

    vertices: Float[np.ndarray, "V 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    bone_indices: Int[np.ndarray, "V 4"]
    """Indices in `handsim.hand.shape.BONES` of the bones that move each vertex."""
    bone_weights: Float[np.ndarray, "V 4"]
    """Weights of these bones: not negative, in descending order, summing to one."""


class _Template(NamedTuple):
    """What all hands share. The last four are rows of `measured`, the vertices that the fit measures."""

    topology: CageTopology
    subdivide: sparse.csr_array
    faces: np.ndarray
    bone_indices: np.ndarray
    bone_weights: np.ndarray
    measured: sparse.csr_array
    ring_loops: np.ndarray
    knuckle_loop: np.ndarray
    tips: np.ndarray
    back_and_palm: np.ndarray


@functools.cache
def _template() -> _Template:
    from scipy import sparse

    topology = cage_topology()
    quads, count = topology.quads, topology.num_vertices
    loops = [ring for rings in topology.rings for ring in rings] + [topology.palm[KNUCKLES]]
    subdivide = sparse.eye_array(count, format="csr")
    for _ in range(2):
        step, next_quads = catmull_clark(quads, count)
        loops = subdivided_loops(loops, quads, count)
        subdivide = step @ subdivide
        quads, count = next_quads, step.shape[0]
    children = np.arange(len(quads)).reshape(len(topology.quads), -1)  # quads that came from each cage quad
    tips = np.array([np.unique(quads[children[pair]]) for pair in topology.tips])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    indices, weights = strongest_weights(subdivide @ cage_weights(topology))
    for array in (faces, indices, weights):
        array.setflags(write=False)
    back_and_palm = topology.palm[METACARPUS][[3, palmar(3)]]
    looked_at = (np.array(loops[:-1]), loops[-1], tips, back_and_palm)
    rows = np.unique(np.concatenate([part.ravel() for part in looked_at]))
    parts = [np.searchsorted(rows, part) for part in looked_at]
    return _Template(topology, subdivide, faces, indices, weights, subdivide[rows], *parts)


def build_surface(shape: HandShape) -> HandSurface:
    """Skin of a hand at zero angles.

    Subdivision shrinks, so the cage is enlarged until the skin has the shape's girths, lengths, breadth and
    palm thickness. A left hand is the exact mirror image of the right one.
    """
    template, vertices = _template(), _right_vertices(np.array(pack_hand(shape), HAND_DTYPE).tobytes()[1:])
    faces = template.faces
    if shape.side == "left":
        vertices, faces = vertices @ MIRROR, faces[:, ::-1]
    return HandSurface(vertices, faces, template.bone_indices, template.bone_weights)


@functools.lru_cache(maxsize=4)
def _right_vertices(measures: bytes) -> Float[np.ndarray, "V 3"]:
    """`rest_vertices` of the bytes of a `HAND_DTYPE` without the side, cached for both hands of a pair."""
    return np.asarray(_rest_vertices(np.frombuffer(b"\0" + measures, HAND_DTYPE))[0])


def rest_vertices(shapes: Sequence[HandShape]) -> Float[np.ndarray, "B V 3"]:
    """Vertices of the skins of hands as right hands, as in `build_surface` [m]; many cost little more."""
    return _rest_vertices(np.array([pack_hand(shape) for shape in shapes], HAND_DTYPE))


def _rest_vertices(hands: NDArray[np.void]) -> NDArray[np.float64]:
    """`rest_vertices` of hands of type `HAND_DTYPE`."""
    template = _template()
    return _subdivided(template.subdivide, _fitted_cages(CageHands.of(hands), template))


def _subdivided(matrix: sparse.csr_array, cages: np.ndarray) -> np.ndarray:
    """Rows of the subdivision of each cage (B, K, 3): (B, R, 3)."""
    count = len(cages)
    rows = matrix @ cages.swapaxes(0, 1).reshape(-1, 3 * count)
    return np.ascontiguousarray(rows.reshape(-1, count, 3).swapaxes(0, 1))


def _fitted_cages(hands: CageHands, template: _Template) -> np.ndarray:
    """Cage vertices (B, K, 3) after a few corrections of their scales by expected over measured sizes."""
    topology, count = template.topology, len(hands.breadth)
    still, wide, deep = hands.cage_parts(topology)
    palm, on_ring = topology.palm.size, topology.rings[0].shape[1]
    sideways, upwards = np.full((2, count, topology.num_vertices), _FIRST_PALM)
    sideways[:, palm:], upwards[:, palm:] = _FIRST_RING, 0.0
    rings = sideways[:, palm:].reshape(count, -1, on_ring)  # a view
    tip_rings = np.cumsum([len(digit) for digit in topology.rings]) - 1
    outermost = np.array([digit[-1] for digit in topology.rings])
    girths, reach = hands.ring_girths(), hands.bone_lengths.sum(axis=2)
    for _ in range(4):
        cages = still + sideways[..., None] * wide + upwards[..., None] * deep
        points = _subdivided(template.measured, cages)
        loops = points.take(template.ring_loops, axis=1)
        around = np.linalg.norm(loops - np.roll(loops, 1, axis=2), axis=-1).sum(axis=2)
        rings *= (girths / around)[..., None]
        rings[:, tip_rings] = rings[:, tip_rings - 1]
        tips = points[:, template.tips] - hands.frames[:, :, None, :3, 3]
        ahead = np.einsum("bdni,bdi->bdn", tips, hands.frames[..., :3, 0])
        upwards[:, outermost] += (reach - ahead.max(axis=2))[..., None]
        across = np.ptp(points[:, template.knuckle_loop, 1], axis=1)
        sideways[:, :palm] *= (hands.breadth / across)[:, None]
        upwards[:, :palm] *= -hands.palm_thickness[:, None] / np.diff(points[:, template.back_and_palm, 2])
    return np.asarray(still + sideways[..., None] * wide + upwards[..., None] * deep)


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Outward unit normals, each the area-weighted mean of the faces around its vertex."""
    points = np.ascontiguousarray(vertices, dtype=np.float64)
    return np.asarray(_vertex_normals(points, np.ascontiguousarray(faces, dtype=np.int64)))


@kernel
def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """See `vertex_normals`; zero for a vertex without faces."""
    normals = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux = vertices[b, 0] - vertices[a, 0]
        uy = vertices[b, 1] - vertices[a, 1]
        uz = vertices[b, 2] - vertices[a, 2]
        vx = vertices[c, 0] - vertices[a, 0]
        vy = vertices[c, 1] - vertices[a, 1]
        vz = vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in (a, b, c):
            normals[corner, 0] += x
            normals[corner, 1] += y
            normals[corner, 2] += z
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if length > 0.0:
            for i in range(3):
                normals[v, i] /= length
    return normals


def cage_weights(topology: CageTopology) -> Float[np.ndarray, "K 16"]:
    """Share of every bone in every cage vertex; rows sum to one."""
    weights = np.zeros((topology.num_vertices, NUM_BONES))
    for row, (on_finger, on_web) in _KNUCKLE_SHARES.items():
        for column in range(9):
            beside = (column // 2,) if column % 2 else (column // 2 - 1, column // 2)
            fingers = [finger for finger in beside if 0 <= finger < 4]
            share = on_finger if column % 2 or len(fingers) == 1 else on_web
            for index in (column, palmar(column)):
                weights[topology.palm[row, index], [4 + 3 * f for f in fingers]] = share / len(fingers)
    for row, index, share in _THENAR:
        weights[topology.palm[row, index], 1] = share
    for digit, rings in enumerate(topology.rings):
        first = 1 + 3 * digit
        if digit == 0:
            weights[rings[0], first] = 0.95
        for ring, (bone, share) in zip(rings[-len(_FINGER_RINGS) :], _FINGER_RINGS, strict=True):
            weights[ring, first + bone - 1] = 1.0 - share
            weights[ring, first + bone] = share
    weights[:, PALM] = 1.0 - weights[:, PALM + 1 :].sum(axis=1)
    return weights


def strongest_weights(
    weights: Float[np.ndarray, "V 16"],
) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"]]:
    """The four largest shares of each vertex in descending order, scaled to sum to one, and their bones."""
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    shares = np.clip(np.take_along_axis(weights, indices, axis=1), 0.0, None)
    return indices, shares / shares.sum(axis=1, keepdims=True)


def all_weights(
    indices: Int[np.ndarray, "V 4"], shares: Float[np.ndarray, "V 4"]
) -> Float[np.ndarray, "V 16"]:
    """Shares of all bones, from those of four."""
    weights = np.zeros((len(indices), NUM_BONES))
    np.add.at(weights, (np.arange(len(indices))[:, None], indices), shares)
    return weights


def skin_frames(
    points: Float[np.ndarray, "V 3"],
    bone_indices: Int[np.ndarray, "V 4"],
    bone_weights: Float[np.ndarray, "V 4"],
    rest_transforms: Float[np.ndarray, "L 4 4"],
    transforms: Float[np.ndarray, "T L 4 4"],
) -> Float[np.ndarray, "T V 3"]:
    """Points attached at rest, carried by the bones."""
    motion = np.ascontiguousarray((transforms @ np.linalg.inv(rest_transforms))[..., :3, :])
    return np.asarray(_skin(points, bone_indices, bone_weights, motion))


@kernel
def _skin(
    points: Float[np.ndarray, "V 3"],
    bones: Int[np.ndarray, "V 4"],
    weights: Float[np.ndarray, "V 4"],
    motion: Float[np.ndarray, "T L 3 4"],
) -> Any:
    """Skinned positions (T, V, 3) [m] by transforms from the rest pose to each frame."""
    skinned = np.empty((len(motion), len(points), 3))
    for t in range(len(motion)):
        for v in range(len(points)):
            px, py, pz = points[v, 0], points[v, 1], points[v, 2]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(weights.shape[1]):
                share = weights[v, i]
                if share == 0.0:
                    break
                m = motion[t, bones[v, i]]
                x += share * (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3])
                y += share * (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3])
                z += share * (m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3])
            skinned[t, v, 0], skinned[t, v, 1], skinned[t, v, 2] = x, y, z
    return skinned
