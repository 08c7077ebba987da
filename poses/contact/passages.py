"""Frames of two hands: how they are stored, which are valid, and the path between two of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from handsim.hand.capsules import overlap_between
from handsim.hand.model import HandModel, join_qpos
from handsim.space.transforms import rotation_quaternions
from poses.motion.paths import PEAK_ACCELERATION, PEAK_SPEED, minimum_jerk
from poses.shapes.validity import is_valid, sample_valid_angles

MAX_OVERLAP: Final = 0.001
"""How deep two hands may press into each other [m]."""
RATE: Final = 120.0
"""Frames per second [Hz]."""
MAX_SPEED: Final = 10.0
"""Highest joint speed [rad/s]."""
MAX_ACCELERATION: Final = 200.0
"""Largest joint acceleration [rad/s^2]."""
WRIST_SPEED: Final = 1.0
"""Highest speed of the pair, and of either hand against it between two meetings [m/s]."""
APPROACH: Final = (0.4, 0.8)
"""Shortest and longest time to come together or to let go [s]."""
VOLUME: Final = 0.2
"""Half side of the cube in which the middle of the wrists travels [m], around 1.1 m above the floor."""
_TURNING: Final = 8.0  # fastest rotation of one hand against the other [rad/s]
_DISTANCE: Final = (0.25, 0.45)  # between the wrists of hands that are apart [m]


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """Frames of two hands: the left wrist in the right one's frame, and the joints of both."""

    rotation: Float[np.ndarray, "T 3 3"]
    """Orientation of the left wrist."""
    position: Float[np.ndarray, "T 3"]
    """Position of the left wrist [m]."""
    right: Float[np.ndarray, "T 20"]
    """Joint angles of the right hand [rad]."""
    left: Float[np.ndarray, "T 20"]
    """Joint angles of the left hand [rad]."""

    def __len__(self) -> int:
        return len(self.right)

    def at(self, frames: Any) -> Passage:
        """Some of its frames."""
        return Passage(self.rotation[frames], self.position[frames], self.right[frames], self.left[frames])


def join_passages(passages: list[Passage]) -> Passage:
    """Passages concatenated in time."""
    return Passage(
        np.concatenate([passage.rotation for passage in passages]),
        np.concatenate([passage.position for passage in passages]),
        np.concatenate([passage.right for passage in passages]),
        np.concatenate([passage.left for passage in passages]),
    )


def path_between(
    right: HandModel,
    left: HandModel,
    start: Passage,
    end: Passage,
    pause: tuple[float, float],
    *,
    rng: np.random.Generator,
) -> Passage | None:
    """Frames from one pose to another by way of one where the hands are apart; None when not valid.

    Args:
        start: Where the path begins, one frame.
        end: Where it ends, one frame.
        pause: Shortest and longest rest where the hands are apart [s].
    """
    apart = Passage(
        *_place_apart(rng), sample_valid_angles(right, 1, rng=rng), sample_valid_angles(left, 1, rng=rng)
    )
    rest = apart.at(np.zeros(int(rng.uniform(*pause) * RATE), dtype=int))
    path = join_passages([_straight(start, apart, rng), rest, _straight(apart, end, rng)])
    return path if valid_frames(right, left, path).all() else None


def valid_frames(right: HandModel, left: HandModel, passage: Passage) -> Bool[np.ndarray, "T"]:
    """Which frames respect ranges, self-penetration and `MAX_OVERLAP`."""
    overlap = overlap_between(
        right.capsules,
        right.forward_kinematics(join_qpos(passage.right)),
        left.capsules,
        left.forward_kinematics(placed_qpos(passage.left, passage.rotation, passage.position)),
    )
    valid: NDArray[np.bool_] = (
        is_valid(right, passage.right) & is_valid(left, passage.left) & (overlap <= MAX_OVERLAP)
    )
    return valid


def placed_qpos(
    angles: Float[np.ndarray, "T 20"],
    rotation: Float[np.ndarray, "T 3 3"],
    position: Float[np.ndarray, "T 3"],
) -> Float[np.ndarray, "T 27"]:
    """Qpos of joint angles [rad] with the wrist at these orientations and positions [m]."""
    return join_qpos(angles, position=position, quaternion=rotation_quaternions(rotation))


def _straight(start: Passage, end: Passage, rng: np.random.Generator) -> Passage:
    """Minimum-jerk frames from a single pose to another, without the first."""
    rotations = Rotation.from_matrix(np.concatenate([start.rotation, end.rotation]))
    bend = max(np.abs(end.right - start.right).max(), np.abs(end.left - start.left).max())
    seconds = max(
        rng.uniform(*APPROACH),
        PEAK_SPEED * bend / MAX_SPEED,
        np.sqrt(PEAK_ACCELERATION * bend / MAX_ACCELERATION),
        PEAK_SPEED * (rotations[0].inv() * rotations[1]).magnitude() / _TURNING,
        PEAK_SPEED * 0.5 * float(np.linalg.norm(end.position - start.position)) / WRIST_SPEED,
    )
    share = minimum_jerk(int(np.ceil(seconds * RATE)) + 1)
    along = share[:, None]
    return Passage(
        Slerp([0.0, 1.0], rotations)(share).as_matrix(),
        start.position + along * (end.position - start.position),
        start.right + along * (end.right - start.right),
        start.left + along * (end.left - start.left),
    )


def _place_apart(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orientation (1, 3, 3) and position (1, 3) of the left wrist: from side by side to palm facing palm."""
    roll = rng.uniform(0.0, np.pi)
    rotation = Rotation.from_rotvec(rng.normal(scale=0.4, size=3)) * Rotation.from_rotvec([-roll, 0.0, 0.0])
    direction = np.array([rng.uniform(-0.3, 0.3), np.cos(roll / 2), -np.sin(roll / 2)])
    return rotation.as_matrix()[None], rng.uniform(*_DISTANCE) * direction[None] / np.linalg.norm(direction)
