"""How right labelers are, counted by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gloves import Capture
from handsim.errors import CaptureError
from train import Corruption, Labeling, evaluate_labeler, evaluate_labels, simulate_take
from train.evaluation import (
    BINS,
    History,
    count_labels,
    error_without,
    expected_calibration_error,
    print_figures,
    reliability,
)

points = st.integers(1, 60).flatmap(
    lambda count: st.tuples(
        arrays.arrays(float, count, elements=st.floats(0.0, 1.0, allow_subnormal=False)),
        arrays.arrays(bool, count),
    )
)


def _one_each(pairs):
    """Labels and truth of a frame in which no marker is there, or said, twice."""
    kept = []
    for said, true in pairs:
        if not any((said == other >= 0) or (true == same >= 0) for other, same in kept):
            kept.append((said, true))
    table = np.array(kept, dtype=int).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def counted(num_labels, *frames):
    """The report on frames of labels and truth."""
    names = tuple(map(str, range(num_labels)))
    return count_labels(names, ((labels, np.full(len(labels), np.nan), truth) for labels, truth in frames))


def test_a_frame_counted_by_hand():
    # Points: marker 0, marker 2, a ghost. Marker 1 is hidden. The labeler takes the ghost for marker 1.
    wrong = np.array([0, 2, 1]), np.array([0, 2, -1])
    figures = counted(3, wrong).figures
    assert figures["slot_accuracy"] == pytest.approx(2 / 3)
    assert figures["point_accuracy"] == pytest.approx(2 / 3)
    assert figures["frame_accuracy"] == 0.0
    assert figures["occlusion_recall"] == 0.0
    assert figures["ghost_recall"] == 0.0
    assert np.isnan(figures["ghost_precision"])
    figures = counted(3, wrong, (np.array([1, 0, -1]), np.array([1, 0, -1]))).figures
    assert figures["frame_accuracy"] == 0.5
    assert figures["occlusion_recall"] == 0.5
    assert figures["occlusion_precision"] == 1.0
    assert figures["ghost_recall"] == 0.5
    assert figures["ghost_precision"] == 1.0


def test_an_empty_frame_is_all_occluded_and_figures_are_printed_in_percent(capsys):
    figures = counted(19, (np.zeros(0, dtype=int), np.zeros(0, dtype=int))).figures
    assert figures["slot_accuracy"] == figures["occlusion_recall"] == 1.0
    print_figures({"clean": {**figures, "macro_f1": 0.98765}}, title="Figures")
    said = capsys.readouterr().out
    assert "macro f1" in said and "98.77" in said and "100.00" in said and " -\n" in said


def test_confusion_and_macro_f1_by_hand():
    assert np.isnan(counted(4).figures["macro_f1"])
    # Marker 3 neither occurs nor is said: it is no class of these frames.
    report = counted(
        4, (np.array([0, 1, -1, 2]), np.array([0, 2, -1, -1])), (np.array([0, -1]), np.array([0, 2]))
    )
    wanted = np.zeros((5, 5), dtype=int)
    wanted[0, 0], wanted[2, 1], wanted[2, 4], wanted[4, 4], wanted[4, 2] = 2, 1, 1, 1, 1
    np.testing.assert_array_equal(report.confusion, wanted)
    # F1 is 1 for marker 0, 0 for 1 (said, never there) and 2 (there, never said right), 1/2 for ghosts.
    assert report.figures["macro_f1"] == pytest.approx(1.5 / 4)


@given(
    st.lists(
        st.lists(st.tuples(st.integers(-1, 6), st.integers(-1, 6)), max_size=9).map(_one_each), max_size=5
    )
)
def test_confusion_agrees_with_the_counts(frames):
    report = counted(7, *frames)
    confusion, figures = report.confusion, report.figures
    nothing = np.zeros(0, dtype=np.int64)
    given = np.concatenate([nothing, *(labels for labels, _ in frames)])
    true = np.concatenate([nothing, *(truth for _, truth in frames)])
    assert confusion.sum() == report.numbers["points"] == len(true)
    assert confusion.trace() == (given == true).sum()
    if frames:
        assert confusion[-1].sum() == (true < 0).sum() and confusion[:, -1].sum() == (given < 0).sum()
    if len(true):
        assert (figures["macro_f1"] == 1.0) == (figures["point_accuracy"] == 1.0)


class ByHeight:
    """Names points by the centimeter they lie at; of the third it is unsure, and takes it for the second."""

    marker_names = ("A", "B", "C", "D")

    def label_frames(self, frames):
        return [self._label(np.rint(100 * points[:, 2]).astype(int)) for points in frames]

    def _label(self, height):
        labels = np.where(height == 2, 1 if 1 not in height else -1, height)
        return Labeling(labels, np.where(height == 2, 0.25, 1.0))


def column(frames, missing=()):
    markers = np.zeros((frames, 4, 3))
    markers[..., 2] = 0.01 * np.arange(4)
    for frame, marker in missing:
        markers[frame, marker] = np.nan
    return markers


def test_points_are_told_in_order_with_their_confidence(rng):
    report = evaluate_labeler(ByHeight(), column(2, missing=[(1, 1)]), Corruption(0, 0), rng=rng)
    # The first frame's third point is called a ghost, the second's, where no second is, the second.
    wanted = np.zeros((5, 5), dtype=int)
    wanted[range(4), range(4)] = [2, 1, 0, 2]
    wanted[2, 4] = wanted[2, 1] = 1
    np.testing.assert_array_equal(report.confusion, wanted)
    assert report.right.shape == report.confidences.shape == (7,)
    np.testing.assert_array_equal(report.confidences, np.where(report.right, 1.0, 0.25))
    assert (~report.right[:4]).sum() == (~report.right[4:]).sum() == 1
    figures = report.figures
    assert figures["point_accuracy"] == pytest.approx(5 / 7)
    assert figures["calibration_error"] == pytest.approx(2 * 0.25 / 7)
    assert figures["error_without_least_sure"] == pytest.approx(2 / 7)  # 2 % of seven points is none
    assert figures["macro_f1"] == pytest.approx((1 + 2 / 3 + 0 + 1 + 0) / 5)
    np.testing.assert_array_equal(report.slot_accuracy_by_marker, [1.0, 0.5, 0.0, 1.0])


def test_leaving_two_percent_out_takes_the_least_sure_first(rng):
    markers = column(100)
    markers[3:, 2] = np.nan  # three wrong of 303 points, all of them unsure: six are left out
    figures = evaluate_labeler(ByHeight(), markers, Corruption(0, 0), rng=rng).figures
    assert figures["point_accuracy"] == pytest.approx(300 / 303)
    assert figures["error_without_least_sure"] == 0.0


def test_no_frames_and_no_points(rng):
    for markers in (np.zeros((0, 4, 3)), np.full((3, 4, 3), np.nan)):
        report = evaluate_labeler(ByHeight(), markers, Corruption(0, 0), rng=rng)
        assert report.confusion.shape == (5, 5)
        assert report.right.size == report.confidences.size == report.confusion.sum() == 0
        for figure in ("point_accuracy", "macro_f1", "calibration_error", "error_without_least_sure"):
            assert np.isnan(report.figures[figure])


def test_a_calibrated_source_has_no_error(rng):
    confidence = rng.uniform(size=200_000)
    right = rng.uniform(size=confidence.size) < confidence
    assert expected_calibration_error(confidence, right) < 0.01
    bins = reliability(confidence, right)
    np.testing.assert_allclose(bins.right, bins.confidence, atol=0.02)
    np.testing.assert_allclose(bins.confidence, (np.arange(BINS) + 0.5) / BINS, atol=0.005)


def test_bins_are_weighted_by_their_points():
    # Three points are said 0.9 and right, one is said 0.1 and right: 3/4 x 0.1 + 1/4 x 0.9.
    error = expected_calibration_error(np.array([0.9, 0.1, 0.9, 0.9]), np.ones(4, dtype=bool))
    assert error == pytest.approx(0.3)
    half = np.arange(1000) % 2 == 0
    errors = [expected_calibration_error(np.full(1000, said), half) for said in (0.0, 0.5, 1.0)]
    assert errors == [0.5, 0.0, 0.5]
    assert reliability(np.ones(1000), half).count.tolist() == [0] * (BINS - 1) + [1000]


@given(points)
def test_the_error_is_at_least_the_mean_gap_and_at_most_one(drawn):
    confidence, right = drawn
    error = expected_calibration_error(confidence, right)
    assert abs(confidence.mean() - right.mean()) - 1e-12 <= error <= 1.0
    bins = reliability(confidence, right)
    assert bins.count.sum() == len(right)
    assert np.nansum(bins.right * bins.count) == pytest.approx(right.sum())


def test_leaving_the_least_sure_out():
    confidence, right = np.array([0.9, 0.2, 0.8, 0.4, 0.6]), np.array([True, False, True, True, False])
    # The one of 0.2 goes first, then that of 0.4, which was right.
    for share, error in ((0.0, 2 / 5), (0.2, 1 / 4), (0.4, 1 / 3), (0.6, 0.0), (1.0, np.nan)):
        assert error_without(confidence, right, share) == pytest.approx(error, nan_ok=True)


@given(points, st.floats(0.0, 1.0, allow_subnormal=False), st.randoms(use_true_random=False))
def test_the_order_of_points_has_no_say(drawn, share, random):
    confidence, right = np.round(drawn[0], 1), drawn[1]  # rounded, so that there are ties
    order = list(range(len(right)))
    random.shuffle(order)
    np.testing.assert_allclose(
        error_without(confidence[order], right[order], share), error_without(confidence, right, share)
    )


def test_ties_count_by_the_mean_over_all_choices():
    right = np.array([True, False, True, True])
    # Of four alike two go; whichever they are, the one mistake stays half of the time.
    assert error_without(np.full(4, 0.7), right, 0.5) == pytest.approx(0.5 * 1 / 2)


def test_an_entry_is_the_mean_since_the_one_before_and_steps_that_wait_are_kept():
    history = History()
    history.add(4.0)
    history = History(**dataclasses.asdict(history))
    for loss in (2.0, 3.0):
        history.add(loss)
    assert history.close(768, 0.1) == 3.0
    history.add(1.0)
    assert history.close(1024, 0.05) == 1.0
    assert history.losses == [(768, 3.0, 0.1), (1024, 1.0, 0.05)]


@pytest.fixture(scope="module")
def take():
    return simulate_take(num_frames=300, seed=3)


def _swapped(take, share):
    """The take as a capture with sides, in which two markers are exchanged in the first frames."""
    labeled = take.labeled_capture()
    positions, names = labeled.positions.copy(), list(labeled.names)
    pair, frames = [names.index("right:ThumbTip"), names.index("right:IndexTip")], int(share * len(positions))
    positions[:frames, pair] = positions[:frames, pair[::-1]]
    return Capture(tuple(names), positions, take.rate)


def test_the_truth_as_a_capture_has_no_error(take):
    for sides in (take.labeled_capture(), _swapped(take, 0.0)):
        report = evaluate_labels(sides, take)
        assert report.figures["slot_accuracy"] == report.figures["point_accuracy"] == 1.0
        assert np.isnan(report.figures["calibration_error"])
        assert report.interval() == (1.0, 1.0) and report.grouped_by == "seconds"
    assert report.marker_names == take.label_names[: len(report.marker_names)]


def test_exchanged_labels_are_counted_by_marker_with_an_interval(take):
    report = evaluate_labels(_swapped(take, 0.5), take)
    wrong = {
        name: 1.0 - share
        for name, share in zip(report.marker_names, report.slot_accuracy_by_marker, strict=True)
        if share < 1.0
    }
    assert set(wrong) == {"right:ThumbTip", "right:IndexTip"}
    assert all(0.3 < share <= 0.5 for share in wrong.values())  # a frame that lacks both is right
    thumb = report.marker_names.index("right:ThumbTip")
    low, high = report.interval(marker=thumb)
    assert low < report.slot_accuracy_by_marker[thumb] < high
    for name, (low, high) in report.intervals().items():
        assert low < report.figures[name] < min(high, 1.0)


def test_columns_without_sides_fit_the_hand_that_is_there(take):
    (left,) = (mine for mine, side in zip(take.hand_labels, take.sides, strict=True) if side == "left")
    names = tuple(name.partition(":")[2] for name in take.label_names[left.start : left.stop])
    report = evaluate_labels(Capture(names, take.observed("left"), take.rate), take)
    np.testing.assert_array_equal(report.slot_accuracy_by_marker[left.start : left.stop], 1.0)
    others = np.delete(report.slot_accuracy_by_marker, slice(left.start, left.stop))
    seen = np.isfinite(take.observed("right")[..., 0]).mean(axis=0)
    np.testing.assert_allclose(others, 1.0 - seen)
    right_points = np.isfinite(take.observed("right")[..., 0]).sum()
    assert report.numbers["points_of_truth_alone"] >= right_points


def test_markers_of_a_hand_that_is_not_there_are_mistakes():
    alone = simulate_take(num_frames=5, hands=("right",), seed=1)
    labeled = alone.labeled_capture()
    other = tuple(name.replace("right:", "left:") for name in labeled.names)
    names = (*other[:1], *labeled.names[1:])
    report = evaluate_labels(Capture(names, labeled.positions, labeled.rate), alone)
    seen = np.isfinite(labeled.positions[:, 0, 0]).mean()
    assert report.slot_accuracy_by_marker[0] == pytest.approx(1.0 - seen)
    np.testing.assert_array_equal(report.slot_accuracy_by_marker[1:], 1.0)


def test_points_of_another_place_are_ghosts_and_those_of_another_capture_are_refused(take):
    labeled = take.labeled_capture()
    moved = labeled.positions.copy()
    moved[:, 0] += 0.01
    report = evaluate_labels(Capture(labeled.names, moved, labeled.rate), take)
    seen = int(np.isfinite(moved[:, 0, 0]).sum())
    assert report.numbers["points_of_capture_alone"] == report.numbers["points_of_truth_alone"] == seen
    assert report.confusion[-1, 0] == seen  # ghosts that are labeled as the first marker
    with pytest.raises(CaptureError, match=r"shares 0 of its \d+ points with the take"):
        evaluate_labels(Capture(labeled.names, labeled.positions[..., ::-1] + 5.0, labeled.rate), take)
    with pytest.raises(CaptureError, match="the capture has 299 frames and the take 300"):
        evaluate_labels(Capture(labeled.names, labeled.positions[1:], labeled.rate), take)
    twice = (labeled.names[1], *labeled.names[1:])
    with pytest.raises(CaptureError, match="two columns of one marker"):
        evaluate_labels(Capture(twice, labeled.positions, labeled.rate), take)
