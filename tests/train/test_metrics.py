"""Counts by hand."""

from __future__ import annotations

import numpy as np
import pytest

from train.metrics import LabelCounts


def test_a_frame_counted_by_hand():
    counts = LabelCounts()
    # Points: marker 0, marker 2, a ghost. Marker 1 is hidden. The labeler takes the ghost for marker 1.
    counts.add(np.array([0, 2, 1]), np.array([0, 2, -1]), num_labels=3)
    figures = counts.figures()
    assert figures["slot_accuracy"] == pytest.approx(2 / 3)
    assert figures["point_accuracy"] == pytest.approx(2 / 3)
    assert figures["frame_accuracy"] == 0.0
    assert figures["occlusion_recall"] == 0.0
    assert figures["ghost_recall"] == 0.0
    assert np.isnan(figures["ghost_precision"])
    counts.add(np.array([1, 0, -1]), np.array([1, 0, -1]), num_labels=3)
    figures = counts.figures()
    assert figures["frame_accuracy"] == 0.5
    assert figures["occlusion_recall"] == 0.5
    assert figures["occlusion_precision"] == 1.0
    assert figures["ghost_recall"] == 0.5
    assert figures["ghost_precision"] == 1.0


def test_an_empty_frame_is_all_occluded():
    counts = LabelCounts()
    counts.add(np.zeros(0, dtype=int), np.zeros(0, dtype=int), num_labels=19)
    assert counts.figures()["slot_accuracy"] == 1.0
    assert counts.figures()["occlusion_recall"] == 1.0
