"""A hand that holds an object and plays with it: smooth motion between variants of settled grasps.

Grasps are settled by dynamics (`settle_hold`); the motion between them is smooth, no faster than a hand, and
checked in every frame: ranges, self-penetration, and penetration of the object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.motion import BodyMotion, HandMotion
from handsim.space.objects import RigidObject
from poses.grasps.grasp_scene import (
    MAX_OBJECT_PENETRATION,
    GraspScene,
    grasp_scene,
    object_penetration,
    wrist_poses,
)
from poses.grasps.grasping import Hold, settle_hold, why_not_held
from poses.grasps.held_poses import Held, between, is_held_valid, rotation_between, sample_held_poses
from poses.grasps.hold_library import HoldStyle, hold_names, hold_style
from poses.motion.paths import PEAK_ACCELERATION, PEAK_SPEED, MotionConfig, minimum_jerk
from poses.motion.wrist_paths import free_wrist_path

__all__ = [
    "MAX_OBJECT_PENETRATION",
    "Hold",
    "hold_names",
    "object_penetration",
    "sample_held_poses",
    "sample_object_motion",
    "settle_hold",
]

_VARIANTS: Final = 12  # drawn at once
_MOST_DRAWS: Final = 20
_HOLDS: Final = 3  # grasps of one style that a motion goes between
_SHIFTS: Final = 0.15  # how often the object shifts in the hand
_LOOSEST: Final = 0.003  # [m] between the object and the digits that hold it, while it shifts
_SLIDING, _ROLLING = 0.15, 4.0  # fastest shift of the object in the hand [m/s], [rad/s]
_MARGIN: Final = 0.9  # of the fastest and of the largest acceleration, for the steps between frames


def sample_object_motion(
    model: HandModel, obj: RigidObject, duration: float, *, rng: np.random.Generator
) -> tuple[HandMotion, BodyMotion]:
    """Random smooth motion of a hand that carries an object and plays with it, valid at every frame.

    It has `round(duration * rate) + 1` frames.

    Raises:
        ArgumentError: The duration is not positive.
        PoseError: This hand does not get hold of the object, or finds no valid path out of a hold.
    """
    config = MotionConfig()
    if not 0.0 < duration < np.inf:
        raise ArgumentError(f"the duration is {duration:g} s, expected a positive number")
    frames = round(duration * config.rate) + 1
    names = hold_names(obj)
    name = names[rng.integers(len(names))]
    holds = [settle_hold(model, obj, hold=name, rng=rng) for _ in range(_HOLDS)]
    player = _Player(grasp_scene(model, obj), hold_style(model, obj, name), holds, config, rng)
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
    return HandMotion(qpos, config.rate), BodyMotion(wrist_poses(qpos) @ held, config.rate)


@dataclass(frozen=True, slots=True)
class _Player:
    """Moves a hand from one variant of its holds to the next."""

    scene: GraspScene
    style: HoldStyle
    holds: list[Hold]
    config: MotionConfig
    rng: np.random.Generator

    def next_part(self, last: Held, current: int) -> tuple[Held, int]:
        """Valid frames to a variant of the current hold, or sometimes of another, and that hold's index."""
        start = Held(last.angles[-1:], last.poses[-1:])
        if self.rng.random() < _SHIFTS:
            other = int(self.rng.integers(len(self.holds)))
            part = self._path(start, self._home(other))
            if other != current and is_held_valid(self.scene, part).all() and self._keeps_touch(part):
                return self._rested(part), other
        model, obj = self.scene.hand, self.scene.obj
        for _ in range(_MOST_DRAWS):
            angles, poses = sample_held_poses(model, obj, self.holds[current], _VARIANTS, rng=self.rng)
            paths = (
                self._path(start, Held(angles[[number]], poses[[number]])) for number in range(_VARIANTS)
            )
            for part in (*paths, self._path(start, self._home(current))):
                if is_held_valid(self.scene, part).all():
                    return self._rested(part), current
        raise PoseError(f"no valid path out of a hold of the {obj.name} in {_MOST_DRAWS * _VARIANTS} tries")

    def _home(self, number: int) -> Held:
        return Held(self.holds[number].angles[None], self.holds[number].T_wrist_object[None])

    def _path(self, start: Held, target: Held) -> Held:
        config = self.config
        distance = np.abs(target.angles - start.angles).max()
        quickest = max(
            PEAK_SPEED * distance / (_MARGIN * config.max_speed),
            np.sqrt(PEAK_ACCELERATION * distance / (_MARGIN * config.max_acceleration)),
            PEAK_SPEED * float(np.linalg.norm((target.poses - start.poses)[0, :3, 3])) / _SLIDING,
            PEAK_SPEED * float(np.linalg.norm(rotation_between(start, target)[0])) / _ROLLING,
        )
        frames = int(np.ceil(max(quickest, self.rng.uniform(*config.durations)) * config.rate)) + 1
        return between(start, target, minimum_jerk(frames))

    def _rested(self, path: Held) -> Held:
        pause = int(self.rng.uniform(0.0, self.config.hold) * self.config.rate)
        return Held(*(np.concatenate([part, np.repeat(part[-1:], pause, axis=0)]) for part in path))

    def _keeps_touch(self, held: Held) -> bool:
        """Whether the digits that hold the object stay near it, at the quarters and halfway."""
        scene = self.scene
        names = [scene.mj_model.geom(geom).name for geom in scene.hand_geoms]
        for number in len(held.angles) * np.array([1, 2, 3]) // 4:
            distances = scene.distances(scene.new_data(held.angles[number], held.poses[number]))
            near = {name for name, gap in zip(names, distances, strict=True) if gap < _LOOSEST}
            if why_not_held(self.style, near):
                return False
        return True


def _scribble(frames: int, size: float, rate: float, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Small quick loops of a writing wrist (T, 3) [m], whose size swells and fades."""
    time = np.arange(frames) / rate
    loops = np.zeros((frames, 3))
    for axis in range(3):
        for frequency in rng.uniform(1.0, 3.5, size=2):
            loops[:, axis] += 0.5 * np.sin(2 * np.pi * (frequency * time + rng.random()))
    swell = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(0.1, 0.3) * time + rng.random()))
    return size * swell[:, None] ** 2 * loops
