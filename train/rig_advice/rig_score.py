"""The score of a rig: everything that is known of it before it records."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from handsim.space.cameras import CameraRig
from train.rig_advice.forecast import CameraLoss, Forecast, camera_losses, forecast, light
from train.rig_advice.rig_faults import faults
from train.rig_advice.volume_map import VolumeMap, map_volume
from train.simulation.motion import SceneMotion


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
            "cameras": len(self.rig.positions),
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
    lit = {kind: light(scenes, rig, rng=rng) for kind, scenes in work.items()}
    everything = [one for scenes in lit.values() for one in scenes]
    return RigScore(
        rig,
        forecast(everything, rig, seed=seed),
        {kind: forecast(scenes, rig, seed=seed) for kind, scenes in lit.items()},
        camera_losses(everything, rig, seed=seed),
        map_volume([one.scene for one in everything], rig, center, sides, rng=rng),
        faults(rig),
    )


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
