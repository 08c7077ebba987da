"""Search for a rigid constellation of markers among points, by the distances between them (numba kernels).

Shapes and conventions are those of `constellation`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.kernels.segments import squared_distance
from track.bodies.constellation import FEWEST, fit_inliers, nearest_free

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
