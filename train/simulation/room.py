"""The simulated capture room: hands and an object move, cameras see them, an optical system makes a take."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from gloves.optics.identities import number_runs, pack_columns
from gloves.optics.reconstruction import Reconstruction, reconstruct
from gloves.takes.take import RigidBody, Take
from handsim.space.rig import CameraRig
from handsim.space.transforms import transform_poses
from train.simulation.light_sources import LightSources, sample_light_sources
from train.simulation.motion import SceneMotion
from train.simulation.room_settings import RoomConfig
from train.simulation.sight import SceneSight


def record_take(
    scene: SceneMotion,
    rig: CameraRig,
    config: RoomConfig,
    settings: dict[str, Any],
    *,
    rng: np.random.Generator,
) -> Take:
    """What the optical system puts out of hands and an object in motion, with the truth.

    Args:
        scene: What moves: T frames of one or more gloved hands and perhaps an object.
        rig: C cameras around them.
        settings: Kept in the take as they are.

    Raises:
        ArgumentError: A camera stands in the hands.
    """
    sources = sample_light_sources(SceneSight(scene, rig), config, rng=rng)
    return pack_take(scene, sources, rig, config, settings, rng=rng)


def pack_take(
    scene: SceneMotion,
    sources: LightSources,
    rig: CameraRig,
    config: RoomConfig,
    settings: dict[str, Any],
    *,
    rng: np.random.Generator,
) -> Take:
    """A take of points triangulated from light sources, in columns and with IDs that do not tell the marker.

    Args:
        sources: What shines.
        settings: Kept in the take as they are.
    """
    optics = config.optics
    found = reconstruct(
        sources.positions, sources.visible, rig, optics, radii=sources.radii, continuous=True, rng=rng
    )
    false_labels = label_false_points(found, sources.positions, sources.labels, optics.max_residual)
    labels = np.hstack([np.tile(sources.labels, (scene.num_frames, 1)), false_labels])
    order = rng.permutation(labels.shape[1])  # neither IDs nor columns may tell what a point comes from
    positions = np.concatenate([found.positions, found.false_points], axis=1)[:, order]
    labels = labels[:, order]
    present = np.isfinite(positions).all(axis=-1)
    columns, count = pack_columns(present, rng=rng)
    frame, source = np.nonzero(present)
    column = columns[frame, source]
    points = np.full((scene.num_frames, count, 3), np.nan)
    ids, truth = np.full((2, scene.num_frames, count), -1)
    points[frame, column] = positions[frame, source]
    ids[frame, column] = number_runs(present)[frame, source]
    truth[frame, column] = labels[frame, source]
    held = scene.moving_object
    thing = None if held is None else held.rigid_object
    return Take.of_truth(
        [hand.fit for hand in scene.hands],
        np.stack([hand.qpos for hand in scene.hands], axis=1),
        points,
        ids,
        truth,
        rate=scene.rate,
        bodies=() if thing is None else (RigidBody(thing.name, thing.marker_names, thing.markers),),
        body_poses=None if held is None else transform_poses(held.motion.T_world_body)[:, None],
        settings=settings,
    )


def label_false_points(
    found: Reconstruction,
    positions: Float[np.ndarray, "T S 3"],
    labels: Int[np.ndarray, "S"],
    max_distance: float,
) -> Int[np.ndarray, "T F"]:
    """Labels of false points: the nearest marker that has no other point, -1 where none is near enough [m].

    A person who labels a capture takes such a point for the marker, although it is a little off.
    """
    false_labels = np.full(found.false_points.shape[:2], -1)
    markers = np.flatnonzero(labels >= 0)
    for frame in np.flatnonzero(np.isfinite(found.false_points[..., 0]).any(axis=1)):
        missing = markers[found.rays[frame, markers] == 0]
        distance = np.linalg.norm(found.false_points[frame, :, None] - positions[frame, missing], axis=-1)
        distance[~(distance < max_distance)] = np.inf
        while distance.size and np.isfinite(distance.min()):
            point, marker = np.unravel_index(distance.argmin(), distance.shape)
            false_labels[frame, point] = labels[missing[marker]]
            distance[point], distance[:, marker] = np.inf, np.inf
    runs = number_runs(np.isfinite(found.false_points[..., 0]))
    for run in np.unique(runs[false_labels >= 0]):  # an ID stands for one marker, or for none, all its life
        if len(np.unique(false_labels[runs == run])) > 1:
            false_labels[runs == run] = -1
    return false_labels
