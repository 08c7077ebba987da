"""The tables of labeling: the paper's figures stand beside ours, row by row."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.held_out import held_out_markers
from benchmarks.paper import labeling_tables
from benchmarks.paper.labeling_tables import FIGURES, count_gaps, figures_of_tests, gap_figures
from benchmarks.paper.printed import TABLE3, TABLE4, TABLE6, TEST_SETS
from train import evaluate_labeler, load_labeler, simulate_take
from train.data.batches import paper_corruption
from train.simulation.scenes import KINDS


@pytest.fixture(scope="module")
def takes():
    return {kind: simulate_take(kind=kind, num_frames=40) for kind in KINDS}


def test_gaps_of_a_capture_made_by_hand() -> None:
    present = np.ones((12, 3), dtype=bool)
    present[2:4, 0] = False
    present[3:6, 1] = False  # overlaps: one gap of frames 2 to 5
    present[11, 2] = False
    counts = count_gaps(present)
    assert (counts.frames, counts.gaps) == (12, 2)
    assert counts.average_length == (4 + 1) / 2
    assert counts.average_missing == 6 / 5
    never = count_gaps(np.zeros((5, 2), dtype=bool))  # is one gap
    assert (never.gaps, never.average_length, never.average_missing) == (1, 5.0, 2.0)
    always = count_gaps(np.ones((5, 2), dtype=bool))
    assert always.gaps == 0 and np.isnan([always.average_length, always.average_missing]).all()


def test_the_papers_tables_agree_with_its_recipe():
    for table, markers in ((TABLE4, 19), (TABLE6, 13)):
        assert all(len(figures) == len(TEST_SETS) for figures in table.values())
        # What is drawn: the chance that a slot is hit by 0 to 5 (3) draws, and one ghost a frame on average.
        draws = np.arange(paper_corruption(markers).occlude + 1)
        assert table["occlusion_ratio"][0] == pytest.approx(1 - np.mean((1 - 1 / markers) ** draws), abs=1e-3)
        assert table["ghost_ratio"][0] == pytest.approx(1 / markers, abs=1e-3)


def test_unseen_people_follow_the_seed_and_are_in_no_training_set():
    first = held_out_markers("dense19", 200, seed=0)
    assert first.shape == (200, 19, 3)
    np.testing.assert_array_equal(first, held_out_markers("dense19", 200, seed=0))
    assert not np.isclose(first, held_out_markers("dense19", 200, seed=1)).any()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_table_3_has_gaps_like_the_papers(kind):
    rows = list(gap_figures(kind, simulate_take(kind=kind)).values())
    pairs = np.array(rows[0][1])
    np.testing.assert_allclose(pairs[:4, 1], TABLE3[kind])
    np.testing.assert_allclose(pairs[1:4, 0], TABLE3[kind][1:], rtol=0.4)
    assert pairs[0, 0] == pairs[0, 1], "a twin is as long as the capture"
    mean, least, most, *_ = rows[1][1]
    assert 0.0 <= least <= mean <= most <= 100.0


@pytest.mark.slow
def test_table_4_has_a_column_a_test_set(monkeypatch, takes):
    monkeypatch.setattr(labeling_tables, "simulate_takes", lambda glove, seed: takes)
    kept = figures_of_tests("dense19", TABLE4, None, 100, 0)
    for key, name in FIGURES.items():
        row = np.array(kept[key][1])
        assert len(row) == len(TEST_SETS)
        if name in TABLE4:
            np.testing.assert_allclose(row[:, 1], 100 * np.array(TABLE4[name]))
    pen = evaluate_labeler(load_labeler("dense19"), [takes["hand-pen"]]).figures
    column = TEST_SETS.index("hand-pen")
    assert kept["slots"][1][column][0] == pytest.approx(100 * pen["slot_accuracy"])
    assert kept["g_recall"][1][column][0] == pytest.approx(100 * pen["ghost_recall"], nan_ok=True)
