"""Where a pen goes that points at one marker after another of the other hand (Han et al. 2018, hand-pen)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from handsim.errors import PoseError
from handsim.hand.contact import overlap_between
from handsim.hand.model import HandModel
from handsim.hand.motion import BodyMotion, HandMotion
from handsim.space.objects import RigidObject
from handsim.space.transforms import axis_angle_matrix
from poses.grasps.grasp_scene import object_penetration, pose_to_qpos, wrist_poses
from poses.motion.minimum_jerk import PEAK_SPEED, minimum_jerk
from poses.shapes.validity import MAX_PENETRATION

if TYPE_CHECKING:
    from jaxtyping import Float

_UPRIGHT: Final = np.array([0.36, -0.26, 0.9]) / np.linalg.norm([0.36, -0.26, 0.9])
"""How a pen in the right hand of somebody at -y stands over a palm that looks down."""
_ARM: Final = np.array([0.8, -0.6, 0.0])  # where the writing arm comes from
_CONE: Final = 1.2  # farthest that the pen leans from upright [rad]
_MOST_LEAN: Final = 1.0  # as a tangent
_BEHIND: Final = -0.2  # places that look away from the pen by more, as a cosine, are not pointed at
_MOST_RETREATS: Final = 12
_STEADY: Final = 0.15  # [s] over which the pen follows what its places look at, standard deviation
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
    speed: float = 0.6
    """Fastest way of the tip between places that keep still, retreat aside [m/s]; ways get longer for it."""
    turning: float = 3.0
    """The same for the turn of the pen [rad/s]."""


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
    outward = gaussian_filter1d(outward, _STEADY * rate, axis=0, mode="nearest")
    outward = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    visits = _plan(places, outward, rate, config, rng)
    share = np.concatenate([visit.share for visit in visits])
    number = np.repeat(np.arange(len(visits)), [len(visit.share) for visit in visits])
    now = np.arange(len(places))
    share, number = share[now], number[now]

    def at(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        target = np.array([visit.target for visit in visits])[which]
        lean = np.stack([visit.lean for visit in visits])[which]
        distance = np.array([visit.distance for visit in visits])[which]
        axis = _axes(outward[now, target], lean)
        return places[now, target] + distance[:, None] * axis, axis

    (here, axis_here), (there, axis_there) = at(number), at(number + 1)
    blend = share[:, None]
    axis = _between(axis_here, axis_there, blend)
    lift = config.retreat * np.sin(np.pi * blend) ** 2
    return _frames((1.0 - blend) * here + blend * there + lift * axis, axis)


@dataclass(frozen=True, slots=True)
class _Visit:
    """One place, and the way from it to the next."""

    target: int
    distance: float
    lean: Float[np.ndarray, "3"]
    share: Float[np.ndarray, "S"]
    """Of the way, for each frame."""


def _plan(
    places: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    config: PointingConfig,
    rng: np.random.Generator,
) -> list[_Visit]:
    """Visits for all frames, and one more where the last way leads."""
    visits: list[_Visit] = []
    frame = 0
    target, lean = _draw(outward[0], config, rng)
    while frame < len(places):
        here, axis = places[frame], _axes(outward[frame, target], lean)
        following, next_lean = _draw(outward[frame], config, rng)
        next_axis = _axes(outward[frame, following], next_lean)
        turn = float(np.arccos(np.clip(axis @ next_axis, -1.0, 1.0)))
        seconds = max(
            rng.uniform(*config.way),
            PEAK_SPEED * float(np.linalg.norm(here[following] - here[target])) / config.speed,
            PEAK_SPEED * turn / config.turning,
        )
        stay = np.zeros(max(1, round(rng.uniform(*config.stay) * rate)))
        share = np.concatenate([stay, minimum_jerk(max(2, int(np.ceil(seconds * rate))))])
        visits.append(_Visit(target, rng.uniform(*config.distance), lean, share))
        frame, target, lean = frame + len(share), following, next_lean
    return [*visits, _Visit(target, rng.uniform(*config.distance), lean, np.zeros(0))]


def _draw(
    outward: Float[np.ndarray, "M 3"], config: PointingConfig, rng: np.random.Generator
) -> tuple[int, Float[np.ndarray, "3"]]:
    """A place that can be reached now, and how the pen leans there."""
    open_to_pen = np.flatnonzero(outward @ _UPRIGHT > _BEHIND)
    target = int(rng.choice(open_to_pen if len(open_to_pen) else len(outward)))
    lean = config.tilt * rng.standard_normal(3)
    lean -= (lean @ outward[target]) * outward[target]  # sideways, or a turn of the place would swing the pen
    return target, lean * min(1.0, _MOST_LEAN / max(float(np.linalg.norm(lean)), 1e-9))


def _axes(outward: Float[np.ndarray, "*T 3"], lean: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T 3"]:
    """Directions of the pen at places: off the skin, and never far from upright, smoothly in both."""
    axis = outward + lean
    facing = np.einsum("...i,...i->...", axis, outward)[..., None]
    axis = axis + np.clip(0.5 - facing, 0.0, None) * outward
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    upright = np.broadcast_to(_UPRIGHT, axis.shape)
    angle = np.arccos(np.clip(axis @ _UPRIGHT, -1.0, 1.0))[..., None]
    return _between(upright, axis, _CONE * np.tanh(angle / _CONE) / np.maximum(angle, 1e-9))


def _between(
    start: Float[np.ndarray, "*T 3"], end: Float[np.ndarray, "*T 3"], share: Float[np.ndarray, "*T 1"]
) -> Float[np.ndarray, "*T 3"]:
    """Directions a share of the shortest turn from one to another."""
    angle = np.arccos(np.clip(np.einsum("...i,...i->...", start, end), -1.0, 1.0))[..., None]
    mixed = np.sin((1.0 - share) * angle) * start + np.sin(share * angle) * end
    mixed = np.where(angle > 1e-6, mixed, start)
    between: np.ndarray = mixed / np.maximum(np.linalg.norm(mixed, axis=-1, keepdims=True), 1e-12)
    return between


def _frames(origin: Float[np.ndarray, "T 3"], axis: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with +z along `axis`, by the shortest turn from upright, where +x looks to the arm."""
    x = _ARM - (_ARM @ _UPRIGHT) * _UPRIGHT
    x /= np.linalg.norm(x)
    # The shortest turn from u to a moves v to v - (v . (u + a)) / (1 + u . a) (u + a) + 2 (v . u) a.
    middle = axis + _UPRIGHT
    x = x - (middle @ x / (1.0 + axis @ _UPRIGHT))[:, None] * middle
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
        ArgumentError: Even drawn back, something touches.
    """
    motion, body = held
    T_wrist_pen = np.linalg.inv(wrist_poses(motion.qpos)) @ body.T_world_body
    T_world_pen = path @ _turned_to_the_arm(T_wrist_pen.mean(axis=0), pen.markers[0])
    qpos = motion.qpos.copy()
    qpos[:, :7] = pose_to_qpos(T_world_pen @ np.linalg.inv(T_wrist_pen))
    led = HandMotion(qpos, motion.rate), BodyMotion(T_world_pen, motion.rate)
    return keep_apart(holder, other, pen, led, other_motion, path[:, :3, 2])


def keep_apart(
    holder: HandModel,
    other: HandModel,
    thing: RigidObject,
    held: tuple[HandMotion, BodyMotion],
    other_motion: HandMotion,
    direction: Float[np.ndarray, "T 3"],
) -> tuple[HandMotion, BodyMotion]:
    """A hand and what it holds, drawn back smoothly wherever either would touch the other hand.

    Args:
        holder: The hand with the thing.
        other: The hand that is in the way.
        thing: What is held.
        held: How hand and thing would move.
        other_motion: What the other hand does.
        direction: Unit directions to draw back in.

    Raises:
        ArgumentError: Even drawn back, something touches.
    """
    motion, body = held
    back = np.zeros(len(direction))
    for _ in range(_MOST_RETREATS):
        qpos, poses = motion.qpos.copy(), body.T_world_body.copy()
        qpos[:, :3] += back[:, None] * direction
        poses[:, :3, 3] += back[:, None] * direction
        deep = np.maximum(
            overlap_between(
                holder.capsules, holder.forward_kinematics(qpos),
                other.capsules, other.forward_kinematics(other_motion.qpos),
            ),
            object_penetration(other, thing, other_motion.qpos, poses),
        )  # fmt: skip
        if deep.max() <= MAX_PENETRATION:
            return HandMotion(qpos, motion.rate), BodyMotion(poses, motion.rate)
        needed = np.where(deep > 0.5 * MAX_PENETRATION, back + deep + _RETREAT_STEP, back)
        window = 2 * int(_SMOOTHING * motion.rate / 2) + 1
        back = uniform_filter1d(maximum_filter1d(needed, window), window)
    raise PoseError("the hands touch, however far one of them draws back")


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
