"""Two hands that meet, clasp, clap, rub, point and part: smooth motions, and single poses drawn from them.

The contact is solved for each pair of hands: in each frame the moving hand backs off until it just touches,
and fingers close until they meet something. Both are smoothed towards the free side, every frame is checked,
and what fails is drawn again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.errors import ArgumentError, PoseError
from handsim.hand.capsules import overlap_between
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.motion import HandMotion
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import random_quaternions, rotation_quaternions
from poses.contact.interactions import INTERACTIONS, check_names
from poses.contact.meetings import draw_poses, play_meeting
from poses.contact.passages import RATE, VOLUME, WRIST_SPEED, Passage, join_passages, path_between
from poses.motion.paths import PEAK_SPEED, minimum_jerk
from poses.motion.wrist_paths import along

__all__ = [
    "INTERACTIONS",
    "sample_two_hand_motion",
    "sample_two_hand_poses",
    "two_hands_penetration",
]

PAUSE: Final = (0.0, 0.6)
"""Shortest and longest rest between two meetings [s]."""
_TRAVEL_TIME: Final = (0.8, 2.5)  # between two positions of the pair [s]
_ROTATION: Final = 0.5  # spread of the rotation between two positions [rad]
_MOST_DRAWS: Final = 60
_MOST_PATHS: Final = 10


def two_hands_penetration(
    right: HandModel,
    left: HandModel,
    right_qpos: Float[np.ndarray, "T 27"],
    left_qpos: Float[np.ndarray, "T 27"],
) -> Float[np.ndarray, "T"]:
    """Deepest overlap of any capsule of one hand with any of the other [m]; 0 where they do not touch."""
    overlap = overlap_between(
        right.capsules,
        right.forward_kinematics(right_qpos),
        left.capsules,
        left.forward_kinematics(left_qpos),
    )
    depth: NDArray[np.float64] = np.maximum(overlap, 0.0)
    return depth


def sample_two_hand_motion(
    right: HandModel,
    left: HandModel,
    duration: float,
    *,
    pause: tuple[float, float] = PAUSE,
    interactions: Sequence[str] | None = None,
    rng: np.random.Generator,
) -> tuple[HandMotion, HandMotion]:
    """Random smooth motion of two hands through a series of interactions, valid at every frame.

    It has `round(duration * RATE) + 1` frames, and the interactions are all of `INTERACTIONS` when not given.
    Between two meetings hands rest apart for a time from shortest to longest pause [s]. The left hand may be
    another person's.

    Raises:
        ArgumentError: The duration is not positive, an interaction is unknown, or the hands are not a right
            and a left one.
        PoseError: No valid path that brings them together was found.
    """
    names = INTERACTIONS if interactions is None else tuple(interactions)
    check_names(names)
    _check_sides(right, left)
    if not 0.0 < duration < np.inf:
        raise ArgumentError(f"the duration is {duration:g} s, expected a positive number")
    frames = round(duration * RATE) + 1
    passages = _next_passages(right, left, None, names, pause, rng=rng)
    while sum(map(len, passages)) < frames:
        passages += _next_passages(right, left, passages[-1].at([-1]), names, pause, rng=rng)
    whole = join_passages(passages).at(slice(frames))
    right_qpos, left_qpos = _in_world(whole, *_travel(frames, rng))
    return HandMotion(right_qpos, RATE), HandMotion(left_qpos, RATE)


def sample_two_hand_poses(
    right: HandModel, left: HandModel, count: int, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 27"], Float[np.ndarray, "T 27"]]:
    """Single poses of a right and a left hand that touch or nearly do, each drawn on its own, all valid.

    Raises:
        ArgumentError: The count is not positive, or the hands are not a right and a left one.
        PoseError: No valid poses were found.
    """
    _check_sides(right, left)
    if count < 1:
        raise ArgumentError(f"the count of poses is {count}, expected a positive number")
    passages: list[Passage] = []
    missing = count
    for _ in range(_MOST_DRAWS):
        # Each name twice, since roles are drawn once per batch; more than needed, since some will fail.
        batches = rng.multinomial(
            missing + missing // 8 + 2, np.full(2 * len(INTERACTIONS), 0.5 / len(INTERACTIONS))
        )
        counts = [(name, int(n)) for name, n in zip(2 * INTERACTIONS, batches, strict=True) if n]
        passages.append(draw_poses(right, left, counts, rng=rng))
        missing = count - sum(map(len, passages))
        if missing <= 0:
            whole = join_passages(passages)
            whole = whole.at(rng.permutation(len(whole))[:count])
            positions = ROOM_CENTER + rng.uniform(-VOLUME, VOLUME, size=(count, 3))
            return _in_world(whole, positions, Rotation.from_quat(random_quaternions(count, rng=rng)))
    raise PoseError(f"no valid pose of these two hands was found in {_MOST_DRAWS} tries")


def _next_passages(
    right: HandModel,
    left: HandModel,
    last: Passage | None,
    names: tuple[str, ...],
    pause: tuple[float, float],
    *,
    rng: np.random.Generator,
) -> list[Passage]:
    """The path from the last frame to a meeting, and the meeting."""
    name = names[rng.integers(len(names))]
    for _ in range(_MOST_DRAWS):
        meeting = play_meeting(right, left, name, rng=rng)
        if meeting is None:
            continue
        if last is None:
            return [meeting]
        for _ in range(_MOST_PATHS):
            path = path_between(right, left, last, meeting.at([0]), pause, rng=rng)
            if path is not None:
                return [path, meeting]
    raise PoseError(f"no valid path was found in {_MOST_DRAWS} tries to bring these hands to '{name}'")


def _travel(frames: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], Rotation]:
    """Positions (T, 3) and orientations of a pair of hands that moves from position to position."""
    positions = [ROOM_CENTER + rng.uniform(-VOLUME, VOLUME, size=3)]
    orientations, shares = [Rotation.from_quat(random_quaternions(1, rng=rng)[0])], [np.zeros(1)]
    while sum(map(len, shares)) < frames:
        positions.append(ROOM_CENTER + rng.uniform(-VOLUME, VOLUME, size=3))
        orientations.append(orientations[-1] * Rotation.from_rotvec(rng.normal(scale=_ROTATION, size=3)))
        distance = float(np.linalg.norm(positions[-1] - positions[-2]))
        seconds = max(rng.uniform(*_TRAVEL_TIME), PEAK_SPEED * distance / WRIST_SPEED)
        shares.append(len(positions) - 2 + minimum_jerk(int(np.ceil(seconds * RATE))))
    return along(np.array(positions), Rotation.concatenate(orientations), np.concatenate(shares)[:frames])


def _in_world(
    whole: Passage, middle: NDArray[np.float64], orientations: Rotation
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both hands' qpos from the middle of their wrists and the right one's orientation."""
    across = orientations.apply(whole.position) / 2
    rotations = orientations.as_matrix()
    return (
        join_qpos(whole.right, position=middle - across, quaternion=rotation_quaternions(rotations)),
        join_qpos(
            whole.left,
            position=middle + across,
            quaternion=rotation_quaternions(rotations @ whole.rotation),
        ),
    )


def _check_sides(right: HandModel, left: HandModel) -> None:
    sides = right.shape.side, left.shape.side
    if sides != ("right", "left"):
        raise ArgumentError(
            f"the hands are a {sides[0]} and a {sides[1]} one, expected a right and a left one"
        )
