"""The hand's picture: where things lie on paper, and names that can be read."""

from __future__ import annotations

import base64
import re

import numpy as np
import pytest

from gloves import MarkerLayout, MarkerPlace, attach, load_layout
from gloves.layout import MAX_MARKERS, MIN_MARKERS
from handsim import HandModel
from handsim.hand.shape import BONES, bones_of
from train import GenerateSettings
from train.reports.hand_plot import (
    HAND_SIZE,
    arrow_curve,
    flat_hand,
    mistakes,
    name_extent,
    place_names,
    short,
    slips_picture,
)
from train.simulation.training_frames import slipped_gloves


def any_layout(count: int) -> MarkerLayout:
    """Markers all over the hand, three sides of every bone at most four times."""
    places = []
    for number in range(count):
        place, bone = divmod(number, len(BONES))
        palm = BONES[bone].parent < 0
        around = 0.0 if palm else np.deg2rad((0.0, 50.0, -60.0, 170.0)[place])
        along = 0.3 + 0.15 * place if palm else 0.15 + 0.25 * place
        across = 0.25 * (-1) ** place if palm else 0.0
        places.append(MarkerPlace(f"{BONES[bone].name}{place}", BONES[bone].name, along, around, across))
    return MarkerLayout("all over", tuple(places), 0.003)


def area(loop):
    ahead = np.roll(loop, -1, axis=0)
    return 0.5 * float((loop[:, 0] * ahead[:, 1] - loop[:, 1] * ahead[:, 0]).sum())


def test_a_right_hand_from_the_back():
    layout = load_layout("dense19")
    hand = flat_hand(layout)
    places = dict(zip(layout.names, hand.markers, strict=True))
    assert places["ThumbTip"][0] < places["IndexTip"][0] < places["RingTip"][0] < places["PinkyTip"][0]
    assert max(places, key=lambda name: places[name][1]) == "MiddleTip"
    assert not hand.below.any()
    assert len(hand.bones) == 20  # fifteen of the digits, and from the wrist to each digit
    tips = hand.bones[[bones_of(digit)[2] - 1 for digit in ("index", "middle", "ring", "little")], 1]
    assert (np.diff(tips[:, 0]) > 0).all()


def test_the_outline_goes_around_the_whole_hand():
    hand, model = flat_hand(load_layout("sparse13")), HandModel.named("M")
    vertices = model.surface.vertices
    outline = max(hand.outlines, key=area)
    np.testing.assert_allclose(np.ptp(outline, axis=0), np.ptp(vertices[:, [1, 0]], axis=0), atol=1e-12)
    # A hand is about as wide as its breadth along two thirds of its length.
    assert 0.5 < area(outline) / (model.shape.breadth * np.ptp(vertices[:, 0])) < 1.0
    assert all((loop[0] == loop[-1]).all() for loop in hand.outlines)


def test_markers_of_the_palm_side_are_told():
    hand = flat_hand(any_layout(MAX_MARKERS))
    layout = any_layout(MAX_MARKERS)
    for marker, below in zip(layout.markers, hand.below, strict=True):
        if "palm" not in marker.bone and "thumb" not in marker.bone:
            assert below == (marker.around > 2.0)


def test_mistakes_are_the_most_frequent_pairs():
    confusion = np.diag([90, 80, 100, 7])
    confusion[0, 2], confusion[1, 0], confusion[1, 2], confusion[2, 3], confusion[3, 1] = 10, 15, 5, 40, 30
    found = mistakes(confusion)
    assert [(one.truth, one.called, one.points) for one in found] == [(1, 0, 15), (0, 2, 10), (1, 2, 5)]
    assert [one.share for one in found] == pytest.approx([0.15, 0.1, 0.05])
    assert mistakes(confusion, most=1) == found[:1]
    assert mistakes(np.diag([3, 0, 1, 5])) == []


@pytest.mark.parametrize("count", [MIN_MARKERS, 19, MAX_MARKERS])
def test_names_do_not_lie_on_one_another(count):
    layout = load_layout("dense19") if count == 19 else any_layout(count)
    size = (72.0 * HAND_SIZE[0], 72.0 * HAND_SIZE[1])
    dots = 3000.0 * flat_hand(layout).markers + (350.0, 100.0)
    confusion = np.eye(count + 1, dtype=int) + np.roll(np.eye(count + 1, dtype=int), 3, axis=1)
    curves = [arrow_curve(dots[arrow.truth], dots[arrow.called]) for arrow in mistakes(confusion)]
    places = place_names(list(layout.names), dots, curves, size)
    half = np.array([name_extent(name) for name in layout.names]) / 2.0
    apart = (np.abs(places[:, None] - places) - (half[:, None] + half)).max(axis=-1)
    assert apart[~np.eye(count, dtype=bool)].min() > 0.0
    assert ((places - half > 0.0) & (places + half < size)).all()
    from_dots = np.abs(places[:, None] - dots) - half[:, None]
    assert from_dots.max(axis=-1).min() > 0.0, "a name lies on a dot"


def test_slips_of_every_marker_are_named_once():
    layout, model = any_layout(64 - len(BONES)), HandModel.named("M")
    slips = slipped_gloves(layout, model, GenerateSettings(), rng=np.random.default_rng(0))
    moved = np.stack([fit.attachment.points for fit in slips]) - attach(layout, model).attachment.points
    assert len(slips) == 100 and np.linalg.norm(moved, axis=-1).max() > 0.003
    drawn = base64.b64decode(slips_picture(layout, slips).split(",")[1]).decode()
    names = re.findall(r"<!-- (\S+) -->", drawn)
    assert sorted(names) == sorted(short(name) for name in layout.names)
