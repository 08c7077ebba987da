"""The search for a rig: what candidate cameras see of hands at work, which are chosen, and their forecast.

Cameras are chosen one after the other, then exchanged while that helps. What a candidate sees are bits of
marker-frames, and what it tells of points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, UInt64
from numpy.typing import NDArray

from gloves.layout import MarkerLayout, load_layout
from gloves.optics.reconstruction import MARKER_RADIUS
from handsim._checks import check_choice, check_count
from handsim.callbacks import OnStep, no_step
from handsim.errors import ArgumentError
from handsim.space.camera import Camera, focal_of_angle, look_at, pinhole
from handsim.space.rig import FEWEST_CAMERAS, MAX_CAMERAS, ROOM_CENTER, CameraRig, as_rig
from train.rig_advice.forecast import OPTICS, Forecast, forecast, light_work
from train.rig_advice.mounts import MOUNTS, Mount, places
from train.rig_advice.work import GLOVE, VOLUME, checked_center, checked_sides, sample_work
from train.simulation.room import SceneSight, marker_radii
from train.simulation.scenes import SceneMotion

WEIGHTS: Final = (0.02, 0.4, 0.6, 0.05)
"""What the shares of marker-frames that one, two, three and four cameras see are worth. A point begins with
three rays and goes on with two, so that both count; one alone matters while there is one camera only, and a
fourth forgives a lost picture."""
_ERROR: Final = 0.15  # what a millimeter of mean error costs
_LONGEST: Final = 1.5  # error of points that no two cameras see, or only along nearly one line [mm]
_APART: Final = 0.3  # of two cameras [m]
_GAIN: Final = 1e-5  # of an exchange, at least
_EXCHANGES: Final = 200
_WIDE: Final = pinhole("wide", (1280, 1280), focal_of_angle(1280, np.deg2rad(170.0)))
"""A camera in whose view hands are wherever it is aimed."""
_SAMPLED: Final = 1200  # marker-frames whose error is looked at
_PEOPLE: Final = 3  # of each kind of work
_FRAMES: Final = 900  # of each
_SKIPPED: Final = 12  # every so many frames count
_JUDGED: Final = 600  # frames of a person that the plan did not see


class CandidateViews(NamedTuple):
    """K candidate cameras before N marker-frames."""

    bits: UInt64[np.ndarray, "K W"]
    """Marker-frames that each sees, 64 in a word."""
    num_marker_frames: int
    told: Float[np.ndarray, "6 K S"]
    """What each tells of S of the marker-frames, the inverse of a covariance [1/mm^2]: xx, xy, xz, yy, yz,
    zz; 0 where it does not see."""


def view_candidates(
    scenes: Sequence[SceneMotion],
    candidates: Sequence[Camera],
    *,
    rng: np.random.Generator,
) -> CandidateViews:
    """Cast the lines of sight from every marker to every candidate, once for candidates at one position.

    Args:
        rng: Source of visible spots, and of the marker-frames whose error is looked at.
    """
    centers_of = np.stack([one.T_world_camera[:3, 3] for one in candidates])
    positions, which = np.unique(centers_of.round(6), axis=0, return_inverse=True)
    which = which.reshape(-1)
    seen, points, noise = [], [], []
    for scene in scenes:
        free, centers, radii = _free_views(scene, positions, rng)
        inside = np.stack([one.in_view(centers) for one in candidates])
        seen.append(free[:, which].T & inside)
        points.append(centers)
        noise.append(OPTICS.noise * np.sqrt(MARKER_RADIUS / radii))
    views, centers = np.concatenate(seen, axis=1), np.concatenate(points)
    sampled = rng.choice(len(centers), min(_SAMPLED, len(centers)), replace=False)
    focals = np.array([one.focal_length for one in candidates])
    told = _told(centers[sampled], centers_of, np.concatenate(noise)[sampled] / focals[:, None])
    return CandidateViews(_packed(views), len(centers), told * views[:, sampled])


class Planning:
    """Cameras chosen among candidates.

    Args:
        positions: Where each is [m].
        kept: Candidates that are chosen before and stay.
    """

    def __init__(
        self, views: CandidateViews, positions: Float[np.ndarray, "K 3"], kept: Sequence[int] = ()
    ) -> None:
        self._views, self._positions, self._kept = views, positions, tuple(kept)
        self.chosen = list(kept)
        """Numbers of the candidates so far."""

    @property
    def value(self) -> float:
        """How good the chosen cameras are."""
        return self._value_of(self.chosen)

    def grow(self, num_cameras: int) -> None:
        """Choose the best candidate, then the best beside it, and so on.

        Raises:
            ArgumentError: There are too few places.
        """
        while len(self.chosen) < num_cameras:
            values = self._values_with(self.chosen)
            if not np.isfinite(values.max()):
                raise ArgumentError(
                    f"there is room for {len(self.chosen)} cameras {_APART:g} m apart, expected "
                    f"{num_cameras}; give more mounts or a larger room"
                )
            self.chosen.append(int(values.argmax()))

    def exchange(self, told: Callable[[float], None] = lambda value: None) -> None:
        """Move one camera at a time to the best candidate, while that helps.

        Args:
            told: Called with the value after every exchange.
        """
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
        error = _mean_error(self._views.told[:, list(chosen)].sum(axis=1)[:, None])
        return float(shares @ WEIGHTS - _ERROR * error[0])

    def _values_with(self, chosen: Sequence[int]) -> NDArray[np.float64]:
        """The value (K,) of the chosen cameras and each candidate; -inf where that is too near to one."""
        views = self._views
        planes = self._planes(chosen)
        values = np.zeros(len(views.bits))
        before = [~np.zeros_like(planes[0]), *planes[:-1]]
        for weight, plane, fewer in zip(WEIGHTS, planes, before, strict=True):
            fresh = np.bitwise_count(views.bits & (fewer & ~plane)).sum(axis=1, dtype=np.int64)
            values += weight * (fresh + int(np.bitwise_count(plane).sum()))
        values /= views.num_marker_frames
        told = views.told[:, list(chosen)].sum(axis=1)[:, None]
        values -= _ERROR * _mean_error(told + views.told)
        crowded = np.zeros(len(self._positions), dtype=bool)
        for camera in chosen:
            crowded |= np.linalg.norm(self._positions - self._positions[camera], axis=1) < _APART
        values[crowded] = -np.inf
        return values

    def _planes(self, chosen: Sequence[int]) -> list[NDArray[np.uint64]]:
        """Bits of the marker-frames that at least one, two, ... of the chosen cameras see."""
        planes = [np.zeros_like(self._views.bits[0]) for _ in WEIGHTS]
        for camera in chosen:
            for level in range(len(WEIGHTS) - 1, 0, -1):
                planes[level] |= planes[level - 1] & self._views.bits[camera]
            planes[0] |= self._views.bits[camera]
        return planes


def _mean_error(told: Float[np.ndarray, "6 K S"]) -> NDArray[np.float64]:
    """Root mean square distance of points from the truth (K,) [mm], averaged over the points."""
    a, b, c, d, e, f = told
    # The trace of the inverse of [[a, b, c], [b, d, e], [c, e, f]].
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    known = determinant > 1e-6 * np.maximum(a + d + f, 1e-12) ** 3
    squared = np.where(known, minors, _LONGEST**2) / np.where(known, determinant, 1.0)
    mean: NDArray[np.float64] = np.sqrt(np.clip(squared, 0.0, _LONGEST**2)).mean(axis=-1, dtype=np.float64)
    return mean


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
        views = [_WIDE.at(look_at(one, middle)) for one in some]
        rig = CameraRig("candidates", [replace(one, name=f"{number}") for number, one in enumerate(views)])
        sight = SceneSight(scene, rig)
        radii = marker_radii(scene, OPTICS)
        visible = sight.visible_markers(OPTICS.partial * radii, rng=rng)
        parts.append(visible[:, :count, : len(few)].reshape(-1, len(few)))
    centers = sight.markers[0][:, :count].reshape(-1, 3)
    return np.concatenate(parts, axis=1), centers, np.tile(radii[:count], scene.num_frames)


def _told(
    points: NDArray[np.float64], positions: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float32]:
    """What a ray with noise [rad] tells across itself (6, K, S) [1/mm^2]."""
    rays = points - positions[:, None]
    distances = np.linalg.norm(rays, axis=-1)
    x, y, z = np.moveaxis(rays / distances[..., None], -1, 0)
    weight = 1e-6 / (noise * distances) ** 2
    parts = (1.0 - x * x, -x * y, -x * z, 1.0 - y * y, -y * z, 1.0 - z * z)
    return np.stack([(weight * part).astype(np.float32) for part in parts])


def _packed(views: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Rows of flags (K, N) as bits, 64 in a word, the last word filled with zeros."""
    padded = np.zeros((len(views), -(-views.shape[1] // 64) * 64), dtype=bool)
    padded[:, : views.shape[1]] = views
    return np.packbits(padded, axis=1).view(np.uint64)


class RigPlan(NamedTuple):
    """A rig, and the forecast of it."""

    rig: CameraRig
    targets: Float[np.ndarray, "C 3"]
    """What each camera looks at [m]; of cameras that were kept a point one meter ahead."""
    before: Forecast | None
    """Of the cameras that were kept alone."""
    after: Forecast


def plan_rig(
    cameras: int,
    room: Sequence[float],
    *,
    mounts: Mount | Sequence[Mount] = MOUNTS,
    volume: Sequence[float] = VOLUME,
    center: Sequence[float] = ROOM_CENTER,
    camera: Camera | None = None,
    keep: CameraRig | str | Path | None = None,
    glove: MarkerLayout | str | Path = GLOVE,
    name: str = "planned",
    seed: int = 0,
    on_step: OnStep = no_step,
) -> RigPlan:
    """Look for the best places of cameras, as `handsim rig plan` does.

    Args:
        cameras: Cameras of the rig, with those that are kept.
        room: Width along x, depth along y and height of the room or truss (3,) [m]; it stands on the floor,
            its middle below that of the volume.
        mounts: What cameras can hang on: walls, truss, tripods.
        volume: Sides of the space that hands work in (3,) [m].
        center: Its middle (3,) [m].
        camera: What every new camera is, but for its pose; when not given, the first of those that are kept,
            or one of 1280 x 1280 pixels and 60 degrees.
        keep: The rig, its name or path, whose cameras stay where they are.
        glove: Marker layout, or its shipped name or the path of its .toml file.
        name: Name of the rig.
        seed: Seed of people and motion.
        on_step: Called with the name of each step.

    Raises:
        ArgumentError: A number is out of range, or there is no room for so many cameras.
        LayoutError, RigError: The glove or the rig is unknown.
    """
    kept, layout = None if keep is None else as_rig(keep), load_layout(glove)
    old = () if kept is None else tuple(kept.cameras)
    check_count("cameras", cameras, len(old) + 1 if old else FEWEST_CAMERAS, MAX_CAMERAS)
    check_count("seed", seed, 0)
    hung_on = (mounts,) if isinstance(mounts, str) else tuple(mounts)
    for mount in hung_on:
        check_choice(mount, MOUNTS, noun="mount")
    if not hung_on:
        raise ArgumentError(f"mounts is empty, expected some of {', '.join(MOUNTS)}")
    sides, middle = checked_sides("volume", volume), checked_center(center)
    one_of_new = camera or (old[0] if old else plain_camera())
    free = places(checked_sides("room", room), hung_on, middle, sides)
    candidates = [*old, *(one_of_new.at(pose) for pose in free.T_world_camera)]
    ahead = [one.T_world_camera[:3, 3] + one.T_world_camera[:3, 2] for one in old]
    targets = np.array([*ahead, *free.targets])
    on_step("simulating hands")
    rng = np.random.default_rng(seed)
    work = sample_work(layout, middle, sides, _FRAMES, _PEOPLE, rng=rng)
    scenes = [one.faster(_SKIPPED) for part in work.values() for one in part]
    on_step(f"what cameras at {len(free.targets)} places would see")
    views = view_candidates(scenes, candidates, rng=rng)
    positions = np.stack([one.T_world_camera[:3, 3] for one in candidates])
    search = Planning(views, positions, range(len(old)))
    search.grow(cameras)
    search.exchange(lambda value: on_step(f"moving cameras: {value:.4f}"))
    chosen = [candidates[number] for number in search.chosen]
    new = [
        dataclasses.replace(one, name=f"camera{number}")
        for number, one in enumerate(chosen[len(old) :], len(old) + 1)
    ]
    rig = CameraRig(name, [*old, *new])
    on_step("forecasting")
    fresh = sample_work(layout, middle, sides, _JUDGED, 1, rng=np.random.default_rng(seed + 1))
    before = None if kept is None else _forecast(fresh, kept, seed)
    return RigPlan(rig, targets[search.chosen], before, _forecast(fresh, rig, seed))


def _forecast(work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, seed: int) -> Forecast:
    lit = light_work(work, rig, rng=np.random.default_rng(seed))
    return forecast([one for scenes in lit.values() for one in scenes], rig, seed=seed)


def plain_camera(size: tuple[int, int] = (1280, 1280), field_of_view: float = 60.0) -> Camera:
    """A camera without distortion, at the world's origin.

    Args:
        size: Width and height of its pictures [px].
        field_of_view: Full opening across the shorter side of these [deg].

    Raises:
        ArgumentError: The opening is none.
    """
    if not 1.0 <= field_of_view <= 170.0:
        raise ArgumentError(f"field of view is {field_of_view:g} degrees, expected 1 to 170")
    return pinhole("camera", size, focal_of_angle(min(size), np.deg2rad(field_of_view)))
