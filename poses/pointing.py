"""Where a pen goes that points at one marker after another of the other hand (Han et al. 2018, hand-pen)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

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

_REFERENCE: Final = np.array([0.53, -0.85, 0.0])  # where the writing arm is, for a user who faces +y
_DRAW: Final = 0.02  # share by which the pen turns back to it in a frame
_CHOICES: Final = 6  # places thought of before the next one is taken
_FOLLOWING: Final = 0.2  # [s]
_PEAK: Final = 1.875  # peak speed of the minimum-jerk profile, in distances per duration

_MOST_RETREATS: Final = 12
_RETREAT_STEP: Final = 0.003  # [m] beyond what is asked for
_SMOOTHING: Final = 0.25  # [s] over which the pen draws back


@dataclass(frozen=True, slots=True)
class PointingConfig:
    """How the pen is led."""

    distance: tuple[float, float] = (0.006, 0.02)
    """Least and greatest distance of the tip from the place it points at [m]."""
    retreat: float = 0.04
    """How far the tip draws back between two places [m]."""
    stay: tuple[float, float] = (0.15, 0.6)
    """Shortest and longest time at a place [s]."""
    way: tuple[float, float] = (0.4, 0.9)
    """Shortest and longest time from place to place, where the limits below do not ask for more [s]."""
    speed: float = 0.6
    """Fastest travel of the tip from place to place [m/s]."""
    turning: float = 2.5
    """Fastest turn of the pen on the way [rad/s]."""
    tilt: float = 0.5
    """How far the pen leans from straight at the place, standard deviation of the tangent."""


class _Visits(NamedTuple):
    """Target, distance and lean of each visit; each frame's visit and its share of the way to the next."""

    target: list[int]
    distance: list[float]
    lean: list[np.ndarray]
    visit: list[int]
    share: list[float]


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
    window = 2 * int(_FOLLOWING * rate / 2) + 1  # a hand follows a moving finger with some lag
    places, outward = (uniform_filter1d(values, window, axis=0) for values in (places, outward))
    visits = _plan(places, outward, rate, config, rng)
    now, visit, share = np.arange(len(places)), np.array(visits.visit), np.array(visits.share)
    target, distance, lean = np.array(visits.target), np.array(visits.distance), np.array(visits.lean)
    tips, axes = [], []
    for which in (visit, visit + 1):
        axis = _axis(outward[now, target[which]], lean[which])
        axes.append(axis)
        tips.append(places[now, target[which]] + distance[which, None] * axis)
    axis = _between(axes[0], axes[1], share)
    lift = config.retreat * np.sin(np.pi * share)[:, None] ** 2
    blend = share[:, None]
    return _frames((1.0 - blend) * tips[0] + blend * tips[1] + lift * axis, axis)


def _plan(
    places: np.ndarray, outward: np.ndarray, rate: float, config: PointingConfig, rng: np.random.Generator
) -> _Visits:
    """Visits one after another, the next one among a few that takes the least turning of the pen."""
    frames, count = places.shape[:2]
    visits = _Visits([int(rng.integers(count))], [rng.uniform(*config.distance)], [np.zeros(3)], [], [])
    while len(visits.visit) < frames:
        at = len(visits.visit)
        axis = _axis(outward[at, visits.target[-1]], visits.lean[-1])
        targets = rng.integers(count, size=_CHOICES)
        leans = config.tilt * rng.standard_normal((_CHOICES, 3))
        angles = np.arccos(np.clip(_axis(outward[at, targets], leans) @ axis, -1.0, 1.0))
        best = int(angles.argmin())
        far = np.linalg.norm(places[at, targets[best]] - places[at, visits.target[-1]]) + config.retreat
        least = _PEAK * max(far / config.speed, angles[best] / config.turning)
        way = minimum_jerk(max(2, round(max(rng.uniform(*config.way), least) * rate)))
        stay = max(1, round(rng.uniform(*config.stay) * rate))
        visits.visit.extend([len(visits.target) - 1] * (stay + len(way)))
        visits.share.extend([0.0] * stay + way.tolist())
        visits.target.append(int(targets[best]))
        visits.distance.append(rng.uniform(*config.distance))
        visits.lean.append(leans[best])
    return visits._replace(visit=visits.visit[:frames], share=visits.share[:frames])


def _axis(outward: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """Unit directions (..., 3) that lean from `outward`, but never by more than some 60 degrees."""
    axis = outward + lean
    facing = np.einsum("...i,...i->...", axis, outward)
    axis = axis + np.clip(0.5 - facing, 0.0, None)[..., None] * outward
    unit: np.ndarray = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    return unit


def _between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit directions (T, 3) on the great circle from one to another."""
    angle = np.arccos(np.clip(np.einsum("ti,ti->t", first, second), -1.0, 1.0))[:, None]
    sine = np.maximum(np.sin(angle), 1e-6)
    blend = share[:, None]
    axis = np.sin((1.0 - blend) * angle) / sine * first + np.sin(blend * angle) / sine * second
    axis = np.where(angle < 1e-3, (1.0 - blend) * first + blend * second, axis)
    unit: np.ndarray = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return unit


def _frames(origin: Float[np.ndarray, "T 3"], axis: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with +z along `axis`; +x is carried from frame to frame and drawn slowly to where the arm is."""
    pose = np.tile(np.eye(4), (len(origin), 1, 1))
    x = _REFERENCE
    for frame, z in enumerate(axis):
        x = x + _DRAW * (_REFERENCE - x)
        x = x - (x @ z) * z
        x = x / np.linalg.norm(x)
        pose[frame, :3, 0] = x
    pose[:, :3, 1], pose[:, :3, 2], pose[:, :3, 3] = np.cross(axis, pose[:, :3, 0]), axis, origin
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
