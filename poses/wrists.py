"""Where a wrist goes: from place to place and from turn to turn, each way a minimum-jerk one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from handsim.transforms import random_quaternions
from poses.pace import MotionConfig, minimum_jerk

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_CENTRE: Final = np.array([0.0, 0.0, 1.1])
_FREE_TURN: Final = 0.6  # from place to place, standard deviation about each axis [rad]
_FORWARD: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Fingers along +y, back of the hand up."""


@dataclass(frozen=True, slots=True)
class WristConfig:
    """Where the wrist of somebody at a table goes and how it turns."""

    centre: tuple[float, float, float] = (0.0, 0.0, 1.1)
    """Middle of the cube it moves in [m]."""
    volume: float = 0.3
    """Half side of that cube [m]."""
    turning: float = 0.5
    """Standard deviation of the turns about each axis, from fingers ahead and palm down [rad]."""
    times: tuple[float, float] = (0.6, 2.0)
    """Shortest and longest time from place to place [s]."""


def free_wrist_path(
    frames: int, config: MotionConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Positions [m] and orientations (wxyz) of a wrist that ends up turned any way."""
    places, turns, shares = [_place(config, rng)], [random_quaternions(1, rng=rng)[0]], [np.zeros(1)]
    while sum(map(len, shares)) < frames:
        places.append(_place(config, rng))
        turn = Rotation.from_rotvec(rng.normal(scale=_FREE_TURN, size=3)).as_quat(scalar_first=True)
        earlier = Rotation.from_quat(turns[-1], scalar_first=True)
        turns.append((earlier * Rotation.from_quat(turn, scalar_first=True)).as_quat(scalar_first=True))
        steps = int(rng.uniform(*config.wrist_time) * config.rate) + 1
        shares.append(len(places) - 2 + minimum_jerk(steps))
    turned = Rotation.from_quat(np.array(turns), scalar_first=True)
    return _along(np.array(places), turned, np.concatenate(shares)[:frames])


def wrist_path(
    frames: int, rate: float, config: WristConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Positions [m] and orientations (wxyz) of a wrist whose palm looks mostly down."""
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < max(frames, 2):  # turns need two places
        steps = int(rng.uniform(*config.times) * rate) + 1
        shares.append(len(shares) - 1 + minimum_jerk(steps))
    count = len(shares)
    places = config.centre + rng.uniform(-config.volume, config.volume, size=(count, 3))
    away = Rotation.from_rotvec(rng.normal(scale=config.turning, size=(count, 3)))
    return _along(places, away * Rotation.from_matrix(_FORWARD), np.concatenate(shares)[:frames])


def _along(
    places: NDArray[np.float64], turns: Rotation, progress: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Between places and turns, `progress` counting the places left behind."""
    keys = np.arange(len(places))
    position = np.stack([np.interp(progress, keys, axis) for axis in places.T], axis=1)
    orientation: NDArray[np.float64] = Slerp(keys, turns)(progress).as_quat(scalar_first=True)
    return position, orientation


def _place(config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    place: NDArray[np.float64] = _CENTRE + rng.uniform(-config.volume, config.volume, size=3)
    return place
