"""Simulates a capture room: light sources, the cameras that see them, and the recorded take.

The frequencies of camera dropouts and reflections are fitted to the four test captures of Han et al. 2018: to
Table 3 and to the ghost ratios of Table 4 (docs/room.md has the numbers).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Final, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.optics.ghosts import StrayConfig, cameras_by_mirror, reflect, sample_strays
from gloves.optics.reconstruction import OpticsConfig, Reconstruction, number_runs, pack_columns, reconstruct
from gloves.optics.visibility import (
    MeshTree,
    clear_of_body,
    clear_of_mesh,
    facing_cameras,
    free_rays,
    hand_tree,
)
from gloves.takes.bodies import RigidBody
from gloves.takes.take import Take
from handsim.hand.shape import PALM
from handsim.settings import Limits, Settings
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import CameraRig, check_outside
from handsim.space.transforms import transform_poses
from train.simulation.scenes import SceneMotion, SimulatedKind

SKIN_CHUNK: Final = 16
"""Number of frames whose skins are posed together, few enough for the processor's cache."""
_CHUNK: Final = 256  # number of frames whose lines of sight are in memory together
Group = TypeVar("Group", OpticsConfig, StrayConfig)
_MIN_BODY_MARKERS: Final = 3  # An object needs this many markers to be tracked as a rigid body.

_SIMILAR_KIND: Final[dict[str, str]] = {"real-like": "hand-hand", "free": "single-hand"}


@dataclass(frozen=True, slots=True)
class RoomConfig(Settings):
    """The optical system, stray reflections and shiny surfaces of a room."""

    optics: OpticsConfig = field(default_factory=OpticsConfig)
    """Noise, losses and triangulation of the optical system."""
    strays: StrayConfig = field(default_factory=StrayConfig)
    """Stray reflections on every hand and on the object."""
    reflectance: Annotated[float, Limits(0.0, 1.0)] = 0.5
    """Share of the mirror images in shiny patches that are bright enough to be seen."""


def with_given(group: Group, options: StrayOptions | OpticsOptions) -> Group:
    """Replace the settings of a group by those options that are not None, and validate them."""
    given = {name: value for name, value in dataclasses.asdict(options).items() if value is not None}
    return dataclasses.replace(group, **given)


@dataclass(frozen=True, slots=True)
class StrayOptions(Settings):
    """Fields of `StrayConfig`; the default of each is fitted to the kind of capture."""

    number: float | None = None
    """Mean number of reflecting spots on each hand and the object."""
    shown: float | None = None
    """Mean time that a spot reflects [s]."""
    hidden: float | None = None
    """Mean time between two flashes of a spot [s]."""


@dataclass(frozen=True, slots=True)
class OpticsOptions(Settings):
    """The fields of `OpticsConfig`; the default of each is fitted to the kind of capture."""

    noise: float | None = None
    """Standard deviation of a blob's center per axis [px], for a sphere of 3.2 mm radius."""
    marker_radius: float | None = None
    """Radius of the glove's spheres [m]; the layout's when not given."""
    roundness: float | None = None
    """Two touching blobs count as one marker within this share of the sum of their radii."""
    max_residual: float | None = None
    """Largest distance of a ray from its point [m]."""
    min_angle: float | None = None
    """Smallest angle between two rays that alone make a point [deg]."""
    min_distance: float | None = None
    """Closer points are merged [m]."""
    partial: float | None = None
    """Visible spots lie within this share of a marker's radius, randomly for each camera."""
    blob_loss: float | None = None
    """Probability that a camera misses a blob."""
    dropout: float | None = None
    """Probability per frame that cameras begin to lose their pictures."""
    dropout_length: float | None = None
    """Mean number of pictures lost in a row."""
    dropout_cameras: int | None = None
    """Number of cameras that lose pictures together."""
    min_rays: int | None = None
    """Number of rays that must meet for a point."""
    min_rays_to_start: int | None = None
    """Number of rays that must meet for a point that was not there in the frame before."""

    def applied(self, optics: OpticsConfig) -> OpticsConfig:
        """Replace settings of the optics by these options, and validate them."""
        return with_given(optics, self)


class Twin(NamedTuple):
    """Settings of a simulated capture that make it similar to one of the paper's."""

    num_frames: int
    """Number of frames of the paper's capture (Table 3)."""
    room: RoomConfig
    draw: int
    """Number of the random capture of this kind that is nearest to the paper's figures."""

    @classmethod
    def of(cls, num_frames: int, strays: float, losses: tuple[float, float, float, int], draw: int) -> Twin:
        """A twin, from its number of stray reflections and four settings of losses."""
        names = ("blob_loss", "dropout", "dropout_length", "dropout_cameras")
        optics = OpticsConfig(min_rays_to_start=2, **dict(zip(names, losses, strict=True)))  # type: ignore[arg-type]
        return cls(num_frames, RoomConfig(optics=optics, strays=StrayConfig(number=strays)), draw)


TWINS: Final[dict[str, Twin]] = {
    "single-hand": Twin.of(4785, 0.0, (0.01, 0.016, 2.2, 6), draw=8),
    "hand-hand": Twin.of(3312, 7.0, (0.002, 0.35, 1.5, 4), draw=8),
    "hand-pen": Twin.of(4511, 3.0, (0.002, 0.17, 1.4, 6), draw=15),
    "hand-controller": Twin.of(2645, 1.7, (0.115, 0.0, 1.0, 1), draw=2),
}


def usual_room(kind: SimulatedKind) -> RoomConfig:
    """The room of the paper's capture of this kind, or of the most similar kind."""
    return RoomConfig() if kind == "calibration" else TWINS[_SIMILAR_KIND.get(kind, kind)].room


class SceneSight:
    """Positions of a scene's markers, and the cameras of a rig with a free view of each."""

    def __init__(self, scene: SceneMotion, rig: CameraRig) -> None:
        self.scene, self.rig = scene, rig
        self.T_world_bone = [hand.fit.model.forward_kinematics(hand.qpos) for hand in scene.hands]
        """Bone frames (T, L, 4, 4) of each hand [m]."""

    @cached_property
    def markers(self) -> tuple[Float[np.ndarray, "T P 3"], Float[np.ndarray, "T P 3"]]:
        """Centers [m] and outward unit directions of the hands' markers, the forearms', and the object's."""
        parts = [
            hand.fit.attachment.markers(hand.fit.model, bones)
            for hand, bones in zip(self.scene.hands, self.T_world_bone, strict=True)
        ]
        for part, moved in zip(parts, self.scene.skin, strict=False):
            part[0][:] += moved
        bodies = [(arm.T_world_body, arm.body.positions, arm.normals) for arm in self.scene.forearms]
        held = self.scene.moving_object
        if held is not None:
            thing = held.rigid_object
            bodies.append((held.T_world_body, thing.markers, thing.marker_normals))
        for pose, places, outward in bodies:
            rotation = pose[:, :3, :3]
            centers = np.einsum("tij,qj->tqi", rotation, places) + pose[:, None, :3, 3]
            parts.append((centers, np.einsum("tij,qj->tqi", rotation, outward)))
        centers, normals = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        return centers, normals

    @cached_property
    def capsules(self) -> tuple[Float[np.ndarray, "T K 2 3"], Float[np.ndarray, "K"]]:
        """Segments [m] and radii [m] of all hands' capsules in the world."""
        capsules = [hand.fit.model.capsules for hand in self.scene.hands]
        posed = [part.posed(bones) for part, bones in zip(capsules, self.T_world_bone, strict=True)]
        return np.concatenate(posed, axis=1), np.concatenate([part.radii for part in capsules])

    @cached_property
    def obstacles(self) -> list[tuple[MeshTree, Float[np.ndarray, "T 4 4"]]]:
        """Meshes of the rigid objects that hide markers, and their poses `T_world_body`."""
        held = self.scene.moving_object
        if held is None:
            return []
        return [(MeshTree(held.rigid_object.vertices, held.rigid_object.faces), held.T_world_body)]

    def free_of_hands(self, points: Float[np.ndarray, "T S 3"]) -> Bool[np.ndarray, "T S C"]:
        """Which cameras see points [m] that are not hidden by a hand's capsules."""
        free = self.rig.in_view(points) & free_rays(points, self.rig.positions, *self.capsules)
        return np.asarray(free)

    def visible_markers(
        self, radii: Float[np.ndarray, "P"], *, rng: np.random.Generator
    ) -> Bool[np.ndarray, "T P C"]:
        """Which cameras see a random spot of each marker, within a radius [m] of its center."""
        markers, normals = self.markers
        seen = np.empty((*markers.shape[:2], len(self.rig.positions)), dtype=bool)
        for first in range(0, self.scene.num_frames, _CHUNK):
            part = slice(first, first + _CHUNK)
            facing = facing_cameras(markers[part], normals[part], self.rig)
            starts = markers[part, :, None] + _random_offsets(facing.shape, radii, rng)
            for begin in range(0, len(facing), SKIN_CHUNK):
                few = slice(begin, begin + SKIN_CHUNK)
                frames = slice(first + begin, first + begin + SKIN_CHUNK)
                seen[frames] = self.clear_lines(frames, starts[few], facing[few])
        return seen

    def clear_lines(
        self, frames: slice, starts: Float[np.ndarray, "t P C 3"], candidates: Bool[np.ndarray, "t P C"]
    ) -> Bool[np.ndarray, "t P C"]:
        """Which candidate lines from the starts [m] to the cameras meet neither skin nor object."""
        clear = candidates
        for hand in self.scene.hands:
            vertices = hand.fit.model.skin(hand.qpos[frames])
            clear = clear_of_mesh(hand_tree(), vertices, starts, self.rig.positions, clear)
        for tree, poses in self.obstacles:
            clear = clear_of_body(tree, poses[frames], starts, self.rig.positions, clear)
        return clear


def _random_offsets(
    shape: tuple[int, int, int], radii: Float[np.ndarray, "P"], rng: np.random.Generator
) -> Float[np.ndarray, "*shape 3"]:
    """Random offsets in balls; `radii` [m] belong to the sources along the second axis."""
    offsets = rng.standard_normal((*shape, 3), dtype=np.float32)
    length = np.sqrt(np.einsum("...i,...i->...", offsets, offsets))
    scale = radii.astype(np.float32)[:, None] * np.cbrt(rng.random(shape, dtype=np.float32))
    scale /= np.maximum(length, 1e-12)
    offsets *= scale[..., None]
    return offsets


class LightSources(NamedTuple):
    """The light sources of a room: markers, their mirror images in shiny objects, and stray reflections."""

    positions: Float[np.ndarray, "T S 3"]
    """Centers in the world [m]."""
    visible: Bool[np.ndarray, "T S C"]
    """Which cameras have a free view."""
    labels: Int[np.ndarray, "S"]
    """Marker of each source; -1 if it is not a marker."""
    radii: Float[np.ndarray, "S"]
    """Radii of the sources [m]."""


def sample_light_sources(sight: SceneSight, config: RoomConfig, *, rng: np.random.Generator) -> LightSources:
    """Collect the light sources of a scene, and find the cameras that see them."""
    markers, _ = sight.markers
    check_outside(sight.rig, markers)
    labels, held = np.arange(markers.shape[1]), sight.scene.moving_object
    count = 0 if held is None else len(held.rigid_object.markers)
    if count < _MIN_BODY_MARKERS:
        labels[len(labels) - count :] = -1  # Too few markers for a rigid body are ghosts.
    radii = marker_radii(sight.scene, config.optics)
    visible = sight.visible_markers(config.optics.partial * radii, rng=rng)
    parts = [
        LightSources(markers, visible, labels, radii),
        *mirror_images(sight, radii, config.reflectance, rng=rng),
        *stray_reflections(sight, config, rng=rng),
    ]
    if sight.scene.others is not None:
        parts.append(_unlabeled_sources(sight.scene.others, sight.free_of_hands(sight.scene.others)))
    joined = (np.concatenate(one, axis=1 if one[0].ndim > 1 else 0) for one in zip(*parts, strict=True))
    return LightSources(*joined)


def _unlabeled_sources(
    positions: Float[np.ndarray, "T S 3"], visible: Bool[np.ndarray, "T S C"]
) -> LightSources:
    """Light sources of the usual size that are no markers of a hand."""
    count = positions.shape[1]
    return LightSources(positions, visible, np.full(count, -1), np.full(count, MARKER_RADIUS))


def marker_radii(scene: SceneMotion, optics: OpticsConfig) -> Float[np.ndarray, "P"]:
    """Radii of the markers [m] as in `SceneSight.markers`; the optics may override those of the gloves."""
    layouts = [hand.fit.layout for hand in scene.hands]
    radii = [np.full(layout.num_markers, optics.radius_of(layout.radius)) for layout in layouts]
    radii += [
        np.full(len(arm.body.positions), optics.radius_of(layout.radius))
        for arm, layout in zip(scene.forearms, layouts, strict=False)
    ]
    if scene.moving_object is not None:
        radii.append(np.full(len(scene.moving_object.rigid_object.markers), MARKER_RADIUS))
    return np.concatenate(radii)


def mirror_images(
    sight: SceneSight, radii: Float[np.ndarray, "P"], reflectance: float, *, rng: np.random.Generator
) -> list[LightSources]:
    """Mirror images of markers in the object's shiny patches; a share `reflectance` is bright enough."""
    markers, _ = sight.markers
    parts: list[LightSources] = []
    if sight.scene.moving_object is None:
        return parts
    pose = sight.scene.moving_object.T_world_body
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


def stray_reflections(
    sight: SceneSight, config: RoomConfig, *, rng: np.random.Generator
) -> list[LightSources]:
    """Stray reflections on hands and object, and the cameras that see them past the hands."""
    scene = sight.scene
    carriers = [
        (bones[:, PALM], np.array([0.6 * hand.fit.model.skeleton.lengths[PALM], 0.0, 0.0]))
        for hand, bones in zip(scene.hands, sight.T_world_bone, strict=True)
    ]
    if scene.moving_object is not None:
        carriers.append((scene.moving_object.T_world_body, np.zeros(3)))
    parts = []
    for pose, middle in carriers:
        positions, visible = sample_strays(
            pose, middle, config.strays, rate=scene.rate, num_cameras=len(sight.rig.positions), rng=rng
        )
        parts.append(_unlabeled_sources(positions, visible & sight.free_of_hands(positions)))
    return parts


def record_take(
    scene: SceneMotion,
    rig: CameraRig,
    config: RoomConfig,
    settings: dict[str, Any],
    *,
    rng: np.random.Generator,
) -> Take:
    """Record a scene with an optical system, as a take with its truth and these settings.

    The points are in random columns and have random IDs.
    """
    optics, sources = config.optics, sample_light_sources(SceneSight(scene, rig), config, rng=rng)
    found = reconstruct(
        sources.positions, sources.visible, rig, optics, radii=sources.radii, continuous=True, rng=rng
    )
    false_labels = label_false_points(found, sources.positions, sources.labels, optics.max_residual)
    labels = np.hstack([np.tile(sources.labels, (scene.num_frames, 1)), false_labels])
    order = rng.permutation(labels.shape[1])  # IDs and columns must not reveal markers.
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
    bodies = [(arm.body, arm.T_world_body) for arm in scene.forearms]
    bodies += [] if held is None else [(RigidBody.of(held.rigid_object), held.T_world_body)]
    return Take.of_truth(
        [hand.fit for hand in scene.hands],
        np.stack([hand.qpos for hand in scene.hands], axis=1),
        points,
        ids,
        truth,
        rate=scene.rate,
        bodies=tuple(body for body, _ in bodies),
        body_poses=np.stack([transform_poses(poses) for _, poses in bodies], axis=1) if bodies else None,
        settings=settings,
    )


def label_false_points(
    found: Reconstruction,
    positions: Float[np.ndarray, "T S 3"],
    labels: Int[np.ndarray, "S"],
    max_distance: float,
) -> Int[np.ndarray, "T F"]:
    """Labels of false points: the nearest marker without another point, or -1 beyond `max_distance` [m].

    People who label a capture also assign such a point to the marker.
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
    for run in np.unique(runs[false_labels >= 0]):  # An ID keeps its label.
        if len(np.unique(false_labels[runs == run])) > 1:
            false_labels[runs == run] = -1
    return false_labels
