"""Gloved hands in many poses, or in a take's motion, as a rig and its optical system see them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.fit import GloveFit, attach
from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim.errors import CaptureError
from handsim.space.rig import ROOM_CENTER, CameraRig
from train.simulation.training_frames import (
    FrameScene,
    GenerateSettings,
    HandFrames,
    observe_scene,
    sample_frame_scene,
    sample_hands,
    wear_gloves,
)

_POSES_EACH: Final = 60  # of a person


class ObservedHand(NamedTuple):
    """One hand in some frames."""

    fit: GloveFit
    qpos: Float[np.ndarray, "T 27"]
    frames: HandFrames
    """What rig and optical system make of it."""


def observe_poses(
    layout: MarkerLayout, rig: CameraRig, num_frames: int, *, rng: np.random.Generator
) -> list[ObservedHand]:
    """Random people's hands in the poses and scenes of training sets, every frame by itself.

    Args:
        num_frames: Frames at least, of all hands together.

    Raises:
        LayoutError: A marker misses the skin.
    """
    config, observed, done = GenerateSettings(), [], 0
    slip, roll = config.slip_along, np.deg2rad(config.slip_around)
    while done < num_frames:
        models = sample_hands(config.population, rng=rng)
        scene = sample_frame_scene(models, _POSES_EACH, config, rng=rng)
        fits = wear_gloves(layout, scene.hands, along=slip, around=roll, rng=rng)
        hands = list(_observe(scene, fits, rig, rng))
        observed += hands
        done += sum(len(hand.qpos) for hand in hands)
    return observed


def observe_motion(
    take: Take,
    layout: MarkerLayout,
    rig: CameraRig,
    num_frames: int,
    *,
    rng: np.random.Generator,
) -> list[ObservedHand]:
    """The hands of a take in another glove, its frames evenly chosen, in the middle of the rig.

    Args:
        num_frames: Frames of each hand at most.

    Raises:
        CaptureError: There is no frame in which all hands have a pose.
        LayoutError: A marker misses the skin.
    """
    posed = np.flatnonzero(np.isfinite(take.qpos).all(axis=(1, 2)))
    if not len(posed):
        raise CaptureError("there is no frame in which every hand of the take has a pose, expected one")
    chosen = posed[np.unique(np.linspace(0, len(posed) - 1, num_frames).astype(int))]
    poses = take.qpos[chosen]
    poses[..., :3] += ROOM_CENTER - poses[..., :3].mean(axis=(0, 1))
    models = tuple(hand.model for hand in take.hands)
    fits = tuple(attach(layout, model) for model in models)
    qpos = tuple(np.ascontiguousarray(poses[:, number]) for number in range(len(models)))
    return list(_observe(FrameScene(models, qpos), fits, rig, rng))


def _observe(
    scene: FrameScene, fits: tuple[GloveFit, ...], rig: CameraRig, rng: np.random.Generator
) -> Iterator[ObservedHand]:
    config = GenerateSettings()
    # Single frames do not continue points, so that two rays are enough, as for points that exist already.
    optics = dataclasses.replace(config.optics, min_rays_to_start=config.min_cameras)
    frames = observe_scene(scene, fits, rig, optics, config.ghosts, rng=rng)
    for fit, qpos, seen in zip(fits, scene.qpos, frames, strict=True):
        yield ObservedHand(fit, qpos, seen)
