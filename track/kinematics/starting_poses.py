"""Initial poses of a fit without an earlier pose: a hand put together from a few shapes, digit by digit."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.model import join_qpos
from handsim.hand.shape import NUM_QPOS
from handsim.kernels.kernel import kernel
from handsim.kernels.rotations import align_rigid, write_quaternion_matrix

RESTING: Final = np.tile(np.deg2rad([0.0, 25.0, 35.0, 20.0]), 5)
"""Hinge angles of a relaxed hand [rad]."""
# Six ways to hold a digit [deg], in the order of its hinges: relaxed, straight, half closed, bent in the
# knuckle alone, bent in all others, closed; for the thumb relaxed, away from the palm, beside the index
# finger, opposed, opposed and bent, across the palm.
_FINGER: Final = (
    (0, 25, 35, 20),
    (0, 0, 5, 5),
    (0, 45, 60, 35),
    (0, 75, 10, 10),
    (0, 10, 95, 55),
    (0, 80, 100, 55),
)
_THUMB: Final = (
    (0, 25, 35, 20),
    (25, -25, 0, 0),
    (-20, -20, 10, 10),
    (25, 20, 10, 10),
    (20, 25, 45, 60),
    (-20, 35, 50, 40),
)
_ROUNDS: Final = 3  # of choosing digits and aligning again; the choice is settled after these
_STEADY: Final = 0.005  # [m] spread of a marker that is the same in all shapes: bounds its weight


class StartingShapes(NamedTuple):
    """K hand shapes with the wrist at the origin, and the positions of their markers."""

    angles: Float[np.ndarray, "K 20"]
    """Hinge angles [rad]."""
    markers: Float[np.ndarray, "K M 3"]
    """Markers in the wrist's frame [m]."""
    weights: Float[np.ndarray, "M"]
    """Weight of each marker where a whole hand is aligned [1/m^2]: small if it differs between the shapes."""


def starting_shapes(fit: GloveFit) -> StartingShapes:
    """The shapes that a fit of this hand in its glove may start from."""
    angles = np.deg2rad([[*thumb, *finger * 4] for thumb, finger in zip(_THUMB, _FINGER, strict=True)])
    markers = fit.markers(join_qpos(angles))[0]
    return StartingShapes(angles, markers, 1.0 / (_STEADY**2 + markers.var(axis=0).sum(axis=1)))


@kernel
def initial_poses(
    shapes: StartingShapes, digits: Int[np.ndarray, "M"], target: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "S 27"]:
    """Poses to start from (K + 1, 27) for the markers of one frame, the most likely one first.

    The first takes every digit from the shape that has it nearest; the others are whole shapes, the best
    aligned with the markers first.
    """
    count = len(shapes.angles)
    aligned, poses = np.empty((count, NUM_QPOS)), np.empty((count + 1, NUM_QPOS))
    squares = np.empty(count)
    for number in range(count):
        aligned[number, 7:] = shapes.angles[number]
        squares[number] = align_rigid(shapes.markers[number], target, shapes.weights, aligned[number])
    for number in range(count):
        better = 0
        for other in range(count):
            if squares[other] < squares[number] or (squares[other] == squares[number] and other < number):
                better += 1
        poses[1 + better] = aligned[number]
    markers = np.empty_like(target)
    poses[0] = poses[1]
    for _ in range(_ROUNDS):
        _choose_digits(shapes, digits, target, poses[0], markers)
        align_rigid(markers, target, shapes.weights, poses[0])
    return poses


@kernel
def _choose_digits(
    shapes: StartingShapes,
    digits: Int[np.ndarray, "M"],
    target: Float[np.ndarray, "M 3"],
    pose: Float[np.ndarray, "27"],
    markers: Float[np.ndarray, "M 3"],
) -> None:
    """Take each digit from the shape whose markers are nearest, the wrist held."""
    rotation = np.empty((3, 3))
    write_quaternion_matrix(rotation, pose[3], pose[4], pose[5], pose[6])
    squares = np.zeros((5, len(shapes.angles)))
    for marker in range(len(target)):
        if digits[marker] < 0 or np.isnan(target[marker, 0]):
            continue
        for i in range(3):
            local = 0.0
            for j in range(3):
                local += rotation[j, i] * (target[marker, j] - pose[j])
            for number in range(len(shapes.angles)):
                squares[digits[marker], number] += (shapes.markers[number, marker, i] - local) ** 2
    for digit in range(5):
        nearest = squares[digit].argmin()
        pose[7 + 4 * digit : 11 + 4 * digit] = shapes.angles[nearest, 4 * digit : 4 * digit + 4]
        for marker in range(len(target)):
            if digits[marker] == digit:
                markers[marker] = shapes.markers[nearest, marker]
    for marker in range(len(target)):
        if digits[marker] < 0:
            markers[marker] = shapes.markers[0, marker]
