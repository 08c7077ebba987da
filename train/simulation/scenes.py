"""Single frames for training: a hand alone, two hands that touch, a hand that holds something."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gloves.attachment import Attachment
from gloves.optics.ghosts import GHOST_REACH, GhostConfig, keep_some, sample_ghosts
from gloves.optics.mesh_sight import clear_of_body
from gloves.optics.mesh_tree import MeshTree
from gloves.optics.reconstruction import OpticsConfig, reconstruct
from gloves.optics.visibility import pack_cameras, visible_cameras
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.space.cameras import ROOM_CENTER, CameraRig
from handsim.space.objects import RigidObject, named_object, object_names
from handsim.space.transforms import random_quaternions
from poses.contact.two_hands import sample_two_hand_poses
from poses.grasps.grasp_scene import wrist_poses
from poses.grasps.object_motion import sample_held_poses, settle_hold
from poses.shapes.samplers import PoseMix
from poses.shapes.validity import sample_valid_angles

if TYPE_CHECKING:
    from jaxtyping import Float


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


class Scene(NamedTuple):
    """Frames of one or two hands, and perhaps a thing."""

    hands: tuple[HandModel, ...]
    qpos: tuple[Float[np.ndarray, "T 27"], ...]
    thing: RigidObject | None = None
    T_world_thing: Float[np.ndarray, "T 4 4"] | None = None


class Sight(NamedTuple):
    """What a rig and its system make of one hand of a scene."""

    markers: Float[np.ndarray, "T M 3"]
    """True centers [m]."""
    cameras: Float[np.ndarray, "T M"]
    """Cameras with a free view, a bit each."""
    observed: Float[np.ndarray, "T M 3"]
    """Where the system puts each marker [m], NaN where it loses it."""
    ghosts: Float[np.ndarray, "T 4 3"]
    """[m], NaN where there is none."""


def alone(hand: HandModel, count: int, mix: PoseMix, volume: float, *, rng: np.random.Generator) -> Scene:
    """Poses of one hand, turned every way, in a cube of half side `volume` [m]."""
    position = ROOM_CENTER + rng.uniform(-volume, volume, size=(count, 3))
    angles = sample_valid_angles(hand, count, mix, rng=rng)
    return Scene(
        (hand,), (join_qpos(angles, position=position, quaternion=random_quaternions(count, rng=rng)),)
    )


def together(right: HandModel, left: HandModel, count: int, *, rng: np.random.Generator) -> Scene:
    """Poses of two hands that touch."""
    return Scene((right, left), sample_two_hand_poses(right, left, count, rng=rng))


def holding(hand: HandModel, count: int, volume: float, *, rng: np.random.Generator) -> Scene:
    """Poses of a hand that holds one of the objects.

    Raises:
        ArgumentError: The hand does not get hold of it.
    """
    names = object_names()
    thing = named_object(names[rng.integers(len(names))])
    angles, T_wrist_thing = sample_held_poses(hand, thing, settle_hold(hand, thing, rng=rng), count, rng=rng)
    position = ROOM_CENTER + rng.uniform(-volume, volume, size=(count, 3))
    quaternion = random_quaternions(count, rng=rng)
    qpos = join_qpos(angles, position=position, quaternion=quaternion)
    return Scene((hand,), (qpos,), thing, wrist_poses(qpos) @ T_wrist_thing)


def watch(
    scene: Scene,
    gloves: tuple[Attachment, ...],
    rig: CameraRig,
    optics: OpticsConfig,
    ghosts: GhostConfig,
    *,
    rng: np.random.Generator,
) -> tuple[Sight, ...]:
    """What the rig sees of every hand past hands (capsules) and thing, and what the system makes of it."""
    bones = [hand.forward_kinematics(qpos) for hand, qpos in zip(scene.hands, scene.qpos, strict=True)]
    worn = [glove.markers(hand, bone) for glove, hand, bone in zip(gloves, scene.hands, bones, strict=True)]
    markers, normals = (np.concatenate(parts, axis=1) for parts in zip(*worn, strict=True))
    posed = [hand.capsules.posed(bone) for hand, bone in zip(scene.hands, bones, strict=True)]
    segments = np.concatenate(posed, axis=1)
    radii = np.concatenate([hand.capsules.radii for hand in scene.hands])
    seen = visible_cameras(markers, normals, rig, segments, radii)
    if scene.thing is not None and scene.T_world_thing is not None:
        seen = clear_of_body(_tree(scene.thing.name), scene.T_world_thing, markers, rig.positions, seen)
    found = reconstruct(markers, seen, rig, optics, continuous=False, rng=rng)
    cameras, sights = pack_cameras(seen), []
    for number, (centers, _) in enumerate(worn):
        mine = slice(number * centers.shape[1], (number + 1) * centers.shape[1])
        strays = sample_ghosts(centers, rig, segments, radii, ghosts, min_cameras=optics.min_rays, rng=rng)
        off = np.linalg.norm(found.false_points[:, :, None] - centers[:, None], axis=-1).min(axis=2)
        near = np.where((off < GHOST_REACH)[..., None], found.false_points, np.nan)
        chosen = keep_some(np.concatenate([strays, near], axis=1), rng=rng)
        sights.append(Sight(centers, cameras[:, mine], found.positions[:, mine], chosen))
    return tuple(sights)


@cache
def _tree(name: str) -> MeshTree:
    thing = named_object(name)
    return MeshTree(thing.vertices, thing.faces)
