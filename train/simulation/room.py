"""The simulated capture room: hands and an object move, cameras see, an optical system makes points of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from gloves.fit import GlovedHand
from gloves.optics.identities import number_runs, pack_columns
from gloves.optics.mesh_sight import clear_of_body, clear_of_mesh
from gloves.optics.mesh_tree import MeshTree, hand_tree
from gloves.optics.mirrors import cameras_by_mirror, reflect
from gloves.optics.reconstruction import OpticsConfig, Reconstruction, reconstruct
from gloves.optics.strays import StrayConfig, sample_strays
from gloves.optics.visibility import facing_cameras, free_rays
from gloves.takes.take import HeldBody, Take
from handsim.hand.motion import BodyMotion
from handsim.hand.topology import PALM
from handsim.space.cameras import CameraRig, check_outside
from handsim.space.objects import RigidObject

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_CHUNK: Final = 256  # frames whose lines of sight are in memory at once
_SKINS: Final = 16  # and their skins: so few stay in the processor's cache
_FEWEST_OF_A_BODY: Final = 3  # markers without which an object cannot be tracked as a rigid body


@dataclass(frozen=True, slots=True, eq=False)
class Prop:
    """An object in the room."""

    thing: RigidObject
    motion: BodyMotion


@dataclass(frozen=True, slots=True)
class RoomConfig:
    """What the room does to what is seen."""

    optics: OpticsConfig = field(default_factory=OpticsConfig)
    strays: StrayConfig = field(default_factory=StrayConfig)
    """Carried by every hand and by the object."""
    reflectance: float = 0.5
    """Share of the mirror images in shiny patches that are bright enough."""


class Sources(NamedTuple):
    """All that shines in a room."""

    places: Float[np.ndarray, "T S 3"]
    """[m] in the world."""
    seen: Bool[np.ndarray, "T S C"]
    """Cameras with a free view."""
    labels: Int[np.ndarray, "S"]
    """Marker of each, -1 for what is none."""


class Room:
    """Hands, perhaps an object, and cameras around them.

    Args:
        hands: The hands; all motions have one length.
        prop: The object, if there is one.
        rig: The cameras.
        config: Noise, strays and mirrors.
        rate: Frames per second [Hz] of all motions.
    """

    def __init__(
        self,
        hands: tuple[GlovedHand, ...],
        prop: Prop | None,
        rig: CameraRig,
        config: RoomConfig,
        *,
        rate: float = 120.0,
    ) -> None:
        self.hands, self.prop, self.rig, self.config = hands, prop, rig, config
        self.rate = rate
        self.num_frames = len(hands[0].qpos)
        self._bones = [hand.fit.model.forward_kinematics(hand.qpos) for hand in hands]

    @cached_property
    def markers(self) -> tuple[Float[np.ndarray, "T P 3"], Float[np.ndarray, "T P 3"]]:
        """Centers [m] and outward directions of the hands' markers and then of the object's."""
        worn = [
            hand.fit.attachment.markers(hand.fit.model, bone)
            for hand, bone in zip(self.hands, self._bones, strict=True)
        ]
        if self.prop is not None:
            thing, pose = self.prop.thing, self.prop.motion.T_world_body
            centers = np.einsum("tij,qj->tqi", pose[:, :3, :3], thing.markers) + pose[:, None, :3, 3]
            worn.append((centers, np.einsum("tij,qj->tqi", pose[:, :3, :3], thing.marker_normals)))
        centers, normals = (np.concatenate(parts, axis=1) for parts in zip(*worn, strict=True))
        return centers, normals

    @cached_property
    def _capsules(self) -> tuple[Float[np.ndarray, "T K 2 3"], Float[np.ndarray, "K"]]:
        capsules = [hand.fit.model.capsules for hand in self.hands]
        posed = [flesh.posed(bone) for flesh, bone in zip(capsules, self._bones, strict=True)]
        radii = [flesh.radii for flesh in capsules]
        return np.concatenate(posed, axis=1), np.concatenate(radii)

    def take(self, settings: dict[str, Any], *, rng: np.random.Generator) -> Take:
        """What the optical system puts out, with the truth; `settings` are kept with it."""
        sources = self.sources(rng=rng)
        found = reconstruct(
            sources.places, sources.seen, self.rig, self.config.optics, continuous=True, rng=rng
        )
        owned = _owned(found, sources.places, sources.labels, self.config.optics.max_residual)
        labels = np.hstack([np.tile(sources.labels, (self.num_frames, 1)), owned])
        order = rng.permutation(labels.shape[1])  # neither IDs nor columns may tell what a point comes from
        positions = np.concatenate([found.positions, found.false_points], axis=1)[:, order]
        labels = labels[:, order]
        present = np.isfinite(positions).all(axis=-1)
        columns, count = pack_columns(present, rng=rng)
        frame, source = np.nonzero(present)
        column = columns[frame, source]
        points = np.full((self.num_frames, count, 3), np.nan)
        ids, truth = np.full((2, self.num_frames, count), -1)
        points[frame, column] = positions[frame, source]
        ids[frame, column] = number_runs(present)[frame, source]
        truth[frame, column] = labels[frame, source]
        body = None
        if self.prop is not None:
            thing = self.prop.thing
            body = HeldBody(thing.name, thing.marker_names, self.prop.motion.T_world_body)
        return Take(self.rate, points, ids, truth, self.hands, body, settings)

    def sources(self, *, rng: np.random.Generator) -> Sources:
        """All that shines, and which cameras have a free view of it.

        Raises:
            ArgumentError: A camera stands in the hands.
        """
        markers, _ = self.markers
        check_outside(self.rig, markers)
        labels = np.arange(markers.shape[1])
        if self.prop is not None and len(self.prop.thing.markers) < _FEWEST_OF_A_BODY:
            labels[len(labels) - len(self.prop.thing.markers) :] = -1  # points like any other: ghosts
        parts = [Sources(markers, self.markers_seen(rng=rng), labels), *self._images(rng), *self._strays(rng)]
        places, seen, label = zip(*parts, strict=True)
        return Sources(np.concatenate(places, 1), np.concatenate(seen, 1), np.concatenate(label))

    def markers_seen(self, *, rng: np.random.Generator) -> Bool[np.ndarray, "T P C"]:
        """Which cameras have a free view of each marker, past every skin and the object."""
        markers, normals = self.markers
        reach = self.config.optics.partial * self.config.optics.marker_radius
        seen = np.empty((*markers.shape[:2], len(self.rig.positions)), dtype=bool)
        for first in range(0, self.num_frames, _CHUNK):
            part = slice(first, first + _CHUNK)
            wanted = facing_cameras(markers[part], normals[part], self.rig)
            starts = markers[part, :, None] + _in_ball(wanted.shape, reach, rng)
            for begin in range(0, len(wanted), _SKINS):
                few = slice(begin, begin + _SKINS)
                frames = slice(first + begin, first + begin + _SKINS)
                seen[frames] = self._past_all(frames, starts[few], wanted[few])
        return seen

    def _past_all(
        self, frames: slice, starts: Float[np.ndarray, "t P C 3"], wanted: Bool[np.ndarray, "t P C"]
    ) -> Bool[np.ndarray, "t P C"]:
        """Which wanted lines from the starts to the cameras pass every skin and the object."""
        clear = wanted
        for hand in self.hands:
            vertices = hand.fit.model.skin(hand.qpos[frames])
            clear = clear_of_mesh(hand_tree(), vertices, starts, self.rig.positions, clear)
        for tree, poses in self._bodies:
            clear = clear_of_body(tree, poses[frames], starts, self.rig.positions, clear)
        return clear

    @cached_property
    def _bodies(self) -> list[tuple[MeshTree, Float[np.ndarray, "T 4 4"]]]:
        if self.prop is None:
            return []
        thing = self.prop.thing
        return [(MeshTree(thing.vertices, thing.faces), self.prop.motion.T_world_body)]

    def _images(self, rng: np.random.Generator) -> list[Sources]:
        """Mirror images of all markers in the object's shiny patches, those that a camera ever sees."""
        markers, _ = self.markers
        parts: list[Sources] = []
        if self.prop is None:
            return parts
        turn, shift = self.prop.motion.T_world_body[:, :3, :3], self.prop.motion.T_world_body[:, :3, 3]
        for patch in self.prop.thing.shiny:
            point, normal = turn @ patch[:3] + shift, turn @ patch[3:6]
            bright = np.flatnonzero(rng.random(markers.shape[1]) < self.config.reflectance)
            images = reflect(markers[:, bright], point[:, None], normal[:, None])
            seen = cameras_by_mirror(images, point, normal, patch[6], self.rig, *self._capsules)
            ever = seen.any(axis=(0, 2))
            parts.append(Sources(images[:, ever], seen[:, ever], np.full(int(ever.sum()), -1)))
        return parts

    def _strays(self, rng: np.random.Generator) -> list[Sources]:
        """Strays carried by hands and object, where nothing stands between them and a camera."""
        carriers = [
            (bone[:, PALM], np.array([0.6 * hand.fit.model.skeleton.lengths[PALM], 0.0, 0.0]))
            for hand, bone in zip(self.hands, self._bones, strict=True)
        ]
        if self.prop is not None:
            carriers.append((self.prop.motion.T_world_body, np.zeros(3)))
        parts = []
        for pose, middle in carriers:
            places, seen = sample_strays(
                pose, middle, self.config.strays, rate=self.rate, num_cameras=len(self.rig.positions), rng=rng
            )
            segments, radii = self._capsules
            seen &= self.rig.in_view(places) & free_rays(places, self.rig.positions, segments, radii)
            parts.append(Sources(places, seen, np.full(places.shape[1], -1)))
        return parts


def _in_ball(
    shape: tuple[int, ...], radius: float, rng: np.random.Generator
) -> Float[np.ndarray, "*shape 3"]:
    """Random offsets in a ball [m]."""
    offsets = rng.standard_normal((*shape, 3), dtype=np.float32)
    length = np.sqrt(np.einsum("...i,...i->...", offsets, offsets))
    reach = radius * np.cbrt(rng.random(shape, dtype=np.float32)) / np.maximum(length, 1e-12)
    offsets *= reach[..., None]
    return offsets


def _owned(
    found: Reconstruction, places: Float[np.ndarray, "T S 3"], labels: Int[np.ndarray, "S"], reach: float
) -> Int[np.ndarray, "T F"]:
    """Labels of false points: the marker within reach [m] that has no other point, -1 for none.

    Whoever labels a capture by hand takes such a point for the marker, a little off as it is.
    """
    owned = np.full(found.false_points.shape[:2], -1)
    markers = np.flatnonzero(labels >= 0)
    for frame in np.flatnonzero(np.isfinite(found.false_points[..., 0]).any(axis=1)):
        missing = markers[found.rays[frame, markers] == 0]
        off = np.linalg.norm(found.false_points[frame, :, None] - places[frame, missing], axis=-1)
        off[~(off < reach)] = np.inf
        while off.size and np.isfinite(off.min()):
            point, marker = np.unravel_index(off.argmin(), off.shape)
            owned[frame, point] = labels[missing[marker]]
            off[point], off[:, marker] = np.inf, np.inf
    runs = number_runs(np.isfinite(found.false_points[..., 0]))
    for run in np.unique(runs[owned >= 0]):  # an ID is one marker's for as long as it lasts, or none's
        if len(np.unique(owned[runs == run])) > 1:
            owned[runs == run] = -1
    return owned
