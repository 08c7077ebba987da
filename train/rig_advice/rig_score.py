"""The score of a rig: everything that is known of it before it records, and sentences on what to do.

A map shows what it sees of hands that are set at each point of a grid in the volume.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GlovedHand
from gloves.optics.reconstruction import MARKER_RADIUS
from handsim.space.rig import FEWEST_CAMERAS, CameraRig
from train.rig_advice.forecast import (
    OPTICS,
    CameraLoss,
    Forecast,
    camera_losses,
    covariances,
    forecast,
    light_work,
)
from train.rig_advice.rig_faults import cube_points, faults
from train.simulation.room import SceneSight, marker_radii
from train.simulation.scenes import SceneMotion

_MISSING: Final = 0.05  # share of marker-frames without a point, from which on cameras lack
_CORNER: Final = (
    0.7  # share of markers seen by two that a corner of the volume should have, of the best point's
)
_USELESS: Final = 0.005  # share of marker-frames that need a camera which can go
_RISE: Final = 1.1  # by which missing marker-frames may rise without it
_LONG: Final = 2.0  # longest axis of the error over the shortest
_FAR: Final = 0.0005  # an error that is worth a sentence [m]
_GHOSTS: Final = 0.2  # of a frame
_DIRECTIONS: Final = ("x", "y", "z")
GRID: Final = 5
"""Points of the map along each side of the volume."""
_HANDS: Final = 12  # hands at every point
_LONGEST: Final = 0.01  # of errors that are averaged [m]: two rays that hardly cross make no point


@dataclass(frozen=True, slots=True, eq=False)
class RigScore:
    """What a rig makes of hands at work."""

    rig: CameraRig
    whole: Forecast
    """Of all work together: shares of the marker-frames, gaps [s], error of points [m]."""
    kinds: dict[str, Forecast]
    """Of each kind of work."""
    losses: list[CameraLoss]
    """Of each camera."""
    volume: VolumeMap
    faults: list[str]
    """What is suspicious about the rig itself, see `train.rig_advice.rig_faults`."""
    work: str
    """Whose hands did what, in words."""
    seed: int
    """Of what is random in seeing and losing."""

    @property
    def advice(self) -> list[str]:
        """What to do with the rig; what is most wrong comes first."""
        if self.whole.missing >= 1.0:
            return [*_suspicious(self), "No point is seen: hands work where no two cameras look."]
        parts = (_suspicious, _missing, _corner, _needed, _dispensable, _error, _ghosts)
        found = [one for part in parts for one in part(self)]
        return found or ["Nothing stands out: hands at work are seen well, and no camera is idle."]

    def record(self) -> dict[str, Any]:
        """All figures as JSON, in meters and seconds; what does not exist is null."""
        return {
            "work": self.work,
            "seed": self.seed,
            "rig": self.rig.name,
            "cameras": len(self.rig.cameras),
            "all": _figures(self.whole),
            "kinds": {kind: _figures(one) for kind, one in self.kinds.items()},
            "without_camera": [
                {
                    "seen": one.seen,
                    "needed": one.needed,
                    **({} if one.without is None else _figures(one.without)),
                }
                for one in self.losses
            ],
            "volume": {name: _numbers(getattr(self.volume, name)) for name in VolumeMap._fields},
            "suspicious": self.faults,
        }


def score_work(
    rig: CameraRig,
    work: Mapping[str, Sequence[SceneMotion]],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    told: str,
    seed: int = 0,
) -> RigScore:
    """Forecast what a rig makes of hands at work, without each of its cameras too.

    Args:
        work: Scenes of each kind of work.
        center: Middle of the volume that is mapped [m].
        told: Whose hands do what, in words.
        seed: Of what is random in seeing and losing.

    Raises:
        ArgumentError: A camera stands in the hands.
    """
    rng = np.random.default_rng(seed)
    lit = light_work(work, rig, rng=rng)
    everything = [one for scenes in lit.values() for one in scenes]
    return RigScore(
        rig,
        forecast(everything, rig, seed=seed),
        {kind: forecast(scenes, rig, seed=seed) for kind, scenes in lit.items()},
        camera_losses(everything, rig, seed=seed),
        map_volume([one.scene for one in everything], rig, center, sides, rng=rng),
        faults(rig),
        told,
        seed,
    )


def _suspicious(score: RigScore) -> Iterator[str]:
    for fault in score.faults:
        yield f"Suspicious: {fault}."


def _missing(score: RigScore) -> Iterator[str]:
    whole = score.whole
    if whole.missing > _MISSING:
        worst = max(score.kinds, key=lambda kind: score.kinds[kind].missing)
        most = (
            f", most with {worst} ({100 * score.kinds[worst].missing:.0f} %)" if len(score.kinds) > 1 else ""
        )
        yield (
            f"{100 * whole.missing:.1f} % of the marker-frames will be missing{most}: add or move cameras."
        )


def _corner(score: RigScore) -> Iterator[str]:
    seen = score.volume.seen_by_two
    worst = int(seen.argmin())
    if seen[worst] < _CORNER * seen.max():
        yield (
            f"At {_place(score.volume.points[worst])} two cameras see {100 * seen[worst]:.0f} % of a hand's "
            f"markers, {100 * seen.max():.0f} % at the best place: keep hands away or aim a camera "
            "at it."
        )


def _needed(score: RigScore) -> Iterator[str]:
    if len(score.losses) == FEWEST_CAMERAS:
        yield "Without either camera there are no points at all: a third would forgive a loss."
        return
    missing = [0.0 if one.without is None else one.without.missing for one in score.losses]
    worst = int(np.argmax(missing))
    yield (
        f"Camera {worst + 1} matters most: without it {100 * missing[worst]:.1f} % of the marker-frames are "
        f"missing, not {100 * score.whole.missing:.1f} %."
    )


def _dispensable(score: RigScore) -> Iterator[str]:
    allowed = _RISE * score.whole.missing + 0.1 * _USELESS
    idle = {
        number: one.without.missing
        for number, one in enumerate(score.losses, 1)
        if one.without is not None and one.needed <= _USELESS and one.without.missing <= allowed
    }
    if not idle:
        return
    least = min(idle, key=lambda number: idle[number])
    told = (
        f"it sees {100 * score.losses[least - 1].needed:.1f} % of the marker-frames that no two others see, "
        f"and without it {100 * idle[least]:.1f} % are missing, not {100 * score.whole.missing:.1f} %"
    )
    others = ", ".join(str(number) for number in idle if number != least)
    also = f". So can any one of {others}; score the rig again after each" if others else ""
    yield f"Camera {least} can go: {told}{also}."


def _error(score: RigScore) -> Iterator[str]:
    axes, directions = score.whole.error.axes, score.whole.error.directions
    if axes[0] > _FAR and axes[0] > _LONG * axes[2]:
        along = _DIRECTIONS[int(np.abs(directions[0]).argmax())]
        yield (
            f"Points are least certain along {along}, {1e3 * axes[0]:.2f} mm against {1e3 * axes[2]:.2f} mm: "
            f"a camera that looks across {along} would help."
        )


def _ghosts(score: RigScore) -> Iterator[str]:
    if score.whole.ghosts > _GHOSTS:
        worst = max(score.kinds, key=lambda kind: score.kinds[kind].ghosts)
        most = f", most with {worst} ({score.kinds[worst].ghosts:.1f})" if len(score.kinds) > 1 else ""
        yield (
            f"{score.whole.ghosts:.1f} points a frame will be no marker{most}: reflections that cameras see, "
            "mirror images, and rays that meet by chance where few cameras see a marker."
        )


def _place(point: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{one:.2f}' for one in point + 0.0)}) m"


def _figures(one: Forecast) -> dict[str, Any]:
    figures = {field.name: getattr(one, field.name) for field in dataclasses.fields(one)}
    error = figures.pop("error")
    figures |= {"error": error.mean, "error_axes": error.axes, "error_directions": error.directions}
    return {name: _numbers(value) for name, value in figures.items()}


def _numbers(value: Any) -> Any:
    """Numbers and lists of them; what is not a number is None."""
    array = np.asarray(value)
    if array.ndim:
        return [_numbers(part) for part in array]
    return array.item() if np.isfinite(array) else None


class VolumeMap(NamedTuple):
    """G points of a volume and what becomes of a hand there."""

    points: Float[np.ndarray, "G 3"]
    """Where the wrist is [m]."""
    seen_by_two: Float[np.ndarray, "G"]
    """Share of a hand's markers that two cameras or more see."""
    seen_by_three: Float[np.ndarray, "G"]
    error: Float[np.ndarray, "G"]
    """Root mean square distance of points from the truth [m]; NaN where no marker has a point."""


def map_volume(
    scenes: Sequence[SceneMotion],
    rig: CameraRig,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    rng: np.random.Generator,
) -> VolumeMap:
    """Set hands at each point of a grid, in poses that hands at work have.

    Args:
        scenes: Whose hands, and their poses.
        rng: Chooses the poses.
    """
    points = cube_points(center, sides, GRID)
    two, three, errors = [], [], []
    for _ in range(_HANDS):
        scene = scenes[int(rng.integers(len(scenes)))]
        hand = scene.hands[int(rng.integers(len(scene.hands)))]
        qpos = np.tile(hand.qpos[rng.integers(scene.num_frames)], (len(points), 1))
        qpos[:, :3] = points
        placed = SceneMotion((GlovedHand(hand.fit, qpos),))
        sight, radii = SceneSight(placed, rig), marker_radii(placed, OPTICS)
        seen = sight.visible_markers(OPTICS.partial * radii, rng=rng)
        views = seen.sum(axis=-1)
        two.append((views >= FEWEST_CAMERAS).mean(axis=1))
        three.append((views > FEWEST_CAMERAS).mean(axis=1))
        errors.append(_errors(sight.markers[0], seen, rig, radii))
    error = np.concatenate(errors, axis=1)
    known = np.isfinite(error)
    mean = np.where(known, error, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    return VolumeMap(points, np.mean(two, axis=0), np.mean(three, axis=0), mean)


def _errors(
    markers: NDArray[np.float64], seen: NDArray[np.bool_], rig: CameraRig, radii: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of each marker (G, M) [m], NaN where it has no point."""
    errors = np.full(seen.shape[:2], np.nan)
    rows, columns = np.nonzero(seen.sum(axis=-1) >= FEWEST_CAMERAS)
    noise = OPTICS.noise * np.sqrt(MARKER_RADIUS / radii[columns])
    spread = covariances(markers[rows, columns], seen[rows, columns], rig, noise)
    lengths = np.sqrt(np.trace(spread, axis1=1, axis2=2))
    errors[rows, columns] = np.where(lengths < _LONGEST, lengths, np.nan)
    return errors
