"""Paths from pose to pose: minimum-jerk profiles (Flash and Hogan 1985) within limits of speed.

Paths to rest do not penetrate the hand: they are straight where possible, else with stops.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_number, check_span
from handsim.errors import PoseError
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, NUM_JOINTS
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture
from poses.shapes.validity import is_valid, resting_angles

PEAK_SPEED: Final = 1.875
"""Peak speed of the minimum-jerk profile, in distances per duration."""
PEAK_ACCELERATION: Final = 5.7735
"""Its peak acceleration, in distances per duration squared."""
# Which digits move first on a path to rest: all at once, one before the others, one after them.
_AHEAD: Final = [np.ones(NUM_JOINTS, dtype=bool)] + [
    np.repeat((np.arange(len(DIGITS)) == digit) == first, 4)
    for first in (True, False)
    for digit in range(len(DIGITS))
]
_ROUNDS: Final = 2
_FANS: Final = (0.0, 0.3, 0.6, 1.0, 1.6)  # how far the fingers part before, in shares of the gesture "spread"


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
    return time**3 * (10.0 - 15.0 * time + 6.0 * time**2)


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


def path_to_rest(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Valid frames (T, 20) [rad] from a pose to rest: the straight path or the first detour that is valid."""
    # Each round draws other durations, and so other frames: a path close to the limit may pass.
    for stops in chain(*(_via_paths(start, resting_angles(model)) for _ in range(_ROUNDS))):
        path = np.concatenate([straight_path(*pair, config, rng) for pair in pairwise([start, *stops])])
        if is_valid(model, path).all():
            return path
    raise PoseError("no valid path leads from one of the poses to this hand's rest")


def _via_paths(
    start: NDArray[np.float64], resting: NDArray[np.float64]
) -> Iterator[list[NDArray[np.float64]]]:
    """Stops on paths to rest: fingers part or not, the thumb swings out or not, one digit moves first."""
    spread = gesture("spread")
    fan = np.where(np.arange(NUM_JOINTS) % 4 == 0, spread - gesture("flat"), 0.0)
    fan[:4] = 0.0
    hubs = [np.concatenate([thumb[:4], resting[4:]]) for thumb in (resting, spread, gesture("claw"))]
    for hub in hubs:
        for share in _FANS:
            parted, opened = (np.clip(pose + share * fan, LOW, HIGH) for pose in (start, hub))
            for ahead in _AHEAD:
                stops = [parted, np.where(ahead, opened, parted), opened, resting]
                legs = pairwise([start, *stops])
                yield [stop for before, stop in legs if not np.array_equal(before, stop)] or [resting]


def can_be_left(model: HandModel, poses: Float[np.ndarray, "K 20"]) -> Bool[np.ndarray, "K"]:
    """Which of these valid poses [rad] have a valid path to rest, and so one from rest."""
    shares = np.linspace(0.0, 1.0, 32)[:, None]
    paths = poses[:, None] + shares * (resting_angles(model) - poses[:, None])
    valid: NDArray[np.bool_] = is_valid(model, paths.reshape(-1, NUM_JOINTS))
    free: NDArray[np.bool_] = np.all(valid.reshape(-1, len(shares)), axis=1)
    one_duration, unused = MotionConfig(durations=(0.4, 0.4)), np.random.default_rng(0)
    for number in np.flatnonzero(~free):
        with contextlib.suppress(PoseError):
            path_to_rest(model, poses[number], one_duration, unused)
            free[number] = True
    return free
