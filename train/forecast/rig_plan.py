"""The search for a camera rig: where cameras can hang, what they would see of hands at work, which are best.

Cameras are chosen one after the other, then exchanged while that helps. What a candidate sees is kept as bits
of marker-frames, and as the information that it gives on points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, UInt64
from numpy.typing import NDArray

from gloves.layout import load_layout
from gloves.optics.reconstruction import MARKER_RADIUS
from handsim._checks import check_array, check_count
from handsim.callbacks import OnStep, no_step
from handsim.errors import ArgumentError
from handsim.space.camera import Camera, focal_of_angle, look_at, pinhole
from handsim.space.rig import (
    FEWEST_CAMERAS,
    HAND_REACH,
    MAX_CAMERAS,
    CameraRig,
    load_rig,
)
from train.forecast.rig_forecast import OPTICS, Forecast, forecast, light_work, sample_work
from train.forecast.settings import LONGEST_SIDE, Mount, PlanRigSettings
from train.simulation.room import SceneSight, marker_radii
from train.simulation.scenes import SceneMotion

_MOST: Final = 400  # places; the step between them grows with the room
_STEPS: Final = (0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)  # between places [m]
_OFF: Final = 0.1  # distance of a lens from wall, ceiling or beam [m]
_LOWEST: Final = 0.5  # height of cameras on walls and posts [m]
_TRIPODS: Final = (0.9, 1.4, 1.9)  # heights of heads [m]
_LARGE: Final = 1.0  # side of a volume from which on cameras look elsewhere than at its middle, too [m]
_ASIDE: Final = 0.3  # how far from the middle, as a share of the side

_WEIGHTS: Final = (0.02, 0.4, 0.6, 0.05)
"""What the shares of marker-frames that one, two, three and four cameras see are worth. A point begins with
three rays and goes on with two, so that both count; one alone matters while there is one camera only, and a
fourth forgives a lost picture."""
_ERROR: Final = 0.15  # what a millimeter of mean error costs
_LONGEST: Final = 1.5  # error of points that no two cameras see, or only along nearly one line [mm]
_APART: Final = 0.3  # least distance of two cameras [m]
_GAIN: Final = 1e-5  # least gain of an exchange
_EXCHANGES: Final = 200
_WIDE: Final = pinhole("wide", (1280, 1280), focal_of_angle(1280, np.deg2rad(170.0)))
"""A camera in whose view hands are wherever it is aimed."""
_SAMPLED: Final = 1200  # marker-frames whose error is looked at
_PEOPLE: Final = 3  # of each kind of work
_FRAMES: Final = 900  # of each
_SKIPPED: Final = 12  # every so many frames count
_JUDGED: Final = 600  # frames of a person that the plan did not see


class RigPlan(NamedTuple):
    """A rig, and the forecast of it."""

    rig: CameraRig
    targets: Float[np.ndarray, "C 3"]
    """What each camera looks at [m]; of cameras that were kept a point one meter ahead."""
    before: Forecast | None
    """The forecast of the cameras that were kept alone."""
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
        cameras: Cameras of the rig, with those that are kept.
        room: Width along x, depth along y and height of the room or truss (3,) [m]; it stands on the floor,
            its middle below that of the volume.
        settings: Where hands work, and what cameras can hang on.
        camera: What every new camera is, but for its pose; when not given, the first of those that are kept,
            or one of the settings' size and field of view.
        name: Name of the rig.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name.

    Raises:
        ArgumentError: A setting or number is refused, or there is no room for so many cameras.
        LayoutError, RigError: The glove or the rig is unknown.
    """
    chosen = PlanRigSettings.of(settings, options)
    layout, seed = load_layout(chosen.glove), chosen.seed
    kept = None if chosen.keep is None else load_rig(chosen.keep)
    old = () if kept is None else tuple(kept.cameras)
    check_count("cameras", cameras, len(old) + 1 if old else FEWEST_CAMERAS, MAX_CAMERAS)
    lengths = check_array("room", room, (3,))
    if not ((lengths > 0.0) & (lengths < LONGEST_SIDE)).all():
        raise ArgumentError(
            f"room is {_lengths(lengths)}, expected three lengths, each above 0 and below {LONGEST_SIDE:g} m"
        )
    sides, center = np.array(chosen.volume, dtype=np.float64), np.array(chosen.center, dtype=np.float64)
    focal = focal_of_angle(min(chosen.size), np.deg2rad(chosen.field_of_view))
    new = camera or (old[0] if old else pinhole("camera", chosen.size, focal))
    free = places(lengths, chosen.mounts, center, sides)
    candidates = [*old, *(new.at(pose) for pose in free.T_world_camera)]
    ahead = [one.T_world_camera[:3, 3] + one.T_world_camera[:3, 2] for one in old]
    targets = np.array([*ahead, *free.targets])
    on_step("simulating hands")
    rng = np.random.default_rng(seed)
    work = sample_work(layout, center, sides, _FRAMES, _PEOPLE, rng=rng)
    scenes = [one.faster(_SKIPPED) for part in work.values() for one in part]
    on_step(f"what cameras at {len(free.targets)} places would see")
    search = Planning(view_candidates(scenes, candidates, rng=rng), kept=range(len(old)))
    search.grow(cameras)
    search.exchange(lambda value: on_step(f"moving cameras: {value:.4f}"))
    hung = [
        dataclasses.replace(candidates[number], name=f"camera{place}")
        for place, number in enumerate(search.chosen[len(old) :], len(old) + 1)
    ]
    rig = CameraRig(name, [*old, *hung])
    on_step("forecasting")
    fresh = sample_work(layout, center, sides, _JUDGED, 1, rng=np.random.default_rng(seed + 1))
    before = None if kept is None else _forecast(fresh, kept, seed)
    return RigPlan(rig, targets[search.chosen], before, _forecast(fresh, rig, seed))


def _forecast(work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, seed: int) -> Forecast:
    lit = light_work(work, rig, rng=np.random.default_rng(seed))
    return forecast([one for scenes in lit.values() for one in scenes], rig, seed=seed)


class Places(NamedTuple):
    """K ways to hang one camera."""

    T_world_camera: Float[np.ndarray, "K 4 4"]
    targets: Float[np.ndarray, "K 3"]
    """What each looks at [m]."""


def places(
    room: Float[np.ndarray, "3"],
    mounts: Sequence[Mount],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
) -> Places:
    """All positions on the mounts of a room, with all aims at a volume, given by its center and sides [m]."""
    for step in _STEPS:
        found = np.unique(np.concatenate([_ON[mount](room, step) for mount in mounts]).round(6), axis=0)
        found[:, :2] += center[:2]
        nearest = np.clip(found, center - sides / 2, center + sides / 2)
        found = found[np.linalg.norm(found - nearest, axis=1) >= HAND_REACH]
        if len(found) <= _MOST:
            break
    if not len(found):
        raise ArgumentError(
            f"in a room of {_lengths(room)} no place on {' and '.join(mounts)} is {HAND_REACH:g} m or more "
            f"from the volume of {_lengths(sides)}; expected a larger room"
        )
    aims = [center]
    for axis in range(3):
        if sides[axis] > _LARGE:
            offset = np.eye(3)[axis] * _ASIDE * sides
            aims += [center + offset, center - offset]
    pairs = [(position, aim) for position in found for aim in aims]
    return Places(
        np.stack([look_at(position, aim) for position, aim in pairs]), np.stack([aim for _, aim in pairs])
    )


def _on_walls(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    width, depth = room[:2] / 2 - _OFF
    return _product(_outline(width, depth, step), _line(_LOWEST, room[2] - _OFF, step))


def _on_truss(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Beams along the top of all four sides, and the posts below their ends."""
    width, depth = room[:2] / 2
    beams = _product(_outline(width, depth, step), np.array([room[2] - _OFF]))
    corners = np.array([[x, y] for x in (-width, width) for y in (-depth, depth)])
    return np.concatenate([beams, _product(corners, _line(_LOWEST, room[2] - _OFF, step))])


def _on_tripods(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    width, depth = room[:2] / 2 - 3 * _OFF
    along, across = _line(-width, width, step), _line(-depth, depth, step)
    floor = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    return _product(floor, np.array([height for height in _TRIPODS if height < room[2] - _OFF]))


_ON: Final = {"walls": _on_walls, "truss": _on_truss, "tripods": _on_tripods}


def _outline(width: float, depth: float, step: float) -> NDArray[np.float64]:
    """Points (N, 2) on a rectangle of these half sides."""
    along, across = _line(-width, width, step), _line(-depth, depth, step)
    sides = [np.stack([along, np.full(len(along), end)], axis=1) for end in (-depth, depth)]
    sides += [np.stack([np.full(len(across), end), across], axis=1) for end in (-width, width)]
    return np.concatenate(sides)


def _line(low: float, high: float, step: float) -> NDArray[np.float64]:
    """Numbers from end to end, about a step apart."""
    return np.linspace(low, high, max(1, round((high - low) / step)) + 1)


def _product(floor: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each point (N, 2) at each height."""
    above = np.repeat(floor, len(heights), axis=0)
    return np.column_stack([above, np.tile(heights, len(floor))])


def _lengths(sides: NDArray[np.float64]) -> str:
    return " x ".join(f"{one:g}" for one in sides) + " m"


class CandidateViews(NamedTuple):
    """K candidate cameras before N marker-frames."""

    positions: Float[np.ndarray, "K 3"]
    """Where each is [m]."""
    bits: UInt64[np.ndarray, "K W"]
    """Marker-frames that each sees, 64 in a word."""
    num_marker_frames: int
    information: Float[np.ndarray, "6 K S"]
    """Information that each gives on S of the marker-frames [1/mm^2]: xx, xy, xz, yy, yz, zz; 0 where it does
    not see."""


def view_candidates(
    scenes: Sequence[SceneMotion], candidates: Sequence[Camera], *, rng: np.random.Generator
) -> CandidateViews:
    """Cast the lines of sight from every marker to every candidate, once for candidates at one position."""
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
    sampled = rng.choice(len(centers), min(_SAMPLED, len(centers)), replace=False)
    focals = np.array([one.focal_length for one in candidates])
    information = _information(centers[sampled], positions, np.concatenate(noise)[sampled] / focals[:, None])
    padded = np.zeros((len(views), -(-views.shape[1] // 64) * 64), dtype=bool)
    padded[:, : views.shape[1]] = views
    bits = np.packbits(padded, axis=1).view(np.uint64)
    return CandidateViews(positions, bits, len(centers), information * views[:, sampled])


def _free_views(
    scene: SceneMotion, positions: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Of the hands' markers in all frames: which positions see them (N, P), where (N, 3), how large (N,)."""
    count = sum(hand.fit.layout.num_markers for hand in scene.hands)
    parts = []
    for begin in range(0, len(positions), MAX_CAMERAS):
        few = positions[begin : begin + MAX_CAMERAS]
        # A rig has two cameras at least: where one is left, it comes with another that is cut off again.
        some = few if len(few) >= FEWEST_CAMERAS else np.concatenate([few, few + np.array([0.0, 0.0, 1.0])])
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
    """Information of rays with noise [rad] across themselves (6, K, S) [1/mm^2]."""
    rays = points - positions[:, None]
    distances = np.linalg.norm(rays, axis=-1)
    x, y, z = np.moveaxis(rays / distances[..., None], -1, 0)
    weight = 1e-6 / (noise * distances) ** 2
    parts = (1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z)
    return np.stack([(weight * part).astype(np.float32) for part in parts])


class Planning:
    """Cameras chosen among candidates; those that are kept come first and stay."""

    def __init__(self, views: CandidateViews, kept: Sequence[int] = ()) -> None:
        self._views, self._kept = views, tuple(kept)
        self.chosen = list(kept)
        """Numbers of the candidates so far."""

    @property
    def value(self) -> float:
        """How good the chosen cameras are."""
        return self._value_of(self.chosen)

    def grow(self, num_cameras: int) -> None:
        """Choose the best candidate, then the best beside it, and so on."""
        while len(self.chosen) < num_cameras:
            values = self._values_with(self.chosen)
            if not np.isfinite(values.max()):
                raise ArgumentError(
                    f"there is room for {len(self.chosen)} cameras {_APART:g} m apart, expected "
                    f"{num_cameras}; give more mounts or a larger room"
                )
            self.chosen.append(int(values.argmax()))

    def exchange(self, told: Callable[[float], None] = lambda value: None) -> None:
        """Move one camera at a time to the best candidate, while that helps; `told` of each new value."""
        value, idle, number = self.value, 0, len(self._kept)
        free = len(self.chosen) - len(self._kept)
        for _ in range(_EXCHANGES):
            if idle >= free:
                return
            others = self.chosen[:number] + self.chosen[number + 1 :]
            values = self._values_with(others)
            best = int(values.argmax())
            idle += 1
            if values[best] > value + _GAIN:
                self.chosen[number], value, idle = best, float(values[best]), 0
                told(value)
            number = number + 1 if number + 1 < len(self.chosen) else len(self._kept)

    def _value_of(self, chosen: Sequence[int]) -> float:
        seen = [int(np.bitwise_count(plane).sum()) for plane in self._planes(chosen)]
        shares = np.array(seen) / self._views.num_marker_frames
        error = _mean_error(self._views.information[:, list(chosen)].sum(axis=1)[:, None])
        return float(shares @ _WEIGHTS - _ERROR * error[0])

    def _values_with(self, chosen: Sequence[int]) -> NDArray[np.float64]:
        """The value (K,) of the chosen cameras and each candidate; -inf where that is too near to one."""
        views = self._views
        planes = self._planes(chosen)
        values = np.zeros(len(views.bits))
        before = [~np.zeros_like(planes[0]), *planes[:-1]]
        for weight, plane, fewer in zip(_WEIGHTS, planes, before, strict=True):
            fresh = np.bitwise_count(views.bits & (fewer & ~plane)).sum(axis=1, dtype=np.int64)
            values += weight * (fresh + int(np.bitwise_count(plane).sum()))
        values /= views.num_marker_frames
        information = views.information[:, list(chosen)].sum(axis=1)[:, None]
        values -= _ERROR * _mean_error(information + views.information)
        for camera in chosen:
            values[np.linalg.norm(views.positions - views.positions[camera], axis=1) < _APART] = -np.inf
        return values

    def _planes(self, chosen: Sequence[int]) -> list[NDArray[np.uint64]]:
        """Bits of the marker-frames that at least one, two, ... of the chosen cameras see."""
        planes = [np.zeros_like(self._views.bits[0]) for _ in _WEIGHTS]
        for camera in chosen:
            for level in range(len(_WEIGHTS) - 1, 0, -1):
                planes[level] |= planes[level - 1] & self._views.bits[camera]
            planes[0] |= self._views.bits[camera]
        return planes


def _mean_error(information: Float[np.ndarray, "6 K S"]) -> NDArray[np.float64]:
    """Root mean square distance of points from the truth (K,) [mm], averaged over the points."""
    a, b, c, d, e, f = information
    # The trace of the inverse of [[a, b, c], [b, d, e], [c, e, f]].
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    known = determinant > 1e-6 * np.maximum(a + d + f, 1e-12) ** 3
    squared = np.where(known, minors, _LONGEST**2) / np.where(known, determinant, 1.0)
    mean: NDArray[np.float64] = np.sqrt(np.clip(squared, 0.0, _LONGEST**2)).mean(axis=-1, dtype=np.float64)
    return mean
