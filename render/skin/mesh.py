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
from handsim.hand.skin.surface import skin_frames, vertex_normals
from handsim.hand.topology import BONES, DIGITS, NUM_BONES, PALM
from handsim.kernels import kernel
from handsim.space.transforms import quaternion_matrix
from render.skin.atlas import RINGS, skin_atlas
from render.skin.flexion import Flexion
from render.skin.forearm import ELBOW, FOREARM, Forearm, bent_rings, forearm_rings

_FLESH: Final = 1.2  # radius of the flesh around a capsule over the capsule's
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
    coarse_faces: Int[np.ndarray, "G 3"]
    """Fewer triangles of the same vertices, nearly the same surface."""


class PosableSkin:
    """The drawn skin of one person's hand.

    Args:
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
        self._elbow = ELBOW * model.shape.length  # behind the first ring, nearly the wrist
        self.rest: Float[np.ndarray, "U 3"] = np.concatenate([hand, arm.reshape(-1, 3), end])
        """Rest positions in the wrist's frame [m]: the hand, the forearm's rings, the middle of its end."""
        beyond = len(self.rest) - len(hand)
        to_palm, whole = np.zeros((beyond, 4), dtype=np.int64), np.tile([1.0, 0.0, 0.0, 0.0], (beyond, 1))
        self._bones = np.concatenate([surface.bone_indices[atlas.used], to_palm + PALM])
        self._weights = np.concatenate([surface.bone_weights[atlas.used], whole])
        mirrored = model.shape.side == "left"
        self.faces = np.ascontiguousarray(atlas.faces[:, ::-1] if mirrored else atlas.faces)
        """Triangles (F, 3) of the vertices of `rest`: a closed surface."""
        self._corner_faces, self._coarse_faces = (
            np.ascontiguousarray(faces[:, ::-1] if mirrored else faces)
            for faces in (atlas.corner_faces, atlas.coarse_faces)
        )
        self._flexion = Flexion(model, self.rest, vertex_normals(self.rest, self.faces), bony)
        self._rest_occluded = self._rest_occlusion()

    def forearm_line(
        self, qpos: Float[np.ndarray, "27"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """The elbow [m], and the unit direction to it from the wrist, in the world."""
        middles = self._rings(self.rest).mean(axis=1)
        ahead = middles[-1] - middles[-2]
        ahead /= np.linalg.norm(ahead)
        elbow = middles[-1] + (self._elbow - np.linalg.norm(np.diff(middles, axis=0), axis=1).sum()) * ahead
        rotation = quaternion_matrix(qpos[3:7])
        return qpos[:3] + rotation @ elbow, rotation @ ahead

    def _rings(self, rest: NDArray[np.float64]) -> NDArray[np.float64]:
        """The arm's rings (K, R, 3)."""
        return rest[skin_atlas().num_hand : -1].reshape(RINGS, -1, 3)

    def posed(
        self, qpos: Float[np.ndarray, "27"], upper_arm: Float[np.ndarray, "3"] | None = None
    ) -> DrawnSkin:
        """The skin in one pose; without the upper arm's direction in the world the arm is straight and short.

        Raises:
            ArgumentError: `qpos` is not (27,) or not finite.
        """
        atlas = skin_atlas()
        transforms = self.model.forward_kinematics(qpos[None])
        shaped = self._flexion.shaped(self.rest, qpos[7:])
        if upper_arm is not None:
            rings = bent_rings(self._rings(shaped), self._elbow, upper_arm @ quaternion_matrix(qpos[3:7]))
            shaped = np.concatenate([shaped[: atlas.num_hand], rings.reshape(-1, 3), rings[-1:].mean(axis=1)])
        points = self.merged(transforms, shaped)
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
            self._coarse_faces,
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

    def _rest_occlusion(self) -> NDArray[np.float32]:
        """Occlusion in the flat hand by capsules of the same flesh: a digit's other neighbors do shade it."""
        normals = vertex_normals(self.rest, self.faces)
        occluded = self._occluded(self.model.rest_transforms[None], self.rest, normals)
        capsules, digits = self.model.capsules, np.array([bone.digit for bone in BONES])
        segments = capsules.posed(self.model.rest_transforms[None])[0]
        of_digit = digits[self._bones]
        for digit in range(len(DIGITS)):
            share = (self._weights * (of_digit == digit)).sum(axis=1)
            mine = np.flatnonzero(share > 0.0)
            near = np.isin(digits[capsules.bones], (digit, digits[PALM]))
            own = _occluded_share(
                self.rest[mine], normals[mine], segments[near], capsules.radii[near] * _FLESH
            )
            occluded[mine] += share[mine].astype(np.float32) * (own - occluded[mine])
        return occluded

    def _occluded(
        self, transforms: NDArray[np.float64], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        capsules = self.model.capsules
        occluded: NDArray[np.float32] = _occluded_share(
            points, normals, capsules.posed(transforms)[0], capsules.radii * _FLESH
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

    The inner loop has no branches and writes one array, so that it is compiled into vector instructions.
    """
    count = len(points)
    x, y, z = _columns(points)
    nx, ny, nz = _columns(normals)
    free = np.ones(count, np.float32)
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-20)
    for k in range(len(radii)):
        sx, sy, sz = (
            np.float32(segments[k, 0, 0]),
            np.float32(segments[k, 0, 1]),
            np.float32(segments[k, 0, 2]),
        )
        ax = np.float32(segments[k, 1, 0] - segments[k, 0, 0])
        ay = np.float32(segments[k, 1, 1] - segments[k, 0, 1])
        az = np.float32(segments[k, 1, 2] - segments[k, 0, 2])
        scale = one / (ax * ax + ay * ay + az * az + np.float32(1e-12))
        square = np.float32(radii[k] * radii[k])
        strength = np.float32(0.85) * square
        for v in range(count):
            px, py, pz = sx - x[v], sy - y[v], sz - z[v]
            along = -(px * ax + py * ay + pz * az) * scale
            along = along if along > zero else zero
            along = along if along < one else one
            px, py, pz = px + along * ax, py + along * ay, pz + along * az
            distance = px * px + py * py + pz * pz
            facing = px * nx[v] + py * ny[v] + pz * nz[v]
            facing = facing if facing > zero else zero
            cosine = facing / np.sqrt(distance + tiny)
            cosine = cosine if cosine < one else one
            free[v] *= one - strength / (distance if distance > square else square) * cosine
    return one - free


@kernel
def _columns(points: NDArray[np.float64]) -> Any:
    """The columns of an array (V, 3)."""
    return (
        points[:, 0].astype(np.float32),
        points[:, 1].astype(np.float32),
        points[:, 2].astype(np.float32),
    )
