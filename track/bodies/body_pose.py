"""Poses of rigid bodies as seven numbers: matrices, markers and velocities (numba kernels).

A pose is position [m] and orientation (wxyz) of the body's frame in the world.
Arrays of floats are contiguous float64, arrays of integers int64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import quaternion_product, write_quaternion_matrix


@kernel
def write_transform(pose: NDArray[np.float64], transform: NDArray[np.float64]) -> None:
    """Write a pose (7,) as a matrix (4, 4), whose last row is left as it is."""
    write_quaternion_matrix(transform, pose[3], pose[4], pose[5], pose[6])
    transform[0, 3], transform[1, 3], transform[2, 3] = pose[0], pose[1], pose[2]


@kernel
def transform_markers(positions: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Markers in the world (Q, 3) [m].

    Args:
        positions: Markers in the body's frame (Q, 3) [m].
        pose: Pose of the body (7,).
    """
    transform, moved = np.empty((4, 4)), np.empty_like(positions)
    write_transform(pose, transform)
    for marker in range(len(positions)):
        for i in range(3):
            moved[marker, i] = transform[i, 3]
            for j in range(3):
                moved[marker, i] += transform[i, j] * positions[marker, j]
    return moved


@kernel
def predict_pose(
    pose: NDArray[np.float64], velocity: NDArray[np.float64], seconds: float
) -> NDArray[np.float64]:
    """The pose (7,) after some time at constant velocity.

    Args:
        pose: Pose now (7,).
        velocity: Linear [m/s] and angular [rad/s] velocity in world axes (6,).
        seconds: Time [s].
    """
    later = pose.copy()
    later[:3] += seconds * velocity[:3]
    half = 0.5 * seconds * velocity[3:]
    angle = np.sqrt((half**2).sum())
    if angle > 1e-12:
        sine, cosine = np.sin(angle) / angle, np.cos(angle)
        later[3], later[4], later[5], later[6] = quaternion_product(
            cosine, sine * half[0], sine * half[1], sine * half[2], pose[3], pose[4], pose[5], pose[6]
        )
    return later


@kernel
def velocity_between(
    first: NDArray[np.float64], second: NDArray[np.float64], seconds: float
) -> NDArray[np.float64]:
    """The velocity (6,) with which `predict_pose` goes from the first pose (7,) to the second."""
    velocity = np.empty(6)
    velocity[:3] = (second[:3] - first[:3]) / seconds
    rotation = np.empty(4)
    rotation[0], rotation[1], rotation[2], rotation[3] = quaternion_product(
        second[3], second[4], second[5], second[6], first[3], -first[4], -first[5], -first[6]
    )
    if rotation[0] < 0.0:  # the same rotation by the shorter way
        rotation = -rotation
    sine = np.sqrt((rotation[1:] ** 2).sum())
    velocity[3:] = rotation[1:] * (
        2.0 / seconds if sine < 1e-12 else 2.0 * np.arctan2(sine, rotation[0]) / sine / seconds
    )
    return velocity


@kernel
def squared_distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Squared distance of two points (3,) [m^2]."""
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    squared: float = x * x + y * y + z * z
    return squared
