"""Training frames: one person's gloved hands in random poses, as a rig and its optical system see them."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout, list_layouts
from gloves.optics.ghosts import GHOST_REACH, GhostConfig, keep_some, sample_ghosts
from gloves.optics.reconstruction import OpticsConfig, reconstruct
from gloves.optics.visibility import MeshTree, clear_of_body, pack_cameras, visible_cameras
from handsim._checks import check_count, check_number, check_span, check_type, fill_settings
from handsim.errors import ArgumentError, DatasetError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import NUM_JOINTS, NUM_QPOS, SIDES, Population
from handsim.space.objects import RigidObject, named_object, object_names
from handsim.space.rig import ROOM_CENTER, CameraRig, list_rigs
from handsim.space.transforms import random_quaternions
from poses.grasps import sample_held_poses, settle_hold, wrist_poses
from poses.shapes import PoseMix, PoseSampler, checked_sampler, make_valid, sample_valid_angles
from poses.two_hands import sample_two_hand_poses
from train.simulation.scenes import wear_gloves

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


@dataclass(frozen=True, slots=True)
class DatasetConfig:
    """Everything that decides the bytes of a training set.

    A group of settings, such as `scenes`, may be given as a mapping of those that differ from its default:
    `scenes={"together": 0.0, "holding": 0.0}`.
    """

    glove: MarkerLayout | str | Path = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    num_frames: int = 170_330
    """Frames; the default is the paper's number."""
    seed: int = 0
    rig: CameraRig | str | Path = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    min_cameras: int = 2
    """Cameras that must see a marker before it exists."""
    frames_per_hand: int = 128
    """Poses of one hand before the next person puts on the glove."""
    slip_along: float = 0.1
    """Standard deviation of the markers' slip along the bones [bone lengths]."""
    slip_around: float = 10.0
    """The same around the bones [deg]."""
    volume: float = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    population: Population = dataclasses.field(default_factory=lambda: Population(children=0.2))
    poses: PoseMix = dataclasses.field(default_factory=PoseMix)
    sampler: PoseSampler | str | None = None
    """A pose sampler of your own for hands that are alone, instead of that mix: module:name, or the name of
    an entry point."""
    scenes: SceneMix = dataclasses.field(default_factory=SceneMix)
    ghosts: GhostConfig = dataclasses.field(default_factory=GhostConfig)
    optics: OpticsConfig = dataclasses.field(default_factory=OpticsConfig)
    blob_loss: tuple[float, float] = (0.0, 0.15)
    """Least and greatest chance that a camera misses a blob; every person draws another."""
    dropout: tuple[float, float] = (0.0, 0.4)
    """Least and greatest chance per frame that some cameras lose their pictures."""

    def __post_init__(self) -> None:
        wanted = "a MarkerLayout, or the name or path of one"
        check_type("glove", self.glove, (MarkerLayout, str, Path), wanted, list_layouts())
        wanted = "a CameraRig, or the name or path of one"
        check_type("rig", self.rig, (CameraRig, str, Path), wanted, list_rigs())
        if self.sampler is not None:
            checked_sampler(self.sampler)
        fill_settings(self)
        for name in ("num_frames", "min_cameras", "frames_per_hand"):
            check_count(name, getattr(self, name), 1, error=DatasetError)
        check_count("seed", self.seed, 0, error=DatasetError)
        check_number("slip_along", self.slip_along, 0.0, 1.0)
        check_number("slip_around", self.slip_around, 0.0, 90.0)
        check_number("volume", self.volume, 0.0, 10.0)
        for name in ("blob_loss", "dropout"):
            check_span(name, getattr(self, name))
            if getattr(self, name)[1] > 1.0:
                raise DatasetError(f"{name} is {getattr(self, name)}, expected chances from 0 to 1")


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


_MAX_LOST_CAMERAS: Final = 6  # that lose their pictures together


class HandFrames(NamedTuple):
    """What a rig and its optical system make of one hand of a scene."""

    markers: Float[np.ndarray, "T M 3"]
    """True centers [m]."""
    cameras: Int[np.ndarray, "T M"]
    """Cameras with a free view, a bit each."""
    observed: Float[np.ndarray, "T M 3"]
    """Where the system puts each marker [m], NaN where it loses it."""
    ghosts: Float[np.ndarray, "T 4 3"]
    """[m], NaN where there is none."""


def simulate_frames(
    block: NDArray[np.void],
    models: tuple[HandModel, ...],
    layout: MarkerLayout,
    rig: CameraRig,
    config: DatasetConfig,
    *,
    redrawn: Counter[str] | None = None,
    rng: np.random.Generator,
) -> None:
    """Fill rows with random poses of one person's gloved hands, and what rig and optical system make of them.

    Where a scene has two hands, the first half of the rows is the right hand's.

    Args:
        block: Rows to fill, see `train.data.shards.row_dtype`.
        layout: The glove on both.
        redrawn: Counts scenes that these hands could not do, by reason.
    """
    scene = sample_frame_scene(
        models,
        len(block),
        config.scenes,
        config.poses,
        config.volume,
        sampler=None if config.sampler is None else checked_sampler(config.sampler),
        redrawn=redrawn,
        rng=rng,
    )
    around = np.deg2rad(config.slip_around)
    fits = wear_gloves(layout, scene.hands, along=config.slip_along, around=around, rng=rng)
    optics = _sample_optics(config, rng)
    observed = observe_scene(scene, fits, rig, optics, config.ghosts, rng=rng)
    begin = 0
    for model, qpos, frames in zip(scene.hands, scene.qpos, observed, strict=True):
        part = block[begin : begin + len(qpos)]
        part["hand"] = SIDES.index(model.shape.side)
        part["qpos"] = qpos[: len(part)]
        for name in HandFrames._fields:
            part[name] = getattr(frames, name)[: len(part)]
        begin += len(qpos)


def _sample_optics(config: DatasetConfig, rng: np.random.Generator) -> OpticsConfig:
    """One person's optical system: how often it loses blobs and pictures."""
    return dataclasses.replace(
        config.optics,
        blob_loss=rng.uniform(*config.blob_loss),
        dropout=rng.uniform(*config.dropout),
        dropout_length=1.0,
        dropout_cameras=int(rng.integers(1, _MAX_LOST_CAMERAS + 1)),
        min_rays=config.min_cameras,
        min_rays_to_start=config.min_cameras,
    )


def observe_scene(
    scene: FrameScene,
    fits: tuple[GloveFit, ...],
    rig: CameraRig,
    optics: OpticsConfig,
    ghosts: GhostConfig,
    *,
    rng: np.random.Generator,
) -> tuple[HandFrames, ...]:
    """What the rig sees of every hand past all hands (as capsules) and the object, and what becomes of it.

    Args:
        fits: Each hand in its glove.
        ghosts: Mirror images and strays.
    """
    bones = [fit.model.forward_kinematics(qpos) for fit, qpos in zip(fits, scene.qpos, strict=True)]
    worn = [fit.attachment.markers(fit.model, frames) for fit, frames in zip(fits, bones, strict=True)]
    markers, normals = (np.concatenate(parts, axis=1) for parts in zip(*worn, strict=True))
    posed = [fit.model.capsules.posed(frames) for fit, frames in zip(fits, bones, strict=True)]
    segments = np.concatenate(posed, axis=1)
    radii = np.concatenate([fit.model.capsules.radii for fit in fits])
    visible = visible_cameras(markers, normals, rig, segments, radii)
    if scene.rigid_object is not None and scene.T_world_object is not None:
        tree = _mesh_tree(scene.rigid_object.name)
        visible = clear_of_body(tree, scene.T_world_object, markers, rig.positions, visible)
    radii_worn = np.array([optics.radius_of(fit.layout.radius) for fit in fits])
    sizes = np.repeat(radii_worn, [centers.shape[1] for centers, _ in worn])
    found = reconstruct(markers, visible, rig, optics, radii=sizes, continuous=False, rng=rng)
    cameras, hands = pack_cameras(visible), []
    for number, (centers, _) in enumerate(worn):
        columns = slice(number * centers.shape[1], (number + 1) * centers.shape[1])
        strays = sample_ghosts(centers, rig, segments, radii, ghosts, min_cameras=optics.min_rays, rng=rng)
        distance = np.linalg.norm(found.false_points[:, :, None] - centers[:, None], axis=-1).min(axis=2)
        near = np.where((distance < GHOST_REACH)[..., None], found.false_points, np.nan)
        kept = keep_some(np.concatenate([strays, near], axis=1), rng=rng)
        hands.append(HandFrames(centers, cameras[:, columns], found.positions[:, columns], kept))
    return tuple(hands)


@cache
def _mesh_tree(name: str) -> MeshTree:
    rigid_object = named_object(name)
    return MeshTree(rigid_object.vertices, rigid_object.faces)
