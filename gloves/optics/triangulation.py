"""The compiled kernels of `gloves.optics.reconstruction`: triangulation and false intersections of rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from gloves.optics.blobs import cast_rays, draw_blobs
from handsim.kernels.kernel import kernel
from handsim.kernels.segments import squared_distance

_FALSE_REACH = 0.25  # [m] farther than this from every source is outside the capture volume
_FALSE_STEP = 0.015  # [m] a false point that moved no farther since the last frame is the same


@kernel
def reconstruct_frames(
    sources: Any, sizes: Any, seen: Any, cameras: Any, optics: Any, gates: Any, min_rays: Any,
    rng: Any, positions: Any, rays: Any, false_points: Any,
) -> None:  # fmt: skip
    """Write the points (T, S, 3) [m] of every frame; see `reconstruct`.

    Args:
        sources: True positions (T, S, 3) [m]; NaN where there is none.
        sizes: Radius of each source (S,) [m].
        seen: Which cameras have a free view of each (T, S, C).
        cameras: `CameraArrays` of C cameras.
        optics: As for `gloves.optics.blobs.draw_blobs`.
        gates: Largest residual of a ray [m], sine of the smallest angle, smallest distance of two points [m].
        min_rays: Rays that must meet for a point to go on, and to begin.
        rays: Where the number of their rays goes (T, S).
        false_points: Where false intersections go (T, F, 3) [m]; NaN before.
    """
    count, num_cameras = seen.shape[1:]
    T_world_camera = cameras.T_world_camera
    centers, radii = np.empty((num_cameras, count, 2)), np.empty((num_cameras, count))
    directions = np.empty((count, num_cameras, 3))
    usable = np.empty((count, num_cameras), dtype=np.bool_)
    for t in range(len(sources)):
        draw_blobs(sources[t], sizes, seen[t], cameras, optics, rng, centers, radii)
        cast_rays(seen[t], cameras, optics, centers, radii, directions, usable)
        for s in np.argsort(-usable.sum(axis=1), kind="mergesort"):
            enough = min_rays[0] if t > 0 and rays[t - 1, s] > 0 else min_rays[1]
            rays[t, s] = _meet(directions[s], usable[s], T_world_camera, gates, enough, positions[t, s])
            if rays[t, s] > 0:
                _spend(positions[t, s], s, directions, usable, T_world_camera, gates[0])
        _join_near(positions[t], rays[t], gates[2])
        false = false_points[t - 1 if t > 0 else 0], false_points[t]
        _meet_by_chance(sources[t], directions, usable, T_world_camera, gates, min_rays, positions[t], false)


@kernel
def _meet(directions: Any, usable: Any, T_world_camera: Any, gates: Any, enough: int, point: Any) -> int:
    """Write the point (3,) nearest to a source's rays (C, 3), the worst ones dropped; number of rays."""
    used = usable.copy()
    count = 0
    for c in range(len(used)):
        count += used[c]
    while count >= enough:
        if not _nearest_point(directions, used, T_world_camera, point):
            break
        worst, far = -1, gates[0]
        for c in range(len(used)):
            if used[c]:
                off = _off(point, directions[c], T_world_camera[c])
                if off > far:
                    worst, far = c, off
        if worst < 0:
            if count == 2 and not _wide(directions, used, gates[1]):
                break
            return count
        used[worst] = False
        count -= 1
    point[:] = np.nan
    return 0


@kernel
def _nearest_point(directions: Any, used: Any, T_world_camera: Any, point: Any) -> bool:
    """Least-squares meeting point of rays: sum of (I - d d^T) (x - o) = 0, by Cramer's rule."""
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]]
    p, q, r = 0.0, 0.0, 0.0
    for k in range(len(used)):
        if used[k]:
            x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
            ox, oy, oz = T_world_camera[k, 0, 3], T_world_camera[k, 1, 3], T_world_camera[k, 2, 3]
            along = x * ox + y * oy + z * oz
            a, d, f = a + 1.0 - x * x, d + 1.0 - y * y, f + 1.0 - z * z
            b, c, e = b - x * y, c - x * z, e - y * z
            p, q, r = p + ox - along * x, q + oy - along * y, r + oz - along * z
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    if determinant < 1e-9:
        return False
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    point[0] = (c00 * p + c01 * q + c02 * r) / determinant
    point[1] = (c01 * p + c11 * q + c12 * r) / determinant
    point[2] = (c02 * p + c12 * q + c22 * r) / determinant
    return True


@kernel
def _off(point: Any, direction: Any, pose: Any) -> float:
    """Distance [m] of a point from a camera's ray; infinite behind the camera."""
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if along <= 0.0:
        return np.inf
    return float(np.sqrt(max(0.0, x * x + y * y + z * z - along * along)))


@kernel
def _wide(directions: Any, used: Any, min_sine: float) -> bool:
    """Whether the first two used rays cross at a wide enough angle."""
    first = -1
    for c in range(len(used)):
        if used[c]:
            if first < 0:
                first = c
            else:
                cosine = np.dot(directions[first], directions[c])
                return bool(1.0 - cosine * cosine >= min_sine * min_sine)
    return False


@kernel
def _join_near(positions: Any, rays: Any, min_distance: float) -> None:
    """Remove the point with fewer rays of any two that are closer than `min_distance` [m]."""
    for s in range(len(rays)):
        for o in range(s):
            if rays[s] > 0 and rays[o] > 0:
                if squared_distance(positions[s], positions[o]) < min_distance * min_distance:
                    gone = o if rays[o] < rays[s] else s
                    rays[gone] = 0
                    positions[gone] = np.nan


@kernel
def _spend(point: Any, source: int, directions: Any, usable: Any, T_world_camera: Any, gate: float) -> None:
    """Mark the rays of a point as used; a camera without a ray of its source gives its nearest ray."""
    for c in range(len(T_world_camera)):
        taken, near = -1, gate
        if usable[source, c]:
            if _off(point, directions[source, c], T_world_camera[c]) <= gate:
                usable[source, c] = False
            continue
        for s in range(len(usable)):
            if usable[s, c]:
                off = _off(point, directions[s, c], T_world_camera[c])
                if off <= near:
                    taken, near = s, off
        if taken >= 0:
            usable[taken, c] = False


@kernel
def _meet_by_chance(
    sources: Any, directions: Any, usable: Any, T_world_camera: Any, gates: Any, min_rays: Any,
    positions: Any, false: Any,
) -> None:  # fmt: skip
    """Write where unused rays of different sources meet into the second of `false`, each (F, 3) [m]."""
    before, now = false
    left = np.argwhere(usable)
    pair, two = np.empty((len(T_world_camera), 3)), np.zeros(len(T_world_camera), dtype=np.bool_)
    point = np.empty(3)
    for first in range(len(left)):
        s, c = left[first]
        for second in range(first + 1, len(left)):
            o, k = left[second]
            if s == o or c == k or not usable[s, c] or not usable[o, k]:
                continue
            pair[c], pair[k] = directions[s, c], directions[o, k]
            two[c], two[k] = True, True
            found = _wide(pair, two, gates[1]) and _nearest_point(pair, two, T_world_camera, point)
            two[c], two[k] = False, False
            if not found or max(
                _off(point, pair[c], T_world_camera[c]), _off(point, pair[k], T_world_camera[k])
            ) > gates[0]:  # fmt: skip
                continue
            column = _false_column(point, before, now)
            fewest = min_rays[0] if column >= 0 else min_rays[1]
            if column < 0:
                column = _free_column(before, now)
            if column < 0 or _support(point, left, directions, usable, T_world_camera, gates[0]) < fewest:
                continue
            if _new_and_near(point, sources, positions, gates[2]):
                now[column] = point
                _spend(point, s, directions, usable, T_world_camera, gates[0])
                usable[s, c] = usable[o, k] = False


@kernel
def _support(point: Any, left: Any, directions: Any, usable: Any, T_world_camera: Any, gate: float) -> int:
    """Number of cameras with an unused ray through the point."""
    through = np.zeros(len(T_world_camera), dtype=np.bool_)
    for s, c in left:
        if usable[s, c] and not through[c]:
            through[c] = _off(point, directions[s, c], T_world_camera[c]) <= gate
    return int(through.sum())


@kernel
def _new_and_near(point: Any, sources: Any, positions: Any, min_distance: float) -> bool:
    """Whether a false point lies in the capture volume and away from all other points."""
    near = False
    for s in range(len(sources)):
        # False where there is none: NaN
        if squared_distance(positions[s], point) < min_distance * min_distance:
            return False
        near |= squared_distance(sources[s], point) < _FALSE_REACH * _FALSE_REACH
    return near


@kernel
def _false_column(point: Any, before: Any, now: Any) -> int:
    """The column whose false point of the frame before lies near, -1 for none."""
    for column in range(len(before)):
        if np.isnan(now[column, 0]) and np.sum((before[column] - point) ** 2) < _FALSE_STEP * _FALSE_STEP:
            return column
    return -1


@kernel
def _free_column(before: Any, now: Any) -> int:
    """A column that was empty in the frame before and is empty now, -1 for none."""
    for column in range(len(before)):
        if np.isnan(now[column, 0]) and np.isnan(before[column, 0]):
            return column
    return -1
