"""`Conditions`: the light and the sensors of one picture, drawn at random."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from render.color_sensor import Exposure, Shutter, sample_exposure, sample_shutter
from render.config import RenderConfig
from render.depth_sensor import DepthNoise, sample_depth_noise
from render.frames import Doubles
from render.scenery.backgrounds import Background, Enclosure
from render.scenery.lights import Lighting, sample_surroundings


@dataclass(frozen=True, slots=True)
class Conditions:
    """Random choices of one picture, apart from people and camera."""

    lighting: Lighting
    background: Background
    exposure: Exposure | None  # None for a perfect color sensor
    shutter: Shutter | None  # None for a picture of an instant
    depth_noise: DepthNoise | None  # None for a perfect depth sensor
    seed: int = 0  # seed of the sensors' noise
    enclosure: Enclosure | None = None
    """Box whose walls show the background to several cameras; None for the picture of one camera."""

    def reseeded(self, rng: np.random.Generator) -> Conditions:
        """A copy with other noise of the sensors."""
        return dataclasses.replace(self, seed=int(rng.integers(2**31)))

    def record(self) -> dict[str, Any]:
        """The choices as JSON."""
        return _as_record(dataclasses.replace(self, seed=0)) | {"seed": self.seed}


def sample_conditions(
    config: RenderConfig,
    viewer: Doubles,
    size: tuple[int, int],
    around: Doubles | None = None,
    *,
    rng: np.random.Generator,
) -> Conditions:
    """Random choices of a picture, with light for a viewer with these axes (3, 3).

    Cameras and hands at positions `around` (N, 3) [m] share an enclosure.
    """
    background, lighting, enclosure = sample_surroundings(config.background, viewer, size, around, rng=rng)
    sensor = config.depth_sensor
    assert sensor != "auto"
    return Conditions(
        lighting=lighting,
        background=background,
        exposure=None if config.color_sensor is None else sample_exposure(config.color_sensor, rng=rng),
        shutter=None if config.shutter is None else sample_shutter(config.shutter, rng=rng),
        depth_noise=None if sensor is None else sample_depth_noise(sensor, rng=rng),
        enclosure=enclosure,
    )


@functools.lru_cache(maxsize=64)
def _as_record(conditions: Conditions) -> dict[str, Any]:
    """The choices as JSON, cached, because pictures of a shard differ in their seeds only."""
    noise = conditions.depth_noise
    kind = {} if noise is None else {"depth_sensor": type(noise).__name__}
    record = kind | dataclasses.asdict(conditions)
    if conditions.enclosure is None:
        del record["enclosure"]
    return record
