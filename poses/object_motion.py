"""Motion of a hand that holds an object: it plays with it, points, and keeps clear of the other hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from handsim.errors import PoseError
from handsim.hand.capsules import overlap_between
from handsim.hand.model import BodyMotion, HandModel, HandMotion, join_qpos
from handsim.space.objects import RigidObject
from handsim.space.transforms import axis_angle_matrix, pose_matrices, rigid, transform_poses, unit
from poses.grasps import (
    GraspScene,
    Held,
    Hold,
    HoldStyle,
    grasp_scene,
    hold_names,
    hold_style,
    interpolate_held,
    is_held_valid,
    object_penetration,
    rotation_between,
    sample_held_poses,
    settle_hold,
    why_not_held,
)
from poses.motion import PEAK_SPEED, MotionConfig, free_wrist_path, minimum_jerk
from poses.shapes import MAX_PENETRATION

_VARIANTS: Final = 12  # number of held poses in a draw
_MAX_DRAWS: Final = 20
_NUM_HOLDS: Final = 3  # number of grasps of one style in a motion
_SHIFT_CHANCE: Final = 0.15  # chance of a change to another grasp
_MAX_GAP: Final = 0.003  # largest gap between a shifting object and the digits that hold it [m]
_MAX_SLIDE_SPEED, _MAX_ROLL_SPEED = 0.15, 4.0  # fastest shift of the object in the hand [m/s], [rad/s]
_LIMIT_SHARE: Final = 0.9  # share of the limits of speed and acceleration that paths use

_RETREAT_STEP: Final = 0.003  # distance that is added to the overlap in each retreat [m]
_RETREAT_WINDOW: Final = 0.25  # time over which a retreat is smoothed [s]

TIP_DISTANCE: Final = (0.006, 0.02)
"""Smallest and largest distance of the tip from its target [m]."""
TIP_SPEED: Final = 0.6
"""Highest speed of the tip between still targets, without the retreat [m/s]."""
PEN_TURN_SPEED: Final = 3.0
"""Highest rotation speed of the pen between still targets [rad/s]."""
RETREAT_DISTANCE: Final = 0.05
"""Distance that the tip retreats between two targets [m]."""
_STAY_TIMES: Final = (0.15, 0.6)  # shortest and longest time at a target [s]
PATH_TIMES: Final = (0.4, 0.9)
"""Shortest and longest time from target to target [s]."""
_LEAN_SPREAD: Final = 0.6  # standard deviation of the pen's lean from the outward direction, as a tangent
_UPRIGHT_PEN: Final = np.array([0.36, -0.26, 0.9]) / np.linalg.norm([0.36, -0.26, 0.9])
"""Direction of a pen in the right hand of a person at -y, over a palm that faces down."""
_ARM_DIRECTION: Final = np.array([0.8, -0.6, 0.0])  # direction from the pen to the writing arm
_MAX_PEN_ANGLE: Final = 1.2  # largest angle of the pen from upright [rad]
_MAX_LEAN: Final = 1.0  # largest lean of the pen from the outward direction, as a tangent
_MIN_FACING: Final = -0.2  # smallest cosine of a target's outward direction and the upright pen
_DIRECTION_SMOOTHING: Final = 0.15  # standard deviation of the smoothing of outward directions [s]


def sample_object_motion(
    model: HandModel, obj: RigidObject, duration: float, *, rng: np.random.Generator
) -> tuple[HandMotion, BodyMotion]:
    """Random smooth motion of a hand that plays with an object, valid at every frame."""
    config = MotionConfig()
    frames = round(duration * config.rate) + 1
    names = hold_names(obj)
    name = names[rng.integers(len(names))]
    holds = [settle_hold(model, obj, hold=name, rng=rng) for _ in range(_NUM_HOLDS)]
    player = _HoldPlayer(grasp_scene(model, obj), hold_style(model, obj, name), holds, config, rng)
    parts = [Held(holds[0].angles[None], holds[0].T_wrist_object[None])]
    count, current = 1, 0
    while count < frames:
        part, current = player.next_part(parts[-1], current)
        parts.append(part)
        count += len(part.angles)
    angles, held = (np.concatenate(rows)[:frames] for rows in zip(*parts, strict=True))
    position, quaternion = free_wrist_path(frames, config, rng=rng)
    position = position + _scribble(frames, player.style.scribble, config.rate, rng=rng)
    qpos = join_qpos(angles, position=position, quaternion=quaternion)
    return HandMotion(qpos, config.rate), BodyMotion(pose_matrices(qpos[:, :7]) @ held, config.rate)


@dataclass(frozen=True, slots=True)
class _HoldPlayer:
    """A player that moves a hand from one variant of its holds to the next."""

    scene: GraspScene
    style: HoldStyle
    holds: list[Hold]
    config: MotionConfig
    rng: np.random.Generator

    def next_part(self, last: Held, current: int) -> tuple[Held, int]:
        """Valid frames to a variant of the current hold or to another hold, and the index of the hold."""
        start = Held(last.angles[-1:], last.poses[-1:])
        if self.rng.random() < _SHIFT_CHANCE:
            other = int(self.rng.integers(len(self.holds)))
            part = self._path(start, self._home(other))
            if other != current and is_held_valid(self.scene, part).all() and self._keeps_touch(part):
                return self._rested(part), other
        model, obj = self.scene.hand, self.scene.obj
        for _ in range(_MAX_DRAWS):
            ends = sample_held_poses(model, obj, self.holds[current], _VARIANTS, rng=self.rng)
            paths = (self._path(start, Held(*(part[[n]] for part in ends))) for n in range(_VARIANTS))
            for part in (*paths, self._path(start, self._home(current))):
                if is_held_valid(self.scene, part).all():
                    return self._rested(part), current
        raise PoseError(f"no valid path out of a hold of the {obj.name} in {_MAX_DRAWS * _VARIANTS} tries")

    def _home(self, number: int) -> Held:
        return Held(self.holds[number].angles[None], self.holds[number].T_wrist_object[None])

    def _path(self, start: Held, target: Held) -> Held:
        config = self.config
        quickest = max(
            config.least_time(np.abs(target.angles - start.angles).max(), _LIMIT_SHARE),
            PEAK_SPEED * float(np.linalg.norm((target.poses - start.poses)[0, :3, 3])) / _MAX_SLIDE_SPEED,
            PEAK_SPEED * float(np.linalg.norm(rotation_between(start, target)[0])) / _MAX_ROLL_SPEED,
        )
        frames = int(np.ceil(max(quickest, self.rng.uniform(*config.durations)) * config.rate)) + 1
        return interpolate_held(start, target, minimum_jerk(frames))

    def _rested(self, path: Held) -> Held:
        pause = int(self.rng.uniform(0.0, self.config.hold) * self.config.rate)
        return Held(*(np.concatenate([part, np.repeat(part[-1:], pause, axis=0)]) for part in path))

    def _keeps_touch(self, held: Held) -> bool:
        """Whether the holding digits are near the object after 1/4, 1/2 and 3/4 of the path."""
        middle = len(held.angles) * np.array([1, 2, 3]) // 4
        near = (self.scene.touching(held.angles[n], held.poses[n], _MAX_GAP) for n in middle)
        return not any(why_not_held(self.style, names) for names in near)


def _scribble(frames: int, size: float, rate: float, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample small loops of a writing wrist (T, 3) [m], of varying size."""
    time = np.arange(frames) / rate
    loops = np.zeros((frames, 3))
    for axis in range(3):
        for frequency in rng.uniform(1.0, 3.5, size=2):
            loops[:, axis] += 0.5 * np.sin(2 * np.pi * (frequency * time + rng.random()))
    swell = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(0.1, 0.3) * time + rng.random()))
    return size * swell[:, None] ** 2 * loops


def point_pen(
    holder: HandModel,
    other: HandModel,
    pen: RigidObject,
    held: tuple[HandMotion, BodyMotion],
    other_motion: HandMotion,
    path: Float[np.ndarray, "T 4 4"],
) -> tuple[HandMotion, BodyMotion]:
    """Move a held pen along a path, and draw it back wherever hands or pen would touch.

    Fingers and pen keep their motion in the wrist's frame. The pen's tip is its first marker.
    """
    motion, body = held
    T_wrist_pen = np.linalg.inv(pose_matrices(motion.qpos[:, :7])) @ body.T_world_body
    # In the path's frame the tip is at the origin, and the pen is rotated so that the wrist is at +x.
    wrist = np.linalg.inv(T_wrist_pen.mean(axis=0))[:3, 3]
    turn = axis_angle_matrix(np.array([0.0, 0.0, 1.0]), -np.arctan2(wrist[[1]], wrist[[0]]))[0]
    T_world_pen = path @ (rigid(turn, np.zeros(3)) @ rigid(np.eye(3), -pen.markers[0]))
    qpos = motion.qpos.copy()
    qpos[:, :7] = transform_poses(T_world_pen @ np.linalg.inv(T_wrist_pen))
    led = HandMotion(qpos, motion.rate), BodyMotion(T_world_pen, motion.rate)
    return keep_apart(holder, other, pen, led, other_motion, path[:, :3, 2])


def keep_apart(
    holder: HandModel,
    other: HandModel,
    obj: RigidObject,
    held: tuple[HandMotion, BodyMotion],
    other_motion: HandMotion,
    direction: Float[np.ndarray, "T 3"],
) -> tuple[HandMotion, BodyMotion]:
    """Draw a hand and its object back smoothly wherever either would touch the other hand."""
    motion, body = held
    back = np.zeros(len(direction))
    for _ in range(12):
        qpos, poses = motion.qpos.copy(), body.T_world_body.copy()
        qpos[:, :3] += back[:, None] * direction
        poses[:, :3, 3] += back[:, None] * direction
        deep = np.maximum(
            overlap_between(
                holder.capsules, holder.forward_kinematics(qpos),
                other.capsules, other.forward_kinematics(other_motion.qpos),
            ),
            object_penetration(other, obj, other_motion.qpos, poses),
        )  # fmt: skip
        if deep.max() <= MAX_PENETRATION:
            return HandMotion(qpos, motion.rate), BodyMotion(poses, motion.rate)
        needed = np.where(deep > 0.5 * MAX_PENETRATION, back + deep + _RETREAT_STEP, back)
        window = 2 * int(_RETREAT_WINDOW * motion.rate / 2) + 1
        back = uniform_filter1d(maximum_filter1d(needed, window), window)
    raise PoseError("the hands touch, however far one of them draws back")


def pointing_path(
    positions: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    *,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4 4"]:
    """Poses of a pen (tip at the origin, body along +z) that visits moving targets at random.

    Targets [m] are reached from their outward unit directions, by a tip no faster than `TIP_SPEED`.
    """
    outward = gaussian_filter1d(outward, _DIRECTION_SMOOTHING * rate, axis=0, mode="nearest")
    outward = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    targets, distances, leans, shares = zip(*_plan_visits(positions, outward, rate, rng), strict=True)
    now = np.arange(len(positions))
    blend = np.concatenate(shares)[now, None]
    number = np.repeat(np.arange(len(shares)), [len(share) for share in shares])[now]

    def at(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        target = np.array(targets)[which]
        axis = _pen_axes(outward[now, target], np.stack(leans)[which])
        return positions[now, target] + np.array(distances)[which, None] * axis, axis

    (here, axis_here), (there, axis_there) = at(number), at(number + 1)
    axis = _slerp(axis_here, axis_there, blend)
    lift = RETREAT_DISTANCE * np.sin(np.pi * blend) ** 2
    return _to_poses((1.0 - blend) * here + blend * there + lift * axis, axis)


class _Visit(NamedTuple):
    """A target, and the path to the next one."""

    target: int
    distance: float
    lean: Float[np.ndarray, "3"]
    share: Float[np.ndarray, "S"]
    """Share of the path after each frame."""


def _plan_visits(
    positions: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    rng: np.random.Generator,
) -> list[_Visit]:
    """Draw visits for all frames, and one more at the end of the last path."""
    visits: list[_Visit] = []
    frame = 0
    target, lean = _draw_target(outward[0], rng)
    while frame < len(positions):
        here, axis = positions[frame], _pen_axes(outward[frame, target], lean)
        following, next_lean = _draw_target(outward[frame], rng)
        next_axis = _pen_axes(outward[frame, following], next_lean)
        turn = float(np.arccos(np.clip(axis @ next_axis, -1.0, 1.0)))
        seconds = max(
            rng.uniform(*PATH_TIMES),
            PEAK_SPEED * float(np.linalg.norm(here[following] - here[target])) / TIP_SPEED,
            PEAK_SPEED * turn / PEN_TURN_SPEED,
        )
        stay = np.zeros(max(1, round(rng.uniform(*_STAY_TIMES) * rate)))
        share = np.concatenate([stay, minimum_jerk(max(2, int(np.ceil(seconds * rate))))])
        visits.append(_Visit(target, rng.uniform(*TIP_DISTANCE), lean, share))
        frame, target, lean = frame + len(share), following, next_lean
    return [*visits, _Visit(target, rng.uniform(*TIP_DISTANCE), lean, np.zeros(0))]


def _draw_target(
    outward: Float[np.ndarray, "M 3"], rng: np.random.Generator
) -> tuple[int, Float[np.ndarray, "3"]]:
    """Draw a target that the pen can reach in this frame, and the lean of the pen there."""
    open_to_pen = np.flatnonzero(outward @ _UPRIGHT_PEN > _MIN_FACING)
    target = int(rng.choice(open_to_pen if len(open_to_pen) else len(outward)))
    lean = _LEAN_SPREAD * rng.standard_normal(3)
    # A pen that leans sideways does not swing when the target rotates.
    lean -= (lean @ outward[target]) * outward[target]
    return target, lean * min(1.0, _MAX_LEAN / max(float(np.linalg.norm(lean)), 1e-9))


def _pen_axes(
    outward: Float[np.ndarray, "*T 3"], lean: Float[np.ndarray, "*T 3"]
) -> Float[np.ndarray, "*T 3"]:
    """Unit directions of a pen at targets: away from the skin, near upright, smooth in both arguments."""
    axis = outward + lean
    facing = np.einsum("...i,...i->...", axis, outward)[..., None]
    axis = unit(axis + np.clip(0.5 - facing, 0.0, None) * outward)
    upright = np.broadcast_to(_UPRIGHT_PEN, axis.shape)
    angle = np.arccos(np.clip(axis @ _UPRIGHT_PEN, -1.0, 1.0))[..., None]
    return _slerp(upright, axis, _MAX_PEN_ANGLE * np.tanh(angle / _MAX_PEN_ANGLE) / np.maximum(angle, 1e-9))


def _slerp(
    start: Float[np.ndarray, "*T 3"], end: Float[np.ndarray, "*T 3"], share: Float[np.ndarray, "*T 1"]
) -> Float[np.ndarray, "*T 3"]:
    """Interpolate unit directions spherically, from `start` (share 0) to `end` (share 1)."""
    angle = np.arccos(np.clip(np.einsum("...i,...i->...", start, end), -1.0, 1.0))[..., None]
    mixed = np.sin((1.0 - share) * angle) * start + np.sin(share * angle) * end
    mixed = np.where(angle > 1e-6, mixed, start)
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=-1, keepdims=True), 1e-12))


def _to_poses(origin: Float[np.ndarray, "T 3"], axis: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with +z along `axis`, by the shortest rotation from upright, where +x points to the arm."""
    x = _ARM_DIRECTION - (_ARM_DIRECTION @ _UPRIGHT_PEN) * _UPRIGHT_PEN
    x /= np.linalg.norm(x)
    # The shortest rotation from u to a moves v to v - (v . (u + a)) / (1 + u . a) (u + a) + 2 (v . u) a.
    middle = axis + _UPRIGHT_PEN
    x = x - (middle @ x / (1.0 + axis @ _UPRIGHT_PEN))[:, None] * middle
    return rigid(np.stack([x, np.cross(axis, x), axis], axis=2), origin)
