"""Search for a camera rig: candidate places, what they would see of hands at work, and the best ones.

Cameras are chosen one after the other, then exchanged while that helps. Each candidate has bits of the
marker-frames that it sees, and its information on the points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, UInt64
from numpy.typing import NDArray

from gloves.layout import load_layout
from handsim._checks import check_array, check_count
from handsim.callbacks import OnStep, no_step
from handsim.errors import ArgumentError
from handsim.space.camera import Camera, focal_of_angle, look_at, pinhole
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import HAND_REACH, MAX_CAMERAS, MAX_SIDE, MIN_CAMERAS, CameraRig, load_rig
from train.forecast.rig_forecast import OPTICS, Forecast, forecast, light_work, sample_work
from train.forecast.settings import Mount, PlanRigSettings
from train.simulation.room import SceneSight, marker_radii
from train.simulation.scenes import SceneMotion

_MAX_PLACES: Final = 400  # The step between places grows with the room to stay below this number.
_STEPS: Final = (0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)  # [m] tried steps between places
_CLEARANCE: Final = 0.1  # [m] distance of a lens from a wall, ceiling or beam
_MIN_HEIGHT: Final = 0.5  # [m] least height of cameras on walls and posts
_TRIPOD_HEIGHTS: Final = (0.9, 1.4, 1.9)  # [m]
_LARGE_SIDE: Final = 1.0  # [m] Along longer sides of a volume cameras may also look beside its center.
_ASIDE: Final = 0.3  # offset of these targets from the center, as share of the side

_WEIGHTS: Final = (0.02, 0.4, 0.6, 0.05)
"""Values of the shares of marker-frames seen by one, two, three and four cameras. A point begins with three
rays and continues with two, so both count. One camera matters only until there is a second, and a fourth
compensates for a lost picture."""
_ERROR_COST: Final = 0.15  # cost of a millimeter of mean error
_MAX_ERROR: Final = 1.5  # [mm] error of points seen by fewer than two cameras, or only along nearly one line
_MIN_DISTANCE: Final = 0.3  # [m] least distance between two cameras
_MIN_GAIN: Final = 1e-5  # least gain of an exchange
_WIDE: Final = pinhole("wide", (1280, 1280), focal_of_angle(1280, np.deg2rad(170.0)))
"""Camera that has hands in view wherever it is aimed."""
_ERROR_SAMPLES: Final = 1200  # marker-frames for the estimate of the error
_PEOPLE: Final = 3  # people for each kind of work
_FRAMES: Final = 900  # frames of each person
_STRIDE: Final = 12  # One frame in this many is used.
_TEST_FRAMES: Final = 600  # frames of each person for the forecast; other people than those of the search


class RigPlan(NamedTuple):
    """A planned rig and its forecast."""

    rig: CameraRig
    targets: Float[np.ndarray, "C 3"]
    """Point at which each camera looks [m]; for kept cameras a point one meter ahead."""
    before: Forecast | None
    """Forecast of the kept cameras alone."""
    after: Forecast


def plan_rig(
    cameras: int,
    room: Sequence[float],
    settings: PlanRigSettings | None = None,
    *,
    camera: Camera | None = None,
    name: str = "planned",
    on_step: OnStep = no_step,
    **options: Any,
) -> RigPlan:
    """Look for the best places of cameras, as `handsim rig plan` does.

    Args:
        cameras: Number of cameras of the rig, including kept ones.
        room: Width along x, depth along y and height of the room or truss (3,) [m]; it stands on the floor,
            with its center below that of the volume.
        settings: Where hands work, and what cameras can be mounted on.
        camera: Model of every new camera except for its pose; if not given, the first kept camera, or one of
            the settings' size and field of view.
        name: Name of the rig.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name.

    Raises:
        ArgumentError: A setting or number is refused, or there is no place for so many cameras.
        LayoutError, RigError: The glove or the rig is unknown.
    """
    chosen = PlanRigSettings.of(settings, options)
    layout, seed = load_layout(chosen.glove), chosen.seed
    kept = None if chosen.keep is None else load_rig(chosen.keep)
    old = () if kept is None else tuple(kept.cameras)
    check_count("cameras", cameras, len(old) + 1 if old else MIN_CAMERAS, MAX_CAMERAS)
    lengths = check_array("room", room, (3,))
    if not ((lengths > 0.0) & (lengths < MAX_SIDE)).all():
        raise ArgumentError(
            f"room is {_meters(lengths)}, expected three lengths, each above 0 and below {MAX_SIDE:g} m"
        )
    sides, center = np.array(chosen.volume, dtype=np.float64), np.array(chosen.center, dtype=np.float64)
    focal = focal_of_angle(min(chosen.size), np.deg2rad(chosen.field_of_view))
    new = camera or (old[0] if old else pinhole("camera", chosen.size, focal))
    poses, free = places(lengths, chosen.mounts, center, sides)
    candidates = [*old, *(new.at(pose) for pose in poses)]
    ahead = [one.T_world_camera[:3, 3] + one.T_world_camera[:3, 2] for one in old]
    targets = np.array([*ahead, *free])
    on_step("simulating hands")
    rng = np.random.default_rng(seed)
    work = sample_work(layout, center, sides, _FRAMES, _PEOPLE, rng=rng)
    scenes = [one.faster(_STRIDE) for part in work.values() for one in part]
    on_step(f"what cameras at {len(free)} places would see")
    search = Planning(view_candidates(scenes, candidates, rng=rng), kept=range(len(old)))
    search.grow(cameras)
    search.exchange(lambda value: on_step(f"moving cameras: {value:.4f}"))
    hung = [
        dataclasses.replace(candidates[number], name=f"camera{place}")
        for place, number in enumerate(search.chosen[len(old) :], len(old) + 1)
    ]
    rig = CameraRig(name, [*old, *hung])
    on_step("forecasting")
    fresh = sample_work(layout, center, sides, _TEST_FRAMES, 1, rng=np.random.default_rng(seed + 1))
    before = None if kept is None else _forecast(fresh, kept, seed)
    return RigPlan(rig, targets[search.chosen], before, _forecast(fresh, rig, seed))


def _forecast(work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, seed: int) -> Forecast:
    lit = light_work(work, rig, rng=np.random.default_rng(seed))
    return forecast([one for scenes in lit.values() for one in scenes], rig, seed=seed)


def places(
    room: Float[np.ndarray, "3"],
    mounts: Sequence[Mount],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "K 4 4"], Float[np.ndarray, "K 3"]]:
    """Poses `T_world_camera` of all candidates on the mounts of a room, and their targets in a volume [m]."""
    positions_on = {"walls": _wall_positions, "truss": _truss_positions, "tripods": _tripod_positions}
    for step in _STEPS:
        positions = np.concatenate([positions_on[mount](room, step) for mount in mounts])
        found = np.unique(positions.round(6), axis=0)
        found[:, :2] += center[:2]
        nearest = np.clip(found, center - sides / 2, center + sides / 2)
        found = found[np.linalg.norm(found - nearest, axis=1) >= HAND_REACH]
        if len(found) <= _MAX_PLACES:
            break
    if not len(found):
        raise ArgumentError(
            f"in a room of {_meters(room)} no place on {' and '.join(mounts)} is {HAND_REACH:g} m or more "
            f"from the volume of {_meters(sides)}; expected a larger room"
        )
    aims = [center]
    for axis in range(3):
        if sides[axis] > _LARGE_SIDE:
            offset = np.eye(3)[axis] * _ASIDE * sides
            aims += [center + offset, center - offset]
    pairs = [(position, aim) for position in found for aim in aims]
    return np.stack([look_at(position, aim) for position, aim in pairs]), np.stack([aim for _, aim in pairs])


def _wall_positions(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Positions (N, 3) on the four walls [m]."""
    width, depth = room[:2] / 2 - _CLEARANCE
    return _at_heights(_outline(width, depth, step), _spaced(_MIN_HEIGHT, room[2] - _CLEARANCE, step))


def _truss_positions(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Positions (N, 3) on the beams along all four upper edges, and on the posts below their ends [m]."""
    width, depth = room[:2] / 2
    beams = _at_heights(_outline(width, depth, step), np.array([room[2] - _CLEARANCE]))
    corners = np.array([[x, y] for x in (-width, width) for y in (-depth, depth)])
    return np.concatenate([beams, _at_heights(corners, _spaced(_MIN_HEIGHT, room[2] - _CLEARANCE, step))])


def _tripod_positions(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Positions (N, 3) of tripods all over the floor [m]."""
    width, depth = room[:2] / 2 - 3 * _CLEARANCE
    along, across = _spaced(-width, width, step), _spaced(-depth, depth, step)
    floor = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    return _at_heights(
        floor, np.array([height for height in _TRIPOD_HEIGHTS if height < room[2] - _CLEARANCE])
    )


def _outline(width: float, depth: float, step: float) -> NDArray[np.float64]:
    """Points (N, 2) on a rectangle with these half sides, about one step apart [m]."""
    along, across = _spaced(-width, width, step), _spaced(-depth, depth, step)
    sides = [np.stack([along, np.full(len(along), end)], axis=1) for end in (-depth, depth)]
    sides += [np.stack([np.full(len(across), end), across], axis=1) for end in (-width, width)]
    return np.concatenate(sides)


def _spaced(low: float, high: float, step: float) -> NDArray[np.float64]:
    """Evenly spaced numbers from end to end, about one step apart."""
    return np.linspace(low, high, max(1, round((high - low) / step)) + 1)


def _at_heights(floor: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) [m]: each floor point (N, 2) at each height."""
    above = np.repeat(floor, len(heights), axis=0)
    return np.column_stack([above, np.tile(heights, len(floor))])


def _meters(sides: NDArray[np.float64]) -> str:
    return " x ".join(f"{one:g}" for one in sides) + " m"


class CandidateViews(NamedTuple):
    """Marker-frames as seen by K candidate cameras."""

    positions: Float[np.ndarray, "K 3"]
    """Positions of the candidates [m]."""
    bits: UInt64[np.ndarray, "K W"]
    """Visible marker-frames of each candidate, 64 per word."""
    num_marker_frames: int
    information: Float[np.ndarray, "6 K S"]
    """Information on S of the marker-frames from each candidate [1/mm^2]: xx, xy, xz, yy, yz, zz; 0 where it
    sees nothing."""


def view_candidates(
    scenes: Sequence[SceneMotion], candidates: Sequence[Camera], *, rng: np.random.Generator
) -> CandidateViews:
    """Cast the lines of sight from every marker to every candidate, once per position."""
    positions = np.stack([one.T_world_camera[:3, 3] for one in candidates])
    apart, which = np.unique(positions.round(6), axis=0, return_inverse=True)
    seen, points, noise = [], [], []
    for scene in scenes:
        free, centers, radii = _free_views(scene, apart, rng)
        inside = np.stack([one.in_view(centers) for one in candidates])
        seen.append(free[:, which.reshape(-1)].T & inside)
        points.append(centers)
        noise.append(OPTICS.noise * np.sqrt(MARKER_RADIUS / radii))
    views, centers = np.concatenate(seen, axis=1), np.concatenate(points)
    sampled = rng.choice(len(centers), min(_ERROR_SAMPLES, len(centers)), replace=False)
    focals = np.array([one.focal_length for one in candidates])
    information = _information(centers[sampled], positions, np.concatenate(noise)[sampled] / focals[:, None])
    padded = np.zeros((len(views), -(-views.shape[1] // 64) * 64), dtype=bool)
    padded[:, : views.shape[1]] = views
    bits = np.packbits(padded, axis=1).view(np.uint64)
    return CandidateViews(positions, bits, len(centers), information * views[:, sampled])


def _free_views(
    scene: SceneMotion, positions: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Marker-frames of the hands: which positions see them (N, P), centers (N, 3) and radii (N,) [m]."""
    count = sum(hand.fit.layout.num_markers for hand in scene.hands)
    parts = []
    for begin in range(0, len(positions), MAX_CAMERAS):
        few = positions[begin : begin + MAX_CAMERAS]
        # A rig needs two cameras: a single one gets a companion, whose view is dropped.
        some = few if len(few) >= MIN_CAMERAS else np.concatenate([few, few + np.array([0.0, 0.0, 1.0])])
        middle = scene.hands[0].qpos[:, :3].mean(axis=0)
        cameras = [
            dataclasses.replace(_WIDE.at(look_at(one, middle)), name=f"{number}")
            for number, one in enumerate(some)
        ]
        sight = SceneSight(scene, CameraRig("candidates", cameras))
        radii = marker_radii(scene, OPTICS)
        visible = sight.visible_markers(OPTICS.partial * radii, rng=rng)
        parts.append(visible[:, :count, : len(few)].reshape(-1, len(few)))
    centers = sight.markers[0][:, :count].reshape(-1, 3)
    return np.concatenate(parts, axis=1), centers, np.tile(radii[:count], scene.num_frames)


def _information(
    points: NDArray[np.float64], positions: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Information (6, K, S) [1/mm^2] of rays with noisy directions [rad]."""
    rays = points - positions[:, None]
    distances = np.linalg.norm(rays, axis=-1)
    x, y, z = np.moveaxis(rays / distances[..., None], -1, 0)
    weight = 1e-6 / (noise * distances) ** 2
    parts = (1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z)
    return np.stack([(weight * part).astype(np.float32) for part in parts])


class Planning:
    """Cameras chosen among candidates, in addition to kept ones."""

    def __init__(self, views: CandidateViews, kept: Sequence[int] = ()) -> None:
        self._views, self._kept = views, tuple(kept)
        self.chosen = list(kept)
        """Indices of the candidates chosen so far."""

    def value_of(self, chosen: Sequence[int]) -> float:
        """Value of a set of cameras."""
        seen = [int(np.bitwise_count(plane).sum()) for plane in self._coverage_bits(chosen)]
        shares = np.array(seen) / self._views.num_marker_frames
        error = _mean_error(self._views.information[:, list(chosen)].sum(axis=1)[:, None])
        return float(shares @ _WEIGHTS - _ERROR_COST * error[0])

    def grow(self, num_cameras: int) -> None:
        """Add the best candidates up to `num_cameras`."""
        while len(self.chosen) < num_cameras:
            values = self._values_with(self.chosen)
            if not np.isfinite(values.max()):
                raise ArgumentError(
                    f"there is room for {len(self.chosen)} cameras {_MIN_DISTANCE:g} m apart, expected "
                    f"{num_cameras}; give more mounts or a larger room"
                )
            self.chosen.append(int(values.argmax()))

    def exchange(self, on_value: Callable[[float], None] = lambda value: None) -> None:
        """Move one camera at a time to the best candidate while the value rises; report it to `on_value`."""
        value, idle, number = self.value_of(self.chosen), 0, len(self._kept)
        free = len(self.chosen) - len(self._kept)
        for _ in range(200):
            if idle >= free:
                return
            others = self.chosen[:number] + self.chosen[number + 1 :]
            values = self._values_with(others)
            best = int(values.argmax())
            idle += 1
            if values[best] > value + _MIN_GAIN:
                self.chosen[number], value, idle = best, float(values[best]), 0
                on_value(value)
            number = number + 1 if number + 1 < len(self.chosen) else len(self._kept)

    def _values_with(self, chosen: Sequence[int]) -> NDArray[np.float64]:
        """Values (K,) of the chosen cameras plus each candidate; -inf if it is too close to another."""
        views = self._views
        planes = self._coverage_bits(chosen)
        values = np.zeros(len(views.bits))
        before = [~np.zeros_like(planes[0]), *planes[:-1]]
        for weight, plane, fewer in zip(_WEIGHTS, planes, before, strict=True):
            fresh = np.bitwise_count(views.bits & (fewer & ~plane)).sum(axis=1, dtype=np.int64)
            values += weight * (fresh + int(np.bitwise_count(plane).sum()))
        values /= views.num_marker_frames
        information = views.information[:, list(chosen)].sum(axis=1)[:, None]
        values -= _ERROR_COST * _mean_error(information + views.information)
        for camera in chosen:
            distances = np.linalg.norm(views.positions - views.positions[camera], axis=1)
            values[distances < _MIN_DISTANCE] = -np.inf
        return values

    def _coverage_bits(self, chosen: Sequence[int]) -> list[NDArray[np.uint64]]:
        """Bits of the marker-frames seen by at least one, two, ... of the chosen cameras."""
        planes = [np.zeros_like(self._views.bits[0]) for _ in _WEIGHTS]
        for camera in chosen:
            for level in range(len(_WEIGHTS) - 1, 0, -1):
                planes[level] |= planes[level - 1] & self._views.bits[camera]
            planes[0] |= self._views.bits[camera]
        return planes


def _mean_error(information: Float[np.ndarray, "6 K S"]) -> NDArray[np.float64]:
    """Root mean square error of points (K,) [mm], averaged over the points."""
    a, b, c, d, e, f = information
    # trace of the inverse of [[a, b, c], [b, d, e], [c, e, f]]
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    known = determinant > 1e-6 * np.maximum(a + d + f, 1e-12) ** 3
    squared = np.where(known, minors, _MAX_ERROR**2) / np.where(known, determinant, 1.0)
    return np.asarray(np.sqrt(np.clip(squared, 0.0, _MAX_ERROR**2)).mean(axis=-1, dtype=np.float64))
