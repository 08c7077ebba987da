"""Paths to rest that do not penetrate the hand: straight where possible, else with stops."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import chain, pairwise
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.errors import PoseError
from handsim.hand.model import HandModel
from handsim.hand.topology import DIGITS, NUM_JOINTS
from poses.motion.minimum_jerk import MotionConfig, straight_path
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture
from poses.shapes.validity import is_valid, resting_angles

# Which digits move first on a path to rest: all at once, one before the others, one after them.
_AHEAD: Final = [np.ones(NUM_JOINTS, dtype=bool)] + [
    np.repeat((np.arange(len(DIGITS)) == digit) == first, 4)
    for first in (True, False)
    for digit in range(len(DIGITS))
]
_ROUNDS: Final = 2
_FANS: Final = (0.0, 0.3, 0.6, 1.0, 1.6)  # how far the fingers part before, in shares of the gesture "spread"


def path_to_rest(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Valid frames (T, 20) [rad] from a pose to rest: the straight path or the first detour that is valid.

    Raises:
        PoseError: No path was valid.
    """
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
