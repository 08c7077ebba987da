"""Reconstruction by an optical system: blobs, rays, points, gaps and false points.

One model produces them all. A marker is a noisy blob in every camera that sees it; blobs that touch merge;
rays through blobs meet in points, if enough of them meet closely enough; rays without a point may meet by
chance.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.pieces import shared_columns
from handsim.errors import ArgumentError
from handsim.kernels import kernel, squared_distance
from handsim.settings import Limits, Settings
from handsim.space.camera import PINHOLE, distort_jacobian
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import CameraRig

_FALSE_REACH = 0.25  # a point farther than this from every source is outside the capture volume [m]
_FALSE_STEP = 0.015  # a false point that moved at most this far since the last frame is the same one [m]
MAX_FALSE_POINTS: Final = 6
"""False intersections kept per frame."""


@kernel
def draw_blobs(
    sources: Any, sizes: Any, seen: Any, cameras: Any, optics: Any, rng: Any, centers: Any, radii: Any
) -> None:
    """Write noisy blob centers (C, S, 2) and radii (C, S) [px] of one frame; radius 0 where there is no blob.

    The error of a disc's centroid comes from the pixels of its border, whose number grows with the radius,
    and is divided by the disc's area, which grows with its square: it falls with the radius's root.

    Args:
        sources: Positions of everything that shines (S, 3) [m]; NaN where there is none.
        sizes: Radius of each (S,) [m].
        seen: Which cameras have a free view of each (S, C).
        cameras: `CameraArrays` of C cameras.
        optics: Noise of a source of `MARKER_RADIUS` [px], chance to lose a blob, roundness.
        rng: Random numbers are drawn camera by camera, then source by source.
    """
    loss = optics[1]
    for c in range(len(cameras.lenses)):
        pose, lens = cameras.T_world_camera[c], cameras.lenses[c]
        fx, fy = cameras.intrinsics[c, 0], cameras.intrinsics[c, 1]
        focal = np.sqrt(fx * fy)
        for s in range(len(sources)):
            radii[c, s] = 0.0
            if not seen[s, c] or np.isnan(sources[s, 0]) or (loss > 0.0 and rng.random() < loss):
                continue
            x, y, z = sources[s, 0] - pose[0, 3], sources[s, 1] - pose[1, 3], sources[s, 2] - pose[2, 3]
            depth = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
            if depth <= 1e-6:
                continue
            right = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
            down = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
            noise = optics[0] * np.sqrt(MARKER_RADIUS / sizes[s])
            du, dv = noise * rng.standard_normal(), noise * rng.standard_normal()
            if lens[0] != PINHOLE:
                xx, xy, yx, yy = distort_jacobian(lens, right, down, depth)
                determinant = xx * yy - xy * yx
                if not determinant > 1e-6:  # also where the lens does not see: NaN
                    continue
                across, along = du / fx, dv / fy
                du, dv = (
                    fx * (yy * across - xy * along) / determinant,
                    fy * (xx * along - yx * across) / determinant,
                )
            radii[c, s] = focal * sizes[s] / depth
            centers[c, s, 0] = fx * right / depth + du
            centers[c, s, 1] = fy * down / depth + dv


@kernel
def cast_rays(
    seen: Any, cameras: Any, optics: Any, centers: Any, radii: Any, directions: Any, usable: Any
) -> None:
    """Write the unit rays (S, C, 3) of every source's blob in every camera; blobs that touch have merged.

    `usable` (S, C) gets whether a camera has a ray to a source. The other arguments are those of
    `draw_blobs`.
    """
    roundness = optics[2]
    count = seen.shape[0]
    blobs, touches = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.bool_)
    for c in range(len(cameras.lenses)):
        pose, inner = cameras.T_world_camera[c], cameras.intrinsics[c]
        number = 0
        for s in range(count):
            usable[s, c] = radii[c, s] > 0.0
            if usable[s, c]:
                blobs[number] = s
                number += 1
        touches[:number] = False
        for n in range(number):
            x, y, size = centers[c, blobs[n], 0], centers[c, blobs[n], 1], radii[c, blobs[n]]
            for m in range(n):
                du, dv, reach = (
                    centers[c, blobs[m], 0] - x,
                    centers[c, blobs[m], 1] - y,
                    radii[c, blobs[m]] + size,
                )
                if du * du + dv * dv < reach * reach:
                    touches[n] = touches[m] = True
        for n in range(number):
            s = blobs[n]
            u, v, members = centers[c, s, 0], centers[c, s, 1], 1
            for m in range(number if touches[n] else 0):
                o = blobs[m]
                du, dv, reach = (
                    centers[c, o, 0] - centers[c, s, 0],
                    centers[c, o, 1] - centers[c, s, 1],
                    radii[c, o] + radii[c, s],
                )
                squared = du * du + dv * dv
                if o == s or squared >= reach * reach:
                    continue
                if squared > (roundness * reach) ** 2:
                    usable[s, c] = False
                    break
                u, v, members = u + centers[c, o, 0], v + centers[c, o, 1], members + 1
            if not usable[s, c]:
                continue
            u, v = u / (members * inner[0]), v / (members * inner[1])
            length = np.sqrt(u * u + v * v + 1.0)
            for i in range(3):
                directions[s, c, i] = (pose[i, 0] * u + pose[i, 1] * v + pose[i, 2]) / length


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
        optics: As for `gloves.optics.reconstruction.draw_blobs`.
        gates: Largest residual of a ray [m], sine of the smallest angle, smallest distance of two points [m].
        min_rays: Rays that must meet for a point to go on, and to begin.
        rays: Output: the number of rays of each point (T, S).
        false_points: Output: false intersections (T, F, 3) [m]; all NaN when passed.
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
    """Write the point (3,) nearest to a source's rays (C, 3) without the worst; return how many are used."""
    used = usable.copy()
    count = 0
    for c in range(len(used)):
        count += used[c]
    while count >= enough:
        if not _nearest_point(directions, used, T_world_camera, point):
            break
        worst, far = -1, gates[0] * gates[0]
        for c in range(len(used)):
            if used[c]:
                off = _off_squared(point, directions[c], T_world_camera[c])
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


@kernel(inline=True)
def _off_squared(point: Any, direction: Any, pose: Any) -> float:
    """Squared distance [m^2] of a point from a camera's ray; infinite behind the camera."""
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if along <= 0.0:
        return np.inf
    return float(x * x + y * y + z * z - along * along)


@kernel
def _wide(directions: Any, used: Any, min_sine: float) -> bool:
    """Whether the first two used rays cross at a wide enough angle."""
    first = -1
    for c in range(len(used)):
        if used[c]:
            if first < 0:
                first = c
            else:
                return bool(_sine_squared(directions[first], directions[c]) >= min_sine * min_sine)
    return False


@kernel(inline=True)
def _sine_squared(one: Any, other: Any) -> float:
    """Squared sine of the angle between two unit directions (3,)."""
    cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return float(1.0 - cosine * cosine)


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
    """Mark the rays of a point as used; in a camera without a ray of its source, the nearest ray."""
    for c in range(len(T_world_camera)):
        taken, near = -1, gate * gate
        if usable[source, c]:
            if _off_squared(point, directions[source, c], T_world_camera[c]) <= near:
                usable[source, c] = False
            continue
        for s in range(len(usable)):
            if usable[s, c]:
                off = _off_squared(point, directions[s, c], T_world_camera[c])
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
            if not found or gates[0] * gates[0] < max(
                _off_squared(point, pair[c], T_world_camera[c]),
                _off_squared(point, pair[k], T_world_camera[k]),
            ):
                continue
            column, is_old = _false_column(point, before, now)
            fewest = min_rays[0] if is_old else min_rays[1]
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
            through[c] = _off_squared(point, directions[s, c], T_world_camera[c]) <= gate * gate
    return int(through.sum())


@kernel
def _new_and_near(point: Any, sources: Any, positions: Any, min_distance: float) -> bool:
    """Whether a false point lies in the capture volume and away from all other points."""
    near = False
    for s in range(len(sources)):
        # A missing point is NaN, and comparisons with NaN are false.
        if squared_distance(positions[s], point) < min_distance * min_distance:
            return False
        near |= squared_distance(sources[s], point) < _FALSE_REACH * _FALSE_REACH
    return near


@kernel
def _false_column(point: Any, before: Any, now: Any) -> tuple[int, bool]:
    """The column for a false point, -1 for none, and whether a near point of the frame before has it."""
    free = -1
    for column in range(len(before)):
        if np.isnan(now[column, 0]):
            if np.sum((before[column] - point) ** 2) < _FALSE_STEP * _FALSE_STEP:
                return column, True
            if free < 0 and np.isnan(before[column, 0]):
                free = column
    return free, False


@dataclass(frozen=True, slots=True)
class FrameOptics(Settings):
    """What blobs and rays do in a single frame; the defaults are those of a well-kept optical system."""

    noise: Annotated[float, Limits(0.0)] = 0.12
    """Standard deviation of a blob's center per axis in the camera's own pixels [px], for a sphere of 3.2 mm
    radius; it falls with the root of the radius."""
    marker_radius: Annotated[float, Limits(0.0, above=True)] | None = None
    """Radius of the glove's spheres [m]; the layout's when not given."""
    roundness: Annotated[float, Limits(0.0)] = 0.5
    """Two blobs that touch merge: they count as a marker while their centers are nearer than this share of
    the sum of their radii, and are discarded as not round beyond it."""
    max_residual: Annotated[float, Limits(0.0)] = 0.003
    """Largest distance of a ray from its point [m]; the worst ray is dropped first."""
    min_angle: Annotated[float, Limits(0.0, 90.0)] = 10.0
    """Two rays alone must cross at this angle at least [deg]."""
    min_distance: Annotated[float, Limits(0.0)] = 0.004
    """Of two points nearer to each other than this [m], only the one with more rays is kept."""

    def worn(self, radius: float) -> Self:
        """These settings for spheres of this radius [m], unless `marker_radius` is given."""
        return dataclasses.replace(self, marker_radius=self.radius_of(radius))

    def radius_of(self, radius: float) -> float:
        """`marker_radius`, or in its absence a layout's [m]."""
        return radius if self.marker_radius is None else self.marker_radius


@dataclass(frozen=True, slots=True)
class OpticsConfig(FrameOptics):
    """Properties of cameras and solver over time, beside those of a single frame such as `noise` [px].

    The defaults are those of a well-kept optical system.
    """

    partial: Annotated[float, Limits(0.0)] = 0.5
    """Each line of sight goes to a random point of the marker within this share of its radius, so markers
    behind an edge flicker."""
    blob_loss: Annotated[float, Limits(0.0, 1.0)] = 0.002
    """Chance that a camera misses a blob it should see."""
    dropout: Annotated[float, Limits(0.0, 1.0)] = 0.0002
    """Chance per frame that cameras begin to lose their pictures: a lost packet, or an arm in front."""
    dropout_length: Annotated[float, Limits(1.0)] = 3.0
    """Mean number of pictures that a camera loses in a dropout."""
    dropout_cameras: Annotated[int, Limits(0)] = 1
    """Number of cameras that drop out together, as those on one network switch do."""
    min_rays: Annotated[int, Limits(2)] = 2
    """Rays that must meet for a point to exist."""
    min_rays_to_start: Annotated[int, Limits(2)] = 3
    """Rays that must meet for a point that did not exist in the frame before."""

    def check(self) -> None:
        """Refuse points that begin with fewer rays than they need to go on."""
        if self.min_rays > self.min_rays_to_start:
            raise ArgumentError(
                f"min_rays is {self.min_rays} and min_rays_to_start {self.min_rays_to_start}, "
                "expected 2 <= min_rays <= min_rays_to_start"
            )


class Reconstruction(NamedTuple):
    """The points of every frame, each under the source it comes from."""

    positions: Float[np.ndarray, "T S 3"]
    """Reconstructed position of each source [m], NaN where there is none."""
    rays: Int[np.ndarray, "T S"]
    """Rays that made each point, 0 where there is none."""
    false_points: Float[np.ndarray, "T F 3"]
    """Points where rays of different sources met by chance [m], NaN where none; a column holds one such point
    for as long as it stays."""


def reconstruct(
    sources: Float[np.ndarray, "T S 3"],
    seen: Bool[np.ndarray, "T S C"],
    rig: CameraRig,
    config: OpticsConfig,
    *,
    radii: Float[np.ndarray, "S"] | float = MARKER_RADIUS,
    continuous: bool,
    rng: np.random.Generator,
) -> Reconstruction:
    """Simulate detection and triangulation of sources of these radii [m], where cameras have seen them.

    Frames follow each other in time if `continuous`; otherwise each stands alone, and `min_rays` is enough.
    """
    frames, count = sources.shape[:2]
    positions = np.full((frames, count, 3), np.nan)
    rays = np.zeros((frames, count), dtype=np.int64)
    false_points = np.full((frames, MAX_FALSE_POINTS, 3), np.nan)
    cameras = len(rig.positions)
    begins = np.flatnonzero(rng.random(frames) < config.dropout)
    lasts = rng.geometric(1.0 / config.dropout_length, size=len(begins))
    lost = np.zeros((frames, cameras), dtype=bool)  # pictures of cameras that drop out together
    for begin, last in zip(begins, lasts, strict=True):
        together = rng.choice(cameras, min(cameras, config.dropout_cameras), replace=False)
        lost[begin : begin + last, together] = True
    reconstruct_frames(
        np.ascontiguousarray(sources, dtype=np.float64),
        np.broadcast_to(np.asarray(radii, dtype=np.float64), count).copy(),
        np.ascontiguousarray(seen & ~lost[:, None]),
        rig.arrays,
        (config.noise, config.blob_loss, config.roundness),
        (config.max_residual, np.sin(np.deg2rad(config.min_angle)), config.min_distance),
        (config.min_rays, config.min_rays_to_start if continuous else config.min_rays),
        rng,
        positions,
        rays,
        false_points,
    )
    return Reconstruction(positions, rays, false_points)


def number_runs(present: Bool[np.ndarray, "T S"]) -> Int[np.ndarray, "T S"]:
    """IDs from 0 in order of appearance, one per unbroken run of a source; -1 where there is no point."""
    begins = present.copy()
    begins[1:] &= ~present[:-1]
    numbers = np.cumsum(begins.ravel()).reshape(begins.shape) - 1
    running = np.maximum.accumulate(np.where(begins, numbers, -1), axis=0)
    return np.where(present, running, -1)


def pack_columns(
    present: Bool[np.ndarray, "T S"], *, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "T S"], int]:
    """Pack many runs into few columns: an unbroken stretch of a column is one run, then a frame is empty.

    Returns the column of every point, -1 where there is none, and the number of columns. Runs that begin
    together get columns in random order, which does not reveal sources.
    """
    ids = number_runs(present)
    lengths = np.bincount(ids[present])
    begins = present & (np.diff(ids, axis=0, prepend=-1) != 0)
    first = np.nonzero(begins)[0]  # in the order of the IDs
    order = np.lexsort((rng.random(len(first)), first))
    columns = np.empty(len(first), dtype=np.int64)
    columns[order], count = shared_columns(first[order], (first + lengths - 1)[order])
    return np.append(columns, -1)[ids], count
