"""Arms in pictures: they leave hands free, and bend no farther than arms do."""

import functools
from typing import get_args

import numpy as np
import pytest

from gloves import Take
from render import draw
from render.arms import hiding_costs, most_hidden
from render.config import resolve
from render.drawing import Drawing
from render.frames import FOREARM, PARTS_A_HAND, RenderedFrame
from render.studio import Moment, Studio
from render.subject import subject_of_take
from render.viewpoints import Placement
from train import simulate_take

EYE = np.array([[[0.0, -0.6, 0.0]]])
POINTS = np.array([[[x, 0.0, 0.0] for x in (-0.02, 0.0, 0.02)]])


def arm(y: float, z: float = 0.0) -> np.ndarray:
    """The axis of an arm across the view, at a distance and a height [m]."""
    return np.array([[[[-1.0, y, z], [1.0, y, z]]]])


def test_an_arm_before_points_hides_them_and_one_beside_or_behind_them_does_not():
    hides = hiding_costs(arm(-0.3), EYE, POINTS)
    assert hides.shape == (1, 1) and hides[0, 0] > 0.0
    assert hiding_costs(arm(-0.55, 0.1), EYE, POINTS) == hides, "an arm close to the eye hides all"
    for free in (arm(-0.3, 0.1), arm(0.1), arm(-0.3) * np.nan):
        assert hiding_costs(free, EYE, POINTS) == 0.0
    half = 0.5 * (hiding_costs(arm(-0.3, 0.05), EYE, POINTS) / hides)[0, 0]
    assert 0.0 < half < 0.5


def test_the_hand_that_arms_hide_most_counts_and_absent_hands_do_not():
    hands = np.stack([POINTS[0], POINTS[0] + [0.0, 0.0, 0.3], np.full((3, 3), np.nan)])[None]
    assert most_hidden(arm(-0.3), EYE[0], hands) == 1.0
    assert most_hidden(arm(-0.3), EYE[0], hands[:, 1:]) == 0.0


@functools.cache
def a_take(kind: str, seed: int) -> Take:
    return simulate_take(kind=kind, num_frames=240, seed=seed)


def are_free(frame: RenderedFrame) -> bool:
    """Whether the picture has half of each hand's keypoints where no arm hides them."""
    shares = []
    for number, hand in enumerate(frame.hands):
        inside = ((hand.keypoints >= 0.0) & (hand.keypoints < frame.camera.size)).all(axis=1)
        columns, rows = np.where(inside[:, None], hand.keypoints, 0.0).astype(int).T
        shown = frame.ideal.parts[rows, columns].astype(int) - 1
        of_arm = (shown >= 0) & (shown % PARTS_A_HAND == FOREARM)
        of_arm[0] &= shown[0] // PARTS_A_HAND != number  # at the wrist an arm begins
        shares.append((inside & ~of_arm).mean())
    return min(shares) >= 0.5


@pytest.mark.parametrize("placement", get_args(Placement))
@pytest.mark.parametrize(("kind", "seed"), [("hand-hand", 61), ("single-hand", 9405)])
def test_arms_leave_both_hands_free(kind, seed, placement):
    frames = draw(a_take(kind, seed), view={"placement": placement}, passes=("ids",), num_frames=12)
    assert np.mean([are_free(frame) for frame in frames]) >= (0.85 if placement == "rig" else 0.95)


def test_elbows_bend_no_farther_than_elbows_do():
    take = a_take("hand-hand", 61)
    bends = []
    for placement in get_args(Placement):
        drawing = Drawing(subject_of_take(take), resolve(settings={"view": {"placement": placement}}))
        studio = Studio(take.hands, drawing.config, rng=np.random.default_rng(0), has_user=True)
        for frame in range(0, 240, 20):
            cameras = drawing.viewpoints.cameras(frame)
            moment = studio.reaching(Moment(take, frame), cameras, drawing._user)
            np.testing.assert_allclose(np.linalg.norm(moment.forearms, axis=1), 1.0)
            cosines = (moment.forearms * moment.upper_arms).sum(axis=1)
            bends += np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0))).tolist()
    assert max(bends) <= 130.0
