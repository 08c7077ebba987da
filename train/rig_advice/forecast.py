"""The forecast of a rig: what captures of hands at work will miss, in the rooms of simulated takes.

The error of points is a covariance, from the noise of blobs in the pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gloves.captures.capture import run_lengths
from gloves.optics.reconstruction import MARKER_RADIUS, OpticsConfig, reconstruct
from handsim.space.rig import FEWEST_CAMERAS, CameraRig
from train.rig_advice.work import room_of_work
from train.simulation.room import (
    LightSources,
    RoomConfig,
    SceneSight,
    label_false_points,
    sample_light_sources,
)
from train.simulation.scenes import SceneMotion

_ERRORS: Final = 4000  # marker-frames of a scene from which the error is taken
OPTICS: Final = OpticsConfig()
"""Noise of blobs, and size of visible spots: the same in every room."""


class ErrorEllipsoid(NamedTuple):
    """The error of points, averaged."""

    axes: Float[np.ndarray, "3"]
    """Standard deviations along the directions, the longest first [m]; NaN without points."""
    directions: Float[np.ndarray, "3 3"]
    """Unit vectors in the world, one in each row."""
    mean: float
    """Root mean square of the distance from the truth, averaged over the points [m]."""


class LitScene(NamedTuple):
    """A scene, and all that shines in it as the cameras of a rig see it."""

    scene: SceneMotion
    sources: LightSources
    optics: OpticsConfig
    """Noise and losses of the room."""

    @property
    def num_markers(self) -> int:
        """Markers of the hands, the first of the sources."""
        return sum(hand.fit.layout.num_markers for hand in self.scene.hands)

    @property
    def seen(self) -> Bool[np.ndarray, "T M C"]:
        """Which cameras have a free view of the hands' markers."""
        return self.sources.visible[:, : self.num_markers]

    def without(self, camera: int) -> LitScene:
        """The same before one camera less."""
        visible = np.delete(self.sources.visible, camera, axis=2)
        return self._replace(sources=self.sources._replace(visible=visible))


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """What a rig makes of hands at work; shares are of marker-frames: every marker in every frame."""

    marker_frames: int
    seen_by_two: float
    """Share that two cameras or more see."""
    seen_by_three: float
    missing: float
    """Share without a point."""
    gaps: float
    """Gaps of a marker in a minute."""
    gap_median: float
    """Length of a gap [s]; NaN without gaps."""
    gap_p95: float
    ghosts: float
    """Points of a frame that are no marker."""
    error: ErrorEllipsoid


class CameraLoss(NamedTuple):
    """What one camera is worth."""

    seen: float
    """Share of the marker-frames that it sees."""
    needed: float
    """Share of the marker-frames that it sees and fewer than two others see."""
    without: Forecast | None
    """Without it; None where two cameras are all there are."""


def light(
    scenes: Sequence[SceneMotion], rig: CameraRig, room: RoomConfig, *, rng: np.random.Generator
) -> list[LitScene]:
    """Cast all lines of sight.

    Args:
        room: Losses and stray reflections of this work, see `train.simulation.room.usual_room`.
        rng: Source of the strays, and of the spots of markers that are seen past an edge.

    Raises:
        ArgumentError: A camera stands in the hands.
    """
    return [
        LitScene(scene, sample_light_sources(SceneSight(scene, rig), room, rng=rng), room.optics)
        for scene in scenes
    ]


def light_work(
    work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, *, rng: np.random.Generator
) -> dict[str, list[LitScene]]:
    """`light` for scenes of each kind of work, in the rooms that simulated takes of it have by default."""
    return {
        kind: [lit for scene in scenes for lit in light([scene], rig, room_of_work(kind, scene), rng=rng)]
        for kind, scenes in work.items()
    }


def forecast(lit: Sequence[LitScene], rig: CameraRig, *, seed: int = 0) -> Forecast:
    """What the optical system makes of scenes.

    Args:
        lit: Scenes as this rig sees them.
        seed: Of noise and losses.
    """
    rng = np.random.default_rng(seed)
    counted = [_count(one, rig, rng) for one in lit]
    total = sum(one.marker_frames for one in counted)
    minutes = sum(one.minutes for one in counted)
    lengths = np.concatenate([one.lengths for one in counted])
    median, p95 = np.percentile(lengths, [50, 95]) if len(lengths) else (np.nan, np.nan)
    return Forecast(
        total,
        sum(one.two for one in counted) / total,
        sum(one.three for one in counted) / total,
        sum(one.missing for one in counted) / total,
        len(lengths) / minutes,
        float(median),
        float(p95),
        sum(one.ghosts for one in counted) / sum(one.scene_frames for one in counted),
        ellipsoid(np.concatenate([one.spread for one in counted])),
    )


def camera_losses(lit: Sequence[LitScene], rig: CameraRig, *, seed: int = 0) -> list[CameraLoss]:
    """What each camera is worth: the same hands without it."""
    counts = [one.seen.sum(axis=-1) for one in lit]
    total = sum(count.size for count in counts)
    found = []
    for camera in range(len(rig.positions)):
        mine = [one.seen[..., camera] for one in lit]
        seen = sum(int(part.sum()) for part in mine)
        needed = sum(
            int((part & (count <= FEWEST_CAMERAS)).sum()) for part, count in zip(mine, counts, strict=True)
        )
        without = None
        if len(rig.positions) > FEWEST_CAMERAS:
            without = forecast([one.without(camera) for one in lit], rig.without(camera), seed=seed)
        found.append(CameraLoss(seen / total, needed / total, without))
    return found


class _Counts(NamedTuple):
    marker_frames: int
    scene_frames: int
    minutes: float  # of markers
    two: int
    three: int
    missing: int
    ghosts: int
    lengths: np.ndarray  # of gaps [s]
    spread: np.ndarray  # of points (N, 3, 3) [m^2]


def _count(one: LitScene, rig: CameraRig, rng: np.random.Generator) -> _Counts:
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
    rows, columns = np.nonzero(triangulated[:, :markers] & (views >= FEWEST_CAMERAS))
    step = max(1, len(rows) // _ERRORS)
    rows, columns = rows[::step], columns[::step]
    noise = optics.noise * np.sqrt(MARKER_RADIUS / sources.radii[columns])
    return _Counts(
        present.size,
        len(present),
        present.size / rate / 60.0,
        int((views >= FEWEST_CAMERAS).sum()),
        int((views > FEWEST_CAMERAS).sum()),
        int((~present).sum()),
        int(triangulated[:, sources.labels < 0].sum() + false.sum()),
        run_lengths(~present) / rate,
        covariances(sources.positions[rows, columns], one.seen[rows, columns], rig, noise),
    )


def covariances(
    points: Float[np.ndarray, "N 3"],
    seen: Bool[np.ndarray, "N C"],
    rig: CameraRig,
    noise: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N 3 3"]:
    """Covariance of each triangulated point [m^2], the one nearest to its rays, which all count alike.

    Args:
        points: In the world [m].
        seen: Which cameras see each: two or more, from different directions.
        noise: Standard deviation of each point's blob per axis [px].
    """
    total, shifts = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, 3))
    for number, camera in enumerate(rig.cameras):
        rays = points - camera.T_world_camera[:3, 3]
        distances = np.linalg.norm(rays, axis=1)
        directions = rays / distances[:, None]
        across = (np.eye(3) - directions[:, :, None] * directions[:, None]) * seen[:, number, None, None]
        total += across
        # A pixel to the right or down moves the ray at the point's depth by so much, across the ray.
        local = camera.local(points)
        tangents = np.linalg.inv(camera.lens.jacobian(local)) / camera.focal_lengths
        moved = across @ camera.T_world_camera[:3, :2] @ tangents * (local[:, 2] * noise)[:, None, None]
        shifts += moved @ moved.transpose(0, 2, 1)
    inverse = np.linalg.inv(total)
    return inverse @ shifts @ inverse


def ellipsoid(spread: Float[np.ndarray, "N 3 3"]) -> ErrorEllipsoid:
    """The mean of some points' covariances [m^2]."""
    if not len(spread):
        return ErrorEllipsoid(np.full(3, np.nan), np.eye(3), float("nan"))
    values, vectors = np.linalg.eigh(spread.mean(axis=0))
    mean = float(np.sqrt(np.trace(spread, axis1=1, axis2=2)).mean())
    return ErrorEllipsoid(np.sqrt(np.maximum(values[::-1], 0.0)), vectors.T[::-1], mean)
