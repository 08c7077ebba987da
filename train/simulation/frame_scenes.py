"""Single frames' poses for training: one hand, two hands that touch, or a hand that holds an object."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import NUM_JOINTS, NUM_QPOS
from handsim.space.objects import RigidObject, named_object, object_names
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import random_quaternions
from poses.contact.two_hands import sample_two_hand_poses
from poses.grasps.grasp_scene import wrist_poses
from poses.grasps.object_motion import sample_held_poses, settle_hold
from poses.shapes.samplers import PoseMix
from poses.shapes.sampling import PoseSampler
from poses.shapes.validity import make_valid, sample_valid_angles

NO_TOUCH: Final = "two hands: no valid pose, one hand instead"
"""Reason for which a scene of two hands becomes one of a single hand."""
NO_GRASP: Final = "held object: not grasped, empty hand instead"
"""Reason for which a scene with an object becomes one without."""


@dataclass(frozen=True, slots=True)
class SceneMix:
    """How often a person's hands are alone, together or hold something; the shares are normalized."""

    alone: float = 0.6
    together: float = 0.25
    """Two hands that touch."""
    holding: float = 0.15
    """A hand with one of the objects of `handsim.space.objects`."""

    def __post_init__(self) -> None:
        shares = dataclasses.astuple(self)
        if min(shares) < 0.0 or not 0.0 < sum(shares) < np.inf:
            raise ArgumentError(f"the shares of scenes are {shares}, expected none negative and one positive")


class FrameScene(NamedTuple):
    """Unrelated frames of one or two hands, and perhaps an object."""

    hands: tuple[HandModel, ...]
    qpos: tuple[Float[np.ndarray, "T 27"], ...]
    rigid_object: RigidObject | None = None
    T_world_object: Float[np.ndarray, "T 4 4"] | None = None


def sample_frame_scene(
    models: tuple[HandModel, ...],
    num_rows: int,
    scenes: SceneMix,
    poses: PoseMix,
    volume: float,
    *,
    sampler: PoseSampler | None = None,
    redrawn: Counter[str] | None = None,
    rng: np.random.Generator,
) -> FrameScene:
    """A random scene that fills a number of rows, which two hands share.

    Where the hands cannot do it, it is one of a hand alone, counted in `redrawn` by reason. Wrists are in a
    cube of half side `volume` [m]; a sampler replaces the poses of single hands.
    """
    shares = np.array(dataclasses.astuple(scenes))
    kind = int(rng.choice(len(shares), p=shares / shares.sum()))
    model = models[int(rng.integers(len(models)))]
    reason = NO_TOUCH if kind == 1 else NO_GRASP
    try:
        if kind == 1:
            left, right = models
            return sample_two_hands(right, left, -(-num_rows // 2), rng=rng)
        if kind == 2:
            return sample_holding_hand(model, num_rows, volume, rng=rng)
    except PoseError:
        if redrawn is not None:
            redrawn[reason] += 1
    return sample_single_hand(model, num_rows, poses, volume, sampler=sampler, rng=rng)


def sample_single_hand(
    model: HandModel,
    num_frames: int,
    poses: PoseMix,
    volume: float,
    *,
    sampler: PoseSampler | None = None,
    rng: np.random.Generator,
) -> FrameScene:
    """Poses of one hand in any orientation, in a cube of half side `volume` [m].

    The wrists are those of a sampler of whole poses, unless it leaves all of them at the origin, as
    `poses.sample_poses` does.
    """
    position = ROOM_CENTER + rng.uniform(-volume, volume, size=(num_frames, 3))
    if sampler is None:
        angles = sample_valid_angles(model, num_frames, poses, rng=rng)
    else:
        drawn = sampler(model, num_frames, rng=rng)
        angles = make_valid(model, drawn[:, -NUM_JOINTS:])
        if drawn.shape[1] == NUM_QPOS and drawn[:, :3].any():
            qpos = np.concatenate([drawn[:, :-NUM_JOINTS], angles], axis=1)
            return FrameScene((model,), (qpos,))
    quaternion = random_quaternions(num_frames, rng=rng)
    return FrameScene((model,), (join_qpos(angles, position=position, quaternion=quaternion),))


def sample_two_hands(
    right: HandModel, left: HandModel, num_frames: int, *, rng: np.random.Generator
) -> FrameScene:
    """Poses of two hands that touch.

    Raises:
        PoseError: No valid pose of these hands was found.
    """
    return FrameScene((right, left), sample_two_hand_poses(right, left, num_frames, rng=rng))


def sample_holding_hand(
    model: HandModel, num_frames: int, volume: float, *, rng: np.random.Generator
) -> FrameScene:
    """Poses of a hand that holds a random object, in a cube of half side `volume` [m].

    Raises:
        PoseError: The hand does not grasp the object.
    """
    names = object_names()
    rigid_object = named_object(names[rng.integers(len(names))])
    hold = settle_hold(model, rigid_object, rng=rng)
    angles, T_wrist_object = sample_held_poses(model, rigid_object, hold, num_frames, rng=rng)
    position = ROOM_CENTER + rng.uniform(-volume, volume, size=(num_frames, 3))
    quaternion = random_quaternions(num_frames, rng=rng)
    qpos = join_qpos(angles, position=position, quaternion=quaternion)
    return FrameScene((model,), (qpos,), rigid_object, wrist_poses(qpos) @ T_wrist_object)
