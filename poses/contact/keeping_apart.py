"""A hand and the object it holds, drawn back wherever either would touch the other hand."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from handsim.errors import PoseError
from handsim.hand.capsules import overlap_between
from handsim.hand.model import HandModel
from handsim.hand.motion import BodyMotion, HandMotion
from handsim.space.objects import RigidObject
from handsim.space.transforms import axis_angle_matrix
from poses.grasps.grasp_scene import object_penetration, pose_to_qpos, wrist_poses
from poses.shapes.validity import MAX_PENETRATION

_MOST_RETREATS: Final = 12
_RETREAT_STEP: Final = 0.003  # [m] beyond what is needed
_SMOOTHING: Final = 0.25  # [s] over which the pen draws back


def point_pen(
    holder: HandModel,
    other: HandModel,
    pen: RigidObject,
    held: tuple[HandMotion, BodyMotion],
    other_motion: HandMotion,
    path: Float[np.ndarray, "T 4 4"],
) -> tuple[HandMotion, BodyMotion]:
    """A pen led along a path by the hand that holds it, drawn back wherever something would touch.

    Args:
        pen: Its tip is its first marker, its body goes from there along its z axis.
        held: Motion of fingers and pen relative to the wrist; the wrist's own motion is computed here.
        path: Poses of the pen with its tip at the origin, from `pointing_path`.

    Raises:
        PoseError: Something touches even when drawn back.
    """
    motion, body = held
    T_wrist_pen = np.linalg.inv(wrist_poses(motion.qpos)) @ body.T_world_body
    T_world_pen = path @ _rotated_to_the_arm(T_wrist_pen.mean(axis=0), pen.markers[0])
    qpos = motion.qpos.copy()
    qpos[:, :7] = pose_to_qpos(T_world_pen @ np.linalg.inv(T_wrist_pen))
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
    """A hand and the object it holds, drawn back smoothly wherever either would touch the other hand."""
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
            object_penetration(other, obj, other_motion.qpos, poses),
        )  # fmt: skip
        if deep.max() <= MAX_PENETRATION:
            return HandMotion(qpos, motion.rate), BodyMotion(poses, motion.rate)
        needed = np.where(deep > 0.5 * MAX_PENETRATION, back + deep + _RETREAT_STEP, back)
        window = 2 * int(_SMOOTHING * motion.rate / 2) + 1
        back = uniform_filter1d(maximum_filter1d(needed, window), window)
    raise PoseError("the hands touch, however far one of them draws back")


def _rotated_to_the_arm(
    T_wrist_pen: Float[np.ndarray, "4 4"], tip: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Pen in the path's frame: its tip at the origin, rotated about itself until the wrist is at +x."""
    wrist = np.linalg.inv(T_wrist_pen)[:3, 3]
    away = np.arctan2(wrist[1], wrist[0])
    rotation = np.eye(4)
    rotation[:3, :3] = axis_angle_matrix(np.array([0.0, 0.0, 1.0]), np.array([-away]))[0]
    shift = np.eye(4)
    shift[:3, 3] = -tip
    return rotation @ shift
