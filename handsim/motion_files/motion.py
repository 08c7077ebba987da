"""What the writers of motion files take: hands and rigid bodies over time, as a take has them.

Skeletons of other programs have rotations of the bones relative to their parents (`local_rotations`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy import sparse

from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, PALM, Side
from handsim.space.objects import RigidObject
from handsim.space.transforms import UpAxis, pose_matrices, rotation_quaternions

CHILDREN: Final = tuple(
    tuple(number for number, bone in enumerate(BONES) if bone.parent == parent)
    for parent in range(len(BONES))
)
"""Indices of the bones that begin at the end of each bone."""
_PARENTS: Final = np.array([bone.parent for bone in BONES])


class Material(NamedTuple):
    """What a surface looks like in files with materials."""

    name: str
    color: tuple[float, float, float]
    """Linear light, in [0, 1]."""
    roughness: float


SKIN: Final = Material("skin", (0.66, 0.38, 0.28), 0.65)
THING: Final = Material("thing", (0.16, 0.2, 0.26), 0.5)


class HasModel(Protocol):
    """Anything with a hand: a `gloves.GloveFit`."""

    @property
    def model(self) -> HandModel:
        """The hand."""
        ...


class NamedBody(Protocol):
    """A rigid body."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def shape(self) -> RigidObject | None:
        """Its surface; None where only its poses are known."""
        ...


class Motion(Protocol):
    """Hands and rigid bodies, frame by frame: a `gloves.Take`. Each has a pose in one frame at least."""

    @property
    def rate(self) -> float:
        """Frames per second [Hz]; of a stream, the usual one."""
        ...

    @property
    def times(self) -> Float[np.ndarray, "T"]:
        """Time of each frame [s], increasing."""
        ...

    @property
    def hands(self) -> Sequence[HasModel]:
        """The hands, at most one per side."""
        ...

    @property
    def qpos(self) -> Float[np.ndarray, "T H 27"]:
        """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN where there is no pose."""
        ...

    @property
    def bodies(self) -> Sequence[NamedBody]:
        """The rigid bodies."""
        ...

    @property
    def body_poses(self) -> Float[np.ndarray, "T B 7"]:
        """Position [m] and orientation (wxyz); NaN where there is no pose."""
        ...


class PosedHand(NamedTuple):
    """A hand of a motion."""

    model: HandModel
    side: Side
    present: Bool[np.ndarray, "T"]
    """The frames with a pose."""
    qpos: Float[np.ndarray, "T 27"]
    """The poses [m, rad]; without one the last pose, and before the first one that."""


class PosedBody(NamedTuple):
    """A rigid body of a motion."""

    name: str
    shape: RigidObject | None
    present: Bool[np.ndarray, "T"]
    """The frames with a pose."""
    T_world_body: Float[np.ndarray, "T 4 4"]
    """The poses [m]; without one the last pose, and before the first one that."""


def posed_hands(motion: Motion) -> Iterator[PosedHand]:
    """Each hand, with its last pose where it has none."""
    for number, hand in enumerate(motion.hands):
        qpos = motion.qpos[:, number]
        present: NDArray[np.bool_] = np.isfinite(qpos[:, 0])
        yield PosedHand(hand.model, hand.model.shape.side, present, _held(qpos, present))


def posed_bodies(motion: Motion) -> Iterator[PosedBody]:
    """Each rigid body, with its last pose where it has none."""
    for number, body in enumerate(motion.bodies):
        poses = motion.body_poses[:, number]
        present: NDArray[np.bool_] = np.isfinite(poses[:, 0])
        yield PosedBody(body.name, body.shape, present, pose_matrices(_held(poses, present)))


def seconds_of(motion: Motion) -> Float[np.ndarray, "T"]:
    """Time since the first frame [s]."""
    seconds: NDArray[np.float64] = motion.times - motion.times[0]
    return seconds


def file_axes(up: UpAxis) -> Float[np.ndarray, "3 3"]:
    """Turns the world into axes with y up, as glTF, BVH and OpenXR have them; x stays."""
    if up == "y":
        return np.eye(3)
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def changes(present: Bool[np.ndarray, "T"]) -> Int[np.ndarray, "K"]:
    """The first frame, and every frame from which on something appears or disappears."""
    return np.flatnonzero(np.diff(present, prepend=not present[0]))


def _held(values: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rows, with the last row that is present in the place of each that is not."""
    last = np.maximum.accumulate(np.where(present, np.arange(len(present)), -1))
    return values[np.where(last < 0, np.argmax(present), last)]


def local_rotations(rotations: Float[np.ndarray, "T L 3 3"]) -> Float[np.ndarray, "T L 3 3"]:
    """Each bone's orientation in its parent's frame; the palm's stays as it is."""
    local: NDArray[np.float64] = np.swapaxes(rotations[:, _PARENTS], -1, -2) @ rotations
    local[:, PALM] = rotations[:, PALM]
    return local


def smooth_quaternions(rotations: Float[np.ndarray, "T *batch 3 3"]) -> Float[np.ndarray, "T *batch 4"]:
    """Unit wxyz quaternions of rotations over time, with the signs of which neighbors are near."""
    quaternions = rotation_quaternions(rotations.reshape(-1, 3, 3)).reshape(*rotations.shape[:-2], 4)
    dots = (quaternions[1:] * quaternions[:-1]).sum(axis=-1, keepdims=True)
    signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0), axis=0)
    quaternions[1:] *= signs
    return quaternions


_SHARP: Final = np.cos(np.deg2rad(40.0))


def corner_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3 3"]:
    """Outward unit normal at each corner of each face: of the faces there that meet at less than 40 degrees.

    Args:
        faces: Triangles, counter-clockwise from outside.
    """
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    areas = np.cross(second - first, third - first)
    units = _unit(areas)
    count = faces.size
    at = sparse.csr_array((np.ones(count), (np.arange(count), faces.ravel())), shape=(count, len(vertices)))
    one, other = (at @ at.T).nonzero()  # pairs of corners at one vertex
    near = (units[one // 3] * units[other // 3]).sum(axis=1) > _SHARP
    near |= one == other  # a face without an area too
    sums = np.zeros((count, 3))
    np.add.at(sums, one[near], areas[other[near] // 3])
    return _unit(sums).reshape(-1, 3, 3)


def split_vertices(
    faces: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]
) -> tuple[Int[np.ndarray, "W"], Float[np.ndarray, "W 3"], Int[np.ndarray, "F 3"]]:
    """Vertices with one normal each, from triangles with one at each corner.

    Returns:
        The old vertex of each new one, its normal, and the triangles of the new ones.
    """
    keys = np.column_stack([faces.ravel(), np.round(normals.reshape(-1, 3), 4)])
    _, index, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return faces.ravel()[index], normals.reshape(-1, 3)[index], inverse.reshape(-1, 3)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
    unit[lengths[:, 0] == 0.0] = (0.0, 0.0, 1.0)
    return unit
