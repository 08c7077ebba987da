"""Compiled forward kinematics of a hand's markers, their Jacobian and their normal equations.

All kernels work in the wrist's frame: the target markers are transformed into it, so a fit does not depend on
where the hand is. The 26 unknowns of a step are the 20 hinge angles [rad], then the translation of the wrist
[m] and its rotation vector [rad], both along the wrist's own axes. The hinges come first because the Cholesky
factor of the normal matrix then keeps its zeros between digits.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.shape import BONES, NUM_BONES, NUM_JOINTS
from handsim.kernels.kernel import kernel

NUM_UNKNOWNS: Final = NUM_JOINTS + 6
"""Unknowns of a step: 20 hinges, 3 translations and 3 rotations of the wrist."""
_TRANSLATION: Final = NUM_JOINTS  # index of the first unknown of the wrist's translation
_ROTATION: Final = NUM_JOINTS + 3  # index of the first unknown of its rotation


class HandArrays(NamedTuple):
    """A hand and its glove as plain arrays: L bones, J = 20 hinges, M markers."""

    offsets: Float[np.ndarray, "L 3"]
    """Origin of each bone in its parent's frame [m]."""
    rotations: Float[np.ndarray, "L 3 3"]
    """Rotation of each bone in its parent's frame, all hinges at zero."""
    axes: Float[np.ndarray, "J 3"]
    """Unit axis of each hinge in the frame of its bone."""
    ranges: Float[np.ndarray, "J 2"]
    """Lower and upper limit of each hinge [rad]."""
    bones: Int[np.ndarray, "M 4"]
    """The bones that carry each marker, largest weight first; -1 where there is no further one."""
    bone_weights: Float[np.ndarray, "M 4"]
    """Skinning weight of each of these bones; they sum to one."""
    positions: Float[np.ndarray, "M 4 3"]
    """Position of each marker in the frames of its bones [m], times the bone's weight."""
    digits: Int[np.ndarray, "M"]
    """Digit of the bone with the largest weight; -1 for the palm."""
    hinge_span: Int[np.ndarray, "M 2"]
    """First hinge that may move each marker, and the one after the last."""
    skyline: Int[np.ndarray, "26"]
    """Column of the first entry of each row of the normal matrix that can differ from zero."""


class Workspace(NamedTuple):
    """Buffers for one pose: bones and markers in the wrist's frame, and the equations of its next step."""

    rotations: Float[np.ndarray, "L 3 3"]
    """Rotation of each bone."""
    origins: Float[np.ndarray, "L 3"]
    """Origin of each bone [m]."""
    axes: Float[np.ndarray, "J 3"]
    """Unit axis of each hinge."""
    bone_terms: Float[np.ndarray, "M 4 3"]
    """Each bone's term of the weighted sum that is a marker's position [m]."""
    markers: Float[np.ndarray, "M 3"]
    """Position of each marker [m]."""
    residuals: Float[np.ndarray, "M 3"]
    """Model marker minus target marker [m]; NaN where the target is missing."""
    jacobian: Float[np.ndarray, "M 3 26"]
    """Derivatives of the markers by the unknowns [m/rad, m/m]."""
    normal: Float[np.ndarray, "26 26"]
    """Normal matrix, upper triangle; zero between digits that share no marker."""
    gradient: Float[np.ndarray, "26"]
    """Half the gradient of the cost."""
    factor: Float[np.ndarray, "26 26"]
    """Room for a factor of the normal matrix."""
    step: Float[np.ndarray, "26"]
    """Step of the unknowns [rad, m]."""


def hand_arrays(fit: GloveFit) -> HandArrays:
    """The arrays of a hand and its glove, in the layout's order of markers."""
    model, attachment = fit.model, fit.attachment
    skeleton = model.skeleton
    inverse = np.linalg.inv(model.rest_transforms)[attachment.bone_indices]
    local = np.einsum("mkij,mj->mki", inverse[..., :3, :3], attachment.points) + inverse[..., :3, 3]
    order = np.argsort(-attachment.bone_weights, axis=1, kind="stable")
    bones, bone_weights = (
        np.take_along_axis(values, order, axis=1)
        for values in (attachment.bone_indices, attachment.bone_weights)
    )
    positions = np.take_along_axis(local, order[..., None], axis=1) * bone_weights[..., None]
    digits = np.array([bone.digit for bone in BONES])
    carriers = np.where(bone_weights > 0.0, digits[bones], -1)
    hinge_span = np.zeros((len(bones), 2), dtype=np.int64)
    skyline = np.zeros(NUM_UNKNOWNS, dtype=np.int64)
    skyline[:NUM_JOINTS] = np.arange(NUM_JOINTS) // 4 * 4
    for marker, row in enumerate(carriers):
        moving = row[row >= 0]
        if len(moving):
            first, last = 4 * moving.min(), 4 * moving.max() + 4
            hinge_span[marker] = first, last
            skyline[first:last] = np.minimum(skyline[first:last], first)
    return HandArrays(
        np.array(skeleton.offsets, order="C"),
        np.array(skeleton.rotations, order="C"),
        np.array(skeleton.axes, order="C"),
        np.array(skeleton.ranges, order="C"),
        np.where(bone_weights > 0.0, bones, -1),
        bone_weights,
        np.array(positions, order="C"),
        digits[bones[:, 0]],
        hinge_span,
        skyline,
    )


@kernel
def workspace(num_markers: int) -> Workspace:
    """A `Workspace` for a hand with some number of markers; what never changes in it is filled in."""
    rotations, jacobian = np.zeros((NUM_BONES, 3, 3)), np.zeros((num_markers, 3, NUM_UNKNOWNS))
    for i in range(3):
        rotations[0, i, i] = 1.0
        jacobian[:, i, _TRANSLATION + i] = 1.0
    return Workspace(
        rotations,
        np.zeros((NUM_BONES, 3)),
        np.empty((NUM_JOINTS, 3)),
        np.zeros((num_markers, 4, 3)),
        np.empty((num_markers, 3)),
        np.empty((num_markers, 3)),
        jacobian,
        np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS)),
        np.empty(NUM_UNKNOWNS),
        np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS)),
        np.empty(NUM_UNKNOWNS),
    )


@kernel
def compute_markers(hand: HandArrays, angles: Float[np.ndarray, "20"], work: Workspace) -> None:
    """Forward kinematics of all bones, hinge axes and markers, in the wrist's frame.

    Args:
        work: Its `rotations`, `origins`, `axes`, `bone_terms` and `markers` are filled.
    """
    for digit in range(NUM_JOINTS // 4):
        compute_digit(hand, digit, angles[4 * digit : 4 * digit + 4], work)
    for marker in range(len(hand.bones)):
        compute_marker(hand, marker, work)


@kernel
def compute_digit(hand: HandArrays, digit: int, angles: Float[np.ndarray, "4"], work: Workspace) -> None:
    """Forward kinematics of the bones and hinge axes of one digit, in the wrist's frame.

    Args:
        digit: Index of the digit, 0 for the thumb.
        work: The digit's rows of `rotations`, `origins` and `axes` are filled.
    """
    for link in range(3):
        bone = 1 + 3 * digit + link
        parent = bone - 1 if link > 0 else 0
        parent_rotation, own = work.rotations[parent], work.rotations[bone]
        for i in range(3):
            work.origins[bone, i] = work.origins[parent, i]
            for j in range(3):
                work.origins[bone, i] += parent_rotation[i, j] * hand.offsets[bone, j]
                own[i, j] = 0.0
                for k in range(3):
                    own[i, j] += parent_rotation[i, k] * hand.rotations[bone, k, j]
        for number in range(link + 1 if link > 0 else 0, link + 2):
            hinge = 4 * digit + number
            _rotate_bone(own, hand.axes[hinge], angles[number], work.axes[hinge])


@kernel
def compute_marker(hand: HandArrays, marker: int, work: Workspace) -> None:
    """Position of one marker in the wrist's frame [m].

    Args:
        work: Its bones must be computed; the marker's rows of `bone_terms` and `markers` are filled.
    """
    work.markers[marker] = 0.0
    for slot in range(4):
        bone = hand.bones[marker, slot]
        if bone < 0:
            break
        own, position = work.rotations[bone], hand.positions[marker, slot]
        for i in range(3):
            term = hand.bone_weights[marker, slot] * work.origins[bone, i]
            term += own[i, 0] * position[0] + own[i, 1] * position[1] + own[i, 2] * position[2]
            work.bone_terms[marker, slot, i] = term
            work.markers[marker, i] += term


@kernel
def _rotate_bone(
    own: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, "3"], angle: float, outside: Float[np.ndarray, "3"]
) -> None:
    """Rotate a bone about its own unit axis (Rodrigues); `outside` gets the axis in the wrist's frame."""
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    for i in range(3):
        a, b, c = own[i, 0], own[i, 1], own[i, 2]
        along = a * x + b * y + c * z
        outside[i] = along
        along *= 1.0 - cosine
        own[i, 0] = a * cosine + along * x + (b * z - c * y) * sine
        own[i, 1] = b * cosine + along * y + (c * x - a * z) * sine
        own[i, 2] = c * cosine + along * z + (a * y - b * x) * sine


@kernel
def marker_jacobian(hand: HandArrays, marker: int, work: Workspace) -> None:
    """Derivatives of one marker by all unknowns, in the wrist's frame.

    Args:
        work: Its bones and the marker must be computed; the marker's block of `jacobian` is filled.
    """
    jacobian = work.jacobian[marker]
    for digit in range(hand.hinge_span[marker, 0] // 4, hand.hinge_span[marker, 1] // 4):
        x, y, z, share = 0.0, 0.0, 0.0, 0.0
        for link in range(2, -1, -1):  # a hinge moves what is attached to its own bone and to those beyond
            bone = 1 + 3 * digit + link
            for slot in range(4):
                if hand.bones[marker, slot] == bone:
                    x += work.bone_terms[marker, slot, 0]
                    y += work.bone_terms[marker, slot, 1]
                    z += work.bone_terms[marker, slot, 2]
                    share += hand.bone_weights[marker, slot]
            p = x - share * work.origins[bone, 0]
            q = y - share * work.origins[bone, 1]
            r = z - share * work.origins[bone, 2]
            for hinge in range(4 * digit + (link + 1 if link > 0 else 0), 4 * digit + link + 2):
                a, b, c = work.axes[hinge, 0], work.axes[hinge, 1], work.axes[hinge, 2]
                jacobian[0, hinge] = b * r - c * q
                jacobian[1, hinge] = c * p - a * r
                jacobian[2, hinge] = a * q - b * p
    x, y, z = work.markers[marker, 0], work.markers[marker, 1], work.markers[marker, 2]
    jacobian[1, _ROTATION], jacobian[2, _ROTATION] = -z, y
    jacobian[0, _ROTATION + 1], jacobian[2, _ROTATION + 1] = z, -x
    jacobian[0, _ROTATION + 2], jacobian[1, _ROTATION + 2] = -y, x


@kernel
def accumulate_normal_equations(hand: HandArrays, weights: Float[np.ndarray, "M"], work: Workspace) -> None:
    """Normal matrix and half gradient of the sum of the markers' weighted squared residuals.

    Args:
        weights: Weight of each marker [1/m^2]; zero for a missing one.
        work: Its markers and residuals must be computed; `jacobian`, `normal` (upper triangle) and `gradient`
            are filled.
    """
    normal, gradient = work.normal, work.gradient
    normal[:] = 0.0
    gradient[:] = 0.0
    for marker in range(len(weights)):
        marker_jacobian(hand, marker, work)
        weight, jacobian = weights[marker], work.jacobian[marker]
        if weight == 0.0:
            continue
        first, last = hand.hinge_span[marker, 0], hand.hinge_span[marker, 1]
        x, y, z = work.residuals[marker, 0], work.residuals[marker, 1], work.residuals[marker, 2]
        for number in range(last - first + 6):
            row = first + number if number < last - first else _TRANSLATION + number - (last - first)
            a, b, c = weight * jacobian[0, row], weight * jacobian[1, row], weight * jacobian[2, row]
            gradient[row] += a * x + b * y + c * z
            for column in range(row, last):
                normal[row, column] += (
                    a * jacobian[0, column] + b * jacobian[1, column] + c * jacobian[2, column]
                )
            for column in range(_TRANSLATION, NUM_UNKNOWNS):
                normal[row, column] += (
                    a * jacobian[0, column] + b * jacobian[1, column] + c * jacobian[2, column]
                )
