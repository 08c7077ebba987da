"""Paths of a wrist: random positions and orientations, joined by minimum-jerk profiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from handsim._checks import check_array, check_number, check_span
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import random_quaternions
from poses.motion.paths import MotionConfig, minimum_jerk

_FREE_ROTATION: Final = 0.6  # from position to position, standard deviation about each axis [rad]
_FORWARD: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Fingers along +y, back of the hand up."""


@dataclass(frozen=True, slots=True)
class WristConfig:
    """Positions and orientations of the wrist of a person at a table.

    Raises:
        ArgumentError: A number or a pair of numbers is out of range.
    """

    center: tuple[float, float, float] = ROOM_CENTER
    """Middle of the cube it moves in [m]."""
    volume: float = 0.3
    """Half side of that cube [m]."""
    turning: float = 0.5
    """Standard deviation of the rotation about each axis, from fingers ahead and palm down [rad]."""
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
    """Positions [m] and orientations (wxyz) of a wrist that takes any orientation."""
    positions, orientations, shares = (
        [_draw_position(config, rng)],
        [random_quaternions(1, rng=rng)[0]],
        [np.zeros(1)],
    )
    while sum(map(len, shares)) < frames:
        positions.append(_draw_position(config, rng))
        rotation = Rotation.from_rotvec(rng.normal(scale=_FREE_ROTATION, size=3)).as_quat(scalar_first=True)
        earlier = Rotation.from_quat(orientations[-1], scalar_first=True)
        orientations.append(
            (earlier * Rotation.from_quat(rotation, scalar_first=True)).as_quat(scalar_first=True)
        )
        steps = int(rng.uniform(*config.wrist_time) * config.rate) + 1
        shares.append(len(positions) - 2 + minimum_jerk(steps))
    rotated = Rotation.from_quat(np.array(orientations), scalar_first=True)
    return _quaternions(along(np.array(positions), rotated, np.concatenate(shares)[:frames]))


def wrist_path(
    frames: int, rate: float, config: WristConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Positions [m] and orientations (wxyz) of a wrist whose palm faces mostly down."""
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < max(frames, 2):  # interpolation needs two
        steps = int(rng.uniform(*config.times) * rate) + 1
        shares.append(len(shares) - 1 + minimum_jerk(steps))
    count = len(shares)
    positions = config.center + rng.uniform(-config.volume, config.volume, size=(count, 3))
    away = Rotation.from_rotvec(rng.normal(scale=config.turning, size=(count, 3)))
    orientations = away * Rotation.from_matrix(_FORWARD)
    return _quaternions(along(positions, orientations, np.concatenate(shares)[:frames]))


def along(
    positions: Float[np.ndarray, "K 3"], orientations: Rotation, progress: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Rotation]:
    """Interpolated positions [m] and orientations; `progress` goes from 0 to K - 1."""
    keys = np.arange(len(positions))
    position = np.stack([np.interp(progress, keys, axis) for axis in positions.T], axis=1)
    return position, Slerp(keys, orientations)(progress)


def _quaternions(
    path: tuple[NDArray[np.float64], Rotation],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position, orientations = path
    return position, orientations.as_quat(scalar_first=True)


def _draw_position(config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    return ROOM_CENTER + rng.uniform(-config.volume, config.volume, size=3)
