"""What is known of a layout: counted again by other means where that is possible."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import MarkerPlace, Take, attach, load_layout
from handsim import HandModel, load_rig
from handsim.errors import CaptureError
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES, JOINTS
from poses import sample_poses
from track import Trial, label_capture, track_capture
from track.alternatives.alternatives import Alternative
from track.gloves.glove_improvement import verdict
from track.gloves.glove_page import trial_rows, write_glove_page, wrong_line
from track.gloves.glove_score import (
    METHODS,
    NOISE,
    SIDES_EXCHANGED,
    _count_right,
    _wrong_throughout,
    free_spreads,
    joint_spreads,
    layout_spreads,
    mean_trial,
    score_layout,
    try_take,
)
from track.kinematics.pose_solver import PoseSolver
from train import load_labeler, simulate_take
from train.forecast.rig_forecast import observe_motion, observe_poses
from train.labelers.layout_labeler import LayoutLabeler
from train.labelers.storage import shipped_labelers

SHIFT = ((1, 2), (2, 5), (5, 1))


def test_seen_markers_are_counted(tips, tips_hands, tips_score):
    observed = np.concatenate([hand.frames.observed for hand in tips_hands])
    np.testing.assert_allclose(tips_score.seen, np.isfinite(observed).all(axis=2).mean(axis=0))
    assert 0.0 < tips_score.few_seen == (np.isfinite(observed).all(axis=2).sum(axis=1) < 6).mean()


def test_slots_are_right_more_often_where_all_is_seen(tips, tips_score):
    clean, observed = tips_score.clean.figures, tips_score.observed.figures
    assert 1.0 / tips.num_markers < observed["slot_accuracy"] <= clean["slot_accuracy"] + 0.02
    assert tips_score.observed.num_frames == tips_score.clean.num_frames


def test_the_hands_of_a_take_wear_the_layout(tips):
    take = simulate_take("hand-hand", num_frames=60)
    hands = observe_motion(take, tips, load_rig("figure5"), 20, rng=np.random.default_rng(3))
    assert [hand.fit.side for hand in hands] == [hand.side for hand in take.hands]
    assert all(hand.frames.markers.shape == (20, tips.num_markers, 3) for hand in hands)
    np.testing.assert_array_equal(hands[0].qpos[:, 7:], take.qpos[np.linspace(0, 59, 20).astype(int), 0, 7:])
    empty = Take.of_poses(take.hands, np.full_like(take.qpos, np.nan), rate=take.rate)
    with pytest.raises(CaptureError, match="no frame in which every hand"):
        observe_motion(empty, load_layout("tips8"), load_rig("six"), 20, rng=np.random.default_rng(3))


@pytest.fixture(scope="session")
def tips():
    return load_layout("tips8")


@pytest.fixture(scope="session")
def tips_hands(tips):
    return observe_poses(tips, load_rig("six"), 240, rng=np.random.default_rng(0))


@pytest.fixture(scope="session")
def tips_score(tips, tips_hands):
    labeler = LayoutLabeler.at_once(tips, num_poses=2000)
    return score_layout(tips, tips_hands, labeler, rng=np.random.default_rng(1))


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
        few_seen=0.0,
        joints=np.full(20, 0.05),
    )


def test_a_good_layout_is_left_alone(good):
    assert good.advice == ()


def test_confused_markers_are_named(good):
    confusion = good.observed.confusion.copy()
    confusion[2, 2], confusion[2, 4] = 80, 20
    report = dataclasses.replace(good.observed, confusion=confusion)
    (sentence,) = dataclasses.replace(good, observed=report).advice
    names = good.layout.names
    assert sentence.startswith(f"Move {names[2]} or {names[4]}") and "20 %" in sentence


def test_a_joint_of_which_nothing_is_told_asks_for_a_marker_on_its_bone(good):
    joints = good.joints.copy()
    number = JOINT_NAMES.index("index_PIP_flexion")
    joints[number] = 0.9 * free_spreads()[number]
    (sentence,) = dataclasses.replace(good, joints=joints).advice
    assert sentence.startswith("Add a marker on index_middle")


def test_no_marker_is_asked_for_where_every_bone_has_one(good):
    joints = good.joints.copy()
    joints[JOINT_NAMES.index("middle_DIP_flexion")] = free_spreads()[0]
    (sentence,) = dataclasses.replace(good, joints=joints).advice
    assert sentence.startswith("Add a marker on middle_middle")  # the tip has one
    bones = [bone for bone in BONE_NAMES if bone.startswith("middle")]
    first, *_, second = good.layout.markers[:4]  # of other digits
    moved = {
        one.name: MarkerPlace(one.name, bone, 0.5, 0.0)
        for one, bone in zip((first, second), bones, strict=False)
    }
    markers = tuple(moved.get(one.name, one) for one in good.layout.markers)
    layout = dataclasses.replace(good.layout, markers=markers)
    assert dataclasses.replace(good, joints=joints, layout=layout).advice == ()


def test_the_worst_marker_of_captures_is_named(good):
    slots = np.ones(good.layout.num_markers)
    slots[4] = 0.8
    found = Trial(dict.fromkeys(METHODS, slots), dict.fromkeys(METHODS, 0.9), np.zeros(20), 0.0)
    (sentence,) = dataclasses.replace(good, trials={"two touching": found}).advice
    assert sentence.startswith(f"With two touching {good.layout.names[4]} is labeled worst: right in 80 %")


def test_hidden_markers_are_told(good):
    seen = good.seen.copy()
    seen[3] = 0.4
    (sentence,) = dataclasses.replace(good, seen=seen).advice
    assert sentence.startswith(f"Move {good.layout.names[3]} towards the back") and "40 %" in sentence


def test_more_markers_are_asked_for_where_few_are_seen(good):
    (sentence,) = dataclasses.replace(good, few_seen=0.25).advice
    assert sentence.startswith("Add markers, on the back of the hand first: in 25 % of the frames")
    assert "fewer than 6 of 8 are seen" in sentence


def test_the_forecast_is_the_error_of_the_solver(rng):
    """Flexions that three markers tell of; noise of the forecast's size is added to true markers."""
    fit = attach(load_layout("starter30"), HandModel.named("M"))
    qpos = sample_poses(fit.model, 300, rng=rng)
    markers = fit.markers(qpos)[0]
    seen = np.ones(markers.shape[:2], dtype=bool)
    forecast = layout_spreads([(fit, qpos, seen)])
    solved = PoseSolver(fit).solve(markers + NOISE * rng.standard_normal(markers.shape), qpos).qpos
    measured = np.sqrt(((solved - qpos)[:, 7:] ** 2).mean(axis=0))
    ratios = measured / forecast
    assert 1 / 1.3 < np.median(ratios) < 1.3
    assert (ratios > 0.4).all() and (ratios < 2.5).all()


def test_more_markers_leave_less_open(rng):
    model = HandModel.named("M")
    qpos = sample_poses(model, 40, rng=rng)
    few, many = (
        layout_spreads([(attach(load_layout(name), model), qpos, np.ones((40, count), dtype=bool))])
        for name, count in (("starter10", 10), ("starter30", 30))
    )
    assert (many < few).all()
    assert (few <= free_spreads() + 1e-9).all()


def test_a_finger_without_markers_is_known_as_far_as_its_neighbors_tell():
    """All markers on the palm: nothing is known of the fingers."""
    layout = load_layout("starter30")
    palm = tuple(marker for marker in layout.markers if marker.bone == "palm")
    fit = attach(dataclasses.replace(layout, markers=palm), HandModel.named("M"))
    qpos = np.zeros((1, 27))
    qpos[:, 3] = 1.0
    spreads = layout_spreads([(fit, qpos, np.ones((1, len(palm)), dtype=bool))])
    fingers = [number for number, joint in enumerate(JOINTS) if not joint.name.startswith("thumb")]
    # The skin of the palm moves a little with the first joints of the fingers.
    np.testing.assert_allclose(spreads[fingers][2::4], free_spreads()[fingers][2::4], rtol=0.01)
    np.testing.assert_allclose(spreads[fingers][3::4], free_spreads()[fingers][3::4], rtol=0.01)


def test_a_tip_that_is_never_seen_costs_its_finger(tips, tips_hands):
    tip = tips.names.index("IndexTip")
    joints = [number for number, joint in enumerate(JOINTS) if joint.name.startswith("index")]
    others = [number for number, joint in enumerate(JOINTS) if joint.name.startswith("little")]
    hidden = []
    for hand in tips_hands:
        observed = hand.frames.observed.copy()
        observed[:, tip] = np.nan
        hidden.append(hand._replace(frames=hand.frames._replace(observed=observed)))
    lost = joint_spreads(hidden) - joint_spreads(tips_hands)
    assert lost[joints].max() > 5 * max(1e-3, lost[others].max())


@pytest.fixture(scope="module")
def take():
    return simulate_take("single-hand", glove="dense19", num_frames=40, seed=1, hands=["right"])


def trial_of(count):
    """Trials in which every label is right, of a layout with a given number of markers."""
    return Trial(dict.fromkeys(METHODS, np.ones(count)), dict.fromkeys(METHODS, 1.0), np.zeros(20), 0.0)


def right_shares(truth, take):
    """Share of the frames in which each marker of the true hands is right, and share of right frames."""
    share, report = _count_right(truth, take)
    return share.mean(axis=0), report.figures["frame_accuracy"]


def trial(share, joints):
    slots = np.full(4, share)
    slots[2] -= 0.1
    return Trial(dict.fromkeys(METHODS, slots), dict.fromkeys(METHODS, share), np.full(20, joints), 0.002)


def test_a_hand_in_the_dense_glove_is_labeled_and_tracked(take):
    found = try_take(take, load_layout("dense19"), load_labeler("dense19"))
    assert min(found.share(method) for method in METHODS) > 0.98
    assert found.wrong < 0.1 and found.wrong <= sum(one.probability for one in found.alternatives)
    assert np.rad2deg(np.sqrt(np.mean(found.joints**2))) < 15.0
    assert found.size_error < 0.012


def test_truth_is_all_right_and_exchanged_markers_are_not(take):
    share, frames = right_shares(take, take)
    assert (share == 1.0).all() and frames == 1.0
    labels = take.labels.copy()
    labels[:20][take.labels[:20] == 3] = 4
    labels[:20][take.labels[:20] == 4] = 3
    share, frames = right_shares(take, dataclasses.replace(take, labels=labels))
    assert share[3] == pytest.approx(share[4]) and share[3] <= 0.5 + 1e-9
    assert (np.delete(share, [3, 4]) == 1.0).all() and frames <= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dense19", "sparse13", "starter10"])
def test_a_capture_is_tried_by_the_calls_of_users(name):
    """Hands are not given, so that they are measured, and placed anew where other labels are likelier."""
    layout = load_layout(name)
    is_shipped = name in shipped_labelers()
    labeler = load_labeler(name) if is_shipped else LayoutLabeler.at_once(layout, num_poses=500)
    take = simulate_take("single-hand", glove=layout, num_frames=30, seed=2, hands=["right"])
    found = try_take(take, layout, labeler)
    for method, make in (("label", label_capture), ("track", track_capture)):
        share, frames = right_shares(take, make(take.capture(), glove=layout, labeler=labeler))
        np.testing.assert_array_equal(found.slots[method], share)
        assert found.frames[method] == frames


def exchanged(take, pairs, *, share=1.0):
    """The take with labels replaced in the first share of its frames."""
    labels, until = take.labels.copy(), round(share * take.num_frames)
    for before, after in pairs.items():
        labels[:until][take.labels[:until] == before] = after
    return dataclasses.replace(take, labels=labels)


@pytest.mark.parametrize(
    ("pairs", "words", "markers"),
    [
        ({3: 4, 4: 3}, ["{3} and {4} are exchanged"], {(3, 4)}),
        ({22: 25, 25: 22}, ["{3} and {6} are exchanged"], {(3, 6)}),
        ({1: 2, 2: 5, 5: 1}, [f"the points of {{{a}}} have the label {{{b}}}" for a, b in SHIFT], set(SHIFT)),
        ({n: (n + 19) % 38 for n in range(38)}, [SIDES_EXCHANGED], {tuple(range(19))}),
        ({7: -1}, ["{7} is lost"], {(7,)}),
    ],
)  # fmt: skip
def test_what_is_wrong_throughout_a_capture_is_named(pairs, words, markers):
    truth = simulate_take("single-hand", glove="dense19", num_frames=40, seed=1)
    names = truth.hands[0].layout.names
    found = _wrong_throughout(names, *_count_right(truth, exchanged(truth, pairs, share=0.8)))
    assert sorted(one.words for one in found) == sorted(one.format(*names) for one in words)
    assert {one.markers for one in found} == {tuple(sorted(one)) for one in markers} and all(
        one.probability == 1.0 for one in found
    )
    assert not _wrong_throughout(names, *_count_right(truth, exchanged(truth, pairs, share=0.3)))


@pytest.mark.parametrize("wrong", [[0.0] * 9, [1.0, *[0.0] * 8], [0.5, *[0.02] * 11], [1.0] * 9])
def test_the_probability_of_a_wrong_capture_has_an_interval(good, wrong):
    tried = [dataclasses.replace(trial(0.95, 0.2), wrong=one) for one in wrong]
    score = dataclasses.replace(good, trials={"a": mean_trial(tried[::2]), "b": mean_trial(tried[1::2])})
    share, (low, high) = score.wrong
    assert share == pytest.approx(np.mean(wrong)) and low <= share <= high
    assert (low > 0.0) == (share > 0.0) and (high < 1.0) == (share < 1.0)
    assert 0.15 < high - low < 0.6
    assert f"from {len(wrong)} captures" in wrong_line(score)


def test_the_most_similar_labels_are_named_and_drawn(good, tmp_path):
    count = good.layout.num_markers
    pair = Alternative((2, 4), f"{good.layout.names[2]} and {good.layout.names[4]} are exchanged", 0.3)
    sides = Alternative(tuple(range(count)), SIDES_EXCHANGED, 0.1)
    tried = [dataclasses.replace(trial_of(count), alternatives=some) for some in ((pair, sides), (pair,), ())]
    score = dataclasses.replace(good, trials={"real-like": mean_trial(tried)})
    assert [(one.words, one.probability) for one in score.alternatives] == [
        (pair.words, pytest.approx(0.2)), (sides.words, pytest.approx(0.1 / 3)),
    ]  # fmt: skip
    assert f"most similar: {pair.words} (20.0 %), {sides.words} (3.3 %)" in wrong_line(score)
    first, second = score.advice
    assert first.startswith(f"{pair.words} in whole captures with a probability of 20 %")
    assert second.startswith("Left and right are exchanged in whole captures with a probability of 3 %")
    pages = []
    for name, one in (("clear", dataclasses.replace(score, trials={"a": trial_of(count)})), ("alike", score)):
        write_glove_page(tmp_path / name, one)
        pages.append((tmp_path / name).read_text("utf-8"))
    pictures = [page.count("data:image/svg+xml") for page in pages]
    assert pictures[1] == pictures[0] + 1
    assert pages[1].index("wrong throughout") < pages[1].index("What to do")


def test_the_worst_capture_stands_beside_the_mean(tips):
    tried = [trial(share, 0.2) for share in (0.9, 0.5, 1.0)]
    mean = mean_trial(tried)
    assert mean.least("label") == tried[1].share("label") < mean.share("label")
    assert (
        f"{100 * mean.share('label'):.2f}, {100 * tried[1].share('label'):.2f}, 80"
        in trial_rows({"a": mean}, tips)[1]
    )


def test_labels_of_a_hand_that_is_not_there_are_wrong(take):
    both = simulate_take("single-hand", glove="dense19", num_frames=40, seed=1)
    other = dataclasses.replace(take, hands=(both.hands[1],))
    share, frames = right_shares(take, other)
    assert share.max() < 0.2 and frames == 0.0


def test_the_sentence_says_whether_a_layout_is_better():
    before, more, same = trial(0.95, 0.2), trial(0.99, 0.21), trial(0.951, 0.1)
    assert verdict({"a": before}, {"a": more}).startswith("Better in captures: 92.50 %")
    assert verdict({"a": before}, {"a": same}).startswith("Better in captures")
    assert verdict({"a": more}, {"a": before}).startswith("Not better in captures")
    assert verdict({"a": before}, {"a": before}).startswith("Not better in captures")


def test_the_table_names_the_worst_marker(tips):
    header, row = trial_rows({"two touching": trial(0.95, 0.2)}, tips)
    assert len(header) == len(row)
    assert row[0] == "two touching" and f"{tips.names[2]} (85 %)" in row
