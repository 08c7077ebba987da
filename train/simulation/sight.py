"""The lines of sight of a take: where all markers are, and which cameras have a free view of each."""

from __future__ import annotations

from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.optics.mesh_sight import clear_of_body, clear_of_mesh
from gloves.optics.mesh_tree import MeshTree, hand_tree
from gloves.optics.visibility import facing_cameras
from handsim.space.rig import CameraRig
from train.simulation.motion import SceneMotion

_CHUNK: Final = 256  # frames whose lines of sight are in memory at once
SKIN_CHUNK: Final = 16
"""Frames whose skins are posed at once: so few stay in the processor's cache."""


class SceneSight:
    """What a rig can see of hands and an object in motion."""

    def __init__(self, scene: SceneMotion, rig: CameraRig) -> None:
        self.scene, self.rig = scene, rig
        self.T_world_bone = [hand.fit.model.forward_kinematics(hand.qpos) for hand in scene.hands]
        """Bone frames (T, L, 4, 4) of each hand [m]."""

    @cached_property
    def markers(self) -> tuple[Float[np.ndarray, "T P 3"], Float[np.ndarray, "T P 3"]]:
        """Centers [m] and outward unit directions of the hands' markers and then of the object's."""
        parts = [
            hand.fit.attachment.markers(hand.fit.model, bones)
            for hand, bones in zip(self.scene.hands, self.T_world_bone, strict=True)
        ]
        for part, moved in zip(parts, self.scene.skin, strict=False):
            part[0][:] += moved
        if self.scene.moving_object is not None:
            rigid_object, pose = (
                self.scene.moving_object.rigid_object,
                self.scene.moving_object.motion.T_world_body,
            )
            rotation = pose[:, :3, :3]
            centers = np.einsum("tij,qj->tqi", rotation, rigid_object.markers) + pose[:, None, :3, 3]
            parts.append((centers, np.einsum("tij,qj->tqi", rotation, rigid_object.marker_normals)))
        centers, normals = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        return centers, normals

    @cached_property
    def capsules(self) -> tuple[Float[np.ndarray, "T K 2 3"], Float[np.ndarray, "K"]]:
        """Segments [m] and radii [m] of all hands' capsules in the world."""
        capsules = [hand.fit.model.capsules for hand in self.scene.hands]
        posed = [part.posed(bones) for part, bones in zip(capsules, self.T_world_bone, strict=True)]
        radii = [part.radii for part in capsules]
        return np.concatenate(posed, axis=1), np.concatenate(radii)

    @cached_property
    def obstacles(self) -> list[tuple[MeshTree, Float[np.ndarray, "T 4 4"]]]:
        """Meshes of the rigid objects that hide markers, and their poses `T_world_body`."""
        if self.scene.moving_object is None:
            return []
        rigid_object = self.scene.moving_object.rigid_object
        tree = MeshTree(rigid_object.vertices, rigid_object.faces)
        return [(tree, self.scene.moving_object.motion.T_world_body)]

    def visible_markers(
        self, radii: Float[np.ndarray, "P"], *, rng: np.random.Generator
    ) -> Bool[np.ndarray, "T P C"]:
        """Which cameras have a free view of each marker, past every skin and the object.

        Args:
            radii: Radius around each marker's center in which the visible spot lies [m].
        """
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
        """Which candidate lines from the starts [m] to the cameras pass every skin and the object."""
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
    """Random offsets in balls around the sources of the second axis, of these radii [m]."""
    offsets = rng.standard_normal((*shape, 3), dtype=np.float32)
    length = np.sqrt(np.einsum("...i,...i->...", offsets, offsets))
    scale = (
        radii.astype(np.float32)[:, None]
        * np.cbrt(rng.random(shape, dtype=np.float32))
        / np.maximum(length, 1e-12)
    )
    offsets *= scale[..., None]
    return offsets
