"""The drawn skin: the hand's surface on a forearm, with normals, shade, parts and texture coordinates.

The hand's vertices are `HandModel.skin`'s, so that pictures show the surface behind all occlusion;
the forearm replaces the short stump behind the wrist.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.skin.skinning import skin_frames
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import NUM_BONES, PALM
from handsim.kernels.kernel import kernel
from render.skin.atlas import RINGS, skin_atlas
from render.skin.flexion import Flexion
from render.skin.forearm import FOREARM, Forearm, forearm_rings

_DARKEST: Final = 0.12  # even the deepest folds receive some light


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSkin:
    """One hand in one pose, with the vertices that OpenGL needs."""

    vertices: Float32[np.ndarray, "D 3"]
    """In the world [m]; vertices on borders of texture tiles are repeated for each tile."""
    normals: Float32[np.ndarray, "D 3"]
    """Outward unit normals."""
    uv: Float32[np.ndarray, "D 2"]
    """Texture coordinates, the origin at the bottom left."""
    shade: Float32[np.ndarray, "D"]
    """Share of the ambient light that the hand itself does not block, 0 to 1."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles, counter-clockwise from outside."""
    parts: UInt8[np.ndarray, "F"]
    """Bone of each triangle, an index of `topology.BONES` or `FOREARM`."""


class PosableSkin:
    """The drawn skin of one person's hand.

    Args:
        model: The hand.
        forearm: The forearm behind it.
        bony: Factor on what joints make of the skin around them, see `render.skin.flexion`; 0 for the hand
            model's own surface.
    """

    def __init__(self, model: HandModel, forearm: Forearm | None = None, bony: float = 0.0) -> None:
        self.model = model
        self.forearm = Forearm() if forearm is None else forearm
        atlas, surface = skin_atlas(), model.surface
        hand = surface.vertices[atlas.used]
        arm = forearm_rings(model.shape, self.forearm, hand[atlas.wrist], RINGS)
        end = arm[-1].mean(axis=0, keepdims=True)
        self.rest: Float[np.ndarray, "U 3"] = np.concatenate([hand, arm.reshape(-1, 3), end])
        """Rest positions in the wrist's frame [m]: the hand, the forearm's rings, the middle of its end."""
        beyond = len(self.rest) - len(hand)
        to_palm, whole = np.zeros((beyond, 4), dtype=np.int64), np.tile([1.0, 0.0, 0.0, 0.0], (beyond, 1))
        self._bones = np.concatenate([surface.bone_indices[atlas.used], to_palm + PALM])
        self._weights = np.concatenate([surface.bone_weights[atlas.used], whole])
        mirrored = model.shape.side == "left"
        self.faces = np.ascontiguousarray(atlas.faces[:, ::-1] if mirrored else atlas.faces)
        """Triangles (F, 3) of the vertices of `rest`: a closed surface."""
        self._corner_faces = np.ascontiguousarray(
            atlas.corner_faces[:, ::-1] if mirrored else atlas.corner_faces
        )
        self._flexion = Flexion(model, self.rest, vertex_normals(self.rest, self.faces), bony)
        self._rest_occluded = self._rest_occlusion(model.rest_transforms[None], self.rest, self.faces)

    def posed(self, qpos: Float[np.ndarray, "27"]) -> DrawnSkin:
        """The skin in one pose.

        Raises:
            ArgumentError: `qpos` is not (27,) or not finite.
        """
        atlas = skin_atlas()
        transforms = self.model.forward_kinematics(qpos[None])
        points = self.merged(transforms, self._flexion.shaped(self.rest, qpos[7:]))
        normals = vertex_normals(points, self.faces)
        occluded = self._occluded(transforms, points, normals)
        shade = np.clip(1.0 - np.maximum(occluded - self._rest_occluded, 0.0), _DARKEST, 1.0)
        corners = atlas.corners
        return DrawnSkin(
            points[corners].astype(np.float32),
            normals[corners].astype(np.float32),
            atlas.uv,
            shade[corners].astype(np.float32),
            self._corner_faces,
            face_parts(),
        )

    def merged(
        self, transforms: Float[np.ndarray, "1 L 4 4"], rest: Float[np.ndarray, "U 3"] | None = None
    ) -> Float[np.ndarray, "U 3"]:
        """Posed vertices of `rest`, or of its changed form, in the frame of the bones' transforms [m]."""
        still = self.rest if rest is None else rest
        points: NDArray[np.float64] = skin_frames(
            still, self._bones, self._weights, self.model.rest_transforms, transforms
        )[0]
        return points

    def _rest_occlusion(
        self, transforms: NDArray[np.float64], points: NDArray[np.float64], faces: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Occlusion by neighboring capsules in the flat hand, where they are the same flesh."""
        return self._occluded(transforms, points, vertex_normals(points, faces))

    def _occluded(
        self, transforms: NDArray[np.float64], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        capsules = self.model.capsules
        occluded: NDArray[np.float64] = _occluded_share(
            points, normals, capsules.posed(transforms)[0], capsules.radii * 1.2
        )
        return occluded


@functools.cache
def face_parts() -> UInt8[np.ndarray, "F"]:
    """Bone of each triangle of `DrawnSkin.faces`: the one with the largest share in it, or `FOREARM`."""
    atlas, surface = skin_atlas(), HandModel.named("M").surface  # weights are the same for every hand
    shares = np.zeros((atlas.num_vertices, NUM_BONES + 1))
    rows = np.arange(atlas.num_hand)[:, None]
    shares[rows, surface.bone_indices[atlas.used]] = surface.bone_weights[atlas.used]
    shares[atlas.num_hand :, FOREARM] = 1e3  # one vertex of the forearm makes a triangle the forearm's
    parts: NDArray[np.uint8] = shares[atlas.faces].sum(axis=1).argmax(axis=1).astype(np.uint8)
    parts.setflags(write=False)
    return parts


@kernel
def _occluded_share(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    segments: NDArray[np.float64],
    radii: NDArray[np.float64],
) -> Any:
    """Share (V,) of each point's hemisphere behind capsules, each replaced by its nearest ball.

    Args:
        points: Positions (V, 3) [m].
        normals: Unit normals (V, 3).
        segments: Ends of the capsules (K, 2, 3) [m].
        radii: Radii of the capsules (K,) [m].
    """
    occluded = np.empty(len(points))
    axes = segments[:, 1] - segments[:, 0]
    for v in range(len(points)):
        free = 1.0
        for k in range(len(radii)):
            along, square = 0.0, 1e-12
            for i in range(3):
                along += (points[v, i] - segments[k, 0, i]) * axes[k, i]
                square += axes[k, i] * axes[k, i]
            along = min(max(along / square, 0.0), 1.0)
            distance, facing = 0.0, 0.0
            for i in range(3):
                away = segments[k, 0, i] + along * axes[k, i] - points[v, i]
                distance += away * away
                facing += away * normals[v, i]
            if facing > 0.0:
                ratio = radii[k] * radii[k] / max(distance, radii[k] * radii[k])
                free *= 1.0 - 0.85 * ratio * min(facing / np.sqrt(distance), 1.0)
        occluded[v] = 1.0 - free
    return occluded
