"""Left and right hands are told apart by what their markers are called."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.fit import attach_markers
from gloves.layout import MarkerLayout, MarkerPlace, list_layouts, load_layout
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses.shapes import sample_valid_angles
from train.labelers.side import SideClassifier, is_mirror_like


@pytest.fixture(scope="module", params=["dense19", "sparse13"])
def classifier(request):
    layout = load_layout(request.param)
    return layout, SideClassifier(layout, rng=np.random.default_rng(0))


def hands(layout, side, rng, count=60):
    hand = HandModel.named("M", side=side)
    qpos = join_qpos(sample_valid_angles(hand, count, rng=rng), quaternion=random_quaternions(count, rng=rng))
    return attach_markers(layout, hand).markers(hand, hand.forward_kinematics(qpos))[0]


@pytest.mark.parametrize("side", ["left", "right"])
def test_unknown_poses_are_told_also_with_markers_missing(classifier, side, rng):
    layout, tells = classifier
    right = whole = 0
    for points in hands(layout, side, rng):
        whole += tells.classify(points, np.arange(len(points)))[0] == side
        here = rng.permutation(len(points))[3:]
        right += tells.classify(points[here], here)[0] == side
    assert whole >= 58
    assert right >= 55


def test_a_mirror_turns_the_answer_and_nothing_else_matters(classifier, rng):
    layout, tells = classifier
    (points,) = hands(layout, "right", rng, count=1)
    side, clear = tells.classify(points, np.arange(len(points)))
    moved = points @ quaternion_matrix(random_quaternions(1, rng=rng))[0].T + [1.0, -2.0, 0.5]
    order = rng.permutation(len(points))
    assert tells.classify(moved[order], order) == (side, pytest.approx(clear))
    mirrored, as_clear = tells.classify(points * (1.0, 1.0, -1.0), np.arange(len(points)))
    assert {side, mirrored} == {"left", "right"}
    assert as_clear == pytest.approx(clear)


def test_too_few_points_say_nothing(classifier, rng):
    _, tells = classifier
    points = rng.normal(size=(5, 3))
    for labels in ([0, 1, 2, -1, -1], [-1] * 5):
        assert tells.classify(points, np.array(labels)) == ("right", 0.0)
    assert tells.classify(np.zeros((0, 3)), np.zeros(0, dtype=int)) == ("right", 0.0)


@pytest.mark.parametrize("name", list_layouts())
def test_no_shipped_layout_is_like_its_mirror_image(name):
    assert not is_mirror_like(load_layout(name))


def test_a_symmetric_layout_without_a_thumb_is_like_its_mirror_image():
    tips = [MarkerPlace(digit, f"{digit}_distal", 0.7, 0.0) for digit in DIGITS[1:]]
    back = [
        MarkerPlace(f"back{along}{across}", "palm", along, 0.0, across)
        for along in (0.3, 0.7)
        for across in (0.2, -0.2)
    ]
    layout = MarkerLayout("symmetric", (*tips, *back), 0.0032)
    assert is_mirror_like(layout)
    thumb = MarkerPlace("thumb", "thumb_distal", 0.7, 0.0)
    assert not is_mirror_like(dataclasses.replace(layout, markers=(*tips, *back, thumb)))
