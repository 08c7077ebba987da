"""Where a wrist goes: from place to place and from turn to turn, each way a minimum-jerk one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from handsim._checks import check_array, check_number, check_span
from handsim.space.cameras import ROOM_CENTER
from handsim.space.transforms import random_quaternions
from poses.motion.minimum_jerk import MotionConfig, minimum_jerk

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_FREE_TURN: Final = 0.6  # from place to place, standard deviation about each axis [rad]
_FORWARD: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Fingers along +y, back of the hand up."""


@dataclass(frozen=True, slots=True)
class WristConfig:
    """Where the wrist of somebody at a table goes and how it turns."""

    center: tuple[float, float, float] = ROOM_CENTER
    """Middle of the cube it moves in [m]."""
    volume: float = 0.3
    """Half side of that cube [m]."""
    turning: float = 0.5
    """Standard deviation of the turns about each axis, from fingers ahead and palm down [rad]."""
    times: tuple[float, float] = (0.6, 2.0)
    """Shortest and longest time between two positions [s]."""

    def __post_init__(self) -> None:
        check_array("center", self.center, (3,))
        check_number("volume", self.volume, 0.0)
        check_number("turning", self.turning, 0.0)
        check_span("times", self.times)


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
    return _quaternions(along(np.array(places), turned, np.concatenate(shares)[:frames]))


def wrist_path(
    frames: int, rate: float, config: WristConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Positions [m] and orientations (wxyz) of a wrist whose palm looks mostly down."""
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < max(frames, 2):  # turns need two places
        steps = int(rng.uniform(*config.times) * rate) + 1
        shares.append(len(shares) - 1 + minimum_jerk(steps))
    count = len(shares)
    places = config.center + rng.uniform(-config.volume, config.volume, size=(count, 3))
    away = Rotation.from_rotvec(rng.normal(scale=config.turning, size=(count, 3)))
    turns = away * Rotation.from_matrix(_FORWARD)
    return _quaternions(along(places, turns, np.concatenate(shares)[:frames]))


def along(
    places: Float[np.ndarray, "K 3"], turns: Rotation, progress: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Rotation]:
    """Between places and turns, `progress` counting the places left behind."""
    keys = np.arange(len(places))
    position = np.stack([np.interp(progress, keys, axis) for axis in places.T], axis=1)
    return position, Slerp(keys, turns)(progress)


def _quaternions(
    path: tuple[NDArray[np.float64], Rotation],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position, turns = path
    return position, turns.as_quat(scalar_first=True)


def _place(config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    place: NDArray[np.float64] = ROOM_CENTER + rng.uniform(-config.volume, config.volume, size=3)
    return place
