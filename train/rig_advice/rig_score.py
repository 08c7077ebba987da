"""The score of a rig: everything that is known of it before it records, and sentences on what to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.space.cameras import FEWEST_CAMERAS, CameraRig
from train.rig_advice.forecast import CameraLoss, Forecast, camera_losses, forecast, light_work
from train.rig_advice.rig_faults import faults
from train.rig_advice.volume_map import VolumeMap, map_volume
from train.simulation.motion import SceneMotion

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


@dataclass(frozen=True, slots=True, eq=False)
class RigScore:
    """What a rig makes of hands at work."""

    rig: CameraRig
    whole: Forecast
    """Of all work together."""
    kinds: dict[str, Forecast]
    """Of each kind of work."""
    losses: list[CameraLoss]
    """Of each camera."""
    volume: VolumeMap
    faults: list[str]
    """What is suspicious about the rig itself, see `train.rig_advice.rig_faults`."""

    def record(self) -> dict[str, Any]:
        """All figures as JSON, in meters and seconds; what does not exist is null."""
        return {
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


def score_rig(
    rig: CameraRig,
    work: Mapping[str, Sequence[SceneMotion]],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    seed: int = 0,
) -> RigScore:
    """Forecast what a rig makes of hands at work, without each of its cameras too.

    Args:
        rig: The cameras.
        work: Scenes of each kind of work.
        center: Middle of the volume that is mapped [m].
        sides: Its sides [m].
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
    )


def sentences(score: RigScore) -> list[str]:
    """What to do with a rig; what is most wrong comes first."""
    parts = (_suspicious, _missing, _corner, _needed, _dispensable, _error, _ghosts)
    found = [one for part in parts for one in part(score)]
    return found or ["Nothing stands out: hands at work are seen well, and no camera is idle."]


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
