"""The compiled searches of `contact_closing`: where a hand first meets another, how far a digit can close."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.capsules import bounding_spheres
from handsim.kernels.chain import pose_digit_axes
from handsim.kernels.kernel import kernel
from handsim.kernels.segments import segment_distance_squared

FARTHEST: Final = 0.4
"""Where the search for the first contact begins [m], measured along the axis."""
NEAREST: Final = -0.15
"""Where it ends without one [m]."""
_PRESS: Final = 0.0005  # depth [m] to which a hand is brought to the other
_STEP: Final = 0.15  # of all joints together [rad], from open to closed until the first that is blocked
_HALVINGS: Final = 6  # of that last step, or fewer where that is exact to
_PRECISION: Final = 0.003  # of all joints together [rad]


class Digit(NamedTuple):
    """The data of a digit that the searches need: three bones, four joints, three capsules."""

    capsules: NDArray[np.int64]
    """Indices of its capsules among the hand's (3,)."""
    others: NDArray[np.int64]
    """Indices of the hand's other capsules (K - 3,)."""
    offsets: NDArray[np.float64]
    """Origin of each bone in its parent's frame (3, 3) [m]."""
    rotations: NDArray[np.float64]
    """Orientation of each bone in its parent's frame at zero angles (3, 3, 3)."""
    axes: NDArray[np.float64]
    """Unit axes of its joints in the frames of the bones they move (4, 3)."""
    ends: NDArray[np.float64]
    """Both ends of each capsule in its bone's frame (3, 2, 3) [m]."""
    radii: NDArray[np.float64]
    """Radii of its capsules (3,) [m]."""
    meets: NDArray[np.bool_]
    """Which capsules of the hand each of its own may collide with (3, K)."""
    reach: float
    """Largest distance of its skin from its first joint [m]."""


class DigitPaths(NamedTuple):
    """A digit's path in every frame: the pose of the wrist, and joint angles at the start and at the goal."""

    rotations: NDArray[np.float64]
    """Orientation of the wrist (T, 3, 3)."""
    positions: NDArray[np.float64]
    """Position of the wrist (T, 3) [m]."""
    start: NDArray[np.float64]
    """Joint angles at the start (T, 4) [rad]."""
    goal: NDArray[np.float64]
    """Joint angles at the goal (T, 4) [rad]."""


class Obstacles(NamedTuple):
    """Capsules that a digit may meet: those of the other hand and of its own."""

    segments: NDArray[np.float64]
    """Axes in the world (T, K, 2, 3) [m]."""
    radii: NDArray[np.float64]
    """Their radii (K,) [m]."""
    meets: NDArray[np.bool_]
    """Which of them stop which of the digit's bones (3, K)."""
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

    And of each pair (P, 3): the squared distance [m^2] of the spheres' centers, its part along the axis [m],
    and the sum of the spheres' radii [m].
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
    """Share (T,) of its path that a digit can follow before it meets something.

    Args:
        paths: The digit's `DigitPaths`.
        parts: The `Digit`.
        obstacles: The `Obstacles`.
    """
    share = np.ones(len(paths.start))
    near = np.empty(len(obstacles.radii), dtype=np.int64)
    centers, sizes = np.empty((len(near), 3)), np.empty(len(near))
    angles, bones, scratch = np.empty(4), np.empty((3, 2, 3)), np.empty((4, 3))
    for frame in range(len(paths.start)):
        wrist = paths.rotations[frame], paths.positions[frame]
        count = _within_reach(wrist, parts, obstacles, frame, near)
        if count == 0:
            continue
        bounding_spheres(obstacles.segments[frame], obstacles.radii, centers, sizes)
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
            if _blocked(bones, parts, obstacles, frame, near[:count], (centers, sizes)):
                high = min(tried, 1.0 - 1e-9)
            else:
                low = tried
            if low >= 1.0 or (high - low) * bend < _PRECISION:
                break
        share[frame] = low
    return share


@kernel
def _within_reach(wrist: Any, parts: Any, obstacles: Any, frame: Any, near: Any) -> int:
    """Write the indices of the obstacles that a digit can reach into `near` (K,), and count them."""
    knuckle = wrist[1].copy()
    for row in range(3):
        for column in range(3):
            knuckle[row] += wrist[0][row, column] * parts.offsets[0, column]
    count = 0
    for j in range(len(obstacles.radii)):
        reach = parts.reach + obstacles.radii[j]
        a, b = obstacles.segments[frame, j, 0], obstacles.segments[frame, j, 1]
        if segment_distance_squared(knuckle, knuckle, a, b) < reach * reach:
            near[count] = j
            count += 1
    return count


@kernel
def _blocked(bones: Any, parts: Any, obstacles: Any, frame: Any, near: Any, spheres: Any) -> bool:
    """Whether a digit with capsule axes `bones` (3, 2, 3) [m] meets one of the obstacles `near`.

    Obstacles whose bounding spheres, centers (K, 3) [m] and radii (K,) [m], it does not meet cannot be met.
    """
    own, size = np.empty((3, 3)), np.empty(3)
    bounding_spheres(bones, parts.radii, own, size)
    for i in range(3):
        for j in near:
            apart = size[i] + spheres[1][j] - obstacles.press
            x, y, z = own[i, 0] - spheres[0][j, 0], own[i, 1] - spheres[0][j, 1], own[i, 2] - spheres[0][j, 2]
            if obstacles.meets[i, j] and x * x + y * y + z * z < apart * apart:
                reach = parts.radii[i] + obstacles.radii[j] - obstacles.press
                a, b = obstacles.segments[frame, j, 0], obstacles.segments[frame, j, 1]
                if segment_distance_squared(bones[i, 0], bones[i, 1], a, b) < reach * reach:
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
