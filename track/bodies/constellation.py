"""Pose of a rigid constellation of markers from points: from assigned ones, or by distances between markers.

Shapes: Q markers, N points. A pose is position [m] and orientation (wxyz) of the body's frame in the world,
seven numbers. An assignment (Q,) holds the index of each marker's point, -1 for a marker without a point.
Arrays of floats are contiguous float64, arrays of integers int64.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from handsim.arrays import Doubles, Flags, Integers
from handsim.kernels import align_rigid, kernel, squared_distance, write_quaternion_matrix

FEWEST: Final = 3
"""A pose needs at least this many markers."""
_NEW_ID_FACTOR: Final = 1.5  # gate of a point with a new ID, as a multiple of the tight gate
# A triangle whose height is less than this share of its longest side determines no rotation.
_LEAST_TRIANGLE_HEIGHT: Final = 0.1


class _Search(NamedTuple):
    """Input arrays of a search, and the best match so far."""

    positions: Doubles  # markers in the body's frame (Q, 3) [m]
    distances: Doubles  # between markers (Q, Q) [m]
    points: Doubles  # points in the world (N, 3) [m]
    apart: Doubles  # distances between points (N, N) [m]
    near: Flags  # whether a point is near enough to a marker's expected position (Q, N)
    gate: float  # largest residual of a point after the fit [m]
    assignment: Integers  # best assignment so far (Q,)
    pose: Doubles  # its pose (7,)
    score: Doubles  # its number of markers and RMS distance [m]; number of markers of the runner-up


@kernel
def fit_inliers(
    positions: Doubles, points: Doubles, assignment: Integers, pose: Doubles, tight: float, gate: float
) -> tuple[int, float]:
    """Fit the pose to the assigned points that agree tightly, and keep those within the gate of it."""
    # Several wrong points together can bias a fit until the right ones look like outliers. Therefore the
    # point without which the others fit best is removed, one at a time, until all agree.
    core, fitted = assignment.copy(), np.empty(7)
    count, _, worst = _fit_pose(positions, points, core, fitted)
    while count > FEWEST and worst > tight * tight:
        marker, clear = _worst_outlier(positions, points, core)
        if count == FEWEST + 1 and not clear:
            break  # Three of four agree in more than one way: keep all four if they fit within the gate.
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
    positions: Doubles, points: Doubles, assignment: Integers, pose: Doubles
) -> tuple[int, float, float]:
    """Fit the pose to all assigned points; return their number, sum and largest of squares [m^2]."""
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
def _worst_outlier(positions: Doubles, points: Doubles, assignment: Integers) -> tuple[int, bool]:
    """The marker without which the others fit best, and whether that is ten times better than any other."""
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
def assign_remaining(
    positions: Doubles, points: Doubles, assignment: Integers, pose: Doubles, tight: float, gate: float
) -> tuple[int, float]:
    """Assign free points near the predicted markers to the markers without a point, and fit again."""
    predicted = transform_markers(positions, pose)
    for marker in range(len(positions)):
        if assignment[marker] < 0:
            assignment[marker] = _nearest_free(points, predicted[marker], _NEW_ID_FACTOR * tight, assignment)
    return fit_inliers(positions, points, assignment, pose, tight, gate)


@kernel
def _nearest_free(points: Doubles, center: Doubles, radius: float, assignment: Integers) -> int:
    """Nearest unassigned point within a radius [m] of a center (3,), or -1."""
    nearest, least = -1, radius * radius
    for point in range(len(points)):
        square = squared_distance(points[point], center)
        if square < least and not (assignment == point).any():
            nearest, least = point, square
    return nearest


@kernel
def track_by_ids(
    positions: Doubles,
    points: Doubles,
    ids: Integers,
    last_ids: Integers,
    pose: Doubles,
    tight: float,
    gate: float,
    assignment: Integers,
) -> tuple[int, float]:
    """Assign points by the IDs of the last frame (-1: none), fit as `fit_inliers`, and assign the rest."""
    found = 0
    for marker in range(len(last_ids)):
        assignment[marker] = -1
        for point in range(len(points)):
            if last_ids[marker] >= 0 and ids[point] == last_ids[marker]:
                assignment[marker] = point
                found += 1
                break
    if found < FEWEST:
        return 0, np.nan
    count, rms = fit_inliers(positions, points, assignment, pose, tight, gate)
    if FEWEST <= count < len(positions):
        count, rms = assign_remaining(positions, points, assignment, pose, tight, gate)
    return count, rms


@kernel
def transform_markers(positions: Doubles, pose: Doubles) -> Doubles:
    """Transform markers from the body's frame to the world (Q, 3) [m]."""
    rotation, moved = np.empty((3, 3)), np.empty_like(positions)
    write_quaternion_matrix(rotation, pose[3], pose[4], pose[5], pose[6])
    for marker in range(len(positions)):
        for i in range(3):
            moved[marker, i] = pose[i]
            for j in range(3):
                moved[marker, i] += rotation[i, j] * positions[marker, j]
    return moved


@kernel
def search_constellation(
    positions: Doubles,
    distances: Doubles,
    points: Doubles,
    expected: Doubles,
    radius: float,
    gate: float,
    assignment: Integers,
    pose: Doubles,
) -> tuple[int, float, int]:
    """Find the largest set of points in the markers' constellation, starting from every matching triangle."""
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
    search = _Search(positions, distances, points, apart, near, gate, assignment, pose, score)
    for a in range(len(positions) - 2):
        for b in range(a + 1, len(positions) - 1):
            for i in range(len(points)):
                for j in range(len(points)):
                    fits = near[a, i] and near[b, j] and abs(apart[i, j] - distances[a, b]) <= slack
                    if fits and i != j:
                        _try_triangles(search, a, b, i, j)
    return int(score[0]), score[1], int(score[2])


@kernel
def _try_triangles(search: _Search, a: int, b: int, i: int, j: int) -> None:
    """Extend a matched side (markers a and b, points i and j) by every later marker that matches."""
    trial, slack = np.empty_like(search.assignment), 2.0 * search.gate
    apart, distances = search.apart, search.distances
    for c in range(b + 1, len(search.positions)):
        for k in range(len(search.points)):
            if abs(apart[i, k] - distances[a, c]) > slack or abs(apart[j, k] - distances[b, c]) > slack:
                continue
            if search.near[c, k] and k != i and k != j:  # noqa: PLR1714  a tuple costs a kernel time
                trial[:] = -1
                trial[a], trial[b], trial[c] = i, j, k
                least = max(search.score[0], FEWEST)
                if _extend_triangle(search.positions, search.points, slack, trial, a, b, c) >= least:
                    _keep_better(search, trial)


@kernel
def _keep_better(search: _Search, trial: Integers) -> None:
    """Keep a trial with more markers than the best, or as many and a better fit, without its outliers."""
    # A trial that shares three pairs with the best assignment is the same match, not a runner-up.
    pose, score = np.empty(7), search.score
    count, rms = fit_inliers(search.positions, search.points, trial, pose, search.gate, search.gate)
    if count < max(score[0], FEWEST):
        return
    other = ((trial >= 0) & (trial == search.assignment)).sum() < FEWEST
    if count > score[0] or rms < score[1]:
        if other:
            score[2] = score[0]
        score[0], score[1] = count, rms
        search.assignment[:], search.pose[:] = trial, pose
    elif other:
        score[2] = count


@kernel
def _extend_triangle(
    positions: Doubles, points: Doubles, slack: float, assignment: Integers, a: int, b: int, c: int
) -> int:
    """Assign free points where a triangle predicts other markers; return how many, 0 if it is flat."""
    model, seen = np.empty((3, 3)), np.empty((3, 3))
    if not _triangle_axes(positions[a], positions[b], positions[c], model):
        return 0
    if not _triangle_axes(points[assignment[a]], points[assignment[b]], points[assignment[c]], seen):
        return 0
    rotation, count = seen.T @ model, 3
    for marker in range(len(positions)):
        if assignment[marker] < 0:
            predicted = points[assignment[a]] + rotation @ (positions[marker] - positions[a])
            assignment[marker] = _nearest_free(points, predicted, slack, assignment)
            count += assignment[marker] >= 0
    return count


@kernel
def _triangle_axes(first: Doubles, second: Doubles, third: Doubles, axes: Doubles) -> bool:
    """Write a triangle's axes as rows (first side, in-plane, normal); return False if it is too flat."""
    along, across = second - first, third - first
    length = np.sqrt((along**2).sum())
    axes[0] = along / length
    across -= (across * axes[0]).sum() * axes[0]
    height = np.sqrt((across**2).sum())
    axes[1] = across / height
    axes[2, 0] = axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2]
    axes[2, 2] = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    return bool(length > 0.0 and height > _LEAST_TRIANGLE_HEIGHT * length)
