"""A hand that holds a thing and plays with it: variants of a hold, and smooth motion between them.

Grasps are settled by dynamics (`settle_hold`); what moves between them is smooth, no faster than a hand, and
checked at every frame: ranges, the hand's own flesh, and the thing's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handsim._checks import check_array
from handsim.errors import ShapeError
from handsim.model import HandModel, join_qpos
from handsim.motion import BodyMotion, HandMotion
from handsim.objects import RigidObject
from handsim.topology import DIGITS, NUM_JOINTS
from poses.couplings import HIGH, LOW
from poses.grasp_scene import MAX_OBJECT_PENETRATION, GraspScene, grasp_scene, object_penetration, wrist_poses
from poses.grasping import Hold, settle_hold
from poses.hold_library import HoldStyle, hold_names, hold_style
from poses.motions import MotionConfig, _wrist_path, minimum_jerk
from poses.validity import is_valid

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

__all__ = [
    "MAX_OBJECT_PENETRATION",
    "Hold",
    "hold_names",
    "object_penetration",
    "sample_held_poses",
    "sample_object_motion",
    "settle_hold",
]

_HALVINGS: Final = 4
_VARIANTS: Final = 12  # drawn at once
_MOST_DRAWS: Final = 20
_HOLDS: Final = 3  # grasps of one style that a motion goes between
_OPENS: Final = 0.55  # how often a free digit lifts
_TAPS: Final = 0.3  # how often a pressing digit lifts
_SHIFTS: Final = 0.15  # how often the thing shifts in the hand
_LOOSEST: Final = 0.003  # [m] between the thing and the digits that need touch it, while it shifts
_MARGIN: Final = 0.9  # of the fastest and of the largest acceleration, for the steps between frames
_PEAK_SPEED: Final = 1.875  # of the minimum-jerk profile, in distances per duration
_PEAK_ACCELERATION: Final = 5.7735  # in distances per duration squared
# How far a lifted finger opens at most [rad]: abduction (either way), MCP, PIP, DIP; and the thumb.
_LIFT: Final = np.deg2rad([[14.0, 30.0, 20.0, 25.0], [5.0, 45.0, 45.0, 30.0]])
_TAP: Final = np.deg2rad([[4.0, 10.0, 6.0, 8.0], [1.0, 14.0, 10.0, 6.0]])
_TREMBLE: Final = np.deg2rad([0.5, 1.2, 1.8, 1.8])  # of digits that hold
_WOBBLE: Final = (0.0006, np.deg2rad(1.2))  # of the thing in the hand: [m], [rad]


class _Held(NamedTuple):
    """Poses of hand and thing, (B, 20) and (B, 4, 4)."""

    angles: NDArray[np.float64]
    poses: NDArray[np.float64]


def sample_held_poses(
    model: HandModel, obj: RigidObject, hold: Hold, count: int, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "B 20"], Float[np.ndarray, "B 4 4"]]:
    """Valid variants of a hold: free digits lift, others tap or press, the thing tilts a little.

    Args:
        model: The hand.
        obj: What it holds.
        hold: A settled grasp of it by this hand.
        count: How many.
        rng: Source of all randomness.

    Returns:
        Hinge angles [rad], and `T_wrist_object`.

    Raises:
        ShapeError: The hold is not valid, such as one of another hand.
    """
    scene, style = grasp_scene(model, obj), hold_style(model, obj, hold.name)
    start = _Held(hold.angles[None], hold.T_wrist_object[None])
    if not _valid(scene, start)[0]:
        raise ShapeError(f"the hold '{hold.name}' is not valid for this hand and the {obj.name}")
    angles = np.clip(hold.angles + _deviations(style, count, rng), LOW, HIGH)
    poses = np.tile(hold.T_wrist_object, (count, 1, 1))
    shift, turn = (scale * rng.standard_normal((count, 3)).clip(-2.0, 2.0) for scale in _WOBBLE)
    still = rng.random(count) < 0.3
    shift[still], turn[still] = 0.0, 0.0
    poses[:, :3, 3] += shift
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    wanted = _Held(angles, poses)
    # The way back to the hold is halved, so that what digs in ends where it touches.
    share = np.where(_valid(scene, wanted), 1.0, 0.0)
    step = 1.0
    todo = np.flatnonzero(share == 0.0)
    for _ in range(_HALVINGS if len(todo) else 0):
        step /= 2
        nearer = _between(start, _Held(*(part[todo] for part in wanted)), share[todo] + step)
        share[todo] += np.where(_valid(scene, nearer), step, 0.0)
    found = _between(start, wanted, share)
    return found.angles, found.poses


def sample_object_motion(
    model: HandModel,
    obj: RigidObject,
    duration: float,
    config: MotionConfig | None = None,
    *,
    rng: np.random.Generator,
) -> tuple[HandMotion, BodyMotion]:
    """Random smooth motion of a hand that carries a thing and plays with it, valid at every frame.

    Args:
        model: The hand.
        obj: What it holds.
        duration: How long [s]; the motion has `round(duration * rate) + 1` frames.
        config: Speeds and places; human ones when not given.
        rng: Source of all randomness.

    Raises:
        ShapeError: The duration is not positive, or this hand does not get hold of the thing.
    """
    config = config or MotionConfig()
    if not 0.0 < duration < np.inf:
        raise ShapeError(f"the duration is {duration:g} s, wanted a positive number")
    frames = round(duration * config.rate) + 1
    names = hold_names(obj)
    name = names[rng.integers(len(names))]
    holds = [settle_hold(model, obj, hold=name, rng=rng) for _ in range(_HOLDS)]
    scene, style = grasp_scene(model, obj), hold_style(model, obj, name)
    parts = [_Held(holds[0].angles[None], holds[0].T_wrist_object[None])]
    count, current = 1, 0
    while count < frames:
        part, current = _next_part(scene, style, holds, current, parts[-1], config, rng)
        parts.append(part)
        count += len(part.angles)
    angles, held = (np.concatenate(rows)[:frames] for rows in zip(*parts, strict=True))
    position, quaternion = _wrist_path(frames, config, rng)
    position = position + _scribble(frames, style.scribble, config, rng)
    qpos = join_qpos(angles, position=position, quaternion=quaternion)
    poses = check_array("T_world_object", wrist_poses(qpos) @ held, (frames, 4, 4))
    return HandMotion(qpos, config.rate), BodyMotion(poses, config.rate)


def _next_part(
    scene: GraspScene,
    style: HoldStyle,
    holds: list[Hold],
    current: int,
    last: _Held,
    config: MotionConfig,
    rng: np.random.Generator,
) -> tuple[_Held, int]:
    """Valid frames from the last pose to a variant of the hold, or now and then to another hold."""
    start = _Held(last.angles[-1:], last.poses[-1:])
    if rng.random() < _SHIFTS:
        other = int(rng.integers(len(holds)))
        target = _Held(holds[other].angles[None], holds[other].T_wrist_object[None])
        part = _way(start, target, config, rng)
        if other != current and _valid(scene, part).all() and _keeps_touch(scene, style, part):
            return _rested(part, config, rng), other
    hold = holds[current]
    home = _Held(hold.angles[None], hold.T_wrist_object[None])
    for _ in range(_MOST_DRAWS):
        angles, poses = sample_held_poses(scene.hand, scene.obj, hold, _VARIANTS, rng=rng)
        for number in range(_VARIANTS):
            target = _Held(angles[number : number + 1], poses[number : number + 1])
            direct = _way(start, target, config, rng)
            if _valid(scene, direct).all():
                return _rested(direct, config, rng), current
        back = _way(start, home, config, rng)
        if _valid(scene, back).all():
            return _rested(back, config, rng), current
    raise ShapeError(f"no valid way out of a hold of the {scene.obj.name} in {_MOST_DRAWS * _VARIANTS} tries")


def _way(start: _Held, target: _Held, config: MotionConfig, rng: np.random.Generator) -> _Held:
    distance = np.abs(target.angles - start.angles).max()
    quickest = max(
        _PEAK_SPEED * distance / (_MARGIN * config.max_speed),
        np.sqrt(_PEAK_ACCELERATION * distance / (_MARGIN * config.max_acceleration)),
    )
    frames = int(np.ceil(max(quickest, rng.uniform(*config.durations)) * config.rate)) + 1
    return _between(start, target, minimum_jerk(frames))


def _rested(way: _Held, config: MotionConfig, rng: np.random.Generator) -> _Held:
    pause = int(rng.uniform(0.0, config.hold) * config.rate)
    return _Held(*(np.concatenate([part, np.repeat(part[-1:], pause, axis=0)]) for part in way))


def _between(start: _Held, end: _Held, share: NDArray[np.float64]) -> _Held:
    """Poses at shares (B,) of the way from one start to one end or to one each."""
    angles = start.angles + share[:, None] * (end.angles - start.angles)
    poses = np.tile(np.eye(4), (len(share), 1, 1))
    poses[:, :3, 3] = start.poses[:, :3, 3] + share[:, None] * (end.poses - start.poses)[:, :3, 3]
    turn = Rotation.from_matrix(np.swapaxes(start.poses[:, :3, :3], 1, 2) @ end.poses[:, :3, :3]).as_rotvec()
    poses[:, :3, :3] = start.poses[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    return _Held(angles, poses)


def _valid(scene: GraspScene, held: _Held) -> NDArray[np.bool_]:
    valid: NDArray[np.bool_] = is_valid(scene.hand, held.angles)
    valid[valid] = scene.depth(held.angles[valid], held.poses[valid]) <= MAX_OBJECT_PENETRATION
    return valid


def _keeps_touch(scene: GraspScene, style: HoldStyle, held: _Held) -> bool:
    """Whether the digits that need touch the thing stay near it, halfway and at the quarters."""
    names = [scene.mj_model.geom(geom).name for geom in scene.hand_geoms]
    for number in len(held.angles) * np.array([1, 2, 3]) // 4:
        distances = scene.distances(scene.new_data(held.angles[number], held.poses[number]))
        for need in style.needs:
            mine = [gap for name, gap in zip(names, distances, strict=True) if name.startswith(need)]
            if min(mine) > _LOOSEST:
                return False
    return True


def _deviations(style: HoldStyle, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """How much every hinge leaves the hold [rad] (count, 20): positive is flexion and abduction."""
    deviations = _TREMBLE * rng.standard_normal((count, len(DIGITS), 4)).clip(-2.0, 2.0)
    for place, digit in enumerate(DIGITS):
        kind = min(place, 1)
        for digits, most, often in ((style.press, _TAP, _TAPS), (style.free, _LIFT, _OPENS)):
            if digit not in digits:
                continue
            lifts = rng.random(count) < often
            opening = -most[kind] * rng.uniform(0.0, 1.0, (count, 4)) ** np.array([1.0, 0.7, 0.7, 1.0])
            opening[:, 0] = most[kind, 0] * rng.uniform(-1.0, 1.0, count)
            deviations[lifts, place] = opening[lifts]
    flat: NDArray[np.float64] = deviations.reshape(count, NUM_JOINTS)
    return flat


def _scribble(
    frames: int, size: float, config: MotionConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Small quick loops of a writing wrist (T, 3) [m], that come and go."""
    time = np.arange(frames) / config.rate
    loops = np.zeros((frames, 3))
    for axis in range(3):
        for frequency in rng.uniform(1.0, 3.5, size=2):
            loops[:, axis] += 0.5 * np.sin(2 * np.pi * (frequency * time + rng.random()))
    swell = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(0.1, 0.3) * time + rng.random()))
    scribble: NDArray[np.float64] = size * swell[:, None] ** 2 * loops
    return scribble
