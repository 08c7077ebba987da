"""Where a wrist goes: from place to place and from turn to turn, each way a minimum-jerk one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from handsim.transforms import random_quaternions
from poses.motions import minimum_jerk

if TYPE_CHECKING:
    from jaxtyping import Float

_FORWARD: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Fingers along +y, back of the hand up."""


@dataclass(frozen=True, slots=True)
class WristConfig:
    """Where a wrist goes and how it turns."""

    centre: tuple[float, float, float] = (0.0, 0.0, 1.1)
    """Middle of the cube it moves in [m]."""
    volume: float = 0.3
    """Half side of that cube [m]."""
    turning: float | None = None
    """Standard deviation of the turns about each axis, from fingers ahead and palm down [rad]; None: any."""
    times: tuple[float, float] = (0.6, 2.0)
    """Shortest and longest time from place to place [s]."""


def wrist_path(
    frames: int, rate: float, config: WristConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Positions [m] and orientations (wxyz) of a wrist on its way through the room."""
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < max(frames, 2):  # turns need two places
        steps = int(rng.uniform(*config.times) * rate) + 1
        shares.append(len(shares) - 1 + minimum_jerk(steps))
    progress = np.concatenate(shares)[:frames]
    count = len(shares)
    places = config.centre + rng.uniform(-config.volume, config.volume, size=(count, 3))
    keys = np.arange(count)
    position = np.stack([np.interp(progress, keys, axis) for axis in places.T], axis=1)
    orientation: np.ndarray = Slerp(keys, _turns(count, config, rng))(progress).as_quat(scalar_first=True)
    return position, orientation


def _turns(count: int, config: WristConfig, rng: np.random.Generator) -> Rotation:
    if config.turning is not None:
        away = Rotation.from_rotvec(rng.normal(scale=config.turning, size=(count, 3)))
        return away * Rotation.from_matrix(_FORWARD)
    turns = [Rotation.from_quat(random_quaternions(1, rng=rng)[0], scalar_first=True)]
    for _ in range(count - 1):
        turns.append(turns[-1] * Rotation.from_rotvec(rng.normal(scale=0.6, size=3)))
    return Rotation.concatenate(turns)
