"""Smooth motion through valid poses, at speeds a human hand reaches, valid at every frame.

Between two poses every joint follows the minimum-jerk profile of human reaching (Flash and Hogan 1985). A
path that penetrates the hand goes by way of rest instead, with some digits ahead of the others if needed.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array, check_number, check_rng, check_type
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos, load_model
from handsim.hand.motion import HandMotion
from handsim.hand.shape import NUM_JOINTS, HandShape
from poses.motion.paths import MotionConfig, held, minimum_jerk, path_to_rest, straight_path
from poses.motion.wrist_paths import free_wrist_path
from poses.shapes.validity import MAX_PENETRATION, is_valid, resting_angles, sample_valid_angles

__all__ = ["MotionConfig", "minimum_jerk", "motion_through", "sample_motion"]

_MOST_DRAWS: Final = 25
_POSES_A_DRAW: Final = 8


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


def motion_through(
    model: HandModel | HandShape | str,
    poses: Float[np.ndarray, "K 20"],
    config: MotionConfig | None = None,
    *,
    rng: np.random.Generator,
) -> HandMotion:
    """Smooth motion of one hand from each of the given poses [rad] to the next, valid at every frame.

    It begins in the first pose and rests for a moment at each later one; durations and the wrist's path are
    random. A shape or the name of a size is a right hand.

    Raises:
        ArgumentError: There are fewer than two poses, or one is not valid on this hand.
        PoseError: No path leads out of one.
    """
    model = load_model(model)
    config = config or MotionConfig()
    poses = check_array("poses", poses, (None, NUM_JOINTS))
    if poses.ndim != 2 or len(poses) < 2:
        raise ArgumentError(f"poses has shape {poses.shape}, expected at least two poses, (K, {NUM_JOINTS})")
    valid = is_valid(model, poses)
    if not valid.all():
        raise ArgumentError(
            f"pose {valid.argmin()} of {len(poses)} is not valid on this hand: out of range or deeper than "
            f"{1e3 * MAX_PENETRATION:g} mm in itself, expected what poses.shapes.validity.make_valid returns"
        )
    angles = np.concatenate([poses[:1], angles_through(model, poses, config, rng=rng)])
    return with_wrist(angles, config, rng=rng)


def count_frames(duration: float, config: MotionConfig) -> int:
    """Frames of a motion of this duration [s], the first one included."""
    steps = duration * config.rate
    if not np.isfinite(steps) or round(steps) < 1:
        raise ArgumentError(
            f"the motion is {duration:g} s long, expected a number of at least one step at {config.rate:g} Hz"
        )
    return round(steps) + 1


def angles_through(
    model: HandModel, poses: Float[np.ndarray, "K 20"], config: MotionConfig, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Valid frames [rad] from the first of these valid poses (left out) to the last, with a rest at each.

    Raises:
        PoseError: No path leads out of a pose.
    """
    paths = [straight_path(start, target, config, rng) for start, target in pairwise(poses)]
    ends = np.cumsum([len(path) for path in paths])
    valid = np.split(is_valid(model, np.concatenate(paths)), ends[:-1])
    for number, direct in enumerate(valid):
        if not direct.all():
            out = path_to_rest(model, poses[number], config, rng)
            back = path_to_rest(model, poses[number + 1], config, rng)[-2::-1]
            paths[number] = np.concatenate([out, back, poses[number + 1 : number + 2]])
    return np.concatenate([held(path, config, rng) for path in paths])


def _next_path(
    model: HandModel, start: NDArray[np.float64], config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Frames from one pose to another and a rest there, all valid."""
    resting = resting_angles(model)
    for _ in range(_MOST_DRAWS):
        for target in sample_valid_angles(model, _POSES_A_DRAW, rng=rng):
            direct = straight_path(start, target, config, rng)
            if is_valid(model, direct).all():
                return held(direct, config, rng)
            around = np.concatenate(
                [straight_path(start, resting, config, rng), straight_path(resting, target, config, rng)]
            )
            if is_valid(model, around).all():
                return held(around, config, rng)
    return held(path_to_rest(model, start, config, rng), config, rng)


def with_wrist(
    angles: Float[np.ndarray, "T 20"], config: MotionConfig, *, rng: np.random.Generator
) -> HandMotion:
    """The motion of these joint angles [rad] by a hand whose wrist moves from position to position."""
    position, quaternion = free_wrist_path(len(angles), config, rng=rng)
    return HandMotion(join_qpos(angles, position=position, quaternion=quaternion), config.rate)
