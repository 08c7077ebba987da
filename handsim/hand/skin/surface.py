"""The hand's skin: a smooth closed mesh that is a function of the shape, and linear blend skinning.

Shares of the bones are given on the cage, and spread by the same subdivision as its vertices. Skinning is
compiled: the whole skin in every frame, fast enough to cast rays against it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy import sparse

from handsim.hand.shape import NUM_BONES, PALM
from handsim.hand.skin import (
    CARPUS,
    KNUCKLES,
    METACARPUS,
    PAST_KNUCKLES,
    THENAR,
    WEB,
    CageHands,
    CageTopology,
    cage_topology,
    catmull_clark,
    dorsal,
    palmar,
    subdivided_loops,
)
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR

if TYPE_CHECKING:
    from handsim.hand.shape import HandShape


_LEVELS: Final = 2
_FIT_STEPS: Final = 4
_FIRST_RING, _FIRST_PALM = 1.2, 1.1  # scales that suit the mean hand
# Bone of the digit and its share on each ring past the web; the rest goes to the bone before it.
_FINGER_RINGS: Final = ((1, 0.0), (1, 0.5), (1, 1.0), (2, 0.0), (2, 1.0), (2, 1.0), (2, 1.0))
# Share of the thumb's metacarpal on the palm's rows around it: (row, index, share).
_THENAR: Final = (
    (CARPUS, dorsal(0), 0.25),
    (CARPUS, palmar(0), 0.35),
    (CARPUS, palmar(1), 0.15),
    (THENAR, dorsal(0), 0.5),
    (THENAR, dorsal(1), 0.05),
    (THENAR, palmar(0), 0.8),
    (THENAR, palmar(1), 0.6),
    (THENAR, palmar(2), 0.3),
    (THENAR, palmar(3), 0.05),
    (METACARPUS, dorsal(0), 0.15),
    (METACARPUS, palmar(0), 0.4),
    (METACARPUS, palmar(1), 0.25),
)
_KNUCKLE_SHARES: Final = {KNUCKLES: (0.35, 0.25), PAST_KNUCKLES: (0.9, 0.7), WEB: (1.0, 0.9)}  # finger, web


@dataclass(frozen=True, slots=True, eq=False)
class HandSurface:
    """Skin of one hand at zero angles, in the wrist frame; faces and weights are the same for every shape."""

    vertices: Float[np.ndarray, "V 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    bone_indices: Int[np.ndarray, "V 4"]
    """Indices in `topology.BONES` of the bones that move each vertex."""
    bone_weights: Float[np.ndarray, "V 4"]
    """Their shares: not negative, in descending order, summing to one."""


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
    topology = cage_topology()
    quads, count = topology.quads, topology.num_vertices
    loops = [ring for rings in topology.rings for ring in rings] + [topology.palm[KNUCKLES]]
    subdivide = sparse.eye_array(count, format="csr")
    for _ in range(_LEVELS):
        step, next_quads = catmull_clark(quads, count)
        loops = subdivided_loops(loops, quads, count)
        subdivide = step @ subdivide
        quads, count = next_quads, step.shape[0]
    children = np.arange(len(quads)).reshape(len(topology.quads), -1)  # a quad's four follow one another
    tips = np.array([np.unique(quads[children[pair]]) for pair in topology.tips])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    indices, weights = strongest_weights(subdivide @ cage_weights(topology))
    for array in (faces, indices, weights):
        array.setflags(write=False)
    back_and_palm = topology.palm[METACARPUS][[dorsal(3), palmar(3)]]
    looked_at = (np.array(loops[:-1]), loops[-1], tips, back_and_palm)
    rows = np.unique(np.concatenate([part.ravel() for part in looked_at]))
    parts = [np.searchsorted(rows, part) for part in looked_at]
    return _Template(topology, subdivide, faces, indices, weights, subdivide[rows], *parts)


def build_surface(shape: HandShape) -> HandSurface:
    """Skin of a hand at zero angles.

    Subdivision shrinks, so the cage is enlarged until the skin has the shape's girths, lengths, breadth and
    palm thickness. A left hand is the exact mirror image of the right one.
    """
    template, vertices = _template(), rest_vertices([shape])[0]
    faces = template.faces
    if shape.side == "left":
        vertices, faces = vertices @ MIRROR, faces[:, ::-1]
    return HandSurface(vertices, faces, template.bone_indices, template.bone_weights)


def rest_vertices(shapes: Sequence[HandShape]) -> Float[np.ndarray, "B V 3"]:
    """Vertices of the skins of hands as right hands, as in `build_surface` [m]; many cost little more."""
    template = _template()
    return _subdivided(template.subdivide, _fitted_cages(CageHands.of(shapes), template))


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
    for _ in range(_FIT_STEPS):
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
    fitted: np.ndarray = still + sideways[..., None] * wide + upwards[..., None] * deep
    return fitted


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Outward unit normals, each the area-weighted mean of the faces around its vertex.

    Args:
        vertices: Positions in any frame [m].
        faces: Triangles, counter-clockwise from outside.
    """
    return _vertex_normals(
        np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64)
    )


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
            fingers = (
                [column // 2] if column % 2 else [f for f in (column // 2 - 1, column // 2) if 0 <= f < 4]
            )
            share = on_finger if column % 2 or len(fingers) == 1 else on_web
            for index in (dorsal(column), palmar(column)):
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
    shares = np.take_along_axis(weights, indices, axis=1)
    return indices, shares / shares.sum(axis=1, keepdims=True)


def skin_frames(
    points: Float[np.ndarray, "V 3"],
    bone_indices: Int[np.ndarray, "V 4"],
    bone_weights: Float[np.ndarray, "V 4"],
    rest_transforms: Float[np.ndarray, "L 4 4"],
    transforms: Float[np.ndarray, "T L 4 4"],
) -> Float[np.ndarray, "T V 3"]:
    """Points attached at rest, carried by the bones.

    Args:
        points: Rest positions, in the frame of `rest_transforms` [m].
        bone_weights: Their shares in descending order; the first zero ends a point's list.
        rest_transforms: Bones at rest.
        transforms: Bones in every frame, in any one frame of reference.

    Returns:
        Positions in the frame of `transforms` [m].
    """
    motion = np.ascontiguousarray((transforms @ np.linalg.inv(rest_transforms))[..., :3, :])
    skinned: NDArray[np.float64] = _skin(points, bone_indices, bone_weights, motion)
    return skinned


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
