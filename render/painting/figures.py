"""Hands, rigid bodies and balls as surfaces with ids, and the materials of these."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from gloves.fit import GloveFit
from gloves.takes.bodies import RigidBody
from handsim.hand.model import keypoint_thickness
from handsim.hand.skin import vertex_normals
from render.frames import PARTS_A_HAND, Bytes, Doubles, Integers
from render.painting.rasterizer import Triangles
from render.skin.look import Forearm, SkinLook, sample_forearm, sample_skin_look
from render.skin.mesh import PosableSkin
from render.skin.texture import GloveLook, glove_texture, sample_glove_look, skin_texture

if TYPE_CHECKING:
    import trimesh

    from render.skin.texture import SkinTexture

MARKER_COLOR: Final = (0.98, 0.98, 1.0)
SCATTER: Final = (0.30, 0.13, 0.08)
"""Scatter of skin; red light travels farthest (Jensen et al. 2001: free paths of 3.7, 1.4 and 0.7 mm)."""
_FOLD_SHADE: Final = 0.85  # strength of ambient shade in folds; below 1, because lamps light them in part
_BASE_RADII: Final = (0.85, 0.4)  # radius of a marker's base on the glove and in the marker [marker radii]
_BASE_SIDES: Final = 12
_SHARP_EDGE: Final = np.deg2rad(60.0)  # least angle between two faces whose edge is drawn sharp [rad]
_BODY_MARKER_RADIUS: Final = 0.0032  # radius of the markers of rigid bodies (Han et al. 2018) [m]


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How a surface reflects light: the microfacet model of glTF 2.0, without metals."""

    color: Float[np.ndarray, "3"]  # linear light
    roughness: float  # from 0 (mirror) to 1 (chalk)
    glow: float = 0.0  # emitted light, as a share of its color
    scatter: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Light that travels under the surface, for red, green and blue: cosine beyond grazing at which lamps
    still light it."""
    texels: UInt8[np.ndarray, "H W 8"] | None = None
    """Factors on color (sRGB) and roughness (255 for 1), the relief's normal (0 for -1, 255 for 1) along u,
    along normal x u and along the normal, and an unused byte; the top row comes first."""


def linear(color: Float[np.ndarray, "*batch 3"] | tuple[float, float, float]) -> Doubles:
    """Linear light of an sRGB color, with the plain 2.2 power that pyrender's shader undoes."""
    return np.asarray(color, dtype=np.float64) ** 2.2


@functools.cache
def ball_material() -> Material:
    """The material of markers, which have colors by vertex and glow a little, to stay visible in shadows."""
    return Material(np.ones(3), 0.45, glow=0.2)


def skin_material(texture: SkinTexture) -> Material:
    """The material of painted skin, for meshes with `DrawnSkin.uv`."""
    nothing = np.zeros_like(texture.roughness)
    texels = np.dstack([texture.color, texture.roughness, texture.normals, nothing])
    return Material(np.ones(3), 1.0, scatter=np.array(SCATTER), texels=texels)


def shade_colors(shade: Float32[np.ndarray, "D"]) -> Float32[np.ndarray, "D 4"]:
    """Vertex colors for `DrawnSkin.shade`: red light passes through flesh into the folds."""
    colors = np.ones((len(shade), 4), dtype=np.float32)
    lit = 1.0 - _FOLD_SHADE * (1.0 - shade)
    for channel, power in enumerate((0.8, 1.0, 1.05)):
        colors[:, channel] = cv2.pow(lit, power).reshape(-1)
    return colors


def sphere_surface(
    centers: Float[np.ndarray, "N 3"], radius: float, *, level: int
) -> tuple[Doubles, Doubles, Integers]:
    """Vertices [m], normals and faces of balls, ball after ball, the same number for each."""
    ball = _unit_ball(level)
    count, stride = len(centers), len(ball.vertices)
    vertices = (centers[:, None] + radius * ball.vertices).reshape(-1, 3)
    faces = (ball.faces + stride * np.arange(count)[:, None, None]).reshape(-1, 3)
    return vertices, np.tile(ball.vertices, (count, 1)), faces


@functools.cache
def _unit_ball(level: int) -> trimesh.Trimesh:
    import trimesh

    return trimesh.creation.icosphere(subdivisions=level)


@dataclass(frozen=True, slots=True)
class Appearance:
    """Skin and sleeves of a person, which are alike on both hands."""

    skin: SkinLook
    forearm: Forearm
    glove: GloveLook | None  # the marker gloves, drawn with their markers; None for bare hands


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A surface that is ready to be drawn."""

    triangles: Triangles
    colors: Float32[np.ndarray, "V 4"]  # factors on the material's color, linear
    uv: Float32[np.ndarray, "V 2"] | None
    material: Callable[[], Material]
    """Returns the same material every time; only called for colors, because textures take time."""
    coarse_faces: Int[np.ndarray, "G 3"] | None = None
    """Triangles of the same vertices that cast its shadow; None: all of its own."""
    out_of_focus: bool = False
    """Whether our own painter blurs it; such surfaces come last, and hands hide them sharply."""

    @property
    def casting(self) -> Int[np.ndarray, "G 3"]:
        """Triangles that cast its shadow."""
        return self.triangles.faces if self.coarse_faces is None else self.coarse_faces


def sample_appearance(glove: bool, *, tones: Sequence[float], rng: np.random.Generator) -> Appearance:
    """A random person, in gloves or bare."""
    skin, forearm = sample_skin_look(tones, rng=rng), sample_forearm(rng=rng)
    if not glove:
        return Appearance(skin, forearm, None)
    cloth = sample_glove_look(rng=rng)
    return Appearance(skin, dataclasses.replace(forearm, cuff=cloth.cuff), cloth)


class HandFigure:
    """One hand to draw; its texture is painted once."""

    def __init__(self, fit: GloveFit, look: Appearance, *, first_marker: int) -> None:
        self.fit, self.look = fit, look
        bone_relief = look.skin.relief if look.glove is None else 0.0  # cloth hides bones
        self.skin = PosableSkin(fit.model, look.forearm, bone_relief)
        self._material = functools.cache(self._paint)
        self._marker_bones = bones = fit.attachment.main_bones
        self._marker_numbers = (1 + first_marker + np.arange(len(bones))).astype(np.uint8)
        self.thickness: Float[np.ndarray, "21"] = keypoint_thickness(fit.model.shape)
        """Thickness of the hand at each keypoint, markers included [m]."""
        if look.glove is not None:
            self.thickness = self.thickness + fit.layout.heights.max() + fit.layout.radius

    def drawn(
        self,
        qpos: Float[np.ndarray, "27"],
        number: int,
        upper_arm: Float[np.ndarray, "3"] | None = None,
        forearm: Float[np.ndarray, "3"] | None = None,
        others: Sequence[tuple[Doubles, Doubles]] = (),
    ) -> list[Drawn]:
        """Surfaces of the skin, which the flesh of `others` shades, and of a glove's markers and bases."""
        skin, first_part = self.skin.posed(qpos, upper_arm, forearm, others), 1 + PARTS_A_HAND * number
        count = len(skin.faces)
        triangles = Triangles(
            skin.vertices,
            skin.faces,
            skin.normals,
            (first_part + skin.parts).astype(np.uint8),
            np.full(count, 1 + number, dtype=np.uint8),
            np.zeros(count, dtype=np.uint8),
        )
        drawn = [Drawn(triangles, shade_colors(skin.shade), skin.uv, self._material, skin.coarse_faces)]
        if self.look.glove is not None:
            parts = (first_part + self._marker_bones).astype(np.uint8)
            instances = np.full(len(parts), 1 + number, dtype=np.uint8)
            radius = self.fit.layout.radius
            (markers,), (normals,) = self.fit.markers(qpos[None])
            drawn.append(_drawn_balls(markers, radius, parts, instances, self._marker_numbers))
            feet = markers - self.fit.layout.heights[:, None] * normals
            drawn.append(_drawn_bases(feet, markers, normals, radius, parts, instances, np.zeros_like(parts)))
        return drawn

    def _paint(self) -> Material:
        look, side = self.look, self.fit.side
        texture = skin_texture(look.skin, look.forearm, side=side)
        if look.glove is not None:
            texture = glove_texture(look.glove, texture, look.forearm, side=side)
        return skin_material(texture)


class BodyFigure:
    """One rigid body to draw."""

    def __init__(self, body: RigidBody, color: tuple[float, float, float]) -> None:
        self._object = body.shape
        self._markers = body.positions if self._object is None else self._object.markers
        self._material = functools.cache(lambda: Material(linear(color), 0.5))  # looks like plastic
        if self._object is not None:
            import trimesh

            vertices, faces = self._object.vertices, self._object.faces
            solid = trimesh.Trimesh(vertices, faces, process=False)
            smooth = solid.face_adjacency[solid.face_adjacency_angles < _SHARP_EDGE]
            patches = np.repeat(trimesh.graph.connected_component_labels(smooth, node_count=len(faces)), 3)
            corners, rows = np.unique(np.stack([faces.ravel(), patches]), axis=1, return_inverse=True)
            self._vertices, self._faces = vertices[corners[0]], rows.reshape(-1, 3)
            self._normals = vertex_normals(self._vertices, self._faces)

    def drawn(self, T_world_body: Float[np.ndarray, "4 4"], instance: int) -> list[Drawn]:
        """Surfaces of the body, if its shape is known, and of its markers."""
        rotation, position, drawn = T_world_body[:3, :3], T_world_body[:3, 3], []
        if self._object is not None:
            ids = [np.full(len(self._faces), number, dtype=np.uint8) for number in (0, instance, 0)]
            vertices = self._vertices @ rotation.T + position
            triangles = Triangles(vertices, self._faces, self._normals @ rotation.T, *ids)
            drawn.append(Drawn(triangles, np.ones((len(vertices), 4), np.float32), None, self._material))
        if len(self._markers):
            centers, zeros = self._markers @ rotation.T + position, np.zeros(len(self._markers), np.uint8)
            drawn.append(_drawn_balls(centers, _BODY_MARKER_RADIUS, zeros, zeros + np.uint8(instance), zeros))
        return drawn


def _drawn_bases(feet: Doubles, tops: Doubles, axes: Doubles, radius: float, *ids: Bytes) -> Drawn:
    """Surface of cones from the skin into markers, with a part, an instance and a marker (N,) for each."""
    angles = np.arange(_BASE_SIDES) * (2.0 * np.pi / _BASE_SIDES)
    aside = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(axes, aside)
    around = np.cos(angles)[:, None] * aside[:, None] + np.sin(angles)[:, None] * other[:, None]
    ends = zip((feet, tops), _BASE_RADII, strict=True)
    vertices = np.stack([end[:, None] + wide * radius * around for end, wide in ends], axis=1)
    low = np.arange(_BASE_SIDES)
    high, following = low + _BASE_SIDES, np.roll(low, -1)
    halves = (low, following, high), (following, following + _BASE_SIDES, high)
    sides = np.concatenate([np.stack(half, axis=1) for half in halves])
    faces = (sides + 2 * _BASE_SIDES * np.arange(len(feet))[:, None, None]).reshape(-1, 3)
    normals = np.repeat(around[:, None], 2, axis=1).reshape(-1, 3)
    triangles = Triangles(
        vertices.reshape(-1, 3), faces, normals, *(np.repeat(one, len(sides)) for one in ids)
    )
    return Drawn(triangles, np.ones((len(normals), 4), dtype=np.float32), None, _base_material)


@functools.cache
def _base_material() -> Material:
    return Material(linear((0.16, 0.16, 0.17)), 0.5)


def _drawn_balls(centers: Doubles, radius: float, *ids: Bytes) -> Drawn:
    """Surface of balls, with a part, an instance and a marker (N,) for each."""
    vertices, normals, faces = sphere_surface(centers, radius, level=2)
    faces_per_ball = len(faces) // len(centers)
    triangles = Triangles(vertices, faces, normals, *(np.repeat(one, faces_per_ball) for one in ids))
    colors = np.tile(np.array([*linear(MARKER_COLOR), 1.0], np.float32), (len(vertices), 1))
    return Drawn(triangles, colors, None, ball_material)
