"""Rotations and rigid transforms on numpy arrays, leading batch dimensions everywhere.

Quaternions are wxyz (MuJoCo's order). A matrix `T_a_b` maps coordinates of frame b into frame a.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import ArgumentError

UpAxis = Literal["y", "z"]
"""The axis of a file that points up."""
MIRROR = np.diag([1.0, -1.0, 1.0])
"""Right hand to left hand and back, in the wrist frame."""
DIRECTIONS: Final = ("forward", "left", "up")
"""The axes of a room: those of ROS (REP 103), from which the axes of all programs follow."""
ForwardAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
"""The axis of the camera system that points forward."""
FORWARD: Final = get_args(ForwardAxis)
"""Axes of the camera system that may be forward."""
_OPPOSITES: Final = {"backward": "forward", "right": "left"}
# Axes of each program: directions of x, y and z, signs of the axes of an object, and unit of length.
_PROGRAM_AXES: Final = {
    "ros": (("forward", "left", "up"), (1, 1, 1), "m"),
    "openxr": (("right", "up", "backward"), (1, 1, 1), "m"),
    "opengl": (("right", "up", "backward"), (1, 1, 1), "m"),
    "unity": (("right", "up", "forward"), (1, 1, -1), "m"),
    "unreal": (("forward", "right", "up"), (1, -1, 1), "cm"),
}
PROGRAMS: Final = tuple(_PROGRAM_AXES)
"""Names of the programs whose axes are known."""


def file_axes(up: UpAxis) -> Float[np.ndarray, "3 3"]:
    """Rotation of the world to axes with y up (glTF, BVH, OpenXR, OpenSim), about x."""
    return program_axes("openxr", up, forward="y" if up == "z" else "-z").turn


class ProgramAxes(NamedTuple):
    """How a program writes positions and orientations."""

    turn: Float[np.ndarray, "3 3"]
    """Takes positions in our world to its axes; a reflection if the program's axes are left-handed."""
    quaternion: Float[np.ndarray, "4 4"]
    """Takes a wxyz quaternion of a thing in the world to that in the program."""
    unit: str
    """The program's unit of length, m or cm."""

    @property
    def scale(self) -> float:
        """Number of the program's units in a meter."""
        return 100.0 if self.unit == "cm" else 1.0

    def positions(self, positions: Float[np.ndarray, "*batch 3"]) -> NDArray[np.float64]:
        """Positions (..., 3) [m] of the world in the program's axes and unit."""
        return np.asarray(self.scale * positions @ self.turn.T)

    def quaternions(self, quaternions: Float[np.ndarray, "*batch 4"]) -> NDArray[np.float64]:
        """Wxyz quaternions (..., 4) of the world in the program's axes."""
        return np.asarray(quaternions @ self.quaternion.T)


@functools.cache
def program_axes(name: str, up: UpAxis, unit: str = "auto", *, forward: str = "x") -> ProgramAxes:
    """The axes of one of `PROGRAMS` in its own unit or another, from a world with axes up and forward."""
    directions, mirror, own_unit = _PROGRAM_AXES[name]
    room = dict(zip(DIRECTIONS, room_axes(up, forward), strict=True))
    turn = np.array([-room[_OPPOSITES[one]] if one in _OPPOSITES else room[one] for one in directions])
    # Mirroring keeps the component of a rotation's axis along the mirrored direction, and negates the others.
    mirrored = np.diag([1.0, *np.prod(mirror) * np.array(mirror)])
    return ProgramAxes(
        turn, _left_multiplication(turn @ np.diag(mirror)) @ mirrored, own_unit if unit == "auto" else unit
    )


def _left_multiplication(rotation: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """The matrix (4, 4) that rotates a wxyz quaternion by a rotation of the world."""
    w, x, y, z = rotation_quaternions(rotation[None])[0]
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


@functools.cache
def room_axes(up: UpAxis, forward: str = "x") -> Float[np.ndarray, "3 3"]:
    """The directions `DIRECTIONS` of a room in the axes of its camera system, as rows.

    As a matrix they rotate a world in which the axis `up` points up to ours, in which z does.

    Raises:
        ArgumentError: The same axis points up and forward.
    """
    ahead = (-1.0 if forward.startswith("-") else 1.0) * np.eye(3)["xyz".index(forward[-1])]
    upward = np.eye(3)["xyz".index(up)]
    if ahead @ upward:
        level = ", ".join(axis for axis in FORWARD if axis[-1] != up)
        raise ArgumentError(f"forward is {forward} where {up} points up, expected one of {level}")
    return np.stack([ahead, np.cross(upward, ahead), upward])


def facing(up: UpAxis, forward: str) -> Float[np.ndarray, "3 3"]:
    """Rotation about the axis `up`, after which `file_axes` maps the axis `forward` to -z, as in OpenXR."""
    return np.asarray(file_axes(up).T @ program_axes("openxr", up, forward=forward).turn)


def rotated_poses(poses: Float[np.ndarray, "*batch K"], R: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """Rotate the world of poses: positions and orientations (wxyz) change, later numbers and NaN stay."""
    rotated = np.array(poses, dtype=np.float64)
    rotated[..., :3] = poses[..., :3] @ R.T
    rotated[..., 3:7] = poses[..., 3:7] @ _left_multiplication(R).T
    return rotated


def axis_angle_matrix(axis: Float[np.ndarray, "3"], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) about one unit axis by `angle` (...) [rad] (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross))


def cross(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> NDArray[np.float64]:
    """The vector product (3,) of two vectors; numpy's function for arrays takes twenty times as long."""
    (x, y, z), (u, v, w) = first.tolist(), second.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def unit(vectors: Float[np.ndarray, "*batch K"]) -> NDArray[np.float64]:
    """Vectors scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def quaternion_matrix(quaternion: Float[np.ndarray, "*batch 4"]) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of wxyz quaternions, which are normalized first."""
    turn = unit(quaternion)
    w, x, y, z = turn if turn.ndim == 1 else np.moveaxis(turn, -1, 0)  # numbers are quicker than arrays
    matrix = np.empty((*turn.shape[:-1], 3, 3))
    matrix[..., 0, 0], matrix[..., 0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    matrix[..., 0, 2], matrix[..., 1, 0] = 2 * (x * z + w * y), 2 * (x * y + w * z)
    matrix[..., 1, 1], matrix[..., 1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    matrix[..., 2, 0], matrix[..., 2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    matrix[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return matrix


def frame_with_z(
    direction: Float[np.ndarray, "3"], down: Float[np.ndarray, "3"] | None = None
) -> NDArray[np.float64]:
    """A rotation (3, 3) with this direction as z axis, and an x axis perpendicular to `down` if given."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(np.eye(3)[np.abs(z).argmin()] if down is None else down, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def rigid(
    rotation: Float[np.ndarray, "*batch 3 3"], position: Sequence[float] | Float[np.ndarray, "*batch 3"]
) -> NDArray[np.float64]:
    """Transforms (..., 4, 4) of rotations and positions."""
    transform = np.zeros((*rotation.shape[:-2], 4, 4))
    transform[..., :3, :3], transform[..., :3, 3], transform[..., 3, 3] = rotation, position, 1.0
    return transform


def rotation_quaternions(rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Unit wxyz quaternions (T, 4) of rotation matrices."""
    from handsim.kernels import write_matrix_quaternions

    quaternions: NDArray[np.float64] = np.empty((len(rotations), 4))
    matrices = np.ascontiguousarray(rotations, dtype=np.float64)
    if not write_matrix_quaternions(matrices, quaternions):  # some are no rotations: take the nearest ones
        from scipy.spatial.transform import Rotation

        quaternions = Rotation.from_matrix(matrices).as_quat(scalar_first=True)
    return quaternions


def are_rigid(transforms: Float[np.ndarray, "*batch 4 4"]) -> bool:
    """Whether all transforms are rigid to five decimals, and none is a reflection."""
    rotations, last_rows = transforms[..., :3, :3], transforms[..., 3, :]
    square = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max()
    return bool(
        max(square, np.abs(last_rows - np.eye(4)[3]).max()) < 1e-5 and (np.linalg.det(rotations) > 0.0).all()
    )


def pose_matrices(poses: Float[np.ndarray, "T 7"]) -> NDArray[np.float64]:
    """Transforms (T, 4, 4) of positions and wxyz quaternions; NaN where these are NaN."""
    transforms = np.tile(np.eye(4), (len(poses), 1, 1))
    there = np.isfinite(poses[:, 0])
    transforms[there, :3, :3] = quaternion_matrix(poses[there, 3:])
    transforms[:, :3, 3] = poses[:, :3]
    transforms[~there] = np.nan
    return transforms


def transform_poses(transforms: Float[np.ndarray, "T 4 4"]) -> NDArray[np.float64]:
    """Positions and wxyz quaternions (T, 7) of transforms."""
    return np.concatenate([transforms[:, :3, 3], rotation_quaternions(transforms[:, :3, :3])], axis=1)


def vector_quaternions(vectors: Float[np.ndarray, "T 3"]) -> NDArray[np.float64]:
    """Unit wxyz quaternions (T, 4) of rotation vectors [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vectors).as_quat(scalar_first=True))


def euler_matrix(angles: Float[np.ndarray, "*batch 3"]) -> NDArray[np.float64]:
    """Rotations Rz(a0) Ry(a1) Rx(a2) of three angles [rad]: yaw, pitch, roll."""
    yaw, pitch, roll = np.moveaxis(np.asarray(angles), -1, 0)
    x, y, z = np.eye(3)
    return axis_angle_matrix(z, yaw) @ axis_angle_matrix(y, pitch) @ axis_angle_matrix(x, roll)


def euler_axes(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Unit axes, one a row, about which `euler_matrix` turns as each of its angles grows."""
    axes = np.zeros((*angles.shape, 3))
    axes[..., 0, 2] = 1.0
    axes[..., 1, 0], axes[..., 1, 1] = -np.sin(angles[..., 0]), np.cos(angles[..., 0])
    axes[..., 2, :] = euler_matrix(angles)[..., 0]
    return axes


def euler_angles(rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Angles (T, 3) [rad] with which `euler_matrix` makes these rotations: yaw, pitch, roll."""
    flat = np.hypot(rotations[:, 0, 0], rotations[:, 1, 0])
    pitch = np.arctan2(-rotations[:, 2, 0], flat)
    locked = flat < 1e-9
    yaw = np.where(locked, 0.0, np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    free, fixed = rotations[:, 2, 1:], np.stack([-rotations[:, 1, 2], rotations[:, 1, 1]], axis=1)
    sine, cosine = np.where(locked[:, None], fixed, free).T
    return np.stack([yaw, pitch, np.arctan2(sine, cosine)], axis=1)


def body_fixed_angles(rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Angles (T, 3) [rad] about x, y and z of the body, in turn, that make these rotations: Rx Ry Rz."""
    # Rx Ry Rz is the inverse of Rz Ry Rx with the opposite angles.
    return -euler_angles(np.swapaxes(rotations, -1, -2))[:, ::-1]


def random_quaternions(count: int, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Uniform random rotations as wxyz quaternions (count, 4); read as xyzw they are uniform, too."""
    return unit(rng.standard_normal((count, 4)))


def rigid_fit(
    source: Float[np.ndarray, "*batch N 3"], target: Float[np.ndarray, "*batch N 3"]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (..., 3, 3) and translation (..., 3) that best map `source` onto `target` (Kabsch)."""
    source_center, target_center = source.mean(-2, keepdims=True), target.mean(-2, keepdims=True)
    covariance = np.swapaxes(source - source_center, -1, -2) @ (target - target_center)
    u, _, vt = np.linalg.svd(covariance)
    flip = np.ones(covariance.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = np.swapaxes(u * flip[..., None, :] @ vt, -1, -2)
    translation = target_center[..., 0, :] - np.einsum("...ij,...j->...i", rotation, source_center[..., 0, :])
    return rotation, translation
