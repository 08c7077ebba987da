"""Labels that are wrong in every frame of a take are found, or their doubt is told."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from gloves import MarkerLayout, MarkerPlace, Take, load_layout
from gloves.fit import mean_hand
from track import label_capture
from track.alternatives.alternatives import (
    ALTERNATIVES,
    Alternative,
    Doubt,
    doubts_of,
    judge_take,
    label_probability,
    with_doubt,
)
from train import simulate_take

FRAMES = 240


@pytest.fixture(scope="module")
def truth() -> Take:
    """A right hand in dense19 that moves."""
    return simulate_take("single-hand", hands=("right",), num_frames=FRAMES, seed=31).without_body()


def with_labels(take: Take, new: dict[str, str | None]) -> Take:
    """The take with other labels for the points of some markers; None takes them away."""
    names = {name.removeprefix("right:"): number for number, name in enumerate(take.label_names)}
    table = np.arange(-1, len(names))
    for old, label in new.items():
        table[names[old] + 1] = -1 if label is None else names[label]
    points = take.point_list
    labels = table[points.labels + 1].astype(points.labels.dtype)
    return dataclasses.replace(take, point_list=dataclasses.replace(points, labels=labels))


def markers_of(take: Take, numbers: tuple[int, ...]) -> set[str]:
    return {take.hands[0].layout.names[number] for number in numbers}


def test_right_labels_are_sure(truth):
    (judged,) = judge_take(truth)
    assert not judged.is_changed and judged.alternatives[0].probability > 0.99


@pytest.mark.parametrize(
    "new",
    [
        {"BackHand1": "BackHand2", "BackHand2": "BackHand1"},
        {"ThumbTip": "ThumbIP", "ThumbIP": "ThumbMCP", "ThumbMCP": "ThumbCMC", "ThumbCMC": None},
        {"RingTip": "RingPIP", "RingPIP": "RingTip"},
        {"IndexMCP": "MiddleMCP", "IndexPIP": "MiddlePIP", "IndexTip": "MiddleTip"}
        | {"MiddleMCP": "IndexMCP", "MiddlePIP": "IndexPIP", "MiddleTip": "IndexTip"},
        {"BackHand3": None},
        {"BackHand3": "BackHand1", "BackHand1": None},
    ],
    ids=["pair", "shift", "digit", "fingers", "lost", "lost and taken"],
)
def test_labels_that_are_wrong_throughout_are_found(truth, new):
    (judged,) = judge_take(with_labels(truth, new))
    best = judged.alternatives[0]
    assert judged.is_changed and best.words and best.probability > 0.5
    assert markers_of(truth, best.markers) == {*new, *filter(None, new.values())}


def moved(digit: str, along: float) -> Take:
    """A hand whose markers on a digit all sit elsewhere along its bones than the layout says."""
    layout = load_layout("dense19")
    places = [
        dataclasses.replace(one, along=one.along + along) if one.name.startswith(digit) else one
        for one in layout.markers
    ]
    worn = dataclasses.replace(layout, markers=tuple(places))
    take = simulate_take("single-hand", glove=worn, hands=("right",), num_frames=120, seed=5).without_body()
    shape = take.hands[0].shape
    return dataclasses.replace(take, hands=(mean_hand(shape.length, shape.breadth, layout),))


@pytest.mark.parametrize(
    "markers",
    [
        ("ThumbTip", "ThumbIP", "ThumbMCP", "ThumbCMC"),
        ("IndexTip", "IndexPIP", "IndexMCP"),
        ("RingTip", "RingPIP", "RingMCP"),
    ],
)
def test_a_shift_along_a_digit_whose_markers_are_all_off_is_found(markers):
    take = moved(markers[0].removesuffix("Tip"), -0.2)
    (right,) = judge_take(take)
    assert not right.is_changed and right.alternatives[0].probability > 0.9
    shifted = with_labels(take, dict(zip(markers, [*markers[1:], None], strict=True)))
    (judged,) = judge_take(shifted)
    assert judged.is_changed and judged.alternatives[0].probability > 0.9
    assert markers_of(take, judged.alternatives[0].markers) == set(markers)


@pytest.mark.parametrize(
    "twin",
    [
        MarkerPlace("Twin", "index_proximal", along=0.45, around=0.35),
        MarkerPlace("Twin", "ring_middle", along=0.5, around=-0.5),
        MarkerPlace("Twin", "palm", along=0.45, around=0.0, across=0.06),
    ],
    ids=lambda twin: twin.bone,
)
def test_the_doubt_between_look_alikes_does_not_depend_on_which_labels_they_have(twin):
    other = dataclasses.replace(twin, name="Other", around=-twin.around, across=-twin.across)
    sparse = load_layout("starter10")
    layout = dataclasses.replace(sparse, markers=(*sparse.markers, twin, other))
    take = simulate_take("single-hand", glove=layout, hands=("right",), num_frames=120, seed=8).without_body()
    shape = take.hands[0].shape
    take = dataclasses.replace(take, hands=(mean_hand(shape.length, shape.breadth, layout),))
    exchanged = with_labels(take, {"Twin": "Other", "Other": "Twin"})
    given, changed = (
        next((one for one in judge_take(labeled)[0].alternatives if bool(one.words) == is_changed), None)
        for labeled, is_changed in ((take, False), (exchanged, True))
    )
    assert given and changed
    assert given.probability == pytest.approx(changed.probability, abs=0.1)


@pytest.mark.parametrize(
    ("tried", "sure"),
    [
        ([((), 0.5), ((0, 1), 0.5)], {0: 0.5, 1: 0.5}),
        ([((), 0.25), ((0, 1), 0.25), ((2, 3), 0.25), ((4, 5), 0.25)], dict.fromkeys(range(6), 0.5)),
        ([((), 0.2), ((0, 1), 0.4), ((1, 2), 0.4)], {0: 0.6, 1: 0.2, 2: 0.6}),
        ([((0, 1), 1.0)], {0: 0.0, 1: 0.0}),
        ([((), 1.0)], {}),
    ],
    ids=["one pair", "three pairs", "two that share a marker", "wrong", "right"],
)
def test_pairs_of_look_alikes_are_independent(truth, tried, sure):
    record = [{"markers": of, "words": "x" if of else "", "probability": share} for of, share in tried]
    settings = truth.settings | {ALTERNATIVES: {"right": {"tried": record, "distances": []}}}
    expected = np.ones(truth.hand_labels[-1].stop)
    expected[list(sure)] = list(sure.values())
    found = label_probability(dataclasses.replace(truth, settings=settings))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_doubt_is_in_the_confidence_and_in_the_settings(truth):
    take = with_labels(truth, {"BackHand1": "BackHand2", "BackHand2": "BackHand1"})
    doubted = with_doubt(take, judge_take(take))
    sure = dict(zip(truth.label_names, label_probability(doubted), strict=True))
    assert sure["right:BackHand1"] < 0.1 and sure["right:IndexTip"] > 0.99
    labels, confidence = doubted.point_list.labels, doubted.point_list.confidence
    assert (confidence[labels == truth.label_names.index("right:BackHand2")] < 0.1).all()
    assert ALTERNATIVES in doubted.settings
    assert doubts_of(doubted)["right"].tried[0].markers == judge_take(take)[0].alternatives[0].markers
    np.testing.assert_array_equal(label_probability(take), 1.0)


def test_too_few_frames_are_not_judged(truth):
    gone = dataclasses.replace(truth, point_list=truth.point_list.without(truth.point_list.frames > 2))
    assert judge_take(gone) == ()


@pytest.mark.parametrize("off", [0.1, 0.2])
def test_a_layout_with_two_markers_elsewhere_gives_right_labels(truth, off):
    designed = load_layout("dense19")
    places = [
        dataclasses.replace(one, along=one.along + off, across=one.across + off)
        if one.name in ("BackHand1", "BackHand2")
        else one
        for one in designed.markers
    ]
    layout = MarkerLayout("guessed", tuple(places), designed.radius)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        take = label_capture(truth.capture(), glove=layout, hands="right", labeler="dense19")
    labels, true = take.point_list.labels, truth.point_list.labels
    wrong = labels != true
    sure = take.point_list.confidence >= 0.95
    assert wrong[sure].mean() < 0.005
    assert wrong.mean() < 0.005 or not sure[wrong].any()
    if off > 0.15:  # 21 mm
        assert any("mm from where the layout has it" in str(one.message) for one in told)


@pytest.mark.parametrize(("probability", "count"), [(0.1, 1), (0.4, 2), (0.9, 1)])
def test_places_are_no_finding_where_other_labels_are_likelier(probability: float, count: int) -> None:
    tried = (Alternative((0, 1), "A and B are exchanged", probability),)
    faults = list(Doubt(tried, np.array([0.02, 0.0])).faults("right", ("A", "B")))
    assert len(faults) == count
    assert ("may be labeled wrong" in faults[0].why) == (probability > 0.2)
