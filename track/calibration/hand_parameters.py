"""A hand's shape as 53 parameters around an initial shape: their prior, and jacobians of skinned points.

All shapes are of right hands. Length and breadth scale the whole hand; bone lengths, knuckles, directions of
the digits, girths and the palm's thickness vary in addition, as in `handsim.hand.shape.sample_shape`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel, build_skeleton
from handsim.hand.shape import ADULTS, DIGITS, NUM_BONES, HandShape
from handsim.kernels.kernel import kernel

LENGTH, BREADTH = 0, 1  # log factors
BONE_LENGTHS: Final = slice(2, 17)  # log factors, three per digit
KNUCKLES: Final = slice(17, 32)  # [m], three per digit
DIRECTIONS: Final = slice(32, 47)  # base angles [rad], three per digit
GIRTHS: Final = slice(47, 52)  # log factors, one per digit
THICKNESS: Final = 52  # log factor
NUM_PARAMETERS: Final = 53
# Standard deviations. The nearest of five sizes may be a size off and more; length and breadth are correlated
# (ANSUR II). Real knuckles are assumed to vary twice as much as the simulated population's.
_SIZE_SPREAD: Final = 0.09
_SIZE_CORRELATION: Final = 0.6
_KNUCKLE_SPREAD: Final = 2.0 * ADULTS.knuckle_spread
_STEP: Final = 1e-5  # of finite differences


def shape_at(start: HandShape, parameters: Float[np.ndarray, "53"]) -> HandShape:
    """The shape of these parameters; zeros give `start`."""
    along, across = np.exp(parameters[LENGTH]), np.exp(parameters[BREADTH])
    return dataclasses.replace(
        start,
        length=float(start.length * along),
        breadth=float(start.breadth * across),
        bone_lengths=start.bone_lengths * along * np.exp(parameters[BONE_LENGTHS].reshape(5, 3)),
        knuckles=start.knuckles * [along, across, across] + parameters[KNUCKLES].reshape(5, 3),
        base_angles=start.base_angles + parameters[DIRECTIONS].reshape(5, 3),
        radii=start.radii * across * np.exp(parameters[GIRTHS])[:, None],
        palm_thickness=float(start.palm_thickness * across * np.exp(parameters[THICKNESS])),
    )


def shape_precision() -> Float[np.ndarray, "53 53"]:
    """Information matrix of the prior: inverse covariance of the parameters among people."""
    covariance = np.zeros((NUM_PARAMETERS, NUM_PARAMETERS))
    covariance[:2, :2] = _SIZE_SPREAD**2 * np.array([[1.0, _SIZE_CORRELATION], [_SIZE_CORRELATION, 1.0]])
    a_digit = np.kron(np.eye(len(DIGITS)), np.ones((3, 3)))
    covariance[BONE_LENGTHS, BONE_LENGTHS] = ADULTS.bone_spread**2 * np.eye(15)
    covariance[BONE_LENGTHS, BONE_LENGTHS] += ADULTS.digit_spread**2 * a_digit
    covariance[KNUCKLES, KNUCKLES] = _KNUCKLE_SPREAD**2 * np.eye(15)
    angles = np.deg2rad(ADULTS.angle_spread) * np.repeat([3.0, 1.0, 1.0, 1.0, 1.0], 3)
    covariance[DIRECTIONS, DIRECTIONS] = np.diag(angles**2)
    covariance[GIRTHS, GIRTHS] = ADULTS.girth_spread**2 * np.eye(5)
    covariance[THICKNESS, THICKNESS] = ADULTS.girth_spread**2
    return np.linalg.inv(covariance)


def shape_jacobian(
    start: HandShape,
    parameters: Float[np.ndarray, "53"],
    function: Callable[[list[HandShape]], Float[np.ndarray, "B *shape"]],
) -> Float[np.ndarray, "*shape 53"]:
    """Derivative of a function of the shape by the parameters, by finite differences.

    Args:
        start: Shape of zero parameters.
        parameters: Where to differentiate.
        function: Arrays that depend on shapes, one for each.
    """
    nudged = parameters + _STEP * np.eye(1 + NUM_PARAMETERS, NUM_PARAMETERS, -1)  # the first as it is
    values = function([shape_at(start, one) for one in nudged])
    return np.moveaxis((values[1:] - values[0]) / _STEP, 0, -1)


def skeleton_jacobian(start: HandShape, parameters: Float[np.ndarray, "53"]) -> Float[np.ndarray, "45 53"]:
    """Derivative of what determines a skeleton by the parameters, zero of which are the shape `start`.

    That is, in this order: bone lengths [m], knuckles [m] and base angles [rad], digit by digit.
    """
    along, across = np.exp(parameters[LENGTH]), np.exp(parameters[BREADTH])
    lengths = start.bone_lengths.ravel() * along * np.exp(parameters[BONE_LENGTHS])
    knuckles = start.knuckles * [along, across, across]
    jacobian = np.zeros((45, NUM_PARAMETERS))
    jacobian[:15, LENGTH], jacobian[:15, BONE_LENGTHS] = lengths, np.diag(lengths)
    jacobian[15:30:3, LENGTH] = knuckles[:, 0]
    jacobian[16:30:3, BREADTH], jacobian[17:30:3, BREADTH] = knuckles[:, 1], knuckles[:, 2]
    jacobian[15:30, KNUCKLES] = jacobian[30:, DIRECTIONS] = np.eye(15)
    return jacobian


def skinned_shape_jacobian(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
) -> Float[np.ndarray, "T M 3 45"]:
    """Derivative of skinned points by the skeleton (`skeleton_jacobian`), rest points and poses held fixed.

    A longer bone moves all bones beyond it, in the pose and at rest. Skinning undoes the rest transform, so
    the derivative is the difference of the two. The model is a right hand, rest points are in the wrist's
    frame [m].
    """
    rest = model.rest_transforms
    jacobian = np.zeros((len(T_world_bone), len(points), 3, 45))
    _fill_jacobian(
        np.ascontiguousarray(T_world_bone), rest, points, weights, _base_angle_axes(model.shape), jacobian
    )
    return jacobian


def _base_angle_axes(shape: HandShape) -> Float[np.ndarray, "5 3 3"]:
    """Axes (the last index) in the palm about which a digit rotates when one of its base angles grows."""
    here = build_skeleton(shape).rotations[1::3]
    axes = np.empty((5, 3, 3))
    for angle in range(3):
        nudged = shape.base_angles.copy()
        nudged[:, angle] += 1e-6
        there = build_skeleton(dataclasses.replace(shape, base_angles=nudged)).rotations[1::3]
        spin = np.einsum("dij,dkj->dik", there - here, here) / 1e-6
        axes[:, angle] = np.stack(
            [spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1]],
            axis=1,
        )
    return 0.5 * axes


@kernel
def _fill_jacobian(
    bones: NDArray[np.float64],
    rest: NDArray[np.float64],
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
    axes: NDArray[np.float64],
    jacobian: NDArray[np.float64],
) -> None:
    """Kernel of `skinned_shape_jacobian`; axes are those of the base angles in the palm (5, 3, 3)."""
    rotation = np.empty((3, 3))
    for frame in range(len(bones)):
        for bone in range(1, NUM_BONES):
            own = bones[frame, bone]
            for i in range(3):
                for j in range(3):
                    rotation[i, j] = 0.0
                    for k in range(3):
                        rotation[i, j] += own[i, k] * rest[bone, j, k]
            for point in range(len(points)):
                share = weights[point, bone]
                if share != 0.0:
                    _add_bone(
                        jacobian[frame, point], bone, share, points[point], bones[frame], rest, rotation, axes
                    )


@kernel
def _add_bone(
    row: NDArray[np.float64],
    bone: int,
    share: float,
    point: NDArray[np.float64],
    bones: NDArray[np.float64],
    rest: NDArray[np.float64],
    rotation: NDArray[np.float64],
    axes: NDArray[np.float64],
) -> None:
    """Add one bone's share of a point's jacobian (3, 45); the arguments are those of `_fill_jacobian`."""
    digit, index, first = (bone - 1) // 3, (bone - 1) % 3, bone - (bone - 1) % 3
    carried, arm = np.empty(3), np.empty(3)
    for i in range(3):
        carried[i] = bones[bone, i, 3] - bones[first, i, 3]
        arm[i] = point[i] - rest[first, i, 3]
        for j in range(3):
            carried[i] += rotation[i, j] * (point[j] - rest[bone, j, 3])
    for segment in range(index):  # the bones before this one
        other = first + segment
        for i in range(3):
            moved = bones[other, i, 0]
            for j in range(3):
                moved -= rotation[i, j] * rest[other, j, 0]
            row[i, 3 * digit + segment] += share * moved
    for axis in range(3):
        for i in range(3):
            row[i, 15 + 3 * digit + axis] += share * (bones[0, i, axis] - rotation[i, axis])
        _add_rotation(row, 30 + 3 * digit + axis, share, bones[0], rotation, axes[digit, axis], carried, arm)


@kernel
def _add_rotation(
    row: NDArray[np.float64],
    column: int,
    share: float,
    wrist: NDArray[np.float64],
    rotation: NDArray[np.float64],
    axis: NDArray[np.float64],
    carried: NDArray[np.float64],
    arm: NDArray[np.float64],
) -> None:
    """Add the derivative by one base angle: a rotation of the digit about its knuckle, posed minus at rest.

    `carried` is the posed point minus the knuckle, in the world, `arm` the same at rest, in the wrist's
    frame.
    """
    x = wrist[0, 0] * axis[0] + wrist[0, 1] * axis[1] + wrist[0, 2] * axis[2]
    y = wrist[1, 0] * axis[0] + wrist[1, 1] * axis[1] + wrist[1, 2] * axis[2]
    z = wrist[2, 0] * axis[0] + wrist[2, 1] * axis[1] + wrist[2, 2] * axis[2]
    a = axis[1] * arm[2] - axis[2] * arm[1]
    b = axis[2] * arm[0] - axis[0] * arm[2]
    c = axis[0] * arm[1] - axis[1] * arm[0]
    row[0, column] += share * (
        y * carried[2] - z * carried[1] - rotation[0, 0] * a - rotation[0, 1] * b - rotation[0, 2] * c
    )
    row[1, column] += share * (
        z * carried[0] - x * carried[2] - rotation[1, 0] * a - rotation[1, 1] * b - rotation[1, 2] * c
    )
    row[2, column] += share * (
        x * carried[1] - y * carried[0] - rotation[2, 0] * a - rotation[2, 1] * b - rotation[2, 2] * c
    )


def skinning_terms(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
) -> tuple[Float[np.ndarray, "T M 3 3"], Float[np.ndarray, "T M L 3"]]:
    """Terms of linear blend skinning of a right hand, with rest points in the wrist's frame [m].

    Returns:
        Derivative of each skinned point by its rest position (the blended rotation), and the position that
        each bone alone would give it [m].
    """
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    rotations = np.einsum("ml,tlij->tmij", weights, motion[..., :3], optimize=True)
    by_bone = np.einsum("tlij,mj->tmli", motion[..., :3], points, optimize=True)
    by_bone += motion[:, None, ..., 3]
    return rotations, by_bone
