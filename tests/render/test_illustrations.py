from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import Attachment, GloveFit, MarkerLayout, MarkerPlace, attach, load_layout
from gloves.fit import settle_glove, vary_layout
from handsim import Camera, HandModel, join_qpos, look_at
from handsim.pages import distinct_colors
from handsim.space.camera import pinhole
from poses.shapes import gesture
from render.illustrations import Balls, PosedHand, draw_glove, draw_things, unoccluded, view_along

SIZE = (320, 240)
SMALL = (160, 120)
UP = np.array([1.0, 0.0, 0.0])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.5), st.floats(0.0, 0.3))
def test_view_along_holds_all_points_and_touches_the_margin(seed: int, angle: float, margin: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((20, 3)) * rng.uniform(0.01, 1.0, 3)
    direction, up = rng.standard_normal((2, 3))
    view = view_along(direction, up, points, SIZE, field_of_view=angle, margin=margin)
    share = view.project(points) / SIZE
    ahead = view.local(points)[:, 2]
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


def test_picture_shows_hand_markers_and_background(model: HandModel, attachment: Attachment) -> None:
    fit = GloveFit(model, attachment)
    hand = PosedHand(fit, join_qpos(gesture("flat")[None])[0], "glove", (0.0, 1.0, 0.0))
    view = view_along(np.array([0.0, 0.0, -1.0]), UP, hand.vertices(), (300, 300))
    picture = draw_things(view, hand, behind=(1.0, 1.0, 1.0))
    assert picture.shape == (300, 300, 3)
    assert picture.dtype == np.uint8
    assert (picture[0, 0] == 255).all()
    back = attachment.layout.names.index("BackHand1")
    column, row = view.project(fit.markers(hand.qpos[None])[0][0][back]).astype(int)
    red, green, blue = picture[row, column].astype(int)
    assert green > 150 > max(red, blue)
    assert picture[row, column + 12].max() < 120  # the dark glove beside it
    bare = draw_things(view, PosedHand(model, hand.qpos)).astype(int)
    assert bare[row, column, 0] > bare[row, column, 2] + 20  # skin


def test_left_hand_is_the_mirror_image_of_the_right_one() -> None:
    pictures = []
    for side, mirror in (("right", 1.0), ("left", -1.0)):
        model = HandModel.named("M", side=side)  # type: ignore[arg-type]
        hand = PosedHand(model, join_qpos(gesture("gun")[None])[0])
        view = view_along(np.array([0.2, 0.5 * mirror, -1.0]), UP, hand.vertices(), (200, 200))
        pictures.append(draw_things(view, hand))
    covered = [(np.abs(picture.astype(int) - picture[0, 0]) > 20).any(-1) for picture in pictures]
    assert (covered[0] == covered[1][:, ::-1]).mean() > 0.99
    assert (covered[0] == covered[1]).mean() < 0.95  # the hand itself is not symmetric


@pytest.fixture
def ahead() -> Camera:
    """A camera at the origin that looks along z."""
    return pinhole("view", SMALL, 110.0).at(np.eye(4))


def test_missing_points_are_not_drawn(ahead: Camera) -> None:
    centers = np.array([[np.nan] * 3, [0.0, 0.0, 1.0]])
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    picture = draw_things(ahead, Balls(centers, 0.1, colors))
    red, _, blue = picture[60, 80].astype(int)
    assert blue > red + 50
    assert (draw_things(ahead, Balls(centers[:1], 0.1)) == picture[0, 0]).all()


def test_what_stands_before_a_point(model: HandModel) -> None:
    hand = PosedHand(model, join_qpos(gesture("flat")[None], position=np.array([0.0, 0.0, 0.6]))[0])
    view = view_along(np.array([0.0, 0.0, 1.0]), UP, hand.vertices(), SIZE)
    middle = hand.vertices().mean(axis=0)
    points = middle + np.array([[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert unoccluded(view, hand, points, slack=0.03).tolist() == [True, False, True, False]


def test_slips_of_a_marker_are_dots_of_its_color_on_the_side_where_it_is(model: HandModel) -> None:
    tips = load_layout("tips8").markers
    pad = MarkerPlace("Pad", "index_middle", 0.5, np.pi)
    fit = attach(MarkerLayout("with a pad", (pad, *tips), 0.003), model)
    slips = [
        settle_glove(vary_layout(fit.layout, along=0.05, around=0.1, rng=np.random.default_rng(seed)), model)
        for seed in range(20)
    ]
    color = np.rint(255 * np.array(distinct_colors(fit.layout.num_markers)[0]))

    def dots(side: str) -> int:
        with_slips = draw_glove(fit, sides=(side,), slips=slips)
        lower = with_slips[len(draw_glove(fit, sides=(side,))) :]
        assert len(lower) > 300
        return int((np.abs(lower.astype(int) - color).max(axis=-1) < 30).sum())

    assert dots("palm") > 40
    assert dots("back") == 0
