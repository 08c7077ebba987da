"""Where a pen goes that points at one marker after another of the other hand (Han et al. 2018, hand-pen)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from handsim.contact import overlap_between
from handsim.errors import ShapeError
from handsim.model import HandModel
from handsim.motion import BodyMotion, HandMotion
from handsim.objects import RigidObject
from handsim.transforms import axis_angle_matrix
from poses.grasp_scene import object_penetration, pose_to_qpos, wrist_poses
from poses.motions import minimum_jerk
from poses.validity import MAX_PENETRATION

if TYPE_CHECKING:
    from jaxtyping import Float

_REFERENCE: Final = np.array(
    [0.35, 0.8, 0.5]
)  # where the writing arm comes from, never along the pen for long

_MOST_RETREATS: Final = 12
_RETREAT_STEP: Final = 0.003  # [m] beyond what is asked for
_SMOOTHING: Final = 0.25  # [s] over which the pen draws back


@dataclass(frozen=True, slots=True)
class PointingConfig:
    """How the pen is led."""

    distance: tuple[float, float] = (0.006, 0.02)
    """Least and greatest distance of the tip from the place it points at [m]."""
    retreat: float = 0.05
    """How far the tip draws back between two places [m]."""
    stay: tuple[float, float] = (0.15, 0.6)
    """Shortest and longest time at a place [s]."""
    way: tuple[float, float] = (0.4, 0.9)
    """Shortest and longest time from place to place [s]."""
    tilt: float = 0.6
    """How far the pen leans from straight at the place, standard deviation of the tangent."""


def pointing_path(
    places: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    config: PointingConfig | None = None,
    *,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4 4"]:
    """Poses of a pen, its tip at the origin and its body along +z, that visits moving places at random.

    Args:
        places: What may be pointed at, moving in the world [m].
        outward: Unit directions from which each can be reached.
        rate: Frames a second [Hz].
        config: Distances and times.
        rng: Source of all randomness.
    """
    config = config or PointingConfig()
    frames, count = places.shape[:2]
    share, visit = _schedule(frames, rate, config, rng)
    number = int(visit[-1]) + 2
    target = rng.integers(count, size=number)
    distance = rng.uniform(*config.distance, size=number)
    lean = config.tilt * rng.standard_normal((number, 3))
    now = np.arange(frames)

    def at(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axis = outward[now, target[which]] + lean[which]
        facing = np.einsum("ti,ti->t", axis, outward[now, target[which]])
        axis += np.clip(0.5 - facing, 0.0, None)[:, None] * outward[now, target[which]]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return places[now, target[which]] + distance[which, None] * axis, axis

    (here, axis_here), (there, axis_there) = at(visit), at(visit + 1)
    blend = share[:, None]
    axis = (1.0 - blend) * axis_here + blend * axis_there
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    lift = config.retreat * np.sin(np.pi * share)[:, None] ** 2
    return _frames((1.0 - blend) * here + blend * there + lift * axis, axis)


def _schedule(
    frames: int, rate: float, config: PointingConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """For each frame, the share of the way to the next place, and the number of the place left behind."""
    shares: list[np.ndarray] = []
    visits: list[np.ndarray] = []
    length = 0
    while length < frames:
        stay = np.zeros(max(1, round(rng.uniform(*config.stay) * rate)))
        way = minimum_jerk(max(2, round(rng.uniform(*config.way) * rate)))
        shares += [stay, way]
        visits.append(np.full(len(stay) + len(way), len(visits)))
        length += len(stay) + len(way)
    return np.concatenate(shares)[:frames], np.concatenate(visits)[:frames]


def _frames(origin: Float[np.ndarray, "T 3"], axis: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with +z along `axis`, turned about it so that +x keeps to where the arm comes from."""
    x = _REFERENCE - np.einsum("ti,i->t", axis, _REFERENCE)[:, None] * axis
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    pose = np.tile(np.eye(4), (len(origin), 1, 1))
    pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = x, np.cross(axis, x), axis
    pose[:, :3, 3] = origin
    return pose


def point_pen(
    holder: HandModel,
    other: HandModel,
    pen: RigidObject,
    held: tuple[HandMotion, BodyMotion],
    other_motion: HandMotion,
    path: Float[np.ndarray, "T 4 4"],
) -> tuple[HandMotion, BodyMotion]:
    """The pen led along a path by the hand that holds it, drawn back wherever something would touch.

    Args:
        holder: The hand with the pen.
        other: The hand that is pointed at.
        pen: The pen; its tip is its first marker, its body goes from there along its z axis.
        held: How fingers and pen move against the wrist; where the wrist goes is decided here.
        other_motion: What the other hand does.
        path: Where the tip shall be and how the pen shall stand, see `pointing_path`.

    Raises:
        ShapeError: Even drawn back, something touches.
    """
    motion, body = held
    T_wrist_pen = np.linalg.inv(wrist_poses(motion.qpos)) @ body.T_world_body
    T_path_pen = _turned_to_the_arm(T_wrist_pen.mean(axis=0), pen.markers[0])
    back = np.zeros(len(path))
    for _ in range(_MOST_RETREATS):
        pose = path.copy()
        pose[:, :3, 3] += back[:, None] * path[:, :3, 2]
        T_world_pen = pose @ T_path_pen
        qpos = motion.qpos.copy()
        qpos[:, :7] = pose_to_qpos(T_world_pen @ np.linalg.inv(T_wrist_pen))
        deep = np.maximum(
            overlap_between(
                holder.capsules, holder.forward_kinematics(qpos),
                other.capsules, other.forward_kinematics(other_motion.qpos),
            ),
            object_penetration(other, pen, other_motion.qpos, T_world_pen),
        )  # fmt: skip
        if deep.max() <= MAX_PENETRATION:
            return HandMotion(qpos, motion.rate), BodyMotion(T_world_pen, motion.rate)
        needed = np.where(deep > 0.5 * MAX_PENETRATION, back + deep + _RETREAT_STEP, back)
        window = 2 * int(_SMOOTHING * motion.rate / 2) + 1
        back = uniform_filter1d(maximum_filter1d(needed, window), window)
    raise ShapeError("the hands touch wherever the pen points, however far it draws back")


def _turned_to_the_arm(
    T_wrist_pen: Float[np.ndarray, "4 4"], tip: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Pen in the path's frame: its tip at the origin, turned about itself until the wrist is at +x."""
    wrist = np.linalg.inv(T_wrist_pen)[:3, 3]
    away = np.arctan2(wrist[1], wrist[0])
    turn = np.eye(4)
    turn[:3, :3] = axis_angle_matrix(np.array([0.0, 0.0, 1.0]), np.array([-away]))[0]
    shift = np.eye(4)
    shift[:3, 3] = -tip
    posed: np.ndarray = turn @ shift
    return posed
