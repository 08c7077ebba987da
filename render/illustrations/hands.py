"""Ready-made pictures of hands, gloves, camera views and labeled frames, for `glove check` and the demo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from gloves.optics.visibility import visible_cameras
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import BONE_NAMES, SIZES
from handsim.space.rig import CameraRig
from poses.shapes.library import gesture
from poses.shapes.validity import make_valid
from render.illustrations.captions import captioned, pad, side_by_side, titled, with_names
from render.illustrations.palette import (
    BACKGROUND,
    HIDDEN_COLOR,
    SEEN_COLOR,
    UNLABELED_COLOR,
    Covering,
    bone_colors,
)
from render.illustrations.scene import (
    Balls,
    HandScene,
    PosedHand,
    render_depth,
    render_rgb,
    unoccluded,
    view_along,
)

if TYPE_CHECKING:
    from render.illustrations.captions import Picture


FINGERS_UP: Final = np.array([1.0, 0.0, 0.0])
# Directions of view in the wrist frame of a right hand; mirrored for a left hand.
SIDES_OF_HAND: Final[Mapping[str, tuple[float, float, float]]] = {
    "back": (0.0, 0.0, -1.0),
    "palm": (0.0, 0.0, 1.0),
    "thumb side": (0.0, -1.0, -0.25),
}
_GAP: Final = 0.025  # between hands in a row [m]
_WIDTH, _COLUMNS = 2000, 4  # of a picture of rows [px]; gloves in a row
_HEIGHT: Final = 900  # of a glove from one side [px]
_CAMERA_SIZE: Final = (1100, 900)  # [px], without names
_LABELS_SIZE: Final = (640, 800)  # of one side without names [px]


def draw_row(
    hands: Sequence[tuple[str, HandModel | GloveFit, Float[np.ndarray, "27"]]],
    *,
    direction: Float[np.ndarray, "3"] | tuple[float, float, float] = SIDES_OF_HAND["back"],
    covering: Covering = "skin",
    width: int = _WIDTH,
) -> Picture:
    """Hands side by side at one scale, wrists on one line, each with its caption.

    Args:
        hands: Caption, hand, in its glove or bare, and pose; the wrist's position in the pose is not used.
        direction: Direction of view.
    """
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
        extent += float(np.ptp(across)) + _GAP
        posed.append(PosedHand(hand, at_origin, covering=covering))
    points = np.concatenate([hand.vertices() for hand in posed])
    tall = float(np.ptp(points[:, 0])) / (extent - _GAP)
    size = (width, round(width * min(1.0, tall) * 1.04))
    # A narrow view from far away shows all hands at one scale, and not the sides of the outer ones.
    view = view_along(ahead, FINGERS_UP, points, size, field_of_view=np.deg2rad(4.0), margin=0.015)
    picture = render_rgb(HandScene(view, tuple(posed)), size)
    pixels = view.project(np.array(centers), size)[:, 0]
    return captioned(picture, [(float(x), hand[0]) for x, hand in zip(pixels, hands, strict=True)])


def draw_sizes() -> Picture:
    """The five sizes from the back, at one scale."""
    models = {size: HandModel.named(size) for size in SIZES}
    spread = join_qpos(gesture("spread")[None])[0]
    return draw_row(
        [
            (f"{size}: {1e3 * model.shape.length:.0f} x {1e3 * model.shape.breadth:.0f} mm", model, spread)
            for size, model in models.items()
        ]
    )


def draw_gloves(fits: Sequence[GloveFit]) -> Picture:
    """Gloves (one at least) on flat hands from the back, with name and number of markers, in rows."""
    spread = join_qpos(gesture("spread")[None])[0]
    cells = [(f"{fit.layout.name}: {fit.layout.num_markers}", fit, spread) for fit in fits]
    rows = [
        draw_row(
            cells[start : start + _COLUMNS],
            covering="glove",
            width=_WIDTH * min(_COLUMNS, len(cells) - start) // _COLUMNS,
        )
        for start in range(0, len(cells), _COLUMNS)
    ]
    return np.concatenate([pad(row, (0, 0), (0, _WIDTH - row.shape[1])) for row in rows])


def draw_gestures(model: HandModel, names: Sequence[str]) -> Picture:
    """Gestures of one hand, seen obliquely from the thumb's side of the palm."""
    poses = join_qpos(make_valid(model, np.stack([gesture(name) for name in names])))
    captions = [name.replace("_", " ") for name in names]
    rows = list(zip(captions, [model] * len(names), poses, strict=True))
    return draw_row(rows, direction=(0.0, -0.75, 1.0))


def draw_glove(
    fit: GloveFit,
    *,
    sides: Sequence[str] = tuple(SIDES_OF_HAND),
) -> Picture:
    """A glove on a flat hand from some of `SIDES_OF_HAND`, with the names of the markers that each shows."""
    colors = marker_colors(fit.layout)
    hand = PosedHand(fit, join_qpos(gesture("spread")[None])[0], "glove")
    vertices, markers = hand.vertices(), hand.markers()
    mirror = np.array([1.0, 1.0 if fit.side == "right" else -1.0, 1.0])
    pictures = []
    for side in sides:
        ahead = mirror * SIDES_OF_HAND[side]
        across = np.cross(ahead, FINGERS_UP) / np.linalg.norm(ahead)
        shape = float(np.ptp(vertices @ across) / np.ptp(vertices[:, 0]))
        size = (round(_HEIGHT * max(0.45, shape)), _HEIGHT)
        view = view_along(ahead, FINGERS_UP, np.concatenate([vertices, markers]), size, margin=0.03)
        scene = HandScene(view, (hand,))
        radius = fit.layout.radius
        shown = unoccluded(render_depth(scene, size), view, markers, slack=1.5 * radius)
        pixels = np.where(shown[:, None], view.project(markers, size), np.nan)
        picture = with_names(render_rgb(scene, size), pixels, fit.layout.names, colors)
        pictures.append(titled(picture, side))
    return side_by_side(pictures, gap=40)


def draw_camera(
    fit: GloveFit,
    qpos: Float[np.ndarray, "27"],
    rig: CameraRig,
    camera: int,
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
    picture = render_rgb(HandScene(view, (hand,)), size)
    pixels = view.project(markers[0], size)
    for x, y in np.rint(pixels[~seen]).astype(int):
        cv2.circle(picture, (x, y), 13, byte_color(HIDDEN_COLOR), 3, cv2.LINE_AA)
    return with_names(picture, pixels, fit.layout.names, colors * 0.8), seen


def zoom(
    towards: NDArray[np.float64], points: NDArray[np.float64], up: NDArray[np.float64], size: tuple[int, int]
) -> float:
    """Vertical opening angle [rad] at which a camera `towards` away from the points just holds them."""
    angle = 0.2
    for _ in range(
        20
    ):  # the nearest position for an angle is known; find the angle whose position is the camera's
        view = view_along(towards, up, points, size, field_of_view=angle)
        distance = float(np.linalg.norm(points.mean(axis=0) - view.T_world_camera[:3, 3]))
        angle = 2 * np.arctan(np.tan(angle / 2) * distance / float(np.linalg.norm(towards)))
    return float(angle)


def draw_labels(
    hand: PosedHand,
    points: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    layout: MarkerLayout,
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
    gray = render_rgb(HandScene(view, balls=(Balls(points, radius, UNLABELED_COLOR),)), size)
    bare = PosedHand(hand.model, hand.qpos, covering=hand.covering)
    faint = render_rgb(HandScene(view, (bare,)), size).astype(np.float32)
    faint += 0.72 * (255 * np.array(BACKGROUND, dtype=np.float32) - faint)
    balls = HandScene(view, balls=(Balls(points[~ghost], radius, palette[labels[~ghost]]),))
    colored = render_rgb(balls, size, behind=np.rint(faint).astype(np.uint8))
    pixels = view.project(points, size)
    for x, y in np.rint(pixels[ghost]).astype(int):
        cv2.circle(colored, (x, y), 9, byte_color(HIDDEN_COLOR), 2, cv2.LINE_AA)
    named = with_names(colored, pixels, [names[label] for label in labels], palette[labels])
    margin = (named.shape[0] - size[1]) // 2
    return side_by_side(
        [titled(pad(gray, (margin, margin), (0, 0)), "as it comes"), titled(named, "labeled")], gap=20
    )


def marker_colors(layout: MarkerLayout) -> Float[np.ndarray, "M 3"]:
    """Color (sRGB) of each marker's digit."""
    bones = [BONE_NAMES.index(marker.bone) for marker in layout.markers]
    return bone_colors()[bones]


def byte_color(color: tuple[float, float, float]) -> tuple[int, int, int]:
    """The color with 0 to 255 per channel."""
    red, green, blue = (round(255 * level) for level in color)
    return red, green, blue
