"""Hands of another person, at a wrong scale, or of more than one person are told, and right ones are not."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from gloves import Capture, GloveFit, Take, load_layout
from gloves.fit import mean_hand
from handsim import HandSimWarning
from handsim.errors import HandSimError
from track import calibrate, label_capture, track_capture
from track.alternatives.hands import OTHER_HANDS, other_hands_of, with_other_hands
from track.takes.take_summary import suspicions
from train import load_labeler, simulate_take

FRAMES = 120
GLOVES = "dense19", "sparse13", "starter10"


@functools.cache
def person(seed: int, glove: str = "dense19", side: str = "right", frames: int = FRAMES) -> Take:
    """The moving hand of a person."""
    return simulate_take("free", glove=glove, num_frames=frames, hands=(side,), seed=seed).without_body()


def told(take: Take, **given: str) -> list[str]:
    """What is told of a take's hands, with the origins of those that are given."""
    named = take.hands[0].layout.name if take.hands[0].layout.name in GLOVES[:2] else "dense19"
    return [str(one) for one in other_hands_of(with_other_hands(take, given, load_labeler(named)))]


def in_hand(take: Take, hand: GloveFit) -> Take:
    """The take as if tracked with another hand."""
    return dataclasses.replace(take, hands=(hand.with_side(take.sides[0]),))


def scaled(take: Take, scale: float) -> Take:
    points = dataclasses.replace(take.point_list, points=scale * take.point_list.points)
    return dataclasses.replace(take, point_list=points)


def of_clouds(clouds: list[np.ndarray]) -> Capture:
    """A capture of clouds (T, N, 3) of other columns."""
    positions = np.concatenate(clouds, axis=1)
    return Capture(tuple(f"*{n}" for n in range(positions.shape[1])), positions, 120.0)


def after_another(one: Take, other: Take, gap: int) -> Take:
    """A take of one hand, and then of another, between which no point is seen."""
    layout, worn = one.hands[0].layout, one.hands
    seen = [one.observed(one.sides[0]), np.full((gap, layout.num_markers, 3), np.nan)]
    points = np.concatenate([*seen, other.observed(other.sides[0])])
    labels = np.where(np.isfinite(points[..., 0]), np.arange(points.shape[1]), -1)
    qpos = np.concatenate([one.qpos, np.repeat(one.qpos[-1:], gap, axis=0), other.qpos])
    return Take.of_truth(worn, qpos, points, labels, labels, rate=one.rate)


@pytest.mark.parametrize("glove", GLOVES)
@pytest.mark.parametrize(("seed", "other"), [(102, 104), (101, 102)])
def test_another_persons_calibrated_hand_is_told_and_the_own_is_not(glove, seed, other):
    take, wrong = person(seed, glove), person(other, glove).hands[0]
    assert told(take, right="calibrated") == []
    (sentence,) = told(in_hand(take, wrong), right="calibrated")
    given = (
        f"better than the given one of {1e3 * wrong.shape.length:.0f} x {1e3 * wrong.shape.breadth:.0f} mm"
    )
    assert sentence.startswith("the right hand fits a hand of ") and given in sentence
    assert "calibrate them again, or leave them out" in sentence


@pytest.mark.parametrize("scale", [1.15, 1.25, 0.8])
def test_a_scale_at_which_the_given_hand_does_not_fit_is_told(scale):
    (sentence,) = told(scaled(person(105), scale), right="calibrated")
    times = float(sentence.split("may be ")[1].split()[0])
    assert times == pytest.approx(scale, abs=0.04) and sentence.endswith("times too large")


@pytest.mark.parametrize(("length", "is_told"), [(0.15, False), (0.187, False), (0.21, False), (0.235, True)])
def test_a_measured_hand_that_is_longer_than_peoples_is_told(length, is_told):
    sentences = told(in_hand(person(100), mean_hand(length, 0.44 * length, load_layout("dense19"))))
    assert [one.split(",")[0] for one in sentences] == [
        f"the right hand is {1e3 * length:.0f} mm long"
    ] * is_told


def test_a_given_hand_that_is_longer_than_peoples_is_told():
    hand = mean_hand(0.235, 0.44 * 0.235, load_layout("dense19"))
    sentences = told(in_hand(person(100), hand), right="calibrated")
    assert sentences[0].startswith("the right hand is 235 mm long, longer than people's")


@pytest.mark.parametrize(("seed", "other"), [(100, 105), (101, 100), (105, 104)])
def test_a_second_persons_hand_after_the_first_is_told(seed, other):
    take = after_another(person(seed), person(other), 30)
    (sentence,) = told(take)
    assert sentence.startswith(f"the right hand is another one from {(FRAMES + 30) / 120:.2f} s on, of ")
    sizes = [float(words.split()[0]) for words in sentence.split(" of ")[1:][:1]]
    sizes.append(float(sentence.split("instead of ")[1].split()[0]))
    expected = [1e3 * person(one).hands[0].shape.length for one in (other, seed)]
    np.testing.assert_allclose(sizes, expected, atol=6.0)


@pytest.mark.parametrize("seed", [100, 104, 105])
def test_the_same_hand_that_comes_back_is_not_told(seed):
    whole = person(seed, frames=2 * FRAMES)
    assert told(after_another(whole.cut(0, FRAMES), whole.cut(FRAMES, 2 * FRAMES), 30)) == []


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize(("seed", "other"), [(100, 105), (101, 103)])
def test_a_second_hand_of_the_same_side_is_told(side, seed, other):
    one, two = person(seed, side=side), person(other, side=side)
    free = two.observed(side) + [0.4, 0.0, 0.0]
    points = np.concatenate([one.observed(side), free], axis=1)
    count = one.hands[0].layout.num_markers
    labels = np.where(np.isfinite(points[..., 0]) & (np.arange(2 * count) < count), np.arange(2 * count), -1)
    ids = np.where(np.isfinite(points[..., 0]), np.arange(2 * count), -1)
    take = Take.of_truth(one.hands, one.qpos, points, ids, labels, rate=one.rate)
    (sentence,) = told(take)
    assert sentence.startswith(f"the {side} hand is there twice, from 0.00 s on")


def test_the_other_hand_and_strays_are_no_second_hand(rng):
    one, two = person(100), person(105, side="left")
    strays = rng.uniform(-0.3, 0.3, (FRAMES, 25, 3))
    for free in (two.observed("left") + [0.4, 0.0, 0.0], strays):
        points = np.concatenate([one.observed("right"), free], axis=1)
        columns = np.arange(points.shape[1])
        ids = np.where(np.isfinite(points[..., 0]), columns, -1)
        labels = np.where(columns < 19, ids, -1)
        assert told(Take.of_truth(one.hands, one.qpos, points, ids, labels, rate=one.rate)) == []


@pytest.mark.slow
@pytest.mark.parametrize("verb", [label_capture, track_capture])
def test_files_are_told_of_once_and_takes_keep_it(verb):
    one, two = person(100), person(105)
    capture = of_clouds([one.points, two.points + [0.4, 0.0, 0.0]])
    with pytest.warns(HandSimWarning, match="the right hand is there twice") as caught:
        take = verb(capture, hands="right")
    assert sum("twice" in str(warning.message) for warning in caught) == 1
    assert [one["side"] for one in take.settings[OTHER_HANDS]] == ["right"]
    if verb is track_capture:
        assert str(other_hands_of(take)[0]) in suspicions(take)


@pytest.mark.slow
def test_calibrate_and_given_hands_are_told():
    take = person(100, frames=600)
    with pytest.warns(HandSimWarning, match="the right hand fits a hand of .* better than the given one"):
        calibrate(take.capture(), hands=[person(105).hands[0]])
    with pytest.warns(HandSimWarning, match="the right hand fits a hand of .* better than the given one"):
        track_capture(take.cut(0, FRAMES).capture(), hands=[person(105).hands[0]])


@pytest.mark.parametrize("scale", [1e3, 1e2, 1 / 0.0254])
@pytest.mark.parametrize("verb", [label_capture, track_capture, calibrate])
def test_another_unit_is_refused_in_one_sentence(scale, verb):
    capture = person(100).capture()
    wrong = dataclasses.replace(capture, positions=scale * capture.positions)
    with pytest.raises(HandSimError, match=r"expected a hand in meters; (milli|centi)meters\?|of their size"):
        verb(wrong)
