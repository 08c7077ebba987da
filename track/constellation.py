"""Pose of a rigid constellation of markers from assigned points, by IDs or near a known pose (numba kernels).

Shapes: Q markers, N points. A pose is position [m] and orientation (wxyz) of the body's frame in the world,
seven numbers. An assignment (Q,) holds the index of each marker's point, -1 for a marker without a point.
Arrays of floats are contiguous float64, arrays of integers int64.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.kernels import align_rigid, kernel, quaternion_product, squared_distance, write_quaternion_matrix

FEWEST: Final = 3
"""Markers that determine a pose."""
_NEW: Final = 1.5  # gate of a point with a new ID, over the tight gate


@kernel
def fit_inliers(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
    tight: float,
    gate: float,
) -> tuple[int, float]:
    """Fit the pose to the assigned points that agree tightly, and keep those within the gate of it.

    Several wrong points together can bias a fit until the right ones look like outliers. Therefore the point
    without which the others fit best is removed, one at a time, until all agree.

    Args:
        assignment: Points that are not kept are overwritten by -1.
        pose: Overwritten; left as it is when fewer than three points agree.
        tight: Largest residual of the points that determine the pose [m].
        gate: Largest residual of a point that is kept [m].

    Returns:
        How many points are kept, and their RMS distance from their markers [m].
    """
    core, fitted = assignment.copy(), np.empty(7)
    count, _, worst = _fit_pose(positions, points, core, fitted)
    while count > FEWEST and worst > tight * tight:
        marker, clear = _worst_outlier(positions, points, core)
        if count == FEWEST + 1 and not clear:
            break  # three of four agree in more than one way: all four, if they do within the gate
        core[marker] = -1
        count, _, worst = _fit_pose(positions, points, core, fitted)
    limit = tight if count == FEWEST else gate
    if count < FEWEST or not worst <= limit * limit:
        assignment[:] = -1
        return 0, np.nan
    pose[:] = fitted
    predicted, count, total = transform_markers(positions, pose), 0, 0.0
    for marker in range(len(positions)):
        if assignment[marker] >= 0:
            square = squared_distance(predicted[marker], points[assignment[marker]])
            if square > gate * gate:
                assignment[marker] = -1
            else:
                count, total = count + 1, total + square
    return count, np.sqrt(total / count)


@kernel
def _fit_pose(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
) -> tuple[int, float, float]:
    """Fit the pose to all assigned points; their number, and sum and largest of their squares [m^2]."""
    target, count = np.full_like(positions, np.nan), 0
    for marker in range(len(positions)):
        if assignment[marker] >= 0:
            target[marker] = points[assignment[marker]]
            count += 1
    if count < FEWEST:
        return count, np.nan, np.nan
    align_rigid(positions, target, np.ones(len(positions)), pose)
    predicted, total, worst = transform_markers(positions, pose), 0.0, 0.0
    for marker in range(len(positions)):
        if assignment[marker] >= 0:
            square = squared_distance(predicted[marker], target[marker])
            total, worst = total + square, max(worst, square)
    return count, total, worst


@kernel
def _worst_outlier(
    positions: NDArray[np.float64], points: NDArray[np.float64], assignment: NDArray[np.int64]
) -> tuple[int, bool]:
    """The marker without which the others fit best, and whether they do ten times better than otherwise.

    `assignment` (Q,) is changed and restored.
    """
    outlier, least, second, pose = -1, np.inf, np.inf, np.empty(7)
    for marker in range(len(positions)):
        if assignment[marker] >= 0:
            point, assignment[marker] = assignment[marker], -1
            _, squares, _ = _fit_pose(positions, points, assignment, pose)
            assignment[marker] = point
            if squares < least:
                outlier, least, second = marker, squares, least
            elif squares < second:
                second = squares
    return outlier, least < 0.1 * second


@kernel
def assign_by_id(
    points: NDArray[np.float64],
    ids: NDArray[np.int64],
    last_ids: NDArray[np.int64],
    assignment: NDArray[np.int64],
) -> int:
    """Assign to every marker the point that has its ID of the last frame, -1 for none; how many have one."""
    count = 0
    for marker in range(len(last_ids)):
        assignment[marker] = -1
        if last_ids[marker] < 0:
            continue
        for point in range(len(points)):
            if ids[point] == last_ids[marker]:
                assignment[marker] = point
                count += 1
                break
    return count


@kernel
def assign_remaining(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
    tight: float,
    gate: float,
) -> tuple[int, float]:
    """Assign to the other markers of a known pose the free points nearby, and fit again.

    Arguments and result are those of `fit_inliers`; `pose` is the known pose.
    """
    predicted = transform_markers(positions, pose)
    for marker in range(len(positions)):
        if assignment[marker] < 0:
            assignment[marker] = nearest_free(points, predicted[marker], _NEW * tight, assignment)
    return fit_inliers(positions, points, assignment, pose, tight, gate)


@kernel
def nearest_free(
    points: NDArray[np.float64], center: NDArray[np.float64], radius: float, assignment: NDArray[np.int64]
) -> int:
    """The nearest point within a radius [m] of a center (3,) that no marker has, -1 if there is none."""
    nearest, least = -1, radius * radius
    for point in range(len(points)):
        square = squared_distance(points[point], center)
        if square < least and not (assignment == point).any():
            nearest, least = point, square
    return nearest


@kernel
def shift_to_points(
    points: NDArray[np.float64],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
    predicted: NDArray[np.float64],
    gate: float,
) -> tuple[int, float]:
    """Shift a predicted pose to the one or two points that are assigned, if they agree with it; else none is.

    The gate is the largest shift, and the largest residual after it [m]. Returns how many points agree, and
    their RMS distance from their markers [m].
    """
    shift, count = np.zeros(3), 0
    for marker in range(len(assignment)):
        if assignment[marker] >= 0:
            shift += points[assignment[marker]] - predicted[marker]
            count += 1
    total, agree = 0.0, count > 0
    for marker in range(len(assignment)):
        if assignment[marker] >= 0:
            square = squared_distance(points[assignment[marker]], predicted[marker] + shift / count)
            total += square
            agree = agree and square <= gate * gate
    if not agree or (shift**2).sum() > (count * gate) ** 2:
        assignment[:] = -1
        return 0, np.nan
    pose[:3] += shift / count
    return count, np.sqrt(total / count)


@kernel
def track_by_ids(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    ids: NDArray[np.int64],
    last_ids: NDArray[np.int64],
    pose: NDArray[np.float64],
    tight: float,
    gate: float,
    assignment: NDArray[np.int64],
) -> tuple[int, float]:
    """Assign points by the IDs of the last frame, fit the pose, and assign the rest from it.

    Arguments and result are those of `assign_by_id` and `fit_inliers`.
    """
    if assign_by_id(points, ids, last_ids, assignment) < FEWEST:
        return 0, np.nan
    count, rms = fit_inliers(positions, points, assignment, pose, tight, gate)
    if FEWEST <= count < len(positions):
        fitted: tuple[int, float] = assign_remaining(positions, points, assignment, pose, tight, gate)
        return fitted
    return count, rms


@kernel
def write_labels(
    assignment: NDArray[np.int64],
    ids: NDArray[np.int64],
    labels: NDArray[np.int64],
    last_ids: NDArray[np.int64],
) -> None:
    """Write an assignment as labels of its points, and as last IDs of its markers, -1 for none."""
    for marker in range(len(assignment)):
        last_ids[marker] = -1
        if assignment[marker] >= 0:
            labels[assignment[marker]] = marker
            last_ids[marker] = ids[assignment[marker]]


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


_FLAT: Final = 0.1  # height of a triangle over its longest side, below which it determines no rotation


@kernel
def search_constellation(
    positions: NDArray[np.float64],
    distances: NDArray[np.float64],
    points: NDArray[np.float64],
    expected: NDArray[np.float64],
    radius: float,
    gate: float,
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
) -> tuple[int, float, int]:
    """The largest set of points in the markers' constellation, from every triangle that fits.

    Args:
        distances: Distances between markers (Q, Q) [m].
        expected: Expected positions of the markers in the world (Q, 3) [m].
        radius: Largest distance from there [m]; infinite when nothing is known.
        gate: Largest residual of a point after the fit [m].
        assignment: Overwritten by the best assignment, as `pose` by its pose.

    Returns:
        Number of markers in the best assignment, its RMS distance [m], and number of markers in the best
        other assignment.
    """
    apart = np.empty((len(points), len(points)))
    for i in range(len(points)):
        for j in range(len(points)):
            apart[i, j] = np.sqrt(squared_distance(points[i], points[j]))
    near = np.empty((len(positions), len(points)), dtype=np.bool_)
    for marker in range(len(positions)):
        for point in range(len(points)):
            near[marker, point] = (
                radius == np.inf or squared_distance(points[point], expected[marker]) <= radius * radius
            )
    slack, score = 2.0 * gate, np.array([0.0, np.inf, 0.0])
    assignment[:] = -1
    for a in range(len(positions) - 2):
        for b in range(a + 1, len(positions) - 1):
            for i in range(len(points)):
                for j in range(len(points)):
                    fits = near[a, i] and near[b, j] and abs(apart[i, j] - distances[a, b]) <= slack
                    if fits and i != j:
                        side = a, b, i, j
                        _try_triangles(
                            positions, distances, points, apart, near, gate, side, assignment, pose, score
                        )
    return int(score[0]), score[1], int(score[2])


@kernel
def _try_triangles(
    positions: NDArray[np.float64],
    distances: NDArray[np.float64],
    points: NDArray[np.float64],
    apart: NDArray[np.float64],
    near: NDArray[np.bool_],
    gate: float,
    side: tuple[int, int, int, int],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
    score: NDArray[np.float64],
) -> None:
    """Try every triangle of a side (two markers and their points) that fits and a later marker.

    `apart` are distances between points (N, N) [m], `near` is whether a point is near enough to a marker's
    expected position (Q, N); the others are those of `_keep_better`.
    """
    a, b, i, j = side
    trial, slack = np.empty_like(assignment), 2.0 * gate
    for c in range(b + 1, len(positions)):
        for k in range(len(points)):
            if abs(apart[i, k] - distances[a, c]) > slack or abs(apart[j, k] - distances[b, c]) > slack:
                continue
            if near[c, k] and k != i and k != j:  # noqa: PLR1714  a tuple costs a kernel time
                trial[:] = -1
                trial[a], trial[b], trial[c] = i, j, k
                if _extend_triangle(positions, points, slack, trial, a, b, c) >= max(score[0], FEWEST):
                    _keep_better(positions, points, gate, trial, assignment, pose, score)


@kernel
def _keep_better(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    gate: float,
    trial: NDArray[np.int64],
    assignment: NDArray[np.int64],
    pose: NDArray[np.float64],
    score: NDArray[np.float64],
) -> None:
    """Keep a trial assignment if it has more markers than the best so far, or as many that fit better.

    Points that do not fit are removed from the trial. `score` (3,) is the number of markers in the best
    assignment, its RMS distance [m], and the number of markers in the best other assignment; one that shares
    three pairs with the best is not another one.
    """
    trial_pose = np.empty(7)
    count, rms = fit_inliers(positions, points, trial, trial_pose, gate, gate)
    if count < max(score[0], FEWEST):
        return
    other = ((trial >= 0) & (trial == assignment)).sum() < FEWEST
    if count > score[0] or rms < score[1]:
        if other:
            score[2] = score[0]
        score[0], score[1] = count, rms
        assignment[:], pose[:] = trial, trial_pose
    elif other:
        score[2] = count


@kernel
def _extend_triangle(
    positions: NDArray[np.float64],
    points: NDArray[np.float64],
    slack: float,
    assignment: NDArray[np.int64],
    a: int,
    b: int,
    c: int,
) -> int:
    """Assign to the other markers the free points where a triangle of markers predicts them.

    Returns how many markers have a point; 0 where the triangle is too flat.
    """
    model, seen = np.empty((3, 3)), np.empty((3, 3))
    if not _triangle_axes(positions[a], positions[b], positions[c], model):
        return 0
    if not _triangle_axes(points[assignment[a]], points[assignment[b]], points[assignment[c]], seen):
        return 0
    rotation, count = seen.T @ model, 3
    for marker in range(len(positions)):
        if assignment[marker] < 0:
            predicted = points[assignment[a]] + rotation @ (positions[marker] - positions[a])
            assignment[marker] = nearest_free(points, predicted, slack, assignment)
            count += assignment[marker] >= 0
    return count


@kernel
def _triangle_axes(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    third: NDArray[np.float64],
    axes: NDArray[np.float64],
) -> bool:
    """Write the axes of a triangle as rows: first side, in its plane, normal; False where it is too flat."""
    along, across = second - first, third - first
    length = np.sqrt((along**2).sum())
    axes[0] = along / length
    across -= (across * axes[0]).sum() * axes[0]
    height = np.sqrt((across**2).sum())
    axes[1] = across / height
    axes[2, 0] = axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2]
    axes[2, 2] = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    return bool(length > 0.0 and height > _FLAT * length)
