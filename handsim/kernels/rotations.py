"""Rotations, compiled: axis and angle, quaternions (wxyz, MuJoCo's order) and 3x3 matrices.

Everything is written out in scalars and into arrays of the caller, so that a kernel's inner loop makes no
array.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel


@kernel
def write_quaternion_matrix(matrix: Float[np.ndarray, "_ _"], w: float, x: float, y: float, z: float) -> None:
    """Write the rotation of a unit quaternion to the upper left 3x3 block of a matrix or transform."""
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@kernel
def write_axis_angle_matrix(
    matrix: Float[np.ndarray, "_ _"], axis: Float[np.ndarray, "3"], angle: float
) -> None:
    """Write the rotation matrix about a unit axis by an angle [rad], by way of its quaternion.

    Args:
        matrix: Matrix (3, 3) or transform (4, 4); its upper left 3x3 block is overwritten.
        axis: Unit vector (3,).
    """
    sine, cosine = np.sin(0.5 * angle), np.cos(0.5 * angle)
    write_quaternion_matrix(matrix, cosine, sine * axis[0], sine * axis[1], sine * axis[2])


@kernel
def multiply_rotations(
    first: Float[np.ndarray, "_ _"], second: Float[np.ndarray, "_ _"], product: Float[np.ndarray, "_ _"]
) -> None:
    """Write `first @ second` of two rotations, of which the upper left 3x3 blocks are used.

    Args:
        first: Rotation (3, 3) or transform (4, 4).
        second: Rotation (3, 3) or transform (4, 4); not the same array as `product`.
        product: Where the product goes (3, 3) or (4, 4); may be `first`.
    """
    for i in range(3):
        x, y, z = first[i, 0], first[i, 1], first[i, 2]
        for j in range(3):
            product[i, j] = x * second[0, j] + y * second[1, j] + z * second[2, j]


@kernel
def rotate_about_axis(rotation: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, "3"], angle: float) -> None:
    """Rotate a frame in place about an axis of its own (Rodrigues' formula on its rows).

    Args:
        rotation: Orientation (3, 3) of the frame, overwritten.
        axis: Unit vector (3,) in the frame's own coordinates.
    """
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    for row in range(3):
        a, b, c = rotation[row, 0], rotation[row, 1], rotation[row, 2]
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        rotation[row, 0] = cosine * a + sine * (b * z - c * y) + along * x
        rotation[row, 1] = cosine * b + sine * (c * x - a * z) + along * y
        rotation[row, 2] = cosine * c + sine * (a * y - b * x) + along * z


@kernel
def quaternion_product(
    w: float, x: float, y: float, z: float, e: float, a: float, b: float, c: float
) -> tuple[float, float, float, float]:
    """Product (wxyz) of the quaternions (w, x, y, z) and (e, a, b, c)."""
    return (
        w * e - x * a - y * b - z * c,
        w * a + x * e + y * c - z * b,
        w * b - x * c + y * e + z * a,
        w * c + x * b - y * a + z * e,
    )


@kernel
def rotate_quaternion(
    before: Float[np.ndarray, "4"], vector: Float[np.ndarray, "3"], after: Float[np.ndarray, "4"]
) -> None:
    """Rotate an orientation by a rotation vector in its own frame.

    Args:
        before: Unit quaternion (4,) wxyz.
        vector: Rotation vector (3,) [rad].
        after: Where the new unit quaternion (4,) goes; may be `before`.
    """
    a, b, c = vector[0], vector[1], vector[2]
    angle = np.sqrt(a * a + b * b + c * c)
    share = 0.5 if angle < 1e-8 else np.sin(0.5 * angle) / angle
    after[0], after[1], after[2], after[3] = quaternion_product(
        before[0], before[1], before[2], before[3], np.cos(0.5 * angle), share * a, share * b, share * c
    )
    scale = 1.0 / np.sqrt(after[0] ** 2 + after[1] ** 2 + after[2] ** 2 + after[3] ** 2)
    for n in range(4):
        after[n] *= scale


@kernel
def horn_matrix(products: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """Horn's matrix (4, 4) of a sum of outer products: its last eigenvector is the best rotation."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = products
    return np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )


@kernel
def align_rigid(
    source: Float[np.ndarray, "N 3"],
    target: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, "N"],
    pose: Float[np.ndarray, "7"],
) -> float:
    """`handsim.space.transforms.rigid_fit` for kernels: weighted, and some points may be missing.

    Horn, Closed-form solution of absolute orientation using unit quaternions (1987).

    Args:
        source: Points in the body's frame [m].
        target: The same points in the world [m]; NaN where missing.
        weights: Weight of each pair.
        pose: Position [m] and orientation (wxyz) of the body in the world; the first seven numbers
            are filled.

    Returns:
        The weighted sum of squared distances that is left.
    """
    total, size = 0.0, 0.0
    centers, products = np.zeros((2, 3)), np.zeros((3, 3))
    for point in range(len(source)):
        if not np.isnan(target[point, 0]):
            total += weights[point]
            centers[0] += weights[point] * source[point]
            centers[1] += weights[point] * target[point]
    centers /= total
    for point in range(len(source)):
        if np.isnan(target[point, 0]):
            continue
        for i in range(3):
            a = source[point, i] - centers[0, i]
            size += weights[point] * (a * a + (target[point, i] - centers[1, i]) ** 2)
            for j in range(3):
                products[i, j] += weights[point] * a * (target[point, j] - centers[1, j])
    values, vectors = np.linalg.eigh(horn_matrix(products))
    rotation = np.empty((3, 3))
    pose[3:7] = vectors[:, 3]
    write_quaternion_matrix(rotation, pose[3], pose[4], pose[5], pose[6])
    for i in range(3):
        pose[i] = centers[1, i]
        for j in range(3):
            pose[i] -= rotation[i, j] * centers[0, j]
    return size - 2.0 * values[3]  # type: ignore[no-any-return]
