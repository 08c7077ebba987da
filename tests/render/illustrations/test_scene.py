from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import HandSimError
from handsim.hand.model import HandModel, join_qpos
from handsim.space.camera import look_at
from render.illustrations.scene import PosedHand, View, view_along

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
