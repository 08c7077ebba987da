"""Stray reflections that persist: a watch, a ring, a worn spot of the glove, carried along and flashing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from handsim.errors import ArgumentError


@dataclass(frozen=True, slots=True)
class StrayConfig:
    """Number of reflecting spots, their positions and the duration of their flashes.

    Raises:
        ArgumentError: A number is out of range.
    """

    number: float = 1.0
    """Mean number of reflecting spots, Poisson distributed."""
    reach: float = 0.12
    """Radius of the ball around the middle of the carrier in which they lie [m]."""
    shown: float = 0.4
    """Mean time that a spot reflects [s]."""
    hidden: float = 1.0
    """Mean time that it does not [s]."""
    camera_share: float = 0.5
    """Share of the cameras that a spot reflects to."""

    def __post_init__(self) -> None:
        for name in ("number", "reach", "shown", "hidden"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ArgumentError(f"{name} of strays is {getattr(self, name):g}, expected a number from 0")
        if self.shown <= 0.0 or not 0.0 <= self.camera_share <= 1.0:
            raise ArgumentError("strays need a time shown above 0 s and a camera_share from 0 to 1")


def sample_strays(
    T_world_carrier: Float[np.ndarray, "T 4 4"],
    middle: Float[np.ndarray, "3"],
    config: StrayConfig,
    *,
    rate: float,
    num_cameras: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T K 3"], Bool[np.ndarray, "T K C"]]:
    """Strays carried by a hand, an object or the room.

    Args:
        T_world_carrier: Pose of the carrier.
        middle: Middle of the ball in which they lie, in the carrier's frame [m].
        num_cameras: Cameras of the rig.

    Returns:
        Positions in the world [m], and which cameras each reflects to; occlusion is not tested here.
    """
    count = int(rng.poisson(config.number))
    directions = rng.standard_normal((count, 3))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    local = middle + config.reach * np.cbrt(rng.random((count, 1))) * directions
    positions = np.einsum("tij,kj->tki", T_world_carrier[:, :3, :3], local) + T_world_carrier[:, None, :3, 3]
    shining = np.zeros((len(positions), count), dtype=bool)
    for number in range(count):
        shining[:, number] = _flashes(len(positions), config, rate, rng)
    lit = rng.random((count, num_cameras)) < config.camera_share
    return positions, shining[..., None] & lit


def _flashes(
    frames: int, config: StrayConfig, rate: float, rng: np.random.Generator
) -> Bool[np.ndarray, "T"]:
    """Alternating times of light and dark, exponentially distributed."""
    shown = rng.random() < config.shown / (config.shown + config.hidden)
    shining = np.empty(frames, dtype=bool)
    at = 0
    while at < frames:
        mean = config.shown if shown else config.hidden
        steps = max(1, round(rng.exponential(mean) * rate)) if mean > 0.0 else 0
        shining[at : at + steps] = shown
        at, shown = at + steps, not shown
    return shining
