"""Forecasts of what a rig captures of simulated hands at work, or of those of a take.

Captures are forecast in the rooms of simulated takes. Errors of points are covariances that follow from the
noise of blobs in the pictures. Gloves are scored on single frames of `observe_poses` and `observe_motion`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from gloves.captures.capture import column_runs, runs_of
from gloves.fit import GlovedHand, GloveFit, check_layout, settle_glove
from gloves.layout import MarkerLayout
from gloves.optics.reconstruction import OpticsConfig, reconstruct
from gloves.takes.take import Take
from handsim.errors import CaptureError
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import MIN_CAMERAS, ROOM_CENTER, CameraRig
from handsim.space.transforms import pose_matrices
from train.simulation.room import (
    LightSources,
    SceneSight,
    label_false_points,
    sample_light_sources,
    usual_room,
)
from train.simulation.scenes import KINDS, SIMULATED_KINDS, Kind, SceneMotion, sample_real_like_scene
from train.simulation.takes import first_capable_person, sample_scene
from train.simulation.training_frames import (
    FrameScene,
    GenerateSettings,
    HandFrames,
    MovingObject,
    observe_scene,
    sample_frame_scene,
    sample_hands,
    wear_gloves,
)

HALF_SIDE: Final = 0.3
"""Half side of the default cube in which hands work [m]."""
OPTICS: Final = OpticsConfig()
"""Noise of blobs and size of visible spots, equal in all rooms."""
_MIN_FRAMES: Final = 12  # least number of successive frames that are used of a take
_ROUND_TRIP: Final = (11.0, 14.0, 9.0)  # [s] time to walk through the volume and back along each axis
_POSES_PER_PERSON: Final = 60
_ERROR_SAMPLES: Final = 4000  # marker-frames of a scene for the estimate of the error


def sample_work(
    layout: MarkerLayout,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    num_frames: int,
    people: int,
    *,
    rng: np.random.Generator,
) -> dict[str, list[SceneMotion]]:
    """Scenes of several people by kind of work: real-like, and as in the paper's captures.

    Hands work around the center of a volume [m]; people walk through a volume larger than their reach.
    """
    work: dict[str, list[SceneMotion]] = {}
    kinds: tuple[Literal["real-like"] | Kind, ...] = ("real-like", *KINDS)
    for kind in kinds:
        work[kind] = []
        for _ in range(people):
            if kind == "real-like":
                scene = first_capable_person(
                    kind, lambda: sample_real_like_scene(layout, num_frames, rng=rng)
                )
            else:
                scene = sample_scene(kind, layout, num_frames, rng=rng)
            walk = _walk(scene.num_frames / scene.rate, scene.num_frames, sides, rng)
            work[kind].append(scene.moved(walk + center - ROOM_CENTER))
    return work


def _walk(
    seconds: float, frames: int, sides: Float[np.ndarray, "3"], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Offsets (T, 3) [m] of walking to and fro through the parts of a volume beyond reach from its center."""
    reach = np.maximum(0.0, np.asarray(sides) / 2 - HALF_SIDE)
    turns = seconds * np.linspace(0.0, 1.0, frames)[:, None] / _ROUND_TRIP + rng.random(3)
    return np.asarray(reach * (4.0 * np.abs(turns % 1.0 - 0.5) - 1.0))


def work_of_take(take: Take, layout: MarkerLayout | None, num_frames: int) -> dict[str, list[SceneMotion]]:
    """Scenes of a take's first frames in which every hand has a pose, optionally with another glove."""
    if layout is not None:
        check_layout(layout)
    fits = [hand if layout is None else settle_glove(layout, hand.model) for hand in take.hands]
    whole = np.isfinite(take.qpos).all(axis=(1, 2))
    scenes, left = [], num_frames
    for first, last in runs_of(whole):
        part = slice(first, min(last + 1, first + left))
        if part.stop - part.start >= _MIN_FRAMES:
            left -= part.stop - part.start
            hands = tuple(
                GlovedHand(fit, np.ascontiguousarray(take.qpos[part, number]))
                for number, fit in enumerate(fits)
            )
            held = None
            for number, body in enumerate(take.bodies):
                thing, poses = body.shape, take.body_poses[part, number]
                if held is None and thing is not None and np.isfinite(poses).all():
                    held = MovingObject(thing, pose_matrices(poses))
            scenes.append(SceneMotion(hands, held, take.rate))
    if not scenes:
        raise CaptureError(
            f"the take has no {_MIN_FRAMES} frames in a row in which every hand has a pose, expected some"
        )
    return {"the take": scenes}


class ObservedHand(NamedTuple):
    """One hand in some frames, and what a rig captures of it."""

    fit: GloveFit
    qpos: Float[np.ndarray, "T 27"]
    frames: HandFrames
    """True and captured markers."""


def observe_poses(
    layout: MarkerLayout, rig: CameraRig, num_frames: int, *, rng: np.random.Generator
) -> list[ObservedHand]:
    """Random people's hands in poses and scenes as in training sets, in at least `num_frames` frames."""
    config, observed, done = GenerateSettings(), [], 0
    while done < num_frames:
        models = sample_hands(config.population, rng=rng)
        scene = sample_frame_scene(models, _POSES_PER_PERSON, config, rng=rng)
        fits = wear_gloves(layout, scene.hands, **config.slips, rng=rng)
        hands = list(_observe_hands(scene, fits, rig, rng))
        observed += hands
        done += sum(len(hand.qpos) for hand in hands)
    return observed


def observe_motion(
    take: Take, layout: MarkerLayout, rig: CameraRig, num_frames: int, *, rng: np.random.Generator
) -> list[ObservedHand]:
    """Hands of a take with another glove, in up to `num_frames` frames, moved to the center of the rig."""
    posed = np.flatnonzero(np.isfinite(take.qpos).all(axis=(1, 2)))
    if not len(posed):
        raise CaptureError("there is no frame in which every hand of the take has a pose, expected one")
    chosen = posed[np.unique(np.linspace(0, len(posed) - 1, num_frames).astype(int))]
    poses = take.qpos[chosen]
    poses[..., :3] += ROOM_CENTER - poses[..., :3].mean(axis=(0, 1))
    models = tuple(hand.model for hand in take.hands)
    fits = tuple(settle_glove(layout, model) for model in models)
    qpos = tuple(np.ascontiguousarray(poses[:, number]) for number in range(len(models)))
    return list(_observe_hands(FrameScene(models, qpos), fits, rig, rng))


def _observe_hands(
    scene: FrameScene, fits: tuple[GloveFit, ...], rig: CameraRig, rng: np.random.Generator
) -> Iterator[ObservedHand]:
    """What the rig captures of each hand in unrelated frames."""
    config = GenerateSettings()
    # In single frames two rays suffice for a point, as for a continued point in a capture.
    optics = OpticsConfig(min_rays_to_start=config.min_cameras)
    frames = observe_scene(scene, fits, rig, optics, config.ghosts, rng=rng)
    for fit, qpos, seen in zip(fits, scene.qpos, frames, strict=True):
        yield ObservedHand(fit, qpos, seen)


class LitScene(NamedTuple):
    """A scene, and its light sources as seen by the cameras of a rig."""

    scene: SceneMotion
    sources: LightSources
    optics: OpticsConfig
    """Noise and losses of the optical system."""

    @property
    def num_markers(self) -> int:
        """Number of the hands' markers, which come first among the sources."""
        return sum(hand.fit.layout.num_markers for hand in self.scene.hands)

    @property
    def seen(self) -> Bool[np.ndarray, "T M C"]:
        """Which cameras have a free view of the hands' markers."""
        return self.sources.visible[:, : self.num_markers]

    def without(self, camera: int) -> LitScene:
        """The same scene without one camera."""
        visible = np.delete(self.sources.visible, camera, axis=2)
        return self._replace(sources=self.sources._replace(visible=visible))


def light_work(
    work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, *, rng: np.random.Generator
) -> dict[str, list[LitScene]]:
    """Find which cameras see which markers in each scene, in the default room for its kind of work.

    Raises:
        ArgumentError: A camera is inside a hand.
    """
    lit: dict[str, list[LitScene]] = {}
    for kind, scenes in work.items():
        lit[kind] = []
        for scene in scenes:
            similar = kind if kind in SIMULATED_KINDS else "hand-pen"
            if similar != kind and scene.moving_object is None:
                similar = "hand-hand" if len(scene.hands) > 1 else "single-hand"
            room = usual_room(similar)
            sources = sample_light_sources(SceneSight(scene, rig), room, rng=rng)
            lit[kind].append(LitScene(scene, sources, room.optics))
    return lit


class ErrorEllipsoid(NamedTuple):
    """Mean error of triangulated points."""

    axes: Float[np.ndarray, "3"]
    """Standard deviations along `directions`, the largest first [m]; NaN without points."""
    directions: Float[np.ndarray, "3 3"]
    """Unit vectors in the world, as rows."""
    mean: float
    """Root mean square distance from the truth, averaged over the points [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """Forecast of a capture. Shares are of marker-frames: every marker in every frame."""

    marker_frames: int
    seen_by_two: float
    """Share seen by at least two cameras."""
    seen_by_three: float
    missing: float
    """Share without a point."""
    gaps: float
    """Gaps per marker [1/min]."""
    gap_median: float
    """Median length of a gap that begins in a scene [s]; NaN without gaps, infinite if scenes are shorter."""
    gap_p95: float
    """95th percentile of these lengths [s]; a gap that outlasts its scene counts as at least that long."""
    ghosts: float
    """Points per frame that are not markers."""
    error: ErrorEllipsoid


class CameraLoss(NamedTuple):
    """Contribution of one camera."""

    seen: float
    """Share of the marker-frames that it sees."""
    needed: float
    """Share of the marker-frames that it and fewer than two others see."""
    without: Forecast | None
    """Forecast without it; None for a rig of two cameras."""


def forecast(lit: Sequence[LitScene], rig: CameraRig, *, seed: int = 0) -> Forecast:
    """Forecast of scenes seen by a rig, with noise and losses from a seed."""
    rng = np.random.default_rng(seed)
    counts, gaps, spreads = zip(*(_count_scene(one, rig, rng) for one in lit), strict=True)
    frames, scene_frames, minutes, two, three, missing, ghosts = map(sum, zip(*counts, strict=True))
    runs = np.concatenate(gaps, axis=1)
    begun = runs[:, runs[1] > 0.0]
    return Forecast(
        frames,
        two / frames,
        three / frames,
        missing / frames,
        runs.shape[1] / minutes,
        duration_quantile(begun[0], begun[2] > 0.0, 0.5),
        duration_quantile(begun[0], begun[2] > 0.0, 0.95),
        ghosts / scene_frames,
        ellipsoid(np.concatenate(spreads)),
    )


def _count_scene(
    one: LitScene, rig: CameraRig, rng: np.random.Generator
) -> tuple[tuple[int, int, float, int, int, int, int], Float[np.ndarray, "3 G"], Float[np.ndarray, "N 3 3"]]:
    """Counts of a scene, its gaps, and covariances of some points [m^2].

    Of each gap there are its length [s], and whether it begins and ends in the scene.

    The counts are: marker-frames; frames; minutes of markers; marker-frames seen by two cameras, seen by
    three, and without a point; ghosts.
    """
    sources, optics, markers, rate = one.sources, one.optics, one.num_markers, one.scene.rate
    found = reconstruct(
        sources.positions, sources.visible, rig, optics, radii=sources.radii, continuous=True, rng=rng
    )
    triangulated = np.isfinite(found.positions[..., 0])
    false_labels = label_false_points(found, sources.positions, sources.labels, optics.max_residual)
    present = triangulated[:, :markers].copy()
    frame, column = np.nonzero((false_labels >= 0) & (false_labels < markers))
    present[frame, false_labels[frame, column]] = True
    false = np.isfinite(found.false_points[..., 0]) & (false_labels < 0)
    views = one.seen.sum(axis=-1)
    rows, columns = np.nonzero(triangulated[:, :markers] & (views >= MIN_CAMERAS))
    step = max(1, len(rows) // _ERROR_SAMPLES)
    rows, columns = rows[::step], columns[::step]
    noise = optics.noise * np.sqrt(MARKER_RADIUS / sources.radii[columns])
    counts = (
        present.size,
        len(present),
        present.size / rate / 60.0,
        int((views >= MIN_CAMERAS).sum()),
        int((views > MIN_CAMERAS).sum()),
        int((~present).sum()),
        int(triangulated[:, sources.labels < 0].sum() + false.sum()),
    )
    spreads = covariances(sources.positions[rows, columns], one.seen[rows, columns], rig, noise)
    _, first, last = column_runs(~present)
    return counts, np.stack([(last - first + 1) / rate, first > 0, last < len(present) - 1]), spreads


def duration_quantile(lengths: Float[np.ndarray, "G"], ended: Bool[np.ndarray, "G"], share: float) -> float:
    """A quantile of durations, by Kaplan and Meier; those that did not end are at least as long as seen.

    NaN without durations, infinite where too few have ended.
    """
    if not len(lengths):
        return float("nan")
    order = np.lexsort((~ended, lengths))  # of equal ones those that ended first
    left = np.cumprod(1.0 - ended[order] / np.arange(len(order), 0, -1))
    below = np.flatnonzero(left <= 1.0 - share + 1e-9)
    return float(lengths[order[below[0]]]) if len(below) else float("inf")


def camera_losses(lit: Sequence[LitScene], rig: CameraRig, *, seed: int = 0) -> list[CameraLoss]:
    """Contribution of each camera, from forecasts of the same scenes without it."""
    seen = np.concatenate([one.seen.reshape(-1, len(rig.positions)) for one in lit])
    views, losses = seen.sum(axis=1), []
    for camera in range(len(rig.positions)):
        mine, without = seen[:, camera], None
        if len(rig.positions) > MIN_CAMERAS:
            without = forecast([one.without(camera) for one in lit], rig.without(camera), seed=seed)
        needed = mine & (views <= MIN_CAMERAS)
        losses.append(CameraLoss(int(mine.sum()) / len(seen), int(needed.sum()) / len(seen), without))
    return losses


def covariances(
    points: Float[np.ndarray, "N 3"],
    seen: Bool[np.ndarray, "N C"],
    rig: CameraRig,
    noise: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N 3 3"]:
    """Covariance of each point [m^2], triangulated from equally weighted rays of at least two cameras.

    `noise` is the standard deviation of each point's blob per axis [px].
    """
    total, shifts = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, 3))
    for number, camera in enumerate(rig.cameras):
        rays = points - camera.T_world_camera[:3, 3]
        distances = np.linalg.norm(rays, axis=1)
        directions = rays / distances[:, None]
        across = (np.eye(3) - directions[:, :, None] * directions[:, None]) * seen[:, number, None, None]
        total += across
        # Motion of the ray at the point's depth, across the ray, per pixel to the right and down.
        local = camera.local(points)
        tangents = np.linalg.inv(camera.lens.jacobian(local)) / camera.focal_lengths
        shift = across @ camera.T_world_camera[:3, :2] @ tangents * (local[:, 2] * noise)[:, None, None]
        shifts += shift @ shift.transpose(0, 2, 1)
    inverse = np.linalg.inv(total)
    return inverse @ shifts @ inverse


def ellipsoid(spread: Float[np.ndarray, "N 3 3"]) -> ErrorEllipsoid:
    """Ellipsoid of the mean covariance [m^2]."""
    if not len(spread):
        return ErrorEllipsoid(np.full(3, np.nan), np.eye(3), float("nan"))
    values, vectors = np.linalg.eigh(spread.mean(axis=0))
    mean = float(np.sqrt(np.trace(spread, axis1=1, axis2=2)).mean())
    return ErrorEllipsoid(np.sqrt(np.maximum(values[::-1], 0.0)), vectors.T[::-1], mean)
