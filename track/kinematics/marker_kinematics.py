"""Compiled forward kinematics of a hand's markers, and Levenberg-Marquardt on its pose.

The energy E_IK is that of Han et al. 2018, section 4.3, with joint limits, a prior and a robust loss.

All kernels work in the wrist's frame: targets are transformed into it, so a fit does not depend on the hand's
place. The 26 unknowns of a step are the 20 joint angles [rad], then the translation [m] and the rotation
vector [rad] of the wrist along its own axes. Joint angles come first, so that the Cholesky factor of the
normal matrix keeps its zeros between digits.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.hand.shape import DIGIT_OF_BONE, NUM_BONES, NUM_JOINTS
from handsim.kernels import (
    CARPUS,
    kernel,
    metacarpal_flexion,
    metacarpal_motion,
    multiply_rotations,
    quaternion_product,
    rotate_quaternion,
)

NUM_UNKNOWNS: Final = NUM_JOINTS + 6
"""Unknowns of a step: 20 joint angles, 3 translations and 3 rotations of the wrist."""
MARKER_NOISE: Final = 0.001
"""Standard deviation of a marker [m], the unit of all costs; about what optical systems and gloves reach."""
_TRANSLATION: Final = NUM_JOINTS  # index of the first unknown of the wrist's translation
_ROTATION: Final = NUM_JOINTS + 3  # index of the first unknown of its rotation
_MARKER_PRECISION: Final = MARKER_NOISE**-2  # [1/m^2]
LIMIT_PRECISION: Final = np.deg2rad(2.0) ** -2
"""Precision of a joint angle beyond its range [1/rad^2]: a soft limit."""
_FIRST_DAMPING: Final = 1e-4  # share of the diagonal; small, because most starts are near the minimum
_LEAST_DAMPING: Final = 1e-10  # share of the diagonal; keeps the factor positive
_MOST_DAMPING: Final = 1e8  # share of the diagonal at which steps vanish


class HandArrays(NamedTuple):
    """A hand and its glove as plain arrays: L bones, J = 20 joint angles, M markers."""

    offsets: Float[np.ndarray, "L 3"]  # origin of each bone in its parent's frame [m]
    rotations: Float[np.ndarray, "L 3 3"]  # rotation of each bone in its parent's frame, all joints at zero
    axes: Float[np.ndarray, "J 3"]  # unit axis of each joint in the frame of its bone
    ranges: Float[np.ndarray, "J 2"]  # lower and upper limit of each joint [rad]
    bones: Int[np.ndarray, "M 4"]  # bones that carry each marker, largest weight first; -1 for none
    bone_weights: Float[np.ndarray, "M 4"]  # skinning weight of each of these bones; they sum to one
    positions: Float[np.ndarray, "M 4 3"]  # each marker in the frames of its bones [m], times the weight
    normals: Float[np.ndarray, "M 3"]  # unit direction off the skin, in the frame of the first bone
    digits: Int[np.ndarray, "M"]  # digit of the bone with the largest weight; -1 for the palm
    hinge_span: Int[np.ndarray, "M 2"]  # first joint that may move each marker, and the one after the last
    skyline: Int[np.ndarray, "26"]  # first nonzero column of each row of the normal matrix
    arch: Float[np.ndarray, "5"]  # flexion of each digit's metacarpal over that of its MCP joint


class Workspace(NamedTuple):
    """Buffers for one pose: bones and markers in the wrist's frame, and the equations of its next step."""

    rotations: Float[np.ndarray, "L 3 3"]  # rotation of each bone
    origins: Float[np.ndarray, "L 3"]  # origin of each bone [m]
    axes: Float[np.ndarray, "J 3"]  # unit axis of each joint
    bone_terms: Float[np.ndarray, "M 4 3"]  # each bone's term of the weighted sum that gives a marker [m]
    markers: Float[np.ndarray, "M 3"]  # position of each marker [m]
    residuals: Float[np.ndarray, "M 3"]  # model minus target marker [m]; NaN where the target is missing
    jacobian: Float[np.ndarray, "M 3 26"]  # derivatives of the markers by the unknowns [m/rad, m/m]
    normal: Float[np.ndarray, "26 26"]  # upper triangle; zero between digits that share no marker
    gradient: Float[np.ndarray, "26"]  # half the gradient of the cost
    factor: Float[np.ndarray, "26 26"]  # buffer for a factor of the normal matrix
    step: Float[np.ndarray, "26"]  # step of the unknowns [rad, m]
    arch_rates: Float[np.ndarray, "5"]  # derivatives of the metacarpals' flexions by those of the MCP joints


class PoseEnergy(NamedTuple):
    """Energy of a pose: marker targets and a prior."""

    target: Float[np.ndarray, "M 3"]  # markers in the world [m]; NaN where missing
    prior_mean: Float[np.ndarray, "27"]  # mean of the prior, as a pose
    precision: Float[np.ndarray, "26"]  # precision of each unknown [1/rad^2, 1/m^2, 1/rad^2], or zero
    robust_scale: float  # inverse square scale of the robust loss [1/m^2]; zero for least squares


def hand_arrays(fit: GloveFit) -> HandArrays:
    """The arrays of a hand and its glove, in the layout's order of markers."""
    model, attachment = fit.model, fit.attachment
    inverse = np.linalg.inv(model.rest_transforms)[attachment.bone_indices]
    local = np.einsum("mkij,mj->mki", inverse[..., :3, :3], attachment.points) + inverse[..., :3, 3]
    order = np.argsort(-attachment.bone_weights, axis=1, kind="stable")
    bones = np.take_along_axis(attachment.bone_indices, order, axis=1)
    bone_weights = np.take_along_axis(attachment.bone_weights, order, axis=1)
    positions = np.take_along_axis(local, order[..., None], axis=1) * bone_weights[..., None]
    normals = np.einsum("mji,mj->mi", model.rest_transforms[bones[:, 0], :3, :3], attachment.normals)
    hinge_span = np.zeros((len(bones), 2), dtype=np.int64)
    skyline = np.zeros(NUM_UNKNOWNS, dtype=np.int64)
    skyline[:NUM_JOINTS] = np.arange(NUM_JOINTS) // 4 * 4
    for marker, row in enumerate(np.where(bone_weights > 0.0, DIGIT_OF_BONE[bones], -1)):
        moving = row[row >= 0]
        if len(moving):
            first, last = 4 * moving.min(), 4 * moving.max() + 4
            hinge_span[marker] = first, last
            skyline[first:last] = np.minimum(skyline[first:last], first)
    skeleton = model.skeleton
    return HandArrays(
        np.array(skeleton.offsets, order="C"),
        np.array(skeleton.rotations, order="C"),
        np.array(skeleton.axes, order="C"),
        np.array(skeleton.ranges, order="C"),
        np.where(bone_weights > 0.0, bones, -1),
        bone_weights,
        np.array(positions, order="C"),
        normals,
        DIGIT_OF_BONE[bones[:, 0]],
        hinge_span,
        skyline,
        np.array(skeleton.arch, order="C"),
    )


@kernel
def workspace(num_markers: int) -> Workspace:
    """Allocate a `Workspace` for a number of markers, with all constant entries."""
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
        np.zeros(NUM_JOINTS // 4),
    )


@kernel
def compute_markers(hand: HandArrays, angles: Float[np.ndarray, "20"], work: Workspace) -> None:
    """Forward kinematics: write all bones, joint axes and markers in the wrist's frame."""
    for digit in range(NUM_JOINTS // 4):
        compute_digit(hand, digit, angles[4 * digit : 4 * digit + 4], work)
    for marker in range(len(hand.bones)):
        compute_marker(hand, marker, work)


@kernel
def compute_digit(hand: HandArrays, digit: int, angles: Float[np.ndarray, "4"], work: Workspace) -> None:
    """Write the bones and joint axes of one digit (0 is the thumb) in the wrist's frame."""
    for link in range(3):
        bone = 1 + 3 * digit + link
        parent = bone - 1 if link > 0 else 0
        parent_rotation, own = work.rotations[parent], work.rotations[bone]
        for i in range(3):
            work.origins[bone, i] = work.origins[parent, i]
        if link == 0 and hand.arch[digit] != 0.0:  # The metacarpal is the parent.
            flexion, work.arch_rates[digit] = metacarpal_flexion(hand.arch[digit], angles[1])
            sine, cosine, ahead, above = metacarpal_motion(flexion, hand.offsets[bone])
            work.origins[bone, 0], work.origins[bone, 2] = ahead, above
            own[0, 0], own[0, 1], own[0, 2] = cosine, 0.0, sine
            own[1, 0], own[1, 1], own[1, 2] = 0.0, 1.0, 0.0
            own[2, 0], own[2, 1], own[2, 2] = -sine, 0.0, cosine
            parent_rotation = own
        for i in range(3):
            for j in range(3):
                work.origins[bone, i] += parent_rotation[i, j] * hand.offsets[bone, j]
        multiply_rotations(parent_rotation, hand.rotations[bone], own)
        for number in range(link + 1 if link > 0 else 0, link + 2):
            hinge = 4 * digit + number
            _rotate_bone(own, hand.axes[hinge], angles[number], work.axes[hinge])


@kernel
def compute_marker(hand: HandArrays, marker: int, work: Workspace) -> None:
    """Write the position and the bones' terms of one marker [m]; its bones must be computed."""
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
    """Rotate a bone about its own unit axis (Rodrigues); writes the axis seen from the wrist to `outside`."""
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
    """Write the derivatives of one marker by all unknowns; its bones and the marker must be computed."""
    jacobian = work.jacobian[marker]
    for digit in range(hand.hinge_span[marker, 0] // 4, hand.hinge_span[marker, 1] // 4):
        x, y, z, share = 0.0, 0.0, 0.0, 0.0
        for link in range(2, -1, -1):  # A joint moves its own bone and all bones beyond.
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
        if hand.arch[digit] != 0.0:  # The flexion of an MCP joint turns its metacarpal, too.
            rate, knuckle, flexion = work.arch_rates[digit], hand.offsets[1 + 3 * digit], 4 * digit + 1
            jacobian[0, flexion] += rate * (z - share * CARPUS * knuckle[2])
            jacobian[2, flexion] -= rate * (x - share * CARPUS * knuckle[0])
    x, y, z = work.markers[marker, 0], work.markers[marker, 1], work.markers[marker, 2]
    jacobian[1, _ROTATION], jacobian[2, _ROTATION] = -z, y
    jacobian[0, _ROTATION + 1], jacobian[2, _ROTATION + 1] = z, -x
    jacobian[0, _ROTATION + 2], jacobian[1, _ROTATION + 2] = -y, x


@kernel
def accumulate_normal_equations(hand: HandArrays, weights: Float[np.ndarray, "M"], work: Workspace) -> None:
    """Write normal matrix and half gradient of the markers' weighted squared residuals."""
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


@kernel
def marker_residuals(
    hand: HandArrays, target: Float[np.ndarray, "M 3"], qpos: Float[np.ndarray, "27"], work: Workspace
) -> None:
    """Write markers and residuals of a pose in the wrist's frame; targets [m] are in the world."""
    compute_markers(hand, qpos[7:], work)
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    for marker in range(len(target)):
        a, b, c = target[marker, 0] - qpos[0], target[marker, 1] - qpos[1], target[marker, 2] - qpos[2]
        # The inverse rotation: v + 2 w (v x u) + 2 (v x u) x u, with u the quaternion's vector part.
        i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
        position, residual = work.markers[marker], work.residuals[marker]
        residual[0] = position[0] - a - 2.0 * (w * i + j * z - k * y)
        residual[1] = position[1] - b - 2.0 * (w * j + k * x - i * z)
        residual[2] = position[2] - c - 2.0 * (w * k + i * y - j * x)


@kernel
def levenberg_marquardt(
    hand: HandArrays,
    energy: PoseEnergy,
    qpos: Float[np.ndarray, "27"],
    most_steps: int,
    small_gain: float,
    work: Workspace,
) -> tuple[float, int]:
    """Minimize the cost of a pose in place; return the cost and the number of steps."""
    trial, weights = qpos.copy(), np.zeros(len(energy.target))
    cost = _cost(hand, energy, qpos, work)
    _linearize(hand, energy, qpos, weights, work)
    damping, steps = _FIRST_DAMPING, 0
    while steps < most_steps and damping < _MOST_DAMPING:
        steps += 1
        gain = _solve(hand.skyline, damping, work)
        if gain < 0.0:
            damping *= 10.0
            continue
        move_wrist(qpos, work.step, trial)
        for hinge in range(NUM_JOINTS):
            trial[7 + hinge] = qpos[7 + hinge] + work.step[hinge]
        trial_cost = _cost(hand, energy, trial, work)
        better = trial_cost < cost
        if better:
            qpos[:] = trial
            cost = trial_cost
        if gain < small_gain:
            break
        if better:
            _linearize(hand, energy, qpos, weights, work)
        damping = max(damping * 0.1, _LEAST_DAMPING) if better else damping * 10.0
    return cost, steps


@kernel
def _cost(hand: HandArrays, energy: PoseEnergy, qpos: Float[np.ndarray, "27"], work: Workspace) -> float:
    """Cost of a pose (squared standard deviations); writes to `work` as `marker_residuals` does."""
    marker_residuals(hand, energy.target, qpos, work)
    cost, precision = 0.0, energy.precision
    for marker in range(len(energy.target)):
        residual = work.residuals[marker]
        square = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2]
        if not np.isnan(square):
            cost += _MARKER_PRECISION * square / (1.0 + energy.robust_scale * square)  # Geman, McClure 1987
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        deviation = angle - energy.prior_mean[7 + hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        cost += precision[hinge] * deviation * deviation + LIMIT_PRECISION * beyond * beyond
    if precision[NUM_JOINTS] > 0.0:
        wrist_offsets(energy.prior_mean, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            cost += precision[unknown] * work.step[unknown] ** 2
    return cost


@kernel
def _linearize(
    hand: HandArrays,
    energy: PoseEnergy,
    qpos: Float[np.ndarray, "27"],
    weights: Float[np.ndarray, "M"],
    work: Workspace,
) -> None:
    """Write normal matrix and half gradient at the pose of the last `marker_residuals`."""
    precision = energy.precision
    for marker in range(len(weights)):
        residual = work.residuals[marker]
        square = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2]
        robust = (1.0 + energy.robust_scale * square) ** 2
        weights[marker] = 0.0 if np.isnan(square) else _MARKER_PRECISION / robust
    accumulate_normal_equations(hand, weights, work)
    for hinge in range(NUM_JOINTS):
        angle = qpos[7 + hinge]
        work.gradient[hinge] += precision[hinge] * (angle - energy.prior_mean[7 + hinge])
        work.normal[hinge, hinge] += precision[hinge]
        beyond = max(angle - hand.ranges[hinge, 1], 0.0) + min(angle - hand.ranges[hinge, 0], 0.0)
        if beyond != 0.0:
            work.gradient[hinge] += LIMIT_PRECISION * beyond
            work.normal[hinge, hinge] += LIMIT_PRECISION
    if precision[NUM_JOINTS] > 0.0:
        wrist_offsets(energy.prior_mean, qpos, work.step)
        for unknown in range(NUM_JOINTS, NUM_UNKNOWNS):
            work.gradient[unknown] += precision[unknown] * work.step[unknown]
            work.normal[unknown, unknown] += precision[unknown]


@kernel
def _solve(skyline: Int[np.ndarray, "26"], damping: float, work: Workspace) -> float:
    """Solve the damped equations by a skyline Cholesky factor; return the expected gain, or -1."""
    factor, step, gain = work.factor, work.step, 0.0
    for row in range(NUM_UNKNOWNS):
        start, own = skyline[row], factor[row]
        rest = -work.gradient[row]
        pivot = work.normal[row, row] * (1.0 + damping)
        for column in range(start, row):
            other = factor[column]
            entry = work.normal[column, row]
            for k in range(max(start, skyline[column]), column):
                entry -= own[k] * other[k]
            entry *= other[column]
            own[column] = entry
            pivot -= entry * entry
            rest -= entry * step[column]
        if not pivot > 0.0:
            return -1.0
        own[row] = 1.0 / np.sqrt(pivot)
        step[row] = rest * own[row]
        gain += step[row] * step[row]
    for row in range(NUM_UNKNOWNS - 1, -1, -1):
        step[row] *= factor[row, row]
        for column in range(skyline[row], row):
            step[column] -= factor[row, column] * step[row]
    return gain


@kernel
def move_wrist(
    qpos: Float[np.ndarray, "27"], step: Float[np.ndarray, "26"], moved: Float[np.ndarray, "27"]
) -> None:
    """Write the wrist of a pose after a step along the wrist's own axes to `moved`."""
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    a, b, c = step[NUM_JOINTS], step[NUM_JOINTS + 1], step[NUM_JOINTS + 2]
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    moved[0] = qpos[0] + a + 2.0 * (w * i + y * k - z * j)
    moved[1] = qpos[1] + b + 2.0 * (w * j + z * i - x * k)
    moved[2] = qpos[2] + c + 2.0 * (w * k + x * j - y * i)
    rotate_quaternion(qpos[3:7], step[NUM_JOINTS + 3 : NUM_JOINTS + 6], moved[3:7])


@kernel
def wrist_offsets(
    before: Float[np.ndarray, "27"], now: Float[np.ndarray, "27"], step: Float[np.ndarray, "26"]
) -> None:
    """Write the wrist's step from one pose to another, along its axes in the second."""
    # First order in the rotation: twice the vector part of the quaternion.
    w, x, y, z = now[3], now[4], now[5], now[6]
    a, b, c = now[0] - before[0], now[1] - before[1], now[2] - before[2]
    i, j, k = b * z - c * y, c * x - a * z, a * y - b * x
    step[NUM_JOINTS] = a + 2.0 * (w * i + j * z - k * y)
    step[NUM_JOINTS + 1] = b + 2.0 * (w * j + k * x - i * z)
    step[NUM_JOINTS + 2] = c + 2.0 * (w * k + i * y - j * x)
    e, i, j, k = quaternion_product(before[3], -before[4], -before[5], -before[6], w, x, y, z)
    share = 2.0 if e >= 0.0 else -2.0
    step[NUM_JOINTS + 3], step[NUM_JOINTS + 4], step[NUM_JOINTS + 5] = share * i, share * j, share * k


@kernel
def invert_positive(matrix: Float[np.ndarray, "N N"]) -> None:
    """Invert a symmetric positive-definite matrix in place, given its lower triangle."""
    # A LAPACK call takes longer than the inversion of such a small matrix.
    count = len(matrix)
    for row in range(count):
        for column in range(row + 1):
            entry = matrix[row, column]
            for k in range(column):
                entry -= matrix[row, k] * matrix[column, k]
            matrix[row, column] = np.sqrt(entry) if row == column else entry / matrix[column, column]
    for row in range(count):
        scale = 1.0 / matrix[row, row]
        for column in range(row):
            entry = 0.0
            for k in range(column, row):
                entry -= matrix[row, k] * matrix[k, column]
            matrix[row, column] = entry * scale
        matrix[row, row] = scale
    for row in range(count):
        for column in range(row + 1):
            entry = 0.0
            for k in range(row, count):
                entry += matrix[k, row] * matrix[k, column]
            matrix[row, column] = entry
            matrix[column, row] = entry


@kernel
def eliminate(
    matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"], first: int, last: int
) -> None:
    """Eliminate unknowns `first` to `last` - 1 of a positive-definite system; the rest stays symmetric."""
    for pivot in range(first, last):
        scale = 1.0 / matrix[pivot, pivot]
        for row in range(pivot + 1, len(matrix)):
            share = matrix[row, pivot] * scale
            if share != 0.0:
                for column in range(pivot + 1, len(matrix)):
                    matrix[row, column] -= share * matrix[pivot, column]
                right_side[row] -= share * right_side[pivot]


@kernel
def solve_positive(matrix: Float[np.ndarray, "N N"], right_side: Float[np.ndarray, "N"]) -> None:
    """Solve a symmetric positive-definite system in place: `right_side` becomes the solution."""
    count = len(matrix)
    eliminate(matrix, right_side, 0, count)
    for row in range(count - 1, -1, -1):
        for column in range(row + 1, count):
            right_side[row] -= matrix[row, column] * right_side[column]
        right_side[row] /= matrix[row, row]
