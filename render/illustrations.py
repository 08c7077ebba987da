"""Ready-made pictures and videos of hands, gloves, camera views and labeled frames, without OpenGL."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from gloves.optics.visibility import visible_cameras
from handsim.errors import FileError
from handsim.files.outputs import atomic_write, check_ending, plain_path, unwritten, writing
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import BONE_NAMES, SIZES
from handsim.hand.skin import vertex_normals
from handsim.pages import distinct_colors
from handsim.space.camera import Camera, pinhole
from handsim.space.rig import CameraRig
from handsim.space.transforms import rigid
from poses.shapes import gesture, make_valid
from render.captions import (
    BACKGROUND,
    HIDDEN_COLOR,
    SEEN_COLOR,
    UNLABELED_COLOR,
    Covering,
    Picture,
    bone_colors,
    captioned,
    covering_material,
    pad,
    side_by_side,
    skin_tint,
    titled,
    with_names,
)
from render.frames import Doubles, Integers
from render.painting.figures import MARKER_COLOR, Drawn, Material, ball_material, linear, sphere_surface
from render.painting.painter import paint, put_before
from render.painting.rasterizer import NEAR, Triangles, see
from render.scenery.lights import STUDIO

_OVERSAMPLING: Final = 2  # colors are painted this much larger and scaled down, for smooth outlines
_SIZE: Final = (800, 600)  # size of videos [px]
_CODEC: Final = "mp4v"  # part of every build of OpenCV
_VIEW_DIRECTION: Final = (-0.62, 0.62, -0.48)  # direction of videos, that of a new window of the viewer
_TEXT_COLOR: Final = (60, 60, 60)
FINGERS_UP: Final = np.array([1.0, 0.0, 0.0])
# Directions of view in the wrist frame of a right hand; mirrored for a left hand.
SIDES_OF_HAND: Final[Mapping[str, tuple[float, float, float]]] = {
    "back": (0.0, 0.0, -1.0),
    "palm": (0.0, 0.0, 1.0),
    "thumb side": (0.0, -1.0, -0.25),
    "little finger side": (0.0, 1.0, -0.25),
}
_HAND_GAP: Final = 0.025  # between hands in a row [m]
_WIDTH, _COLUMNS = 2000, 4  # width of a picture of rows [px]; number of gloves in a row
_CAMERA_SIZE: Final = (1100, 900)  # size of a camera's view without the names beside it [px]
_LABELS_SIZE: Final = (640, 800)  # size of a labeled frame without the names beside it [px]


class Balls(NamedTuple):
    """Spheres of one radius, such as markers or the points that an optical system sees."""

    centers: Float[np.ndarray, "N 3"]  # centers in the world [m]; NaN rows are not drawn
    radius: float  # radius [m]
    colors: Float[np.ndarray, "N 3"] | tuple[float, float, float] = MARKER_COLOR
    """sRGB in [0, 1], one for all or one each."""

    def surfaces(self) -> list[Drawn]:
        """All balls as one surface, with colors by vertex; nothing where no center is known."""
        known = np.isfinite(self.centers).all(axis=-1)
        centers = self.centers[known]
        if not len(centers):
            return []
        vertices, normals, faces = sphere_surface(centers, self.radius, level=3)
        tint = linear(np.broadcast_to(np.asarray(self.colors, dtype=np.float64), self.centers.shape)[known])
        colors = np.repeat(tint, len(vertices) // len(centers), axis=0)
        return [_surface(vertices, normals, faces, colors, ball_material())]


class PosedHand(NamedTuple):
    """A hand in a pose, with or without a glove's markers."""

    hand: GloveFit | HandModel  # in a glove whose markers are drawn, or without one
    qpos: Float[np.ndarray, "27"]  # wrist position [m], wrist orientation (wxyz), joint angles [rad]
    covering: Covering = "skin"  # bare skin or a dark glove
    marker_colors: Float[np.ndarray, "M 3"] | tuple[float, float, float] = MARKER_COLOR
    """sRGB in [0, 1], one for all markers or one each."""

    @property
    def model(self) -> HandModel:
        """The hand without its glove."""
        return self.hand.model if isinstance(self.hand, GloveFit) else self.hand

    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """Vertices of the skin in the world [m]."""
        return np.asarray(self.model.skin(self.qpos[None])[0])

    def surfaces(self) -> list[Drawn]:
        """Surfaces of the skin, with smooth normals, and of the glove's markers."""
        vertices, faces = self.vertices(), self.model.surface.faces
        colors = skin_tint(self.model) if self.covering == "skin" else np.ones((len(vertices), 3))
        normals = vertex_normals(vertices, faces)
        drawn = [_surface(vertices, normals, faces, colors, covering_material(self.covering))]
        if isinstance(self.hand, GloveFit):
            markers = self.hand.markers(self.qpos[None])[0][0]
            drawn += Balls(markers, self.hand.layout.radius, self.marker_colors).surfaces()
        return drawn


def _surface(
    vertices: Doubles, normals: Doubles, faces: Integers, colors: Doubles, material: Material
) -> Drawn:
    """A surface without ids; its colors (V, 3) are linear factors on the material's."""
    ids = np.zeros(len(faces), dtype=np.uint8)
    factors = np.ones((len(vertices), 4), dtype=np.float32)
    factors[:, :3] = colors
    return Drawn(Triangles(vertices, faces, normals, ids, ids, ids), factors, None, lambda: material)


def view_along(
    direction: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "N 3"],
    size: tuple[int, int],
    *,
    field_of_view: float = np.deg2rad(24.0),
    margin: float = 0.06,
) -> Camera:
    """The nearest pinhole camera that looks along a direction and has all points [m] in its picture.

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
    pose = rigid(rotation, rotation @ np.array([*(above - below) / 2, -distance]))
    return pinhole("view", size, float(0.5 * size[1] / np.tan(field_of_view / 2))).at(pose)


def draw_things(
    camera: Camera,
    *things: PosedHand | Balls,
    behind: UInt8[np.ndarray, "H W 3"] | tuple[float, float, float] = BACKGROUND,
) -> Picture:
    """Hands and balls, sRGB, before a picture or a color."""
    width, height = camera.size
    K = camera.K.copy()
    K[:2] *= _OVERSAMPLING
    large = dataclasses.replace(camera, size=(_OVERSAMPLING * width, _OVERSAMPLING * height), K=K)
    surfaces = [surface for thing in things for surface in thing.surfaces()]
    lighting = STUDIO.turned(camera.T_world_camera[:3, :3])  # of the viewer
    painted = cv2.resize(paint(large, surfaces, lighting), camera.size, interpolation=cv2.INTER_AREA)
    if isinstance(behind, tuple):
        behind = np.broadcast_to(np.array(byte_color(behind), dtype=np.uint8), (height, width, 3))
    return put_before(painted, np.ascontiguousarray(behind, dtype=np.float32))


def unoccluded(
    camera: Camera, hand: PosedHand, points: Float[np.ndarray, "N 3"], *, slack: float
) -> Bool[np.ndarray, "N"]:
    """Which points are in the picture with nothing more than `slack` [m] before them."""
    depth = see(camera, [one.triangles for one in hand.surfaces()], with_normals=False).depth
    column, row = np.floor(camera.project(points)).astype(int).T
    inside = (column >= 0) & (column < camera.size[0]) & (row >= 0) & (row < camera.size[1])
    first = depth[np.clip(row, 0, camera.size[1] - 1), np.clip(column, 0, camera.size[0] - 1)]
    ahead = camera.local(points)[:, 2]
    return np.asarray(inside & (ahead > 0) & ((first == 0) | (ahead <= first + slack)))


def write_clip(
    path: Path,
    frames: Iterable[tuple[Any, ...]],
    *,
    rate: float,
    shown: Float[np.ndarray, "N 3"],
    radius: float,
) -> None:
    """Write a video (.mp4), whole or not at all, with a view that shows some points in the world [m].

    A frame has pairs of hands and their poses (27,) [m, rad], where hands without a pose are left out; points
    (N, 3) in the world [m], of this radius [m]; their colors (N, 3), sRGB in [0, 1]; and a line of text.
    """
    check_ending(path, ".mp4", option="--video")
    view = view_along(np.array(_VIEW_DIRECTION), np.array([0.0, 0.0, 1.0]), shown, _SIZE)

    def pictures() -> Iterator[Picture]:
        for hands, points, colors, caption in frames:
            posed = [PosedHand(model, qpos) for model, qpos in hands if np.isfinite(qpos).all()]
            picture = draw_things(view, *posed, Balls(points, radius, colors))
            place = (16, _SIZE[1] - 18)
            cv2.putText(picture, caption, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, _TEXT_COLOR, 1, cv2.LINE_AA)
            yield picture

    write_video(path, pictures(), rate=rate, size=_SIZE)


def write_video(path: Path, pictures: Iterable[Picture], *, rate: float, size: tuple[int, int]) -> None:
    """Write a video of pictures of a width and height [px], whole or not at all."""
    with writing(path, FileError), atomic_write(path) as temporary, plain_path(temporary) as plain:
        writer = cv2.VideoWriter(str(plain), cv2.VideoWriter.fourcc(*_CODEC), rate, size)
        try:
            if not writer.isOpened():
                raise FileError(f"{path}: OpenCV cannot write a video of the codec {_CODEC} here")
            for picture in pictures:
                writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        finally:
            writer.release()
        _check_written(plain)


def _check_written(path: Path) -> None:
    """Check that a video can be read: OpenCV does not notice failed writes, such as on a full disk."""
    reader = cv2.VideoCapture(str(path))
    try:
        if not reader.isOpened():
            raise unwritten(path)
    finally:
        reader.release()


def draw_row(
    hands: Sequence[tuple[str, HandModel | GloveFit, Float[np.ndarray, "27"]]],
    *,
    direction: Float[np.ndarray, "3"] | tuple[float, float, float] = SIDES_OF_HAND["back"],
    covering: Covering = "skin",
    width: int = _WIDTH,
) -> Picture:
    """Hands side by side at one scale, wrists on one line, each with its caption."""
    ahead = np.asarray(direction, dtype=np.float64)
    right = np.cross(ahead, FINGERS_UP) / np.linalg.norm(np.cross(ahead, FINGERS_UP))
    posed, centers, extent = [], [], 0.0
    for _, hand, qpos in hands:
        at_origin = np.array(qpos)
        at_origin[:3] = 0.0
        vertices = PosedHand(hand, at_origin).vertices()
        across = vertices @ right
        at_origin[:3] = right * (extent - across.min())
        at_origin[0] -= vertices[:, 0].min()
        centers.append(at_origin[:3] + right * (across.min() + across.max()) / 2)
        extent += float(np.ptp(across)) + _HAND_GAP
        posed.append(PosedHand(hand, at_origin, covering=covering))
    points = np.concatenate([hand.vertices() for hand in posed])
    tall = float(np.ptp(points[:, 0])) / (extent - _HAND_GAP)
    size = (width, round(width * min(1.0, tall) * 1.04))
    # A narrow view from far away shows all hands at one scale, and not the sides of the outer ones.
    view = view_along(ahead, FINGERS_UP, points, size, field_of_view=np.deg2rad(4.0), margin=0.015)
    picture = draw_things(view, *posed)
    pixels = view.project(np.array(centers))[:, 0]
    return captioned(picture, [(float(x), hand[0]) for x, hand in zip(pixels, hands, strict=True)])


def draw_sizes() -> Picture:
    """The five sizes from the back, at one scale."""
    models = {size: HandModel.named(size) for size in SIZES}
    spread = join_qpos(gesture("spread")[None])[0]
    lengths = [(1e3 * model.shape.length, 1e3 * model.shape.breadth) for model in models.values()]
    captions = [f"{size}: {a:.0f} x {b:.0f} mm" for size, (a, b) in zip(models, lengths, strict=True)]
    return draw_row([(caption, one, spread) for caption, one in zip(captions, models.values(), strict=True)])


def draw_gloves(fits: Sequence[GloveFit]) -> Picture:
    """Gloves (one at least) on flat hands from the back, with name and number of markers, in rows."""
    spread = join_qpos(gesture("spread")[None])[0]
    cells = [(f"{fit.layout.name}: {fit.layout.num_markers}", fit, spread) for fit in fits]
    groups = [cells[start : start + _COLUMNS] for start in range(0, len(cells), _COLUMNS)]
    rows = [draw_row(one, covering="glove", width=_WIDTH * len(one) // _COLUMNS) for one in groups]
    return np.concatenate([pad(row, (0, 0), (0, _WIDTH - row.shape[1])) for row in rows])


def draw_gestures(model: HandModel, names: Sequence[str]) -> Picture:
    """Gestures of one hand, seen obliquely from the thumb's side of the palm."""
    poses = join_qpos(make_valid(model, np.stack([gesture(name) for name in names])))
    captions = [name.replace("_", " ") for name in names]
    rows = list(zip(captions, [model] * len(names), poses, strict=True))
    return draw_row(rows, direction=(0.0, -0.75, 1.0))


def draw_glove(
    fit: GloveFit, *, sides: Sequence[str] = tuple(SIDES_OF_HAND), slips: Sequence[GloveFit] = ()
) -> Picture:
    """A glove on a flat hand from some of `SIDES_OF_HAND`, with the names of the markers that each shows.

    With `slips`, the glove as many people wear it, put on the same hand, a second row has their markers as
    dots, and each marker has a color of its own.
    """
    colors = np.array(distinct_colors(fit.layout.num_markers)) if slips else marker_colors(fit.layout)
    qpos = join_qpos(gesture("spread")[None])[0]
    hand, bare = PosedHand(fit, qpos, "glove", colors if slips else MARKER_COLOR), PosedHand(fit.model, qpos)
    markers, slack = fit.markers(qpos[None])[0][0], 1.5 * fit.layout.radius
    pictures, dots = [], np.concatenate([one.markers(qpos[None])[0][0] for one in slips] or [markers])
    below = []
    for side in sides:
        view = _side_view(hand, side, np.concatenate([markers, dots]), 900)
        shown = unoccluded(view, hand, markers, slack=slack)
        pixels = np.where(shown[:, None], view.project(markers), np.nan)
        picture = with_names(draw_things(view, hand), pixels, fit.layout.names, colors)
        pictures.append(titled(picture, side))
        if slips:
            view = _side_view(hand, side, np.concatenate([markers, dots]), 600)
            picture = draw_things(view, bare)
            shown = unoccluded(view, bare, dots, slack=slack)
            pixels, inks = np.rint(view.project(dots[shown])), np.tile(colors, (len(slips), 1))[shown]
            for pixel, color in zip(pixels.astype(int), inks, strict=True):
                cv2.circle(picture, pixel.tolist(), 2, byte_color(tuple(color)), -1, cv2.LINE_AA)
            picture = titled(picture, f"slips of {len(slips)} people")
            spare = pictures[-1].shape[1] - picture.shape[1]
            below.append(pad(picture, (0, 0), (spare // 2, spare - spare // 2)))
    return np.concatenate([side_by_side(row, gap=40) for row in (pictures, below) if row])


def _side_view(hand: PosedHand, side: str, markers: Float[np.ndarray, "N 3"], height: int) -> Camera:
    """The view from one of `SIDES_OF_HAND` of a flat hand and markers [m], with a picture's height [px]."""
    vertices = hand.vertices()
    ahead = np.array([1.0, 1.0 if hand.model.shape.side == "right" else -1.0, 1.0]) * SIDES_OF_HAND[side]
    across = np.cross(ahead, FINGERS_UP) / np.linalg.norm(ahead)
    shape = float(np.ptp(vertices @ across) / np.ptp(vertices[:, 0]))
    size = (round(height * max(0.45, shape)), height)
    return view_along(ahead, FINGERS_UP, np.concatenate([vertices, markers]), size, margin=0.03)


def draw_camera(
    fit: GloveFit, qpos: Float[np.ndarray, "27"], rig: CameraRig, camera: int
) -> tuple[Picture, Bool[np.ndarray, "M"]]:
    """The view of a camera of a rig, zoomed in, and which markers it sees: green, the others red rings."""
    size = _CAMERA_SIZE
    transforms = fit.model.forward_kinematics(qpos[None])
    markers, normals = fit.attachment.markers(fit.model, transforms)
    capsules = fit.model.capsules
    seen = visible_cameras(markers, normals, rig, capsules.posed(transforms), capsules.radii)[0, :, camera]
    colors = np.where(seen[:, None], SEEN_COLOR, HIDDEN_COLOR)
    hand = PosedHand(fit, qpos, "glove", colors)
    vertices = hand.vertices()
    towards = vertices.mean(axis=0) - rig.positions[camera]
    up = np.array([0.0, 0.0, 1.0])
    view = view_along(towards, up, vertices, size, field_of_view=zoom(towards, vertices, up, size))
    picture = draw_things(view, hand)
    pixels = view.project(markers[0])
    for x, y in np.rint(pixels[~seen]).astype(int):
        cv2.circle(picture, (x, y), 13, byte_color(HIDDEN_COLOR), 3, cv2.LINE_AA)
    return with_names(picture, pixels, fit.layout.names, colors * 0.8), seen


def zoom(towards: Doubles, points: Doubles, up: Doubles, size: tuple[int, int]) -> float:
    """Vertical opening angle [rad] at which a camera `towards` away from the points just holds them."""
    angle = 0.2
    for _ in range(20):  # the angle and the distance that it gives converge
        view = view_along(towards, up, points, size, field_of_view=angle)
        distance = float(np.linalg.norm(points.mean(axis=0) - view.T_world_camera[:3, 3]))
        angle = 2 * np.arctan(np.tan(angle / 2) * distance / float(np.linalg.norm(towards)))
    return float(angle)


def draw_labels(
    hand: PosedHand, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], layout: MarkerLayout
) -> Picture:
    """A frame's points [m] without labels, and beside them with their labels (-1: a ghost) and the hand."""
    size = _LABELS_SIZE
    ghost = labels < 0
    palette = np.concatenate([marker_colors(layout), [HIDDEN_COLOR]])
    names = [*layout.names, "ghost"]
    vertices = hand.vertices()
    T_world_wrist = hand.model.forward_kinematics(hand.qpos[None])[0, 0]
    ahead, up = -T_world_wrist[:3, 2], T_world_wrist[:3, 0]
    view = view_along(ahead, up, np.concatenate([vertices, points]), size)
    radius = 1.2 * layout.radius
    gray = draw_things(view, Balls(points, radius, UNLABELED_COLOR))
    bare = PosedHand(hand.model, hand.qpos, covering=hand.covering)
    faint = draw_things(view, bare).astype(np.float32)
    faint += 0.72 * (255 * np.array(BACKGROUND, dtype=np.float32) - faint)
    balls = Balls(points[~ghost], radius, palette[labels[~ghost]])
    colored = draw_things(view, balls, behind=np.rint(faint).astype(np.uint8))
    pixels = view.project(points)
    for x, y in np.rint(pixels[ghost]).astype(int):
        cv2.circle(colored, (x, y), 9, byte_color(HIDDEN_COLOR), 2, cv2.LINE_AA)
    named = with_names(colored, pixels, [names[label] for label in labels], palette[labels])
    margin = (named.shape[0] - size[1]) // 2
    gray = titled(pad(gray, (margin, margin), (0, 0)), "as it comes")
    return side_by_side([gray, titled(named, "labeled")], gap=20)


def marker_colors(layout: MarkerLayout) -> Float[np.ndarray, "M 3"]:
    """Color (sRGB) of each marker's digit."""
    bones = [BONE_NAMES.index(marker.bone) for marker in layout.markers]
    return bone_colors()[bones]


def byte_color(color: tuple[float, float, float]) -> tuple[int, int, int]:
    """The color with 0 to 255 per channel."""
    red, green, blue = (round(255 * level) for level in color)
    return red, green, blue
