"""Two hands brought together until they touch: frames of two hands, and compiled searches for contacts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from handsim.hand.capsules import overlap_between
from handsim.hand.model import HandModel, join_qpos
from handsim.kernels import (
    CARPUS,
    MOST_METACARPAL,
    kernel,
    pose_digit_axes,
    segment_distance_squared,
    squared_distance,
)
from handsim.space.transforms import quaternion_matrix, rotation_quaternions
from poses.motion import PEAK_SPEED, RATE, MotionConfig, minimum_jerk
from poses.shapes import is_valid, sample_valid_angles

FARTHEST: Final = 0.4
"""Distance along the axis at which the search for a contact begins [m]."""
NEAREST: Final = -0.15
"""Distance at which the search ends without a contact [m]."""
_PRESS: Final = 0.0005  # depth of the contact [m]
_STEP: Final = 0.15  # step of closing fingers, summed over joints [rad]
_HALVINGS: Final = 6  # largest number of bisections of the first blocked step
_PRECISION: Final = 0.003  # change at which bisection stops, summed over joints [rad]

# Fingers close in two stages: all joints, then the two outer ones. Each stage has the depth [m] that a finger
# may press into a hand, and its joints.
_CLOSING_STAGES: Final = ((0.0006, slice(0, 4)), (0.0008, slice(2, 4)))
_CLOSING_ORDER: Final = (1, 2, 3, 4, 0)  # the thumb closes last, over what the fingers hold

MAX_OVERLAP: Final = 0.001
"""Largest overlap of two hands [m]."""
WRIST_SPEED: Final = 1.0
"""Highest speed of the pair of hands, and of a hand relative to the pair between meetings [m/s]."""
APPROACH_TIMES: Final = (0.4, 0.8)
"""Shortest and longest time of an approach or a release [s]."""
PAIR_VOLUME: Final = 0.2
"""Half side of the cube in which the middle of the wrists travels [m], around 1.1 m above the floor."""
PAUSE_TIMES: Final = (2.0, 4.0)
"""Shortest and longest rest of hands apart, between two meetings [s]."""
_MAX_TURN_SPEED: Final = 8.0  # fastest rotation of one hand relative to the other [rad/s]
_REST_DISTANCES: Final = (0.25, 0.45)  # distance of the wrists while hands rest apart [m]


class Digit(NamedTuple):
    """A digit for compiled searches: three bones, four joints, three capsules."""

    capsules: NDArray[np.int64]
    """Indices of the digit's capsules in the hand (3,)."""
    offsets: NDArray[np.float64]
    """Origin of each bone in its parent's frame (3, 3) [m]."""
    rotations: NDArray[np.float64]
    """Orientation of each bone in its parent's frame at zero angles (3, 3, 3)."""
    axes: NDArray[np.float64]
    """Unit joint axes in the frames of the bones they move (4, 3)."""
    ends: NDArray[np.float64]
    """Both ends of each capsule in its bone's frame (3, 2, 3) [m]."""
    radii: NDArray[np.float64]
    """Radii of the digit's capsules (3,) [m]."""
    meets: NDArray[np.bool_]
    """Capsules of the hand's other parts that each capsule of the digit may collide with (3, K)."""
    arch: float
    """Flexion of the metacarpal over that of the second joint."""
    reach: float
    """Largest distance of the digit's skin from where its first joint is at zero angles [m]."""


class DigitPaths(NamedTuple):
    """Paths of a digit: the pose of the wrist, and joint angles at start and goal, in every frame."""

    rotations: NDArray[np.float64]
    """Orientation of the wrist (T, 3, 3)."""
    positions: NDArray[np.float64]
    """Position of the wrist (T, 3) [m]."""
    start: NDArray[np.float64]
    """Joint angles at the start (T, 4) [rad]."""
    goal: NDArray[np.float64]
    """Joint angles at the goal (T, 4) [rad]."""


class Obstacles(NamedTuple):
    """Capsules of both hands that a digit may meet."""

    segments: NDArray[np.float64]
    """Axes in the world (T, K, 2, 3) [m]."""
    radii: NDArray[np.float64]
    """Radii (K,) [m]."""
    meets: NDArray[np.bool_]
    """Obstacles that stop each bone of the digit (3, K)."""
    press: float
    """Depth to which the digit may press into them [m]."""


@kernel
def search_contact(
    moving: Float[np.ndarray, "T K 2 3"],
    moving_radii: Float[np.ndarray, "K"],
    still: Float[np.ndarray, "T L 2 3"],
    still_radii: Float[np.ndarray, "L"],
    axis: Float[np.ndarray, "T 3"],
) -> Any:
    """Distance (T,) [m] along the axis at which capsules first touch others, by conservative advancement.

    The moving capsules are in the world, at distance zero; the axis is the unit direction in which they back
    off.
    """
    reach = np.empty(len(moving))
    p, q = np.empty(3), np.empty(3)
    for frame in range(len(moving)):
        pairs, spheres = _pairs_in_line(moving[frame], moving_radii, still[frame], still_radii, axis[frame])
        shift = FARTHEST
        for _ in range(100):
            gap = 1e9
            for number in range(len(pairs)):
                apart, along, near = spheres[number]
                if apart + shift * (2.0 * along + shift) >= (near + gap) ** 2:
                    continue  # spheres around them are farther apart than the nearest pair so far
                i, j = pairs[number, 0], pairs[number, 1]
                for k in range(3):
                    p[k] = moving[frame, i, 0, k] + shift * axis[frame, k]
                    q[k] = moving[frame, i, 1, k] + shift * axis[frame, k]
                near = gap + moving_radii[i] + still_radii[j]
                squared = segment_distance_squared(p, q, still[frame, j, 0], still[frame, j, 1])
                if near > 0.0 and squared < near * near:
                    gap = np.sqrt(squared) - moving_radii[i] - still_radii[j]
            # No point moves faster than the hand, so it can advance by the gap without a touch.
            shift -= gap + _PRESS
            if gap + _PRESS < 2e-5 or shift <= NEAREST:
                break
        reach[frame] = max(shift, NEAREST)
    return reach


@kernel
def _pairs_in_line(moving: Any, moving_radii: Any, still: Any, still_radii: Any, axis: Any) -> Any:
    """Pairs (P, 2) whose bounding spheres meet somewhere along the axis; the others never touch.

    Also returns for each pair (P, 3): the squared distance [m^2] of the spheres' centers, the distance along
    the axis [m], and the sum of the spheres' radii [m].
    """
    pairs = np.empty((len(moving_radii) * len(still_radii), 2), dtype=np.int64)
    spheres = np.empty((len(pairs), 3))
    count = 0
    for i in range(len(moving_radii)):
        for j in range(len(still_radii)):
            along, apart, length, other = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                between = 0.5 * (moving[i, 0, k] + moving[i, 1, k] - still[j, 0, k] - still[j, 1, k])
                along += between * axis[k]
                apart += between * between
                length += (moving[i, 1, k] - moving[i, 0, k]) ** 2
                other += (still[j, 1, k] - still[j, 0, k]) ** 2
            reach = moving_radii[i] + still_radii[j] + 0.5 * (np.sqrt(length) + np.sqrt(other))
            if apart - along * along < reach * reach:
                pairs[count, 0], pairs[count, 1] = i, j
                spheres[count, 0], spheres[count, 1], spheres[count, 2] = apart, along, reach
                count += 1
    return pairs[:count], spheres[:count]


@kernel
def search_closing(paths: DigitPaths, parts: Digit, obstacles: Obstacles) -> Any:
    """Share (T,) of its path that a digit can follow before it meets an obstacle."""
    share = np.ones(len(paths.start))
    near, spheres = np.empty((len(obstacles.radii), 9)), np.empty((7, len(obstacles.radii)))
    angles, bones, scratch = np.empty(4), np.empty((3, 2, 3)), np.empty((4, 3))
    for frame in range(len(paths.start)):
        wrist = paths.rotations[frame], paths.positions[frame]
        count = _within_reach(wrist, parts, obstacles, frame, near, spheres)
        if count == 0:
            continue
        bend = np.abs(paths.goal[frame] - paths.start[frame]).sum()
        steps = max(1, int(np.ceil(bend / _STEP)))
        low, high = 0.0, 1.0
        for step in range(1, steps + _HALVINGS + 1):
            tried = step / steps if step <= steps and high == 1.0 else (low + high) / 2
            for joint in range(4):
                angles[joint] = paths.start[frame, joint] + tried * (
                    paths.goal[frame, joint] - paths.start[frame, joint]
                )
            pose_digit_axes(wrist, angles, parts, bones, scratch)
            if _blocked(bones, count, near, spheres):
                high = min(tried, 1.0 - 1e-9)
            else:
                low = tried
            if low >= 1.0 or (high - low) * bend < _PRECISION:
                break
        share[frame] = low
    return share


@kernel
def _within_reach(wrist: Any, parts: Any, obstacles: Any, frame: Any, near: Any, spheres: Any) -> int:
    """Count the obstacles that a digit can reach, and write what `_blocked` needs of them.

    Args:
        near: Both ends of each obstacle's axis (K, :6) [m], and the squared distances (K, 6:) [m^2] at which
            the axes of the digit's three bones meet it; -1 for a bone that may not meet it.
        spheres: Centers (:3, K) [m] of bounding spheres, and squared distances (3:6, K) at which these meet.
    """
    knuckle = wrist[1].copy()
    for row in range(3):
        for column in range(3):
            knuckle[row] += wrist[0][row, column] * parts.offsets[0, column]
    count = 0
    for j in range(len(obstacles.radii)):
        reach = parts.reach + obstacles.radii[j]
        a, b = obstacles.segments[frame, j, 0], obstacles.segments[frame, j, 1]
        if segment_distance_squared(knuckle, knuckle, a, b) >= reach * reach:
            continue
        half = 0.5 * np.sqrt(squared_distance(a, b))
        for i in range(3):
            near[count, i], near[count, 3 + i], spheres[i, count] = a[i], b[i], 0.5 * (a[i] + b[i])
            touch = parts.radii[i] + obstacles.radii[j] - obstacles.press
            apart = touch + half + 0.5 * np.sqrt(squared_distance(parts.ends[i, 0], parts.ends[i, 1]))
            near[count, 6 + i] = touch * touch if obstacles.meets[i, j] else -1.0
            spheres[3 + i, count] = apart * apart if obstacles.meets[i, j] else -1.0
        count += 1
    return count


@kernel
def _blocked(bones: Any, count: int, near: Any, spheres: Any) -> bool:
    """Whether a digit with capsule axes `bones` (3, 2, 3) [m] meets one of `count` obstacles.

    `near` and `spheres` are those of `_within_reach`; the last row of `spheres` is room for the arithmetic.
    """
    for i in range(2, -1, -1):  # the outer bones hit obstacles most often
        p = (bones[i, 0, 0], bones[i, 0, 1], bones[i, 0, 2])
        q = (bones[i, 1, 0], bones[i, 1, 1], bones[i, 1, 2])
        for n in range(count):
            x = 0.5 * (p[0] + q[0]) - spheres[0, n]
            y = 0.5 * (p[1] + q[1]) - spheres[1, n]
            z = 0.5 * (p[2] + q[2]) - spheres[2, n]
            spheres[6, n] = x * x + y * y + z * z - spheres[3 + i, n]
        for n in range(count):
            if spheres[6, n] < 0.0:  # obstacles whose bounding spheres are not met cannot be met
                a, b = (near[n, 0], near[n, 1], near[n, 2]), (near[n, 3], near[n, 4], near[n, 5])
                if segment_distance_squared(p, q, a, b) < near[n, 6 + i]:
                    return True
    return False


@kernel
def pose_digit(wrists: Any, angles: Any, parts: Any) -> Any:
    """Capsule axes (T, 3, 2, 3) [m] of a digit in the world.

    Args:
        wrists: Orientations (T, 3, 3) and positions (T, 3) [m] of the wrist.
        parts: The `Digit`.
    """
    posed, scratch = np.empty((len(angles), 3, 2, 3)), np.empty((4, 3))
    for frame in range(len(angles)):
        pose_digit_axes((wrists[0][frame], wrists[1][frame]), angles[frame], parts, posed[frame], scratch)
    return posed


def first_contact(
    still: HandModel,
    still_qpos: Float[np.ndarray, "T 27"],
    moving: HandModel,
    moving_qpos: Float[np.ndarray, "T 27"],
    axis: Float[np.ndarray, "T 3"],
) -> Float[np.ndarray, "T"]:
    """Distance along `axis` [m] at which an approaching hand touches a still one; `NEAREST` if it never does.

    The moving hand backs off along this unit direction; at distance zero it has the given poses.
    """
    segments = [
        model.capsules.posed(model.forward_kinematics(qpos))
        for model, qpos in ((moving, moving_qpos), (still, still_qpos))
    ]
    radii = moving.capsules.radii, still.capsules.radii
    return np.asarray(search_contact(segments[0], radii[0], segments[1], radii[1], axis))


def close_fingers(
    model: HandModel,
    opened: Float[np.ndarray, "T 27"],
    closed: Float[np.ndarray, "T 20"],
    strength: Float[np.ndarray, "T 5"],
    *,
    other: HandModel,
    other_qpos: Float[np.ndarray, "T 27"],
    window: int = 1,
) -> Float[np.ndarray, "T 20"]:
    """Joint angles [rad] of fingers that close from one pose towards another until they meet a hand.

    Each digit follows its path as far as it is free of both hands, smoothed over a window of frames.
    """
    busy = np.flatnonzero(strength.max(axis=1) > 0.0)
    angles = opened[:, 7:].copy()
    rotations, positions = quaternion_matrix(opened[busy, 3:7]), opened[busy, :3]
    own = model.capsules.posed(model.forward_kinematics(opened[busy]))
    others = other.capsules.posed(other.forward_kinematics(other_qpos[busy]))
    segments = np.concatenate([others, own], axis=1)
    radii = np.concatenate([other.capsules.radii, model.capsules.radii])
    all_of_other = np.ones((3, len(other.capsules.radii)), dtype=bool)
    for press, joints in _CLOSING_STAGES:
        for digit in _CLOSING_ORDER:
            parts = digit_parts(model, digit)
            columns = slice(4 * digit, 4 * digit + 4)
            goal = angles[:, columns].copy()
            goal[:, joints] = closed[:, columns][:, joints]
            share = np.ones(len(angles))
            share[busy] = search_closing(
                DigitPaths(rotations, positions, angles[busy, columns], goal[busy]),
                parts,
                Obstacles(segments, radii, np.concatenate([all_of_other, parts.meets], axis=1), press),
            )
            share = smooth_below(share, window) * strength[:, digit]
            angles[:, columns] += share[:, None] * (goal - angles[:, columns])
            mine = len(other.capsules.radii) + parts.capsules
            segments[:, mine] = pose_digit((rotations, positions), angles[busy, columns], parts)
    return angles


def smooth_above(values: Float[np.ndarray, "T"], window: int) -> Float[np.ndarray, "T"]:
    """A smooth curve that is nowhere below `values`, smoothed over an odd number of frames."""
    if window < 3:
        return values
    kernel = np.hanning(window + 2)[1:-1]
    highest = maximum_filter1d(values, window, mode="nearest")
    return np.asarray(convolve1d(highest, kernel / kernel.sum(), mode="nearest"))


def smooth_below(values: Float[np.ndarray, "T"], window: int) -> Float[np.ndarray, "T"]:
    """A smooth curve that is nowhere above `values`, smoothed over an odd number of frames."""
    return -smooth_above(-values, window)


@lru_cache(maxsize=4 * len(_CLOSING_ORDER))
def digit_parts(model: HandModel, digit: int) -> Digit:
    """A digit of a hand (0: thumb) as the compiled searches need it."""
    capsules, skeleton = model.capsules, model.skeleton
    first = 1 + 3 * digit
    indices = np.flatnonzero((capsules.bones >= first) & (capsules.bones < first + 3))
    meets = np.zeros((len(capsules.bones),) * 2, dtype=bool)
    pairs = capsules.touching_pairs()
    meets[pairs[:, 0], pairs[:, 1]] = meets[pairs[:, 1], pairs[:, 0]] = True
    meets[:, indices] = False
    bent = MOST_METACARPAL if skeleton.arch[digit] > 0.0 else 0.0
    sinks = bent * (1.0 - CARPUS) * np.linalg.norm(skeleton.offsets[first])
    return Digit(
        capsules=indices,
        offsets=skeleton.offsets[first : first + 3],
        rotations=skeleton.rotations[first : first + 3],
        axes=skeleton.axes[4 * digit : 4 * digit + 4],
        ends=np.stack([capsules.starts[indices], capsules.ends[indices]], axis=1),
        radii=capsules.radii[indices],
        meets=meets[indices],
        arch=float(skeleton.arch[digit]),
        reach=float(skeleton.lengths[first : first + 3].sum() + capsules.radii[indices].max() + sinks),
    )


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
        """The passage at some frames."""
        return Passage(self.rotation[frames], self.position[frames], self.right[frames], self.left[frames])


def join_passages(passages: list[Passage]) -> Passage:
    """Passages concatenated in time."""
    parts = ((one.rotation, one.position, one.right, one.left) for one in passages)
    return Passage(*map(np.concatenate, zip(*parts, strict=True)))


def path_between(
    right: HandModel,
    left: HandModel,
    start: Passage,
    end: Passage,
    *,
    rng: np.random.Generator,
) -> Passage | None:
    """Frames from one pose to another, with a rest of hands apart between them; None if not valid."""
    roll = rng.uniform(0.0, np.pi)  # from hands side by side to palms that face each other
    rotation = Rotation.from_rotvec(rng.normal(scale=0.4, size=3)) * Rotation.from_rotvec([-roll, 0.0, 0.0])
    direction = np.array([rng.uniform(-0.3, 0.3), np.cos(roll / 2), -np.sin(roll / 2)])
    position = rng.uniform(*_REST_DISTANCES) * direction[None] / np.linalg.norm(direction)
    angles = [sample_valid_angles(model, 1, rng=rng) for model in (right, left)]
    apart = Passage(rotation.as_matrix()[None], position, *angles)
    rest = apart.at(np.zeros(int(rng.uniform(*PAUSE_TIMES) * RATE), dtype=int))
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
    return np.asarray(
        is_valid(right, passage.right) & is_valid(left, passage.left) & (overlap <= MAX_OVERLAP)
    )


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
        rng.uniform(*APPROACH_TIMES),
        MotionConfig().least_time(bend),
        PEAK_SPEED * (rotations[0].inv() * rotations[1]).magnitude() / _MAX_TURN_SPEED,
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
