"""The hand's skin: a smooth closed mesh that is a function of the shape, and linear blend skinning.

A control cage of 360 quads is rounded by two steps of subdivision, which spread the weights of the bones as
they spread vertices. `data/hand_cage.json`, which `benchmarks/hand_cage.py` explains and writes, has its
faces, the shares of the bones, and the measures that its vertices follow from.

Skinning is compiled: the whole skin in every frame, fast enough to cast rays against it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.files.inputs import package_data
from handsim.hand.shape import DIGITS, HAND_DTYPE, NUM_BONES, pack_hand
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR, euler_matrix, rigid

if TYPE_CHECKING:
    from scipy import sparse

    from handsim.hand.shape import HandShape


NUM_ROWS: Final = 8
AROUND: Final = 18
PALM_VERTICES: Final = np.arange(NUM_ROWS * AROUND).reshape(NUM_ROWS, AROUND)
"""Vertices of the cage on the palm's rows, from behind the wrist to the webs, each around the palm."""
_ON_RING: Final = 6
RINGS: Final = (
    PALM_VERTICES.size + np.arange(8 * _ON_RING).reshape(1, 8, _ON_RING),
    PALM_VERTICES.size + 8 * _ON_RING + np.arange(4 * 7 * _ON_RING).reshape(4, 7, _ON_RING),
)
"""Vertices of the cage on the thumb's rings, outwards, and on those of the four fingers past the webs."""
_THUMB, _FINGERS = slice(0, 1), slice(1, len(DIGITS))
_PAST_KNUCKLES, _WEB = 6, 7  # rows of the palm
_CARPUS_RISE: Final = 0.42  # the carpus arches over the line from wrist to knuckles, in palm thicknesses
_FIRST_RING, _FIRST_PALM = 1.2, 1.1  # scales that suit the mean hand


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


class Cage(NamedTuple):
    """The control cage and its measures: K vertices, Q quads, R rings, V vertices of the skin."""

    quads: NDArray[np.int64]  # (Q, 4), counter-clockwise from outside
    weights: NDArray[np.float64]  # (K, 16) share of every bone
    ring_loops: NDArray[np.int64]  # (R, 24) vertices of the skin around each ring
    knuckle_loop: NDArray[np.int64]  # (72,) around the palm's row at the knuckles
    wrist_loop: NDArray[np.int64]  # (72,) around the row at the wrist
    tips: NDArray[np.int64]  # (5, 15) vertices of the skin that close each digit
    back_and_palm: NDArray[np.int64]  # (2,) vertices between which the palm's thickness is measured
    finger_slots: NDArray[np.int64]  # (4, 6) indices in a palm row of the vertices around each finger
    row_positions: NDArray[np.float64]  # (6,) of palm rows: 0 at the wrist, 1 at the joints
    heights: NDArray[np.float64]  # (6, 9) of the back above the metacarpals, in palm thicknesses
    depths: NDArray[np.float64]  # (6, 9) of the palm under them, from the little finger's side
    wrist_columns: NDArray[np.float64]  # (4,) y of the rays at the wrist, in breadths
    edges: NDArray[np.float64]  # (2, 6) from the outer rays to the palm's edges, in breadths
    web_distances: NDArray[np.float64]  # (4, 6) of the web row along each first phalanx, in its lengths
    base_section: NDArray[np.float64]  # (6, 2) (y, z) of a finger's base about its axis, in radii
    sections: NDArray[np.float64]  # (8, 6, 2) (y, z) of the rings about the axis, in radii
    waists: NDArray[np.float64]  # (8,) girth of the rings over the shape's
    thumb_base: NDArray[np.int64]  # (12,) vertices of the palm around the thumb's metacarpal
    thumb_base_targets: NDArray[np.float64]  # (12, 4) along, sideways, upwards, share of the way
    thumb_ring: NDArray[np.float64]  # (6, 2) section of the thumb's first ring
    thumb_ring_along: NDArray[np.float64]  # (6,) its positions along the metacarpal [lengths]


@functools.cache
def load_cage() -> Cage:
    """The cage of every hand."""
    return Cage(**{name: np.array(values) for name, values in package_data("handsim", "hand_cage").items()})


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
        for digits, rings in zip((_THUMB, _FINGERS), RINGS, strict=True):
            waists = load_cage().waists[-rings.shape[1] :]
            radii = self._radius_at(digits, self._ring_distances(digits))
            girths.append((2.0 * np.pi * waists * radii).reshape(len(radii), -1))
        return np.concatenate(girths, axis=1)

    def cage_parts(self) -> Float[np.ndarray, "3 B K 3"]:
        """Cage vertices in the wrist frame [m], affine in two scales: at zero, per width, per depth.

        Width scales rings and the palm's breadth; depth pushes the last rings out and scales the palm's
        thickness.
        """
        wide, deep = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        cages = np.empty((len(self.breadth), 3, len(load_cage().weights), 3))
        cages[:, :, PALM_VERTICES] = self._palm(wide, deep)
        for digits, rings in zip((_THUMB, _FINGERS), RINGS, strict=True):
            distances = self._ring_distances(digits)[:, None]  # (B, 1, D, R)
            sections = load_cage().sections[-rings.shape[1] :]
            radii = self._radius_at(digits, distances[:, 0])[:, None] * wide[:, None, None]  # (B, 3, D, R)
            along = np.repeat(distances, 3, axis=1)
            along[..., -1] += deep[:, None]
            cages[:, :, rings] = self._around(digits, along[..., None], sections * radii[..., None, None])
        self._shape_thumb_base(cages)
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
        cage, count = load_cage(), len(self.breadth)
        wrist = np.zeros((count, 1, 4, 3))
        wrist[..., 1] = cage.wrist_columns * self.breadth[:, None, None]
        wrist[..., 2] = _CARPUS_RISE * self.palm_thickness[:, None, None]
        knuckles = self.knuckles[:, None, 1:]
        positions = cage.row_positions[:, None]
        along = np.clip(positions, 0.0, 1.0)[..., None]
        centers = (1.0 - along) * wrist + along * knuckles  # (B, 6, 4, 3)
        reach = np.where(positions < 0.0, knuckles[:, :, 1:2, 0], knuckles[..., 0])
        centers[..., 0] = positions * reach
        columns = np.empty((count, 1, 6, 9, 3))
        columns[:, 0, :, 1::2] = centers
        columns[:, 0, :, 2:-1:2] = 0.5 * (centers[:, :, :-1] + centers[:, :, 1:])
        columns[..., 0, :], columns[..., 8, :] = columns[..., 1, :], columns[..., 7, :]
        columns = np.repeat(columns, 3, axis=1)
        edges = cage.edges * self.breadth[:, None, None, None] * wide[:, None, None]  # (B, 3, 2, 6)
        columns[..., 0, 1] += edges[:, :, 0]
        columns[..., 8, 1] -= edges[:, :, 1]
        thickness = (self.palm_thickness[:, None] * deep)[..., None, None]
        rows = np.empty((count, 3, NUM_ROWS, AROUND, 3))
        rows[:, :, :6, :9], rows[:, :, :6, 9:] = columns, columns[..., ::-1, :]
        rows[:, :, :6, :9, 2] += cage.heights * thickness
        rows[:, :, :6, 9:, 2] -= cage.depths * thickness
        past = np.repeat(0.7 * self.radii[:, 1:, :1], 6, axis=2)
        rows[:, :, _PAST_KNUCKLES] = self._finger_bases(past, 0.12)
        rows[:, :, _WEB] = self._finger_bases(cage.web_distances * self.bone_lengths[:, 1:, :1], 0.0)
        return rows

    def _finger_bases(self, distances: NDArray[np.float64], deepen: float) -> NDArray[np.float64]:
        """A palm row (B, 1, 18, 3) across the fingers, `distances` (B, 4, 6) [m] past their first joints."""
        radius = 1.2 * self._radius_at(_FINGERS, distances)
        section = load_cage().base_section * radius[..., None]
        section[..., 3:, 1] -= deepen * radius[..., 3:]
        bases = self._around(_FINGERS, distances[:, None], section[:, None])
        row, slots = np.zeros((len(distances), 1, AROUND, 3)), load_cage().finger_slots
        for finger, own in enumerate(slots):
            row[:, :, own] += bases[:, :, finger]
        return row / np.bincount(slots.ravel())[:, None]

    def _shape_thumb_base(self, cages: NDArray[np.float64]) -> None:
        """Thenar muscle and first web, in place: the palm's rows around the thumb's metacarpal."""
        length, radius = self.bone_lengths[:, None, :1, :1], self.radii[:, None, :1, :1]
        cage = load_cage()
        moved = cage.thumb_base
        along, across, share = np.split(cage.thumb_base_targets, [1, 3], axis=1)
        targets = self._around(_THUMB, along[:, 0] * length, radius[..., None] * across)[:, :, 0]
        cages[:, :, moved] = (1.0 - share) * cages[:, :, moved] + share * targets
        along = cage.thumb_ring_along * length
        ring = self._around(_THUMB, along, (1.12 * radius)[..., None] * cage.thumb_ring)
        cages[:, :, RINGS[0][0, 0]] = ring[:, :, 0]


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

    cage = load_cage()
    quads, subdivide = cage.quads, sparse.eye_array(len(cage.weights), format="csr")
    for _ in range(2):
        step, quads = catmull_clark(quads, subdivide.shape[0])
        subdivide = step @ subdivide
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    indices, weights = strongest_weights(subdivide @ cage.weights)
    for array in (faces, indices, weights):
        array.setflags(write=False)
    looked_at = (cage.ring_loops, cage.knuckle_loop, cage.tips, cage.back_and_palm)
    rows = np.unique(np.concatenate([part.ravel() for part in looked_at]))
    parts = [np.searchsorted(rows, part) for part in looked_at]
    return _Template(subdivide, faces, indices, weights, subdivide[rows], *parts)


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
    palm, count = PALM_VERTICES.size, len(hands.breadth)
    still, wide, deep = hands.cage_parts()
    sideways, upwards = np.full((2, *still.shape[:2]), _FIRST_PALM)
    sideways[:, palm:], upwards[:, palm:] = _FIRST_RING, 0.0
    rings = sideways[:, palm:].reshape(count, -1, _ON_RING)  # a view
    outermost = np.concatenate([digits[:, -1] for digits in RINGS])
    tip_rings = (outermost[:, 0] - palm) // _ON_RING
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
