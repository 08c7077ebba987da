"""Counts by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from train.metrics import LabelCounts, macro_f1, percent, print_figures


def _one_each(pairs):
    """Labels and truth of a frame in which no marker is there, or said, twice."""
    kept = []
    for said, true in pairs:
        if not any((said == other >= 0) or (true == same >= 0) for other, same in kept):
            kept.append((said, true))
    table = np.array(kept, dtype=int).reshape(-1, 2)
    return table[:, 0], table[:, 1]


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


def test_confusion_and_macro_f1_by_hand():
    counts = LabelCounts()
    assert np.isnan(counts.figures()["macro_f1"])
    # Marker 3 neither occurs nor is said: it is no class of these frames.
    counts.add(np.array([0, 1, -1, 2]), np.array([0, 2, -1, -1]), num_labels=4)
    counts.add(np.array([0, -1]), np.array([0, 2]), num_labels=4)
    wanted = np.zeros((5, 5), dtype=int)
    wanted[0, 0], wanted[2, 1], wanted[2, 4], wanted[4, 4], wanted[4, 2] = 2, 1, 1, 1, 1
    np.testing.assert_array_equal(counts.confusion, wanted)
    # F1 is 1 for marker 0, 0 for 1 (said, never there) and 2 (there, never said right), 1/2 for ghosts.
    assert counts.figures()["macro_f1"] == pytest.approx(1.5 / 4)


@given(
    st.lists(
        st.lists(st.tuples(st.integers(-1, 6), st.integers(-1, 6)), max_size=9).map(_one_each), max_size=5
    )
)
def test_confusion_agrees_with_the_counts(frames):
    counts = LabelCounts()
    for labels, truth in frames:
        counts.add(labels, truth, num_labels=7)
    confusion, figures = counts.confusion, counts.figures()
    assert confusion.sum() == counts.points
    assert confusion.trace() == counts.points_right
    if frames:
        assert confusion[-1].sum() == counts.ghosts and confusion[:, -1].sum() == counts.ghosts_given
    if counts.points:
        assert (figures["macro_f1"] == 1.0) == (figures["point_accuracy"] == 1.0)


def test_macro_f1_of_nothing_and_of_chance():
    assert np.isnan(macro_f1(np.zeros((4, 4), dtype=int)))
    assert macro_f1(np.full((4, 4), 3)) == pytest.approx(0.25)
    assert macro_f1(np.diag([5, 0, 1])) == 1.0


def test_percent():
    assert percent(0.98765) == "98.77" and percent(float("nan")) == "-"


def test_figures_are_printed_in_percent(capsys):
    print_figures({"clean": {"macro_f1": 0.98765, "ghost_recall": float("nan")}}, title="Figures")
    said = capsys.readouterr().out
    assert "macro f1" in said and "98.77" in said and "-" in said
