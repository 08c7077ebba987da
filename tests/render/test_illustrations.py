"""Scenes of ready-made pictures: who is in them, and their colors and depth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves.fit import Attachment, GloveFit
from handsim.errors import HandSimError
from handsim.hand.model import HandModel, join_qpos
from handsim.space.camera import look_at
from poses.shapes import gesture
from render.illustrations import (
    Balls,
    HandScene,
    PosedHand,
    View,
    render_depth,
    render_rgb,
    unoccluded,
    view_along,
)

SIZE = (320, 240)


def test_projection_of_known_points() -> None:
    view = View(np.eye(4), field_of_view=np.pi / 2)  # at the origin, looking along z, y down
    points = np.array([[0.0, 0.0, 2.0], [0.0, 2.0, 2.0], [1.0, 0.0, 2.0]])
    np.testing.assert_allclose(view.project(points, SIZE), [[160, 120], [160, 240], [220, 120]])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.5), st.floats(0.0, 0.3))
def test_view_along_holds_all_points_and_touches_the_margin(seed: int, angle: float, margin: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((20, 3)) * rng.uniform(0.01, 1.0, 3)
    direction, up = rng.standard_normal((2, 3))
    view = view_along(direction, up, points, SIZE, field_of_view=angle, margin=margin)
    share = view.project(points, SIZE) / SIZE
    ahead = (points - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2]
    assert ahead.min() > 0.019  # or the camera would cut it off
    assert share.min() >= margin - 1e-9
    assert share.max() <= 1 - margin + 1e-9
    low, high = share.min(axis=0), share.max(axis=0)
    touching = np.isclose(high - low, 1 - 2 * margin).any()
    assert touching or ahead.min() < 0.021  # no nearer view would do
    assert view.T_world_camera[:3, 1] @ up < 0  # y is down
    assert np.isclose(np.linalg.det(view.T_world_camera[:3, :3]), 1.0)


def test_view_along_agrees_with_look_at() -> None:
    place, target = np.array([0.5, -1.0, 0.7]), np.array([0.1, 0.2, 0.0])
    view = view_along(target - place, np.array([0.0, 0.0, 1.0]), np.array([target, target + 0.1]), SIZE)
    np.testing.assert_allclose(view.T_world_camera[:3, :3], look_at(place, target)[:3, :3], atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, -1.0, 4.0, np.nan])
def test_impossible_views_are_told(angle: float) -> None:
    with pytest.raises(HandSimError, match="field_of_view"):
        View(np.eye(4), angle)


def test_a_hand_needs_one_pose(model: HandModel) -> None:
    with pytest.raises(HandSimError, match="qpos"):
        PosedHand(model, join_qpos(np.zeros((2, 20))))


SMALL = (160, 120)
UP = np.array([1.0, 0.0, 0.0])


def pixel_rays(view: View, pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Rays (N, 3) through pixel centers, of length one along the camera's axis."""
    focal = 0.5 * size[1] / np.tan(view.field_of_view / 2)
    local = np.concatenate([(pixels + 0.5 - np.array(size) / 2) / focal, np.ones((len(pixels), 1))], axis=1)
    return local @ view.T_world_camera[:3, :3].T


def cast(origin: np.ndarray, rays: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Shares of the rays to the first triangle each meets, 0 where none (Cramer's rule, every pair)."""
    edges = triangles[:, 1:] - triangles[:, :1]
    depths = np.zeros(len(rays))
    for number, ray in enumerate(rays):
        matrix = np.stack([edges[:, 0], edges[:, 1], np.broadcast_to(-ray, edges[:, 0].shape)], axis=-1)
        u, v, depth = np.linalg.solve(matrix, (origin - triangles[:, 0])[..., None])[..., 0].T
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
        depths[number] = depth[met].min() if met.any() else 0.0
    return depths


def test_depth_of_a_sphere() -> None:
    center, radius = np.array([0.3, -0.2, 1.0]), 0.05
    place = np.array([0.1, 0.3, 0.6])
    view = View(look_at(place, center + np.array([0.01, 0.02, -0.03])), np.deg2rad(12.0))
    depth = render_depth(HandScene(view, balls=(Balls(center[None], radius),)), SMALL)
    assert depth.shape == (120, 160)
    assert depth.dtype == np.float32
    rows, columns = np.mgrid[0:120:7, 0:160:7]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    rays = pixel_rays(view, pixels, SMALL)
    # |place + d ray - center| = radius, the nearer d
    a, b = (rays**2).sum(1), rays @ (place - center)
    root = b**2 - a * (((place - center) ** 2).sum() - radius**2)
    truth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0.0)
    drawn = depth[pixels[:, 1], pixels[:, 0]]
    rim = np.abs(root) < 2e-3  # there the ball's facets matter
    assert (truth[~rim] > 0).sum() > 20
    np.testing.assert_allclose(drawn[~rim], truth[~rim], atol=4e-4)


@pytest.mark.parametrize("side", ["right", "left"])
def test_depth_of_a_hand_is_what_rays_meet(side: str, rng: np.random.Generator) -> None:
    model = HandModel.named("S", side=side)  # type: ignore[arg-type]
    qpos = join_qpos(
        gesture("pinch_index")[None], position=np.array([0.1, 0.2, 1.0]), quaternion=rng.standard_normal(4)
    )[0]
    hand = PosedHand(model, qpos)
    view = view_along(np.array([0.3, 1.0, -0.4]), np.array([0.0, 0.0, 1.0]), hand.vertices(), SMALL)
    depth = render_depth(HandScene(view, (hand,)), SMALL)
    pixels = rng.integers(0, SMALL, size=(150, 2))
    triangles = hand.vertices()[model.surface.faces]
    truth = cast(view.T_world_camera[:3, 3], pixel_rays(view, pixels, SMALL), triangles)
    drawn = depth[pixels[:, 1], pixels[:, 0]]
    assert 20 < (truth > 0).sum() < 140
    assert (np.abs(drawn - truth) < 2e-4).mean() > 0.97  # a pixel on an edge may go either way


def test_picture_shows_hand_markers_and_background(model: HandModel, attachment: Attachment) -> None:
    hand = PosedHand(
        GloveFit(model, attachment), join_qpos(gesture("flat")[None])[0], "glove", (0.0, 1.0, 0.0)
    )
    view = view_along(np.array([0.0, 0.0, -1.0]), UP, hand.vertices(), (300, 300))
    scene = HandScene(view, (hand,), background=(1.0, 1.0, 1.0))
    picture = render_rgb(scene, (300, 300))
    assert picture.shape == (300, 300, 3)
    assert picture.dtype == np.uint8
    assert (picture[0, 0] == 255).all()
    back = attachment.layout.names.index("BackHand1")
    column, row = view.project(hand.markers()[back], (300, 300)).astype(int)
    red, green, blue = picture[row, column].astype(int)
    assert green > 150 > max(red, blue)
    assert picture[row, column + 12].max() < 120  # the dark glove beside it
    bare = render_rgb(HandScene(view, (PosedHand(model, hand.qpos),)), (300, 300)).astype(int)
    assert bare[row, column, 0] > bare[row, column, 2] + 20  # skin


def test_left_hand_is_the_mirror_image_of_the_right_one() -> None:
    depths, pictures = [], []
    for side, mirror in (("right", 1.0), ("left", -1.0)):
        model = HandModel.named("M", side=side)  # type: ignore[arg-type]
        hand = PosedHand(model, join_qpos(gesture("gun")[None])[0])
        view = view_along(np.array([0.2, 0.5 * mirror, -1.0]), UP, hand.vertices(), (200, 200))
        depths.append(render_depth(HandScene(view, (hand,)), (200, 200)))
        pictures.append(render_rgb(HandScene(view, (hand,)), (200, 200)))
    flipped = depths[1][:, ::-1]
    assert (np.abs(depths[0] - flipped) < 1e-3).mean() > 0.99
    assert (np.abs(depths[0] - depths[1]) < 1e-3).mean() < 0.9  # the hand itself is not symmetric
    covered = [(np.abs(picture.astype(int) - picture[0, 0]) > 20).any(-1) for picture in pictures]
    assert (covered[0] == covered[1][:, ::-1]).mean() > 0.99


def test_missing_points_are_not_drawn() -> None:
    view = View(np.eye(4), 1.0)
    centers = np.array([[np.nan] * 3, [0.0, 0.0, 1.0]])
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    picture = render_rgb(HandScene(view, balls=(Balls(centers, 0.1, colors),)), SMALL)
    red, _, blue = picture[60, 80].astype(int)
    assert blue > red + 50
    nothing = HandScene(view, balls=(Balls(centers[:1], 0.1),))
    assert not render_depth(nothing, SMALL).any()
    assert (render_rgb(nothing, SMALL) == picture[0, 0]).all()


def test_what_stands_before_a_point() -> None:
    view = View(np.eye(4), 1.0)
    depth = render_depth(HandScene(view, balls=(Balls(np.array([[0.0, 0.0, 1.0]]), 0.1),)), SMALL)
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.95], [0.0, 0.0, 2.0], [0.3, 0.0, 2.0], [9.0, 0.0, 1.0]])
    assert unoccluded(depth, view, points, slack=0.11).tolist() == [True, True, False, True, False]


def test_pictures_of_no_size_are_told() -> None:
    with pytest.raises(HandSimError, match="pictures of 0 x 10 pixels"):
        render_depth(HandScene(View(np.eye(4), 1.0)), (0, 10))
