"""Valid variants of a hold: free digits lift, others tap or press, the object tilts a little."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.errors import PoseError
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, NUM_JOINTS
from handsim.space.objects import RigidObject
from poses.grasps.grasp_scene import MAX_OBJECT_PENETRATION, GraspScene, grasp_scene
from poses.grasps.grasping import Hold
from poses.grasps.hold_library import HoldStyle, hold_style
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.validity import is_valid

_DEEPEST: Final = MAX_OBJECT_PENETRATION - 1e-6  # [m], room for rounding in the world's frame
_HALVINGS: Final = 4
_OPENS: Final = 0.55  # how often a free digit lifts
_TAPS: Final = 0.3  # how often a pressing digit lifts
_STILL: Final = 0.3  # how often the object stays as it is
# Largest opening of a lifted digit [rad]: the thumb's four joints; abduction (either way), MCP, PIP, DIP.
_LIFT: Final = np.deg2rad([[14.0, 30.0, 20.0, 25.0], [5.0, 45.0, 45.0, 30.0]])
_TAP: Final = np.deg2rad([[4.0, 10.0, 6.0, 8.0], [1.0, 14.0, 10.0, 6.0]])
_TREMBLE: Final = np.deg2rad([0.5, 1.2, 1.8, 1.8])  # of digits that hold
_WOBBLE: Final = (0.0006, np.deg2rad(1.2))  # of the object in the hand: [m], [rad]


class Held(NamedTuple):
    """Poses of a hand and the object it holds."""

    angles: NDArray[np.float64]
    """Joint angles (B, 20) [rad]."""
    poses: NDArray[np.float64]
    """`T_wrist_object` (B, 4, 4) [m]."""


def sample_held_poses(
    model: HandModel, obj: RigidObject, hold: Hold, count: int, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "B 20"], Float[np.ndarray, "B 4 4"]]:
    """Valid variants of a hold: free digits lift, others tap or press, the object tilts a little.

    Returns joint angles [rad], and `T_wrist_object` [m].

    Raises:
        PoseError: The hold is not valid, such as one of another hand.
    """
    scene, style = grasp_scene(model, obj), hold_style(model, obj, hold.name)
    start = Held(hold.angles[None], hold.T_wrist_object[None])
    if not is_held_valid(scene, start)[0]:
        raise PoseError(f"the hold '{hold.name}' is not valid for this hand and the {obj.name}")
    angles = np.clip(hold.angles + _deviations(style, count, rng), LOW, HIGH)
    poses = np.tile(hold.T_wrist_object, (count, 1, 1))
    shift, rotation = (scale * rng.standard_normal((count, 3)).clip(-2.0, 2.0) for scale in _WOBBLE)
    still = rng.random(count) < _STILL
    shift[still], rotation[still] = 0.0, 0.0
    poses[:, :3, 3] += shift
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(rotation).as_matrix()
    target = Held(angles, poses)
    # The path from the hold is bisected, so that what penetrates ends where it touches.
    share = np.where(is_held_valid(scene, target), 1.0, 0.0)
    step = 1.0
    todo = np.flatnonzero(share == 0.0)
    for _ in range(_HALVINGS if len(todo) else 0):
        step /= 2
        nearer = between(start, Held(*(part[todo] for part in target)), share[todo] + step)
        share[todo] += np.where(is_held_valid(scene, nearer), step, 0.0)
    nearest = between(start, target, share)
    return nearest.angles, nearest.poses


def between(start: Held, end: Held, share: NDArray[np.float64]) -> Held:
    """Poses at shares (B,) of the path from one start to one end or to one end each."""
    angles = start.angles + share[:, None] * (end.angles - start.angles)
    poses = np.tile(np.eye(4), (len(share), 1, 1))
    poses[:, :3, 3] = start.poses[:, :3, 3] + share[:, None] * (end.poses - start.poses)[:, :3, 3]
    rotations = Rotation.from_rotvec(share[:, None] * rotation_between(start, end)).as_matrix()
    poses[:, :3, :3] = start.poses[:, :3, :3] @ rotations
    return Held(angles, poses)


def rotation_between(start: Held, end: Held) -> NDArray[np.float64]:
    """Rotation vectors (B, 3) [rad] from one orientation of the object to another, in its own frame."""
    between = np.swapaxes(start.poses[:, :3, :3], 1, 2) @ end.poses[:, :3, :3]
    rotation: NDArray[np.float64] = Rotation.from_matrix(between).as_rotvec()
    return rotation


def is_held_valid(scene: GraspScene, held: Held) -> Bool[np.ndarray, "B"]:
    """Which poses are inside all ranges and penetrate neither the hand nor the object."""
    valid: NDArray[np.bool_] = is_valid(scene.hand, held.angles)
    valid[valid] = scene.depth(held.angles[valid], held.poses[valid]) <= _DEEPEST
    return valid


def _deviations(style: HoldStyle, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Deviation (count, 20) [rad] of every joint from the hold: positive is flexion and abduction."""
    deviations = _TREMBLE * rng.standard_normal((count, len(DIGITS), 4)).clip(-2.0, 2.0)
    for index, digit in enumerate(DIGITS):
        kind = min(index, 1)
        for digits, most, often in ((style.press, _TAP, _TAPS), (style.free, _LIFT, _OPENS)):
            if digit not in digits:
                continue
            lifts = rng.random(count) < often
            opening = -most[kind] * rng.uniform(0.0, 1.0, (count, 4)) ** np.array([1.0, 0.7, 0.7, 1.0])
            opening[:, 0] = most[kind, 0] * rng.uniform(-1.0, 1.0, count)
            deviations[lifts, index] = opening[lifts]
    flat: NDArray[np.float64] = deviations.reshape(count, NUM_JOINTS)
    return flat
