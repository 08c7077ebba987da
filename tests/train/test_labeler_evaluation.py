"""What an evaluation counts, on clouds whose labels are known beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from train.data.batches import Corruption
from train.evaluate import evaluate_labeler
from train.labelers.protocol import Labeling


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
