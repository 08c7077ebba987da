"""The scene of a ready-made picture: posed hands, markers, free points, and the view of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy.typing import NDArray

from gloves.fit import GloveFit
from handsim._checks import check_array
from handsim.errors import HandSimError
from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_QPOS
from handsim.hand.skin import vertex_normals
from handsim.space.camera import Camera, pinhole
from render.illustrations.palette import BACKGROUND, Covering, covering_material, skin_tint
from render.painting.figures import Drawn, sphere_surface
from render.painting.materials import MARKER_COLOR, Material, ball_material, linear
from render.painting.painter import paint, put_before
from render.painting.rasterizer import NEAR, Triangles, join, rasterize
from render.scenery.lights import STUDIO

_BALL_LEVEL: Final = 3
_OVERSAMPLING: Final = 2  # colors are painted this much larger and scaled down, for smooth outlines


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera: its pose and its field of view.

    Raises:
        HandSimError: The pose is not (4, 4), or the angle is out of range.
    """

    T_world_camera: Float[np.ndarray, "4 4"]
    """Pose in the world [m], OpenCV axes: x right, y down, z into the picture."""
    field_of_view: float
    """Full vertical opening angle [rad]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_camera", check_array("T_world_camera", self.T_world_camera, (4, 4)))
        if not 0.0 < self.field_of_view < np.pi:
            raise HandSimError(f"field_of_view is {self.field_of_view:g}, expected radians between 0 and pi")

    def camera(self, size: tuple[int, int]) -> Camera:
        """The pinhole camera of this view; an `ArgumentError` if no picture has that size [px]."""
        focal = 0.5 * size[1] / np.tan(self.field_of_view / 2)
        return pinhole("view", size, float(focal)).at(self.T_world_camera)

    def project(
        self, points: Float[np.ndarray, "*batch 3"], size: tuple[int, int]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of world points [m] in a picture (width, height) [px]; counted as by `Camera`."""
        rotation, center = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        local = (points - center) @ rotation
        focal = 0.5 * size[1] / np.tan(self.field_of_view / 2)
        pixels: NDArray[np.float64] = focal * local[..., :2] / local[..., 2:] + np.array(size) / 2
        return pixels


@dataclass(frozen=True, slots=True, eq=False)
class Balls:
    """Spheres of one radius, such as markers or the points that an optical system sees."""

    centers: Float[np.ndarray, "N 3"]
    """Centers in the world [m]; NaN rows are not drawn."""
    radius: float
    """Radius [m]."""
    colors: Float[np.ndarray, "N 3"] | tuple[float, float, float] = MARKER_COLOR
    """sRGB in [0, 1], one for all or one each."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedHand:
    """A hand in a pose, with or without a glove's markers."""

    hand: GloveFit | HandModel
    """In a glove whose markers are drawn, or without one."""
    qpos: Float[np.ndarray, "27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]."""
    covering: Covering = "skin"
    """Bare skin or a dark glove."""
    marker_colors: Float[np.ndarray, "M 3"] | tuple[float, float, float] = MARKER_COLOR
    """sRGB in [0, 1], one for all markers or one each."""

    def __post_init__(self) -> None:
        qpos = check_array("qpos", self.qpos, (NUM_QPOS,))
        if qpos.ndim != 1:
            raise HandSimError(f"qpos has shape {qpos.shape}, expected ({NUM_QPOS},): one pose per hand")
        object.__setattr__(self, "qpos", qpos)

    @property
    def model(self) -> HandModel:
        """The hand without its glove."""
        return self.hand.model if isinstance(self.hand, GloveFit) else self.hand

    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """Skin in the world [m]."""
        vertices: NDArray[np.float64] = self.model.skin(self.qpos[None])[0]
        return vertices

    def markers(self) -> Float[np.ndarray, "M 3"]:
        """Marker centers in the world [m]; none without a glove."""
        if not isinstance(self.hand, GloveFit):
            return np.empty((0, 3))
        markers: NDArray[np.float64] = self.hand.markers(self.qpos[None])[0][0]
        return markers


@dataclass(frozen=True, slots=True, eq=False)
class HandScene:
    """The content of one picture."""

    view: View
    hands: tuple[PosedHand, ...] = ()
    balls: tuple[Balls, ...] = ()
    background: tuple[float, float, float] = BACKGROUND
    """sRGB in [0, 1]."""


def view_along(
    direction: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "N 3"],
    size: tuple[int, int],
    *,
    field_of_view: float = np.deg2rad(24.0),
    margin: float = 0.06,
) -> View:
    """The nearest view in a given direction that has all points [m] in the picture.

    `up` is the direction in the world that points up in the picture, the field of view its full vertical
    opening angle [rad], and the margin on each side a share of the picture.
    """
    ahead = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    local = points @ rotation
    slope = np.tan(field_of_view / 2) * (1 - 2 * margin) * np.array([size[0] / size[1], 1.0])
    # A point is inside when |x - x0| <= slope (z + distance), two linear limits; so is y.
    above = (local[:, :2] - slope * local[:, 2:]).max(axis=0)
    below = (-local[:, :2] - slope * local[:, 2:]).max(axis=0)
    distance = max(*((above + below) / (2 * slope)), 2 * NEAR - local[:, 2].min())
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = rotation @ np.array([*(above - below) / 2, -distance])
    return View(pose, field_of_view)


def scene_surfaces(scene: HandScene) -> list[Drawn]:
    """The surfaces of a scene: skins with smooth normals, markers and free points."""
    surfaces: list[Drawn] = []
    for hand in scene.hands:
        vertices, faces = hand.vertices(), hand.model.surface.faces
        colors = skin_tint(hand.model) if hand.covering == "skin" else np.ones((len(vertices), 3))
        surfaces.append(
            _surface(
                vertices, vertex_normals(vertices, faces), faces, colors, covering_material(hand.covering)
            )
        )
        if isinstance(hand.hand, GloveFit):
            surfaces += _ball_surfaces(Balls(hand.markers(), hand.hand.layout.radius, hand.marker_colors))
    for balls in scene.balls:
        surfaces += _ball_surfaces(balls)
    return surfaces


def _ball_surfaces(balls: Balls) -> list[Drawn]:
    """All balls as one surface, with colors by vertex; nothing where no center is known."""
    known = np.isfinite(balls.centers).all(axis=-1)
    centers = balls.centers[known]
    if not len(centers):
        return []
    vertices, normals, faces = sphere_surface(centers, balls.radius, level=_BALL_LEVEL)
    tint = linear(np.broadcast_to(np.asarray(balls.colors, dtype=np.float64), balls.centers.shape)[known])
    colors = np.repeat(tint, len(vertices) // len(centers), axis=0)
    return [_surface(vertices, normals, faces, colors, ball_material())]


def _surface(
    vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
    faces: NDArray[np.int64],
    colors: NDArray[np.float64],
    material: Material,
) -> Drawn:
    """A surface without ids, its colors (V, 3) linear factors on the material's."""
    ids = np.zeros(len(faces), dtype=np.uint8)
    factors = np.ones((len(vertices), 4), dtype=np.float32)
    factors[:, :3] = colors
    return Drawn(Triangles(vertices, faces, normals, ids, ids, ids), factors, None, lambda: material)


def render_rgb(
    scene: HandScene, size: tuple[int, int], *, behind: UInt8[np.ndarray, "H W 3"] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Color picture, sRGB, before a picture or the scene's background."""
    width, height = size
    camera = scene.view.camera(size)
    K = camera.K.copy()
    K[:2] *= _OVERSAMPLING
    large = dataclasses.replace(camera, size=(_OVERSAMPLING * width, _OVERSAMPLING * height), K=K)
    painted = cv2.resize(paint(large, scene_surfaces(scene), STUDIO), size, interpolation=cv2.INTER_AREA)
    if behind is None:
        paper = np.rint(255.0 * np.array(scene.background))
        behind = np.broadcast_to(paper.astype(np.uint8), (height, width, 3))
    return put_before(painted, np.ascontiguousarray(behind, dtype=np.float32))


def render_depth(scene: HandScene, size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """Depth picture: distance along the camera's axis [m] at each pixel's center, 0 where there is nothing.

    Raises:
        ArgumentError: No picture has that size.
    """
    camera, surfaces = scene.view.camera(size), scene_surfaces(scene)
    if not surfaces:
        return np.zeros(size[::-1], dtype=np.float32)
    depth = rasterize(camera, join([one.triangles for one in surfaces]), with_normals=False).depth
    assert depth is not None
    return depth


def unoccluded(
    depth: Float32[np.ndarray, "H W"], view: View, points: Float[np.ndarray, "N 3"], *, slack: float
) -> Bool[np.ndarray, "N"]:
    """Which points lie in a depth picture with nothing in front of them.

    Args:
        depth: The picture [m], 0 where there is nothing.
        points: Points in the world [m].
        slack: How far behind the first surface a point still counts [m], such as a marker's radius.
    """
    height, width = depth.shape
    column, row = np.floor(view.project(points, (width, height))).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    first = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    ahead = (points - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2]
    free: NDArray[np.bool_] = inside & (ahead > 0) & ((first == 0) | (ahead <= first + slack))
    return free
