"""The light sources of a take: markers, their mirror images in shiny objects, and stray reflections."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.optics.blobs import MARKER_RADIUS
from gloves.optics.mirrors import cameras_by_mirror, reflect
from gloves.optics.reconstruction import OpticsConfig
from gloves.optics.strays import sample_strays
from gloves.optics.visibility import free_rays
from handsim.hand.shape import PALM
from handsim.space.rig import check_outside
from train.simulation.motion import SceneMotion
from train.simulation.room_settings import RoomConfig
from train.simulation.sight import SceneSight

_MIN_BODY_MARKERS: Final = 3  # markers without which an object cannot be tracked as a rigid body


class LightSources(NamedTuple):
    """All that shines in a room."""

    positions: Float[np.ndarray, "T S 3"]
    """[m] in the world."""
    visible: Bool[np.ndarray, "T S C"]
    """Cameras with a free view."""
    labels: Int[np.ndarray, "S"]
    """Marker of each source; -1 for a source that is not a marker."""
    radii: Float[np.ndarray, "S"]
    """[m]."""


def sample_light_sources(sight: SceneSight, config: RoomConfig, *, rng: np.random.Generator) -> LightSources:
    """All that shines, and which cameras have a free view of it.

    Raises:
        ArgumentError: A camera stands in the hands.
    """
    markers, _ = sight.markers
    check_outside(sight.rig, markers)
    labels = np.arange(markers.shape[1])
    moving_object = sight.scene.moving_object
    if moving_object is not None:
        count = len(moving_object.rigid_object.markers)
        if count < _MIN_BODY_MARKERS:
            labels[len(labels) - count :] = -1  # points like any other: ghosts
    radii = marker_radii(sight.scene, config.optics)
    visible = sight.visible_markers(config.optics.partial * radii, rng=rng)
    parts = [
        LightSources(markers, visible, labels, radii),
        *mirror_images(sight, radii, config.reflectance, rng=rng),
        *stray_reflections(sight, config, rng=rng),
        *markers_of_others(sight),
    ]
    all_positions, all_visible, all_labels, all_radii = zip(*parts, strict=True)
    return LightSources(
        np.concatenate(all_positions, 1),
        np.concatenate(all_visible, 1),
        np.concatenate(all_labels),
        np.concatenate(all_radii),
    )


def marker_radii(scene: SceneMotion, optics: OpticsConfig) -> Float[np.ndarray, "P"]:
    """Radii of the hands' markers, and then of the object's [m].

    Args:
        scene: Hands in their gloves, and perhaps an object.
        optics: May give the radius of all gloves' markers.
    """
    radii = [
        np.full(hand.fit.layout.num_markers, optics.radius_of(hand.fit.layout.radius)) for hand in scene.hands
    ]
    if scene.moving_object is not None:
        radii.append(np.full(len(scene.moving_object.rigid_object.markers), MARKER_RADIUS))
    return np.concatenate(radii)


def mirror_images(
    sight: SceneSight, radii: Float[np.ndarray, "P"], reflectance: float, *, rng: np.random.Generator
) -> list[LightSources]:
    """Mirror images of all markers in the object's shiny patches, those that a camera ever sees.

    Args:
        radii: Radii of all markers [m].
        reflectance: Share of the images that are bright enough.
    """
    markers, _ = sight.markers
    parts: list[LightSources] = []
    if sight.scene.moving_object is None:
        return parts
    pose = sight.scene.moving_object.motion.T_world_body
    rotation, translation = pose[:, :3, :3], pose[:, :3, 3]
    for patch in sight.scene.moving_object.rigid_object.shiny:
        point, normal = rotation @ patch[:3] + translation, rotation @ patch[3:6]
        bright = np.flatnonzero(rng.random(markers.shape[1]) < reflectance)
        images = reflect(markers[:, bright], point[:, None], normal[:, None])
        visible = cameras_by_mirror(images, point, normal, patch[6], sight.rig, *sight.capsules)
        ever = visible.any(axis=(0, 2))
        labels = np.full(int(ever.sum()), -1)
        parts.append(LightSources(images[:, ever], visible[:, ever], labels, radii[bright][ever]))
    return parts


def markers_of_others(sight: SceneSight) -> list[LightSources]:
    """Markers that belong to no hand, where no hand stands between them and a camera."""
    others, rig = sight.scene.others, sight.rig
    if others is None:
        return []
    visible = rig.in_view(others) & free_rays(others, rig.positions, *sight.capsules)
    count = others.shape[1]
    return [LightSources(others, visible, np.full(count, -1), np.full(count, MARKER_RADIUS))]


def stray_reflections(
    sight: SceneSight, config: RoomConfig, *, rng: np.random.Generator
) -> list[LightSources]:
    """Strays carried by hands and object, where nothing stands between them and a camera."""
    scene, rig = sight.scene, sight.rig
    carriers = [
        (bones[:, PALM], np.array([0.6 * hand.fit.model.skeleton.lengths[PALM], 0.0, 0.0]))
        for hand, bones in zip(scene.hands, sight.T_world_bone, strict=True)
    ]
    if scene.moving_object is not None:
        carriers.append((scene.moving_object.motion.T_world_body, np.zeros(3)))
    parts = []
    for pose, middle in carriers:
        positions, visible = sample_strays(
            pose, middle, config.strays, rate=scene.rate, num_cameras=len(rig.positions), rng=rng
        )
        visible &= rig.in_view(positions) & free_rays(positions, rig.positions, *sight.capsules)
        count = positions.shape[1]
        parts.append(LightSources(positions, visible, np.full(count, -1), np.full(count, MARKER_RADIUS)))
    return parts
