"""A rigid constellation among points: followed from a pose that is known, or looked for; compiled.

A pose is seven numbers: position [m], orientation (wxyz). `owners` (Q,) holds the point of each marker, -1
where it has none.
"""

from __future__ import annotations

from typing import Any, Final

import numba
import numpy as np

from track.kinematics.starting_poses import align_rigid

FEWEST: Final = 3  # markers that tell a pose
_NEW: Final = 1.5  # how much farther than tight a point with a new ID may be off
_FLAT: Final = 0.1  # height of a triangle over its longest side, below which it tells no turn


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def write_transform(pose: Any, transform: Any) -> None:
    """A pose as a 4x4 matrix, whose last row is left as it is."""
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    transform[0, 0], transform[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    transform[1, 0], transform[1, 1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
    transform[2, 0], transform[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    transform[0, 2], transform[1, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x)
    transform[2, 2] = 1 - 2 * (x * x + y * y)
    transform[0, 3], transform[1, 3], transform[2, 3] = pose[0], pose[1], pose[2]


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def put(places: Any, pose: Any) -> Any:
    """Where a pose puts the markers (Q, 3)."""
    transform, put_there = np.empty((4, 4)), np.empty_like(places)
    write_transform(pose, transform)
    for marker in range(len(places)):
        for i in range(3):
            put_there[marker, i] = transform[i, 3]
            for j in range(3):
                put_there[marker, i] += transform[i, j] * places[marker, j]
    return put_there


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def advance(pose: Any, velocity: Any, seconds: float) -> Any:
    """The pose after moving (m/s) and turning (rad/s, world axes) at `velocity` (6,) for a while."""
    later = pose.copy()
    later[:3] += seconds * velocity[:3]
    half = 0.5 * seconds * velocity[3:]
    angle = np.sqrt((half**2).sum())
    if angle > 1e-12:
        sine, cosine = np.sin(angle) / angle, np.cos(angle)
        later[3:] = _times(np.array([cosine, sine * half[0], sine * half[1], sine * half[2]]), pose[3:])
    return later


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def velocity_between(first: Any, second: Any, seconds: float) -> Any:
    """The velocity (6,) that `advance` takes from the first pose to the second."""
    velocity = np.empty(6)
    velocity[:3] = (second[:3] - first[:3]) / seconds
    back = np.array([first[3], -first[4], -first[5], -first[6]])
    turn = _times(second[3:], back)
    if turn[0] < 0.0:  # the same turn, the short way round
        turn = -turn
    sine = np.sqrt((turn[1:] ** 2).sum())
    velocity[3:] = turn[1:] * (
        2.0 / seconds if sine < 1e-12 else 2.0 * np.arctan2(sine, turn[0]) / sine / seconds
    )
    return velocity


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _times(first: Any, second: Any) -> Any:
    a, b, c, d = first[0], first[1], first[2], first[3]
    e, f, g, h = second[0], second[1], second[2], second[3]
    return np.array(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _squared(first: Any, second: Any) -> Any:
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    return x * x + y * y + z * z


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def settle(places: Any, points: Any, owners: Any, pose: Any, tight: float, gate: float) -> Any:
    """Fit the pose to the owned points that agree tightly, and keep those that are within the gate of it.

    Points that are wrong together pull a fit until the right ones look wrong; so that point goes without
    which the others agree best, until all do.

    Returns:
        How many are kept and their RMS distance [m]; with fewer than three that agree none is, and the pose
        stays as it came.
    """
    core, fitted = owners.copy(), np.empty(7)
    count, _, worst = _fit(places, points, core, fitted)
    while count > FEWEST and worst > tight * tight:
        marker, clear = _odd_one(places, points, core)
        if count == FEWEST + 1 and not clear:
            break  # three of four agree in more than one way: all four, if they do within the gate
        core[marker] = -1
        count, _, worst = _fit(places, points, core, fitted)
    limit = tight if count == FEWEST else gate
    if count < FEWEST or not worst <= limit * limit:
        owners[:] = -1
        return 0, np.nan
    pose[:] = fitted
    there, count, total = put(places, pose), 0, 0.0
    for marker in range(len(places)):
        if owners[marker] >= 0:
            square = _squared(there[marker], points[owners[marker]])
            if square > gate * gate:
                owners[marker] = -1
            else:
                count, total = count + 1, total + square
    return count, np.sqrt(total / count)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _fit(places: Any, points: Any, owners: Any, pose: Any) -> Any:
    """Fit the pose to the owned points, three at least; their number, sum of squares and largest square."""
    target, count = np.full_like(places, np.nan), 0
    for marker in range(len(places)):
        if owners[marker] >= 0:
            target[marker] = points[owners[marker]]
            count += 1
    if count < FEWEST:
        return count, np.nan, np.nan
    align_rigid(places, target, np.ones(len(places)), pose)
    there, total, worst = put(places, pose), 0.0, 0.0
    for marker in range(len(places)):
        if owners[marker] >= 0:
            square = _squared(there[marker], target[marker])
            total, worst = total + square, max(worst, square)
    return count, total, worst


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _odd_one(places: Any, points: Any, owners: Any) -> Any:
    """The marker without which the others agree best, and whether without any other they do far worse."""
    odd, least, second, pose = -1, np.inf, np.inf, np.empty(7)
    for marker in range(len(places)):
        if owners[marker] >= 0:
            point, owners[marker] = owners[marker], -1
            _, squares, _ = _fit(places, points, owners, pose)
            owners[marker] = point
            if squares < least:
                odd, least, second = marker, squares, least
            elif squares < second:
                second = squares
    return odd, least < 0.1 * second


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def carry(points: Any, ids: Any, known: Any, owners: Any) -> Any:
    """Give every marker the point that has its ID of the last frame; returns how many have one."""
    count = 0
    for marker in range(len(known)):
        owners[marker] = -1
        if known[marker] < 0:
            continue
        for point in range(len(points)):
            if ids[point] == known[marker]:
                owners[marker] = point
                count += 1
                break
    return count


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def complete(places: Any, points: Any, owners: Any, pose: Any, tight: float, gate: float) -> Any:
    """Let a pose that is known take the points that lie where its other markers are, and settle again."""
    there = put(places, pose)
    for marker in range(len(places)):
        if owners[marker] < 0:
            owners[marker] = _nearest_free(points, there[marker], _NEW * tight, owners)
    return settle(places, points, owners, pose, tight, gate)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _nearest_free(points: Any, place: Any, reach: float, owners: Any) -> Any:
    """The nearest point within reach that no marker owns, -1 if there is none."""
    nearest, least = -1, reach * reach
    for point in range(len(points)):
        square = _squared(points[point], place)
        if square < least and not (owners == point).any():
            nearest, least = point, square
    return nearest


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def lean_on(points: Any, owners: Any, pose: Any, there: Any, gate: float) -> Any:
    """Shift a predicted pose so that the one or two points that are left agree, if they do within the gate.

    `there` is where the pose puts the markers. Returns how many agree and their RMS distance [m]; none stay
    owned if one does not.
    """
    shift, count = np.zeros(3), 0
    for marker in range(len(owners)):
        if owners[marker] >= 0:
            shift += points[owners[marker]] - there[marker]
            count += 1
    total, agree = 0.0, count > 0
    for marker in range(len(owners)):
        if owners[marker] >= 0:
            square = _squared(points[owners[marker]], there[marker] + shift / count)
            total += square
            agree = agree and square <= gate * gate
    if not agree or (shift**2).sum() > (count * gate) ** 2:
        owners[:] = -1
        return 0, np.nan
    pose[:3] += shift / count
    return count, np.sqrt(total / count)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def search(
    places: Any, sides: Any, points: Any, wanted: Any, reach: float, gate: float, owners: Any, pose: Any
) -> Any:
    """The largest set of points that lies as the markers do, found from every triangle that fits.

    Args:
        places: The constellation (Q, 3) [m].
        sides: Its distances (Q, Q).
        points: (N, 3) [m].
        wanted: Where markers are thought to be (Q, 3).
        reach: How far from there they may be [m]; infinite when nothing is known.
        gate: How far a point may be from its marker in the end [m].
        owners: Written: the points of the best explanation.
        pose: Written: its pose.

    Returns:
        How many markers it explains, its RMS distance [m], and how many the best other explanation does.
    """
    apart = np.empty((len(points), len(points)))
    for i in range(len(points)):
        for j in range(len(points)):
            apart[i, j] = np.sqrt(_squared(points[i], points[j]))
    near = np.empty((len(places), len(points)), dtype=np.bool_)
    for marker in range(len(places)):
        for point in range(len(points)):
            near[marker, point] = reach == np.inf or _squared(points[point], wanted[marker]) <= reach * reach
    slack, score = 2.0 * gate, np.array([0.0, np.inf, 0.0])
    owners[:] = -1
    for a in range(len(places) - 2):
        for b in range(a + 1, len(places) - 1):
            for i in range(len(points)):
                for j in range(len(points)):
                    fits = near[a, i] and near[b, j] and abs(apart[i, j] - sides[a, b]) <= slack
                    if fits and i != j:
                        side = a, b, i, j
                        _try_thirds(places, sides, points, apart, near, gate, side, owners, pose, score)
    return int(score[0]), score[1], int(score[2])


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _try_thirds(
    places: Any,
    sides: Any,
    points: Any,
    apart: Any,
    near: Any,
    gate: float,
    side: Any,
    owners: Any,
    pose: Any,
    score: Any,
) -> None:
    """Weigh every triangle with a later marker over a side that fits."""
    a, b, i, j = side
    trial, slack = np.empty_like(owners), 2.0 * gate
    for c in range(b + 1, len(places)):
        for k in range(len(points)):
            if abs(apart[i, k] - sides[a, c]) > slack or abs(apart[j, k] - sides[b, c]) > slack:
                continue
            if near[c, k] and k != i and k != j:  # noqa: PLR1714  a tuple costs a kernel time
                trial[:] = -1
                trial[a], trial[b], trial[c] = i, j, k
                if _extend(places, points, slack, trial, a, b, c) >= max(score[0], FEWEST):
                    _weigh(places, points, gate, trial, owners, pose, score)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _weigh(places: Any, points: Any, gate: float, trial: Any, owners: Any, pose: Any, score: Any) -> None:
    """Keep an explanation that is better than the best so far: more markers, or as many that fit better.

    `score` is how many markers the best explains, its RMS distance, and how many the best other one does; one
    that gives three points to the same markers is no other.
    """
    trial_pose = np.empty(7)
    count, rms = settle(places, points, trial, trial_pose, gate, gate)
    if count < max(score[0], FEWEST):
        return
    other = ((trial >= 0) & (trial == owners)).sum() < FEWEST
    if count > score[0] or rms < score[1]:
        if other:
            score[2] = score[0]
        score[0], score[1] = count, rms
        owners[:], pose[:] = trial, trial_pose
    elif other:
        score[2] = count


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _extend(places: Any, points: Any, slack: float, owners: Any, a: int, b: int, c: int) -> Any:
    """Take the points where a triangle of markers says that others are; returns how many there are now."""
    model, seen = np.empty((3, 3)), np.empty((3, 3))
    if not _frame(places[a], places[b], places[c], model):
        return 0
    if not _frame(points[owners[a]], points[owners[b]], points[owners[c]], seen):
        return 0
    turn, count = seen.T @ model, 3
    for marker in range(len(places)):
        if owners[marker] < 0:
            there = points[owners[a]] + turn @ (places[marker] - places[a])
            owners[marker] = _nearest_free(points, there, slack, owners)
            count += owners[marker] >= 0
    return count


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _frame(first: Any, second: Any, third: Any, axes: Any) -> Any:
    """Axes, as rows, along a triangle's first side, in its plane, and off it; whether it has a plane."""
    along, across = second - first, third - first
    length = np.sqrt((along**2).sum())
    axes[0] = along / length
    across -= (across * axes[0]).sum() * axes[0]
    height = np.sqrt((across**2).sum())
    axes[1] = across / height
    axes[2, 0] = axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2]
    axes[2, 2] = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    return length > 0.0 and height > _FLAT * length


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def follow(
    places: Any, points: Any, ids: Any, known: Any, pose: Any, tight: float, gate: float, owners: Any
) -> Any:
    """Owners by last frame's IDs, and the rest from the pose that they agree on.

    Returns:
        How many markers agree and their RMS distance [m]; fewer than three leave the pose as it came.
    """
    if carry(points, ids, known, owners) < FEWEST:
        return 0, np.nan
    count, rms = settle(places, points, owners, pose, tight, gate)
    if FEWEST <= count < len(places):
        return complete(places, points, owners, pose, tight, gate)
    return count, rms


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def write_labels(owners: Any, ids: Any, labels: Any, known: Any) -> None:
    """Write the marker of every owned point, and the ID of every marker's point."""
    for marker in range(len(owners)):
        known[marker] = -1
        if owners[marker] >= 0:
            labels[owners[marker]] = marker
            known[marker] = ids[owners[marker]]
