"""Smooth motion through valid poses, at speeds a human hand reaches, valid at every frame.

Between two poses every joint follows the minimum-jerk profile of human reaching (Flash and Hogan 1985). A way
that digs into the hand is taken over rest instead, and where that does not help another pose is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from handsim.errors import ShapeError
from handsim.model import HandModel, join_qpos
from handsim.motion import HandMotion
from handsim.transforms import random_quaternions
from poses.validity import is_valid, resting_angles, sample_valid_angles

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_PEAK_SPEED: Final = 1.875  # of the minimum-jerk profile, in distances per duration
_PEAK_ACCELERATION: Final = 5.7735  # in distances per duration squared
_MOST_DRAWS: Final = 25
_POSES_A_DRAW: Final = 8


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """How fast a hand moves and where its wrist goes."""

    rate: float = 120.0
    """Frames a second [Hz]."""
    max_speed: float = 10.0
    """Fastest hinge [rad/s]; rapid finger tapping reaches about this."""
    max_acceleration: float = 200.0
    """Largest hinge acceleration [rad/s^2]."""
    durations: tuple[float, float] = (0.15, 0.8)
    """Shortest and longest time for a way that the limits would allow to be quicker [s]."""
    hold: float = 0.3
    """Longest rest at a pose [s]."""
    volume: float = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    wrist_time: tuple[float, float] = (0.6, 2.0)
    """Shortest and longest time between two places of the wrist [s]."""


def sample_motion(
    model: HandModel, duration: float, config: MotionConfig | None = None, *, rng: np.random.Generator
) -> HandMotion:
    """Random smooth motion of one hand through valid poses, valid at every frame.

    Args:
        model: The hand.
        duration: How long [s]; the motion has `round(duration * rate) + 1` frames.
        config: Speeds and places; human ones when not given.
        rng: Source of all randomness.

    Raises:
        ShapeError: The duration is not positive, or this hand has no room for its fingers.
    """
    config = config or MotionConfig()
    if not 0.0 < duration < np.inf:
        raise ShapeError(f"the duration is {duration:g} s, wanted a positive number")
    frames = round(duration * config.rate) + 1
    angles = sample_valid_angles(model, 1, rng=rng)
    parts, count = [angles], 1
    while count < frames:
        part = _next_way(model, parts[-1][-1], config, rng)
        parts.append(part)
        count += len(part)
    position, quaternion = _wrist_path(frames, config, rng)
    angles = np.concatenate(parts)[:frames]
    return HandMotion(join_qpos(angles, position=position, quaternion=quaternion), config.rate)


def minimum_jerk(frames: int) -> Float[np.ndarray, "T"]:
    """Share of the way after each of `frames` frames, the last one being 1."""
    time = np.arange(1, frames + 1) / frames
    share: NDArray[np.float64] = time**3 * (10.0 - 15.0 * time + 6.0 * time**2)
    return share


def _next_way(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Frames from one pose to another and a hold there, all valid."""
    resting = resting_angles(model)
    for _ in range(_MOST_DRAWS):
        for target in sample_valid_angles(model, _POSES_A_DRAW, rng=rng):
            direct = _way(start, target, config, rng)
            if is_valid(model, direct).all():
                return _held(direct, config, rng)
            around = np.concatenate([_way(start, resting, config, rng), _way(resting, target, config, rng)])
            if is_valid(model, around).all():
                return _held(around, config, rng)
    raise ShapeError(f"no valid way out of a pose was found in {_MOST_DRAWS * _POSES_A_DRAW} tries")


def _way(
    start: NDArray[np.float64], target: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    distance = np.abs(target - start).max()
    quickest = max(
        _PEAK_SPEED * distance / config.max_speed,
        np.sqrt(_PEAK_ACCELERATION * distance / config.max_acceleration),
    )
    frames = int(np.ceil(max(quickest, rng.uniform(*config.durations)) * config.rate)) + 1
    return start + minimum_jerk(frames)[:, None] * (target - start)


def _held(way: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    pause = int(rng.uniform(0.0, config.hold) * config.rate)
    return np.concatenate([way, np.repeat(way[-1:], pause, axis=0)])


def _wrist_path(
    frames: int, config: MotionConfig, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (T, 3) and orientations (T, 4) of a wrist that goes from place to place."""
    places, turns, shares = [_place(config, rng)], [random_quaternions(1, rng=rng)[0]], [np.zeros(1)]
    while sum(map(len, shares)) < frames:
        places.append(_place(config, rng))
        turn = Rotation.from_rotvec(rng.normal(scale=0.6, size=3)).as_quat(scalar_first=True)
        earlier = Rotation.from_quat(turns[-1], scalar_first=True)
        turns.append((earlier * Rotation.from_quat(turn, scalar_first=True)).as_quat(scalar_first=True))
        steps = int(rng.uniform(*config.wrist_time) * config.rate) + 1
        shares.append(len(places) - 2 + minimum_jerk(steps))
    progress = np.concatenate(shares)[:frames]
    keys = np.arange(len(places))
    position = np.stack([np.interp(progress, keys, axis) for axis in np.array(places).T], axis=1)
    slerp = Slerp(keys, Rotation.from_quat(np.array(turns), scalar_first=True))
    orientation: NDArray[np.float64] = slerp(progress).as_quat(scalar_first=True)
    return position, orientation


def _place(config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    centre: NDArray[np.float64] = np.array([0.0, 0.0, 1.1])
    return centre + rng.uniform(-config.volume, config.volume, size=3)
