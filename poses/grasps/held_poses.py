"""Variants of a hold: free digits lift, others tap or press, the thing tilts a little; all of them valid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handsim.errors import PoseError
from handsim.hand.model import HandModel
from handsim.hand.topology import DIGITS, NUM_JOINTS
from handsim.space.objects import RigidObject
from poses.grasps.grasp_scene import MAX_OBJECT_PENETRATION, GraspScene, grasp_scene
from poses.grasps.grasping import Hold
from poses.grasps.hold_library import HoldStyle, hold_style
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.validity import is_valid

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

_DEEPEST: Final = MAX_OBJECT_PENETRATION - 1e-6  # [m], room for rounding in the world's frame
_HALVINGS: Final = 4
_OPENS: Final = 0.55  # how often a free digit lifts
_TAPS: Final = 0.3  # how often a pressing digit lifts
_STILL: Final = 0.3  # how often the thing stays as it is
# How far a lifted digit opens at most [rad]: the thumb's four hinges; abduction (either way), MCP, PIP, DIP.
_LIFT: Final = np.deg2rad([[14.0, 30.0, 20.0, 25.0], [5.0, 45.0, 45.0, 30.0]])
_TAP: Final = np.deg2rad([[4.0, 10.0, 6.0, 8.0], [1.0, 14.0, 10.0, 6.0]])
_TREMBLE: Final = np.deg2rad([0.5, 1.2, 1.8, 1.8])  # of digits that hold
_WOBBLE: Final = (0.0006, np.deg2rad(1.2))  # of the thing in the hand: [m], [rad]


class Held(NamedTuple):
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
        PoseError: The hold is not valid, such as one of another hand.
    """
    scene, style = grasp_scene(model, obj), hold_style(model, obj, hold.name)
    start = Held(hold.angles[None], hold.T_wrist_object[None])
    if not is_held_valid(scene, start)[0]:
        raise PoseError(f"the hold '{hold.name}' is not valid for this hand and the {obj.name}")
    angles = np.clip(hold.angles + _deviations(style, count, rng), LOW, HIGH)
    poses = np.tile(hold.T_wrist_object, (count, 1, 1))
    shift, turn = (scale * rng.standard_normal((count, 3)).clip(-2.0, 2.0) for scale in _WOBBLE)
    still = rng.random(count) < _STILL
    shift[still], turn[still] = 0.0, 0.0
    poses[:, :3, 3] += shift
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    wanted = Held(angles, poses)
    # The way back to the hold is halved, so that what digs in ends where it touches.
    share = np.where(is_held_valid(scene, wanted), 1.0, 0.0)
    step = 1.0
    todo = np.flatnonzero(share == 0.0)
    for _ in range(_HALVINGS if len(todo) else 0):
        step /= 2
        nearer = between(start, Held(*(part[todo] for part in wanted)), share[todo] + step)
        share[todo] += np.where(is_held_valid(scene, nearer), step, 0.0)
    found = between(start, wanted, share)
    return found.angles, found.poses


def between(start: Held, end: Held, share: NDArray[np.float64]) -> Held:
    """Poses at shares (B,) of the way from one start to one end or to one each."""
    angles = start.angles + share[:, None] * (end.angles - start.angles)
    poses = np.tile(np.eye(4), (len(share), 1, 1))
    poses[:, :3, 3] = start.poses[:, :3, 3] + share[:, None] * (end.poses - start.poses)[:, :3, 3]
    turns = Rotation.from_rotvec(share[:, None] * turn_between(start, end)).as_matrix()
    poses[:, :3, :3] = start.poses[:, :3, :3] @ turns
    return Held(angles, poses)


def turn_between(start: Held, end: Held) -> NDArray[np.float64]:
    """Rotation vectors [rad] from one orientation of the thing to another, in its own frame."""
    between = np.swapaxes(start.poses[:, :3, :3], 1, 2) @ end.poses[:, :3, :3]
    turn: NDArray[np.float64] = Rotation.from_matrix(between).as_rotvec()
    return turn


def is_held_valid(scene: GraspScene, held: Held) -> Bool[np.ndarray, "B"]:
    """Which poses are inside all ranges and dig neither into the hand nor into the thing."""
    valid: NDArray[np.bool_] = is_valid(scene.hand, held.angles)
    valid[valid] = scene.depth(held.angles[valid], held.poses[valid]) <= _DEEPEST
    return valid


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
