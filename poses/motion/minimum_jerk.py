"""Straight paths from pose to pose: minimum-jerk profiles (Flash and Hogan 1985) within limits of speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_number, check_span

PEAK_SPEED: Final = 1.875
"""Peak speed of the minimum-jerk profile, in distances per duration."""
PEAK_ACCELERATION: Final = 5.7735
"""Its peak acceleration, in distances per duration squared."""


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """Speeds of a hand, and the volume in which its wrist moves.

    Raises:
        ArgumentError: A number or a pair of numbers is out of range.
    """

    rate: float = 120.0
    """Frames per second [Hz]."""
    max_speed: float = 10.0
    """Highest joint speed [rad/s]; rapid finger tapping reaches about this."""
    max_acceleration: float = 200.0
    """Largest joint acceleration [rad/s^2]."""
    durations: tuple[float, float] = (0.15, 0.8)
    """Shortest and longest time of a path that the limits would allow to be quicker [s]."""
    hold: float = 0.3
    """Longest rest at a pose [s]."""
    volume: float = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    wrist_time: tuple[float, float] = (0.6, 2.0)
    """Shortest and longest time between two positions of the wrist [s]."""

    def __post_init__(self) -> None:
        for name in ("rate", "max_speed", "max_acceleration"):
            check_number(name, getattr(self, name), 0.0, above=True)
        for name in ("hold", "volume"):
            check_number(name, getattr(self, name), 0.0)
        for name in ("durations", "wrist_time"):
            check_span(name, getattr(self, name))


def minimum_jerk(frames: int) -> Float[np.ndarray, "T"]:
    """Share of the path after each of `frames` frames, the last one being 1."""
    time = np.arange(1, frames + 1) / frames
    share: NDArray[np.float64] = time**3 * (10.0 - 15.0 * time + 6.0 * time**2)
    return share


def straight_path(
    start: NDArray[np.float64], target: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Frames (T, 20) [rad] from one pose (left out) to another, of a drawn duration within the limits."""
    distance = np.abs(target - start).max()
    quickest = max(
        PEAK_SPEED * distance / config.max_speed,
        np.sqrt(PEAK_ACCELERATION * distance / config.max_acceleration),
    )
    frames = int(np.ceil(max(quickest, rng.uniform(*config.durations)) * config.rate)) + 1
    return start + minimum_jerk(frames)[:, None] * (target - start)


def held(path: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """The frames, and a rest in the last pose."""
    pause = int(rng.uniform(0.0, config.hold) * config.rate)
    return np.concatenate([path, np.repeat(path[-1:], pause, axis=0)])
