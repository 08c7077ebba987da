"""The size of hands, measured in unlabeled points, and captures of another hand, glove or unit."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from gloves import MarkerLayout, MarkerPlace, attach, load_layout
from handsim import HandModel, HandSimWarning, join_qpos, sample_shape
from handsim.errors import ArgumentError
from handsim.hand.shape import ADULTS, DIGITS, SIZES, shape_from_measures
from poses import sample_motion
from track import StreamedFrame, hand_size, label_capture, measure_hands, track_capture
from track.frames import checked_frames
from track.hand_size import (
    SizeFit,
    _is_found,
    check_scale,
    fit_size,
    sample_frames,
    usual_breadth,
)
from track.user import nominal_user
from train import load_labeler, simulate_take

RATE = 120.0
FRAMES = 60


def frames_of(shapes, *, seed: int, noise: float = 0.0015, seconds: float = 1.0) -> list[StreamedFrame]:
    """Unlabeled points of moving hands, as noisy as those of real gloves, in an order of their own."""
    rng, layout = np.random.default_rng(seed), load_layout("dense19")
    clouds = []
    for number, shape in enumerate(shapes):
        model = HandModel(shape)
        motion = sample_motion(model, seconds, rng=rng).qpos
        place = np.tile([0.4 * number, 0.0, 1.0], (len(motion), 1))
        qpos = join_qpos(motion[:, 7:], position=place)
        fit = attach(layout, model)
        clouds.append(fit.attachment.centers(model, model.forward_kinematics(qpos)))
    points = np.concatenate(clouds, axis=1)
    points += noise * rng.standard_normal(points.shape)
    order = rng.permutation(points.shape[1])
    return [StreamedFrame(t, t / RATE, cloud[order], order) for t, cloud in enumerate(points)]


@pytest.mark.parametrize("length", [0.135, 0.175, 0.215])
def test_lengths_from_children_to_the_longest_are_found(length):
    shape = shape_from_measures(length, usual_breadth(length))
    found = fit_size(frames_of([shape], seed=1), load_layout("dense19"), ["right"], load_labeler("dense19"))
    assert found.shape.length == pytest.approx(length, abs=0.004)
    assert found.shape.breadth == pytest.approx(usual_breadth(length), abs=0.005)
    assert found.rms < 0.003
    (hand,) = found.hands(["left"])
    assert hand.shape.length == found.shape.length and hand.side == "left"


@pytest.mark.parametrize("seed", range(3))
def test_two_hands_of_other_proportions_have_one_size(seed):
    shape = sample_shape(ADULTS, rng=np.random.default_rng(seed))
    frames = frames_of([shape, shape.with_side("left")], seed=seed)
    found = fit_size(frames, load_layout("dense19"), ["right", "left"], load_labeler("dense19"))
    assert found.shape.length == pytest.approx(shape.length, abs=2.0 * found.spread)
    length, breadth, unsure = 1e3 * np.array([found.shape.length, found.shape.breadth, 2.0 * found.spread])
    assert 4.0 < unsure < 8.0 and str(found) == f"{length:.0f} x {breadth:.0f} mm, unsure by {unsure:.0f} mm"


def test_two_gloves_have_places_of_their_own():
    """Markers are glued anew on each hand, so the places on one tell nothing of those on the other."""
    take = simulate_take("hand-hand", num_frames=240, seed=5)
    found, true = (
        right.attachment.points - left.with_side("right").attachment.points
        for right, left in (measure_hands(take.capture()), take.hands)
    )
    off, apart = (np.linalg.norm(one, axis=1).mean() for one in (found - true, true))
    assert apart > 0.0025 and off < 0.5 * apart


def test_frames_without_a_hand_have_no_size():
    rng = np.random.default_rng(0)
    clutter = [StreamedFrame(t, t / RATE, rng.uniform(-1.0, 1.0, (30, 3)), np.arange(30)) for t in range(60)]
    layout, labeler = load_layout("dense19"), load_labeler("dense19")
    assert fit_size(clutter, layout, ["right", "left"], labeler) is None
    assert fit_size([], layout, ["right"], labeler) is None


def test_a_hand_that_comes_late_is_measured():
    shape = shape_from_measures(0.19, 0.085)
    shown = frames_of([shape], seed=2)
    strays = np.random.default_rng(0).uniform(-1.0, 1.0, (len(shown), 3, 3))
    frames = [StreamedFrame(t, t / RATE, points, np.arange(3)) for t, points in enumerate(strays)]
    late = len(shown)
    frames += [
        StreamedFrame(late + frame.number, (late + frame.number) / RATE, frame.points, frame.ids + 3)
        for frame in shown
    ]
    found = fit_size(frames, load_layout("dense19"), ["right"], load_labeler("dense19"))
    assert found.shape.length == pytest.approx(0.19, abs=0.005)


def test_the_usual_breadth_is_that_of_the_five_sizes_and_goes_on():
    for length, breadth in SIZES.values():
        assert usual_breadth(length) == pytest.approx(breadth)
    assert usual_breadth(0.13) / 0.13 == pytest.approx(72.0 / 165.0)
    assert usual_breadth(0.22) > usual_breadth(0.21)


def test_parts_of_a_long_capture_are_consecutive_and_reach_its_end():
    frames = [StreamedFrame(t, t / RATE, np.zeros((0, 3)), np.arange(0)) for t in range(1000)]
    numbers = np.array([frame.number for frame in sample_frames(frames)])
    assert numbers[0] == 0 and numbers[-1] == 999 and len(numbers) == 128
    assert (np.diff(numbers) != 1).sum() == 7
    assert sample_frames(frames[:50]) == frames[:50]


@pytest.mark.slow
def test_hands_of_a_child_are_not_measured_as_an_adults_with_wrong_labels():
    take = simulate_take("real-like", glove="sparse13", num_frames=480, seed=65).without_body()
    assert take.hands[0].shape.length == pytest.approx(0.145, abs=0.001)
    (right, _) = measure_hands(take.capture(), glove="sparse13")
    assert right.shape.length == pytest.approx(take.hands[0].shape.length, abs=0.006)


@pytest.mark.slow
def test_hands_of_few_markers_are_measured_though_no_usual_hand_fits_them():
    """A long, narrow hand that touches another one, in a slipped glove with ten markers."""
    tips = [MarkerPlace(digit, f"{digit}_distal", 0.7, 0.0) for digit in DIGITS]
    middles = [MarkerPlace(f"{digit}_middle", f"{digit}_middle", 0.5, 0.0) for digit in ("index", "ring")]
    across = ((0.3, 0.25), (0.5, -0.2), (0.7, 0.0))
    back = [MarkerPlace(f"back{along}", "palm", along, 0.0, across) for along, across in across]
    layout = MarkerLayout("ten", (*tips, *middles, *back), 0.0032)
    take = simulate_take("hand-hand", glove=layout, num_frames=240, seed=53)
    frames = sample_frames(checked_frames(take.capture()))
    found = fit_size(frames, layout, ("right", "left"), load_labeler(layout))
    assert found is not None
    true = take.hands[0].shape.length
    assert abs(found.shape.length - true) < 3.0 * found.spread and "unsure" in str(found)


@pytest.mark.slow
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_hands_of_eight_markers_that_touch_all_the_time_are_measured(mirror):
    """Few of the frames begin a track, but in these the measured hands fit."""
    layout = load_layout("tips8")
    take = simulate_take("hand-hand", glove=layout, num_frames=600, rig="figure5", seed=53)
    capture = take.capture()
    mirrored = dataclasses.replace(capture, positions=capture.positions * [mirror, 1.0, 1.0])
    found = fit_size(sample_frames(checked_frames(mirrored)), layout, ("right", "left"), load_labeler(layout))
    assert found is not None
    assert abs(found.shape.length - take.hands[0].shape.length) < 3.0 * found.spread


@pytest.mark.parametrize(
    ("share", "off", "is_found"),
    [(1.0, 0.015, True), (0.2, 0.0, True), (0.2, 0.015, False), (0.05, 0.0, False)],
)
def test_measured_hands_are_found_in_most_frames_or_in_some_that_fit_well(share, off, is_found):
    """Hands that are there in a share of the frames, measured too long by `off` [m]."""
    shape, count = shape_from_measures(0.187, 0.085), 120
    frames, rng = frames_of([shape], seed=1, noise=0.0005), np.random.default_rng(0)
    strays = [
        StreamedFrame(one.number, one.time, rng.uniform(-1.0, 1.0, one.points.shape), one.ids + 100)
        for one in frames
    ]
    shown = [*frames[: round(share * count)], *strays[round(share * count) : count]]
    measured = shape_from_measures(0.187 + off, 0.085)
    fit = SizeFit({"right": attach(load_layout("dense19"), HandModel(measured))}, 0.001, 0.003)
    assert _is_found(fit, shown, ("right",), load_labeler("dense19")) is is_found


@pytest.fixture(scope="module")
def capture():
    """A right hand in dense19."""
    return simulate_take("free", num_frames=FRAMES, hands="right", seed=3).capture()


def test_hands_that_fit_are_told_nothing_of_the_one_that_is_not_there(capture):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        take = track_capture(capture)
    right, left = (take.status[:, take.hand_index(side)] for side in ("right", "left"))
    assert (right > 0).mean() > 0.99 and (left > 0).mean() <= 0.005


def test_the_other_side_is_named(capture):
    with pytest.warns(HandSimWarning, match=r"the points fit a right hand better .* \(--hands right\)"):
        track_capture(capture, hands="left")


def test_hands_of_a_user_who_is_not_there_are_to_be_left_out(capture):
    user = dataclasses.replace(nominal_user(load_layout("dense19"), "M", "left"), notes="calibrated")
    with pytest.warns(
        HandSimWarning, match="a right hand better .*; calibrate these, or leave out the hands"
    ):
        track_capture(capture, hands=user)


def test_the_glove_that_is_worn_is_named(capture):
    better = r"a right hand in glove 'dense19' better \(in (\d+) of \d+ frames(?! instead of \1\))"
    with pytest.warns(HandSimWarning, match=rf"{better}.*--glove dense19"):
        label_capture(capture, glove="sparse13")


def test_an_own_glove_in_the_working_folder_is_named(capture, tmp_path, monkeypatch):
    dense = load_layout("dense19")
    own = dataclasses.replace(dense, name="mine", markers=dense.markers[4:])
    own.save(tmp_path / "mine.toml")
    monkeypatch.chdir(tmp_path)
    worn = simulate_take("free", glove=own, num_frames=FRAMES, hands="left", seed=4).capture()
    with pytest.warns(HandSimWarning, match="a left hand in glove 'mine.toml' better"):
        track_capture(worn, glove="sparse13")


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (0.1, "at 0.1 of their size: the file is probably in centimeters, read as millimeters"),
        (3.2808, "at 3.28 of their size"),
    ],
)
def test_another_unit_is_named(scale, said, monkeypatch):
    few = [(name, load_layout(name)) for name in ("sparse13", "tips8")]  # of all that are shipped
    monkeypatch.setattr(hand_size, "_known_gloves", lambda: few)
    both = simulate_take("single-hand", num_frames=20).capture()
    with pytest.raises(ArgumentError, match=said):
        track_capture(dataclasses.replace(both, positions=scale * both.positions))


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0, 1 / 0.0254])
def test_a_unit_that_is_far_off_is_named_before_hands_are_measured(scale):
    layout = load_layout("dense19")
    both = simulate_take("hand-hand", num_frames=FRAMES).capture()
    frames = sample_frames(checked_frames(dataclasses.replace(both, positions=scale * both.positions)))
    user, labeler = nominal_user(layout, "M", ("right", "left")), load_labeler(layout, None)
    if scale == 1.0:
        check_scale(frames, user, labeler)
        return
    with pytest.raises(ArgumentError, match=f"the points fit hands at {scale:.3g} of their size"):
        check_scale(frames, user, labeler)


def test_measured_hands_are_not_told_of_what_they_lack(capture):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measure_hands(capture)
