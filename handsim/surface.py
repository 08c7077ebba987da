"""The hand's skin: a smooth closed mesh that is a function of the shape, and linear blend skinning."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import sparse

from handsim.skin_weights import cage_weights, strongest_weights
from handsim.subdivision import catmull_clark, subdivided_loop
from handsim.surface_cage import (
    KNUCKLES,
    METACARPUS,
    CageScales,
    CageTopology,
    cage_topology,
    cage_vertices,
    digit_frames,
    dorsal,
    first_scales,
    palmar,
    ring_girths,
)
from handsim.topology import DIGITS
from handsim.transforms import MIRROR

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from handsim.shape import HandShape

_LEVELS: Final = 2
_FIT_STEPS: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class HandSurface:
    """Skin of one hand at zero angles, in the wrist frame; faces and weights are the same for every shape."""

    vertices: Float[np.ndarray, "V 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    bone_indices: Int[np.ndarray, "V 4"]
    """Places in `topology.BONES` of the bones that move each vertex."""
    bone_weights: Float[np.ndarray, "V 4"]
    """Their shares: not negative, in descending order, summing to one."""


class _Template(NamedTuple):
    """What all hands share."""

    topology: CageTopology
    subdivide: sparse.csr_array
    faces: np.ndarray
    bone_indices: np.ndarray
    bone_weights: np.ndarray
    ring_loops: list[np.ndarray]
    knuckle_loop: np.ndarray
    tips: list[np.ndarray]


@functools.cache
def _template() -> _Template:
    topology = cage_topology()
    quads, count = topology.quads, topology.num_vertices
    loops = [ring for rings in topology.rings for ring in rings] + [topology.palm[KNUCKLES]]
    subdivide = sparse.eye_array(count, format="csr")
    for _ in range(_LEVELS):
        step, next_quads = catmull_clark(quads, count)
        loops = [subdivided_loop(loop, quads, count) for loop in loops]
        subdivide = step @ subdivide
        quads, count = next_quads, step.shape[0]
    children = np.arange(len(quads)).reshape(len(topology.quads), -1)  # a quad's four follow one another
    tips = [np.unique(quads[children[pair]]) for pair in topology.tips]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    indices, weights = strongest_weights(subdivide @ cage_weights(topology))
    sizes = np.cumsum([len(rings) for rings in topology.rings])[:-1]
    ring_loops = np.split(np.array(loops[:-1]), sizes)
    for array in (faces, indices, weights):
        array.setflags(write=False)
    return _Template(topology, subdivide, faces, indices, weights, ring_loops, loops[-1], tips)


def build_surface(shape: HandShape) -> HandSurface:
    """Skin of a hand at zero angles.

    Subdivision shrinks, so the cage is blown up until the skin has the shape's girths, lengths, breadth and
    palm thickness. A left hand is the exact mirror image of the right one.
    """
    template = _template()
    scales = first_scales()
    frames = digit_frames(shape)
    vertices = template.subdivide @ cage_vertices(shape, frames, template.topology, scales)
    for _ in range(_FIT_STEPS):
        _refit(scales, vertices, shape, frames, template)
        vertices = template.subdivide @ cage_vertices(shape, frames, template.topology, scales)
    faces = template.faces
    if shape.side == "left":
        vertices, faces = vertices @ MIRROR, faces[:, ::-1]
    return HandSurface(vertices, faces, template.bone_indices, template.bone_weights)


def _refit(
    scales: CageScales, vertices: np.ndarray, shape: HandShape, frames: np.ndarray, template: _Template
) -> None:
    """Corrects the scales by wanted over measured."""
    for digit in range(len(DIGITS)):
        loops = vertices[template.ring_loops[digit]]
        girths = np.linalg.norm(loops - np.roll(loops, 1, axis=1), axis=-1).sum(axis=1)
        scales.rings[digit][:-1] *= (ring_girths(shape, digit) / girths)[:-1]
        scales.rings[digit][-1] = scales.rings[digit][-2]
        base, along = frames[digit, :3, 3], frames[digit, :3, 0]
        reach = float(((vertices[template.tips[digit]] - base) @ along).max())
        scales.tips[digit] += shape.bone_lengths[digit].sum() - reach
    palm = template.topology.palm
    loop = vertices[template.knuckle_loop]
    scales.breadth *= shape.breadth / float(np.ptp(loop[:, 1]))
    row = vertices[palm[METACARPUS]]
    scales.thickness *= shape.palm_thickness / float(row[dorsal(3), 2] - row[palmar(3), 2])


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Outward unit normals, each the area-weighted mean of the faces around its vertex."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [np.bincount(faces.ravel(), np.repeat(crosses[:, axis], 3), len(vertices)) for axis in range(3)]
    normals = np.stack(sums, axis=1)
    unit: np.ndarray = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return unit


def linear_blend_skinning(
    points: Float[np.ndarray, "N 3"],
    bone_indices: Int[np.ndarray, "N 4"],
    bone_weights: Float[np.ndarray, "N 4"],
    rest_transforms: Float[np.ndarray, "L 4 4"],
    transforms: Float[np.ndarray, "*batch L 4 4"],
) -> Float[np.ndarray, "*batch N 3"]:
    """Points attached at rest, carried by the bones.

    Args:
        points: Rest positions, in the frame of `rest_transforms` [m].
        bone_indices: The bones that move each point.
        bone_weights: Their shares.
        rest_transforms: Bones at rest.
        transforms: Bones in each pose, in any frame.

    Returns:
        Positions in the frame of `transforms` [m].
    """
    motion = (transforms @ np.linalg.inv(rest_transforms))[..., :3, :]
    weights = np.zeros((len(points), len(rest_transforms)))
    np.add.at(weights, (np.arange(len(points))[:, None], bone_indices), bone_weights)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    # Each bone moves only its own points: one small product a bone instead of a blended matrix a point.
    result = np.zeros((*motion.shape[:-3], len(points), 3))
    for bone in range(len(rest_transforms)):
        mine = np.flatnonzero(weights[:, bone])
        carried = np.einsum("...ij,nj->...ni", motion[..., bone, :, :], homogeneous[mine])
        result[..., mine, :] += weights[mine, bone, None] * carried
    return result
