"""Advice: each sentence for the layout that deserves it, and no other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.layout import MarkerPlace
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES
from track.glove_advice.advice import advice
from track.glove_advice.joint_spread import untold_spreads
from track.glove_advice.trials import METHODS, Trial


@pytest.fixture
def good(tips, tips_score):
    """A score of a layout without faults."""
    count = tips.num_markers
    report = dataclasses.replace(
        tips_score.observed, confusion=np.diag([*[100] * count, 0]), slot_accuracy_by_marker=np.ones(count)
    )
    return dataclasses.replace(
        tips_score,
        observed=report,
        seen=np.ones(count),
        near=np.zeros((count, count)),
        joints=np.full(20, 0.05),
        joints_without=np.full((count, 20), 0.2),
        sides_right=1.0,
    )


def test_a_good_layout_is_left_alone(good):
    assert advice(good) == []


def test_confused_markers_are_named(good):
    confusion = good.observed.confusion.copy()
    confusion[2, 2], confusion[2, 4] = 80, 20
    report = dataclasses.replace(good.observed, confusion=confusion)
    (sentence,) = advice(dataclasses.replace(good, observed=report))
    names = good.layout.names
    assert sentence.startswith(f"Move {names[2]} or {names[4]}") and "20 %" in sentence


def test_a_joint_of_which_nothing_is_told_asks_for_a_marker_on_its_bone(good):
    joints = good.joints.copy()
    number = JOINT_NAMES.index("index_PIP_flexion")
    joints[number] = 0.9 * untold_spreads()[number]
    (sentence,) = advice(dataclasses.replace(good, joints=joints))
    assert sentence.startswith("Add a marker on index_middle")


def test_no_marker_is_asked_for_where_every_bone_has_one(good):
    joints = good.joints.copy()
    joints[JOINT_NAMES.index("middle_DIP_flexion")] = untold_spreads()[0]
    (sentence,) = advice(dataclasses.replace(good, joints=joints))
    assert sentence.startswith("Add a marker on middle_middle")  # the tip has one
    bones = [bone for bone in BONE_NAMES if bone.startswith("middle")]
    first, *_, second = good.layout.markers[:4]  # of other digits
    moved = {
        one.name: MarkerPlace(one.name, bone, 0.5, 0.0)
        for one, bone in zip((first, second), bones, strict=False)
    }
    markers = tuple(moved.get(one.name, one) for one in good.layout.markers)
    layout = dataclasses.replace(good.layout, markers=markers)
    assert advice(dataclasses.replace(good, joints=joints, layout=layout)) == []


def test_the_worst_marker_of_captures_is_named(good):
    slots = np.ones(good.layout.num_markers)
    slots[4] = 0.8
    found = Trial(dict.fromkeys(METHODS, slots), dict.fromkeys(METHODS, 0.9), np.zeros(20), 0.0)
    (sentence,) = advice(dataclasses.replace(good, trials={"two touching": found}))
    assert sentence.startswith(f"With two touching {good.layout.names[4]} is labeled worst: right in 80 %")


def test_hidden_touching_and_symmetric_markers_are_told(good):
    seen, near = good.seen.copy(), good.near.copy()
    seen[3], near[5, 6], near[0, 1] = 0.4, 0.1, 0.3  # tips touch, too, because fingers do
    sentences = advice(dataclasses.replace(good, seen=seen, near=near, sides_right=0.7))
    assert len(sentences) == 3
    assert sentences[0].startswith(f"Move {good.layout.names[3]} towards the back") and "40 %" in sentences[0]
    assert sentences[1].startswith("Make the back of the hand less symmetric") and "30 %" in sentences[1]
    assert sentences[2].startswith(f"Move {good.layout.names[5]} and {good.layout.names[6]} apart")


def test_a_marker_that_tells_nothing_can_be_dropped(good):
    without = good.joints_without.copy()
    without[5] = good.joints
    (sentence,) = advice(dataclasses.replace(good, joints_without=without))
    assert sentence.startswith(f"{good.layout.names[5]} can be dropped")
