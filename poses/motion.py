"""Smooth motion of one hand and its wrist through valid poses, at speeds that a human hand reaches."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Annotated, Any, Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from handsim._checks import check_choice, check_number, check_rng, check_type
from handsim.errors import ArgumentError, PoseError, choices
from handsim.files.inputs import package_data
from handsim.hand.model import HandModel, HandMotion, join_qpos, load_model
from handsim.hand.shape import DIGITS, NUM_JOINTS, HandShape
from handsim.settings import Limits, Settings
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import random_quaternions
from poses.shapes import (
    HIGH,
    LOW,
    gesture,
    gestures_of,
    is_valid,
    make_valid,
    resting_angles,
    sample_valid_angles,
)
from poses.touch import touching_angles

RATE: Final = 120.0
"""Frames per second [Hz]."""
MAX_SPEED: Final = 10.0
"""Highest joint speed [rad/s]; rapid finger tapping reaches about this."""
MAX_ACCELERATION: Final = 200.0
"""Largest joint acceleration [rad/s^2]."""
PEAK_SPEED: Final = 1.875
"""Peak speed of the minimum-jerk profile, in distances per duration."""
PEAK_ACCELERATION: Final = 5.7735
"""Peak acceleration of the minimum-jerk profile, in distances per duration squared."""
# Joints that move first on a path to rest: all, those of one digit, or those of all digits but one.
_MOVES_FIRST: Final = [np.ones(NUM_JOINTS, dtype=bool)] + [
    np.repeat((np.arange(len(DIGITS)) == digit) == first, 4)
    for first in (True, False)
    for digit in range(len(DIGITS))
]
_WRIST_TIMES: Final = (0.6, 2.0)
_FAN_SHARES: Final = (0.0, 0.3, 0.6, 1.0, 1.6)  # finger spread at the first stop, relative to "spread"

_FREE_ROTATION: Final = 0.6  # standard deviation about each axis between two positions [rad]
_FORWARD_WRIST: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Orientation of a wrist with fingers along +y and the back of the hand up."""

FREE: Final = "free"
"""The name of a motion without a script: what `sample_motion` makes."""
_POSES_PER_DRAW: Final = 16


@dataclass(frozen=True, slots=True)
class MotionConfig(Settings):
    """Speeds of a hand, and the volume in which its wrist moves."""

    rate: Annotated[float, Limits(0.0, above=True)] = RATE
    """Frames per second [Hz]."""
    max_speed: Annotated[float, Limits(0.0, above=True)] = MAX_SPEED
    """Highest joint speed [rad/s]; rapid finger tapping reaches about this."""
    max_acceleration: Annotated[float, Limits(0.0, above=True)] = MAX_ACCELERATION
    """Largest joint acceleration [rad/s^2]."""
    durations: Annotated[tuple[float, float], Limits(0.0, ascends=True)] = (0.15, 0.8)
    """Shortest and longest time of a path; speed limits may make it longer [s]."""
    hold: Annotated[float, Limits(0.0)] = 0.3
    """Longest rest at a pose [s]."""
    volume: Annotated[float, Limits(0.0)] = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    wrist_time: Annotated[tuple[float, float], Limits(0.0, ascends=True)] = _WRIST_TIMES
    """Shortest and longest time between two positions of the wrist [s]."""

    def least_time(self, bend: float, share: float = 1.0) -> float:
        """Shortest time [s] of a minimum-jerk path that moves a joint by an angle [rad]."""
        speed, acceleration = share * self.max_speed, share * self.max_acceleration
        return max(PEAK_SPEED * bend / speed, float(np.sqrt(PEAK_ACCELERATION * bend / acceleration)))


def minimum_jerk(frames: int) -> Float[np.ndarray, "T"]:
    """Share of a minimum-jerk path after each of `frames` frames; the last is 1."""
    time = np.arange(1, frames + 1) / frames
    return time**3 * (10.0 - 15.0 * time + 6.0 * time**2)


def straight_path(
    start: NDArray[np.float64], target: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Frames (T, 20) [rad] from one pose (not included) to another, with a random duration."""
    quickest = config.least_time(np.abs(target - start).max())
    frames = int(np.ceil(max(quickest, rng.uniform(*config.durations)) * config.rate)) + 1
    return start + minimum_jerk(frames)[:, None] * (target - start)


def _rested(path: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """Extend a path by a random rest at its end."""
    pause = int(rng.uniform(0.0, config.hold) * config.rate)
    return np.concatenate([path, np.repeat(path[-1:], pause, axis=0)])


def path_to_rest(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Valid frames (T, 20) [rad] from a pose to rest: the straight path, or the first valid detour."""
    # Each path is tried with two random durations: the frames of one may avoid invalid poses of the other.
    for stops in chain(*(_via_paths(start, resting_angles(model)) for _ in range(2))):
        path = np.concatenate([straight_path(*pair, config, rng) for pair in pairwise([start, *stops])])
        if is_valid(model, path).all():
            return path
    raise PoseError("no valid path leads from one of the poses to this hand's rest")


def _via_paths(
    start: NDArray[np.float64], resting: NDArray[np.float64]
) -> Iterator[list[NDArray[np.float64]]]:
    """Yield stops of paths to rest with different spreads of fingers, thumbs, and digits that move first."""
    spread = gesture("spread")
    fan = np.where(np.arange(NUM_JOINTS) % 4 == 0, spread - gesture("flat"), 0.0)
    fan[:4] = 0.0
    hubs = [np.concatenate([thumb[:4], resting[4:]]) for thumb in (resting, spread, gesture("claw"))]
    for hub in hubs:
        for share in _FAN_SHARES:
            parted, opened = (np.clip(pose + share * fan, LOW, HIGH) for pose in (start, hub))
            for ahead in _MOVES_FIRST:
                stops = [parted, np.where(ahead, opened, parted), opened, resting]
                legs = pairwise([start, *stops])
                yield [stop for before, stop in legs if not np.array_equal(before, stop)] or [resting]


def can_be_left(model: HandModel, poses: Float[np.ndarray, "K 20"]) -> Bool[np.ndarray, "K"]:
    """Whether each of these valid poses [rad] has a valid path to rest."""
    shares = np.linspace(0.0, 1.0, 32)[:, None]
    paths = poses[:, None] + shares * (resting_angles(model) - poses[:, None])
    valid: NDArray[np.bool_] = is_valid(model, paths.reshape(-1, NUM_JOINTS))
    free: NDArray[np.bool_] = np.all(valid.reshape(-1, len(shares)), axis=1)
    config, rng = MotionConfig(durations=(0.4, 0.4)), np.random.default_rng(0)  # the same result each time
    for number in np.flatnonzero(~free):
        with contextlib.suppress(PoseError):
            path_to_rest(model, poses[number], config, rng)
            free[number] = True
    return free


def free_wrist_path(
    frames: int, config: MotionConfig, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Sample positions [m] and orientations (wxyz) of a wrist in any orientation."""
    positions = [ROOM_CENTER + rng.uniform(-config.volume, config.volume, size=3)]
    orientations = [random_quaternions(1, rng=rng)[0]]
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < frames:
        positions.append(ROOM_CENTER + rng.uniform(-config.volume, config.volume, size=3))
        rotation = Rotation.from_rotvec(rng.normal(scale=_FREE_ROTATION, size=3)).as_quat(scalar_first=True)
        earlier = Rotation.from_quat(orientations[-1], scalar_first=True)
        orientations.append(
            (earlier * Rotation.from_quat(rotation, scalar_first=True)).as_quat(scalar_first=True)
        )
        steps = int(rng.uniform(*config.wrist_time) * config.rate) + 1
        shares.append(len(positions) - 2 + minimum_jerk(steps))
    keys = Rotation.from_quat(np.array(orientations), scalar_first=True)
    path, rotations = interpolate_path(np.array(positions), keys, np.concatenate(shares)[:frames])
    return path, rotations.as_quat(scalar_first=True)


def wrist_path(
    frames: int,
    rate: float,
    *,
    center: Sequence[float] | Float[np.ndarray, "3"] = ROOM_CENTER,
    volume: float = 0.3,
    turning: float = 0.5,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"]]:
    """Sample positions [m] and orientations (wxyz) of a wrist over a table.

    The wrist stays in a cube of half side `volume` around a center [m]. Its orientation deviates from fingers
    ahead and palm down by the standard deviation `turning` about each axis [rad].
    """
    shares = [np.zeros(1)]
    while sum(map(len, shares)) < max(frames, 2):  # Slerp needs two keys
        steps = int(rng.uniform(*_WRIST_TIMES) * rate) + 1
        shares.append(len(shares) - 1 + minimum_jerk(steps))
    count = len(shares)
    positions = np.asarray(center) + rng.uniform(-volume, volume, size=(count, 3))
    deviations = Rotation.from_rotvec(rng.normal(scale=turning, size=(count, 3)))
    keys = deviations * Rotation.from_matrix(_FORWARD_WRIST)
    path, orientations = interpolate_path(positions, keys, np.concatenate(shares)[:frames])
    return path, orientations.as_quat(scalar_first=True)


def interpolate_path(
    positions: Float[np.ndarray, "K 3"], orientations: Rotation, progress: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Rotation]:
    """Interpolated positions [m] and orientations; `progress` goes from 0 to K - 1."""
    keys = np.arange(len(positions))
    position = np.stack([np.interp(progress, keys, axis) for axis in positions.T], axis=1)
    return position, Slerp(keys, orientations)(progress)


def sample_motion(
    model: HandModel | HandShape | str,
    duration: float,
    config: MotionConfig | None = None,
    *,
    rng: np.random.Generator,
) -> HandMotion:
    """Random smooth motion of one hand through valid poses, valid at every frame.

    Args:
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.
        duration: How long [s]; the motion has `round(duration * rate) + 1` frames.
        config: Speeds and positions; human ones by default.
        rng: Source of all randomness.

    Raises:
        ArgumentError: An argument is of another type, or the duration is not positive or less than a step.
        PoseError: This hand has no room for its fingers, or no path leads out of a pose.
    """
    hand, config = load_model(model), config or MotionConfig()
    check_type("config", config, MotionConfig, "a MotionConfig")
    check_number("duration", duration, 0.0, above=True)
    check_rng(rng)
    frames = count_frames(duration, config)
    angles = sample_valid_angles(hand, 1, rng=rng)
    parts, count = [angles], 1
    while count < frames:
        part = _next_path(hand, parts[-1][-1], config, rng)
        parts.append(part)
        count += len(part)
    return with_wrist(np.concatenate(parts)[:frames], config, rng=rng)


def count_frames(duration: float, config: MotionConfig) -> int:
    """Number of frames of a motion of this duration [s], with the first one."""
    steps = duration * config.rate
    if not np.isfinite(steps) or round(steps) < 1:
        raise ArgumentError(
            f"the motion is {duration:g} s long, expected a number of at least one step at {config.rate:g} Hz"
        )
    return round(steps) + 1


def angles_through(
    model: HandModel, poses: Float[np.ndarray, "K 20"], config: MotionConfig, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Valid frames [rad] through valid poses, without the first pose, with a rest at each."""
    paths = [straight_path(start, target, config, rng) for start, target in pairwise(poses)]
    ends = np.cumsum([len(path) for path in paths])
    valid = np.split(is_valid(model, np.concatenate(paths)), ends[:-1])
    for number, direct in enumerate(valid):
        if not direct.all():
            out = path_to_rest(model, poses[number], config, rng)
            back = path_to_rest(model, poses[number + 1], config, rng)[-2::-1]
            paths[number] = np.concatenate([out, back, poses[number + 1 : number + 2]])
    return np.concatenate([_rested(path, config, rng) for path in paths])


def _next_path(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Valid frames from one pose to a random one, with a rest there."""
    resting = resting_angles(model)
    for _ in range(25):
        for target in sample_valid_angles(model, 8, rng=rng):
            for stops in ([start, target], [start, resting, target]):
                path = np.concatenate([straight_path(*pair, config, rng) for pair in pairwise(stops)])
                if is_valid(model, path).all():
                    return _rested(path, config, rng)
    return _rested(path_to_rest(model, start, config, rng), config, rng)


def with_wrist(
    angles: Float[np.ndarray, "T 20"], config: MotionConfig, *, rng: np.random.Generator
) -> HandMotion:
    """A motion of these joint angles [rad] with a random path of the wrist."""
    position, quaternion = free_wrist_path(len(angles), config, rng=rng)
    return HandMotion(join_qpos(angles, position=position, quaternion=quaternion), config.rate)


def _scripts() -> dict[str, dict[str, Any]]:
    scripts: dict[str, dict[str, Any]] = package_data("poses", "scripts")["scripts"]
    return scripts


def scripted_motion(
    model: HandModel, script: str, duration: float, *, rng: np.random.Generator
) -> HandMotion:
    """Smooth motion of one hand that follows a named script for a duration [s], valid at every frame.

    A script other than "free" brings its own `durations` and `hold`.
    """
    check_choice(script, _scripts(), noun="script")
    if script == FREE:
        return sample_motion(model, duration, rng=rng)
    entry = _scripts()[script]
    config = MotionConfig(durations=tuple(entry["durations"]), hold=entry["hold"])
    frames = count_frames(duration, config)
    poses = script_poses(model, script)
    current = int(rng.integers(len(poses)))
    parts, count = [poses[current : current + 1]], 1
    while count < frames:
        steps = np.ones(_POSES_PER_DRAW, dtype=np.int64)
        if entry["order"] != "in turn":
            steps = rng.integers(1, len(poses), size=_POSES_PER_DRAW)
        indices = (current + np.concatenate([[0], np.cumsum(steps)])) % len(poses)
        parts.append(angles_through(model, poses[indices], config, rng=rng))
        count, current = count + len(parts[-1]), int(indices[-1])
    return with_wrist(np.concatenate(parts)[:frames], config, rng=rng)


def script_poses(model: HandModel, script: str) -> Float[np.ndarray, "K 20"]:
    """The poses [rad] of a script that this hand can strike and leave on a valid path to rest."""
    if script not in _scripts() or script == FREE:
        raise ArgumentError(choices(script, [name for name in _scripts() if name != FREE], noun="script"))
    entry = _scripts()[script]
    if "touches" in entry:
        touches = []
        for finger in entry["touches"]:
            with contextlib.suppress(PoseError):  # leave out a finger that this thumb cannot touch
                touches.append(touching_angles(model, finger))
        poses = np.array(touches).reshape(-1, NUM_JOINTS)
    elif "library" in entry:
        poses = make_valid(model, gestures_of(entry["library"]))
    else:
        poses = make_valid(model, np.stack([gesture(name) for name in entry["gestures"]]))
    poses = poses[np.flatnonzero(can_be_left(model, poses))]
    if len(poses) < 2:
        raise PoseError(f"this hand can strike {len(poses)} poses of '{script}', expected at least 2")
    return poses
