"""A hand's shape as a short vector around a first guess, what people differ by, and how points follow.

Everything is a right hand's. Lengths and breadth scale the whole hand; bones, knuckles, directions of the
digits, girths and the palm's thickness vary on top, as `handsim.hand.shape.sample_shape` has it.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np

from handsim.hand.model import HandModel
from handsim.hand.shape import ADULTS, HandShape
from handsim.hand.skeleton import build_skeleton
from handsim.hand.topology import DIGITS, NUM_BONES

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from numpy.typing import NDArray

LENGTH, BREADTH = 0, 1
BONE_LENGTHS: Final = slice(2, 17)
KNUCKLES: Final = slice(17, 32)
DIRECTIONS: Final = slice(32, 47)
GIRTHS: Final = slice(47, 52)
THICKNESS: Final = 52
NUM_PARAMETERS: Final = 53
# Standard deviations. The nearest of five sizes may be a size off and more; length and breadth go together
# (ANSUR II). Real knuckles are taken to vary twice as much as the simulated population's.
_SIZE_SPREAD: Final = 0.09
_SIZE_CORRELATION: Final = 0.6
_KNUCKLE_SPREAD: Final = 2.0 * ADULTS.knuckle_spread
_STEP: Final = 1e-5


def shape_at(start: HandShape, parameters: Float[np.ndarray, "53"]) -> HandShape:
    """The hand of these parameters, which are zero for `start`."""
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
    """Inverse covariance of the parameters among people."""
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


def slopes_of(
    start: HandShape,
    parameters: Float[np.ndarray, "53"],
    function: Callable[[HandShape], NDArray[np.float64]],
) -> Float[np.ndarray, "*shape 53"]:
    """Derivative of whatever a shape decides by the parameters, by finite differences."""
    here = function(shape_at(start, parameters))
    columns = []
    for number in range(NUM_PARAMETERS):
        nudged = parameters.copy()
        nudged[number] += _STEP
        columns.append((function(shape_at(start, nudged)) - here) / _STEP)
    return np.stack(columns, axis=-1)


def skeleton_numbers(shape: HandShape) -> Float[np.ndarray, "45"]:
    """What of a shape the skeleton knows: bone lengths, knuckles, directions."""
    return np.concatenate([shape.bone_lengths.ravel(), shape.knuckles.ravel(), shape.base_angles.ravel()])


def skinned_shape_slopes(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
) -> Float[np.ndarray, "T M 3 45"]:
    """Derivative of skinned points by `skeleton_numbers`, the rest points and the poses held.

    A longer bone carries all beyond it outwards, in the pose and at rest alike; what is seen is the
    difference, as the rest transform is undone first.

    Args:
        model: A right hand.
        T_world_bone: Its bones.
        points: Rest positions [m].
        weights: Shares of all bones.
    """
    rest = model.rest_transforms
    slopes = np.zeros((len(T_world_bone), len(points), 3, 45))
    _fill_slopes(
        np.ascontiguousarray(T_world_bone), rest, points, weights, _turning_axes(model.shape), slopes
    )
    return slopes


def _turning_axes(shape: HandShape) -> Float[np.ndarray, "5 3 3"]:
    """Axes (the last index) in the palm about which a digit turns when each of its base angles grows."""
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


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _fill_slopes(bones: Any, rest: Any, points: Any, weights: Any, axes: Any, slopes: Any) -> None:
    turn = np.empty((3, 3))
    for frame in range(len(bones)):
        for bone in range(1, NUM_BONES):
            own = bones[frame, bone]
            for i in range(3):
                for j in range(3):
                    turn[i, j] = 0.0
                    for k in range(3):
                        turn[i, j] += own[i, k] * rest[bone, j, k]
            for point in range(len(points)):
                share = weights[point, bone]
                if share != 0.0:
                    _add_share(
                        slopes[frame, point], bone, share, points[point], bones[frame], rest, turn, axes
                    )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _add_share(
    row: Any, bone: Any, share: Any, point: Any, bones: Any, rest: Any, turn: Any, axes: Any
) -> None:
    """What one bone's share adds to a point's slopes; `turn` is how it is turned from rest."""
    digit, place, first = (bone - 1) // 3, (bone - 1) % 3, bone - (bone - 1) % 3
    carried, arm = np.empty(3), np.empty(3)
    for i in range(3):
        carried[i] = bones[bone, i, 3] - bones[first, i, 3]
        arm[i] = point[i] - rest[first, i, 3]
        for j in range(3):
            carried[i] += turn[i, j] * (point[j] - rest[bone, j, 3])
    for segment in range(place):  # the bones before this one
        other = first + segment
        for i in range(3):
            moved = bones[other, i, 0]
            for j in range(3):
                moved -= turn[i, j] * rest[other, j, 0]
            row[i, 3 * digit + segment] += share * moved
    for axis in range(3):
        for i in range(3):
            row[i, 15 + 3 * digit + axis] += share * (bones[0, i, axis] - turn[i, axis])
        _add_turn(row, 30 + 3 * digit + axis, share, bones[0], turn, axes[digit, axis], carried, arm)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _add_turn(
    row: Any, column: Any, share: Any, wrist: Any, turn: Any, axis: Any, carried: Any, arm: Any
) -> None:
    """A digit's new direction turns the posed point about the knuckle; the rest transform turns it back."""
    x = wrist[0, 0] * axis[0] + wrist[0, 1] * axis[1] + wrist[0, 2] * axis[2]
    y = wrist[1, 0] * axis[0] + wrist[1, 1] * axis[1] + wrist[1, 2] * axis[2]
    z = wrist[2, 0] * axis[0] + wrist[2, 1] * axis[1] + wrist[2, 2] * axis[2]
    a = axis[1] * arm[2] - axis[2] * arm[1]
    b = axis[2] * arm[0] - axis[0] * arm[2]
    c = axis[0] * arm[1] - axis[1] * arm[0]
    row[0, column] += share * (
        y * carried[2] - z * carried[1] - turn[0, 0] * a - turn[0, 1] * b - turn[0, 2] * c
    )
    row[1, column] += share * (
        z * carried[0] - x * carried[2] - turn[1, 0] * a - turn[1, 1] * b - turn[1, 2] * c
    )
    row[2, column] += share * (
        x * carried[1] - y * carried[0] - turn[2, 0] * a - turn[2, 1] * b - turn[2, 2] * c
    )


def skinned(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
) -> tuple[Float[np.ndarray, "T M 3 3"], Float[np.ndarray, "T M L 3"]]:
    """How each rest point is turned as a whole, and where each bone alone would carry it [m]."""
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    turns = np.einsum("ml,tlij->tmij", weights, motion[..., :3], optimize=True)
    carried = np.einsum("tlij,mj->tmli", motion[..., :3], points, optimize=True)
    carried += motion[:, None, ..., 3]
    return turns, carried
