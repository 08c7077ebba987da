"""Training frames: one person's gloved hands in random poses, as a rig and its optical system see them."""

from __future__ import annotations

import dataclasses
from collections import Counter
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from gloves.optics.ghosts import GHOST_REACH, GhostConfig, keep_some, sample_ghosts
from gloves.optics.mesh_sight import clear_of_body
from gloves.optics.mesh_tree import MeshTree
from gloves.optics.reconstruction import OpticsConfig, reconstruct
from gloves.optics.visibility import pack_cameras, visible_cameras
from handsim.hand.model import HandModel
from handsim.hand.shape import SIDES
from handsim.space.objects import named_object
from handsim.space.rig import CameraRig
from poses.shapes.sampling import checked_sampler
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import FrameScene, sample_frame_scene
from train.simulation.people import wear_gloves

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
