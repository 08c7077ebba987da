"""The tables of labeling: the paper's figures stand beside ours, row by row."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.command_line import run
from benchmarks.held_out import held_out_markers
from benchmarks.paper import labeling_tables
from benchmarks.paper.labeling_tables import FIGURES, LABELING_TABLES, augmentations, count_gaps
from benchmarks.paper.printed import AUGMENTATIONS, TABLE2, TABLE3, TABLE4, TABLE6, TEST_SETS
from handsim.cli.main import main
from train import evaluate_labeler, load_labeler, simulate_take
from train.simulation.scenes import KINDS


@pytest.fixture(scope="module")
def takes():
    return {kind: simulate_take(kind=kind, num_frames=40) for kind in KINDS}


def tables(words):
    return run("benchmarks.paper", "", LABELING_TABLES, words)


def cells(text: str, first: str) -> list[str]:
    (row,) = (
        line for line in text.splitlines() if line.split("│")[1:2] and line.split("│")[1].strip() == first
    )
    return [cell.strip() for cell in row.split("│")[2:-1]]


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


def test_the_papers_tables_agree_with_each_other():
    assert TABLE2["Base+O+G"][-1] == TABLE4["slot_accuracy"][0]
    for table, markers in ((TABLE4, 19), (TABLE6, 13)):
        assert all(len(figures) == len(TEST_SETS) for figures in table.values())
        # What is drawn: the chance that a slot is hit by 0 to 5 (3) draws, and one ghost a frame on average.
        draws = np.arange(augmentations(markers)["Base+O+G"].occlude + 1)
        assert table["occlusion_ratio"][0] == pytest.approx(1 - np.mean((1 - 1 / markers) ** draws), abs=1e-3)
        assert table["ghost_ratio"][0] == pytest.approx(1 / markers, abs=1e-3)


def test_unseen_people_follow_the_seed_and_are_in_no_training_set():
    first = held_out_markers("dense19", 200, seed=0)
    assert first.shape == (200, 19, 3)
    np.testing.assert_array_equal(first, held_out_markers("dense19", 200, seed=0))
    assert not np.isclose(first, held_out_markers("dense19", 200, seed=1)).any()


@pytest.mark.slow
def test_table_2_trains_and_tests_four_networks(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    data = tmp_path / "set"
    small = ["--num-frames", "600", "--frames-per-hand", "60", "--workers", "1"]
    assert main(["generate", "--out", str(data), *small]) == 0
    capsys.readouterr()
    words = ["table2", str(data), "--out", str(tmp_path / "runs"), "--samples", "64"]
    words += ["--num-frames", "30"]
    assert tables(words) == 0
    said = capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == sorted(
        f"set-{name}" for name in AUGMENTATIONS
    )
    assert "Table 2, set: held-out simulated frames" in said
    for test in AUGMENTATIONS:
        for cell, paper in zip(cells(said, test), TABLE2[test], strict=True):
            ours, theirs = cell.rstrip(")").split(" (")
            assert 0.0 <= float(ours) <= 100.0
            assert float(theirs) == pytest.approx(100 * paper)
    assert tables(words) == 0, "finished runs are taken as they are"
    assert capsys.readouterr().out == said


@pytest.mark.slow
def test_table_3_has_a_row_a_capture_with_the_papers_figures(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert tables(["table3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for kind in KINDS:
        row, by_marker = (line for line in lines if line.split("│")[1:2] and kind in line.split("│")[1])
        paper, ghosts = TABLE3[kind], TABLE4["ghost_ratio"][TEST_SETS.index(kind)]
        frames, gaps, length, missing, share = (cell.strip() for cell in row.split("│")[2:7])
        assert frames == f"{paper.frames} ({paper.frames})"
        for cell, wanted in (
            (gaps, paper.gaps),
            (length, paper.average_length),
            (missing, paper.average_missing),
        ):
            ours, theirs = cell.rstrip(")").split(" (")
            assert float(theirs) == pytest.approx(wanted)
            assert float(ours) == pytest.approx(wanted, rel=0.4), f"{kind}: {cell}"
        assert share.endswith(f"({100 * ghosts:.2f} %)")
        assert by_marker.count("%") == 3
    assert any("real finger markers" in line for line in lines)


@pytest.mark.slow
def test_table_4_has_a_column_a_test_set(capsys, monkeypatch, takes):
    monkeypatch.setenv("COLUMNS", "200")
    # The same captures, but short.
    monkeypatch.setattr(labeling_tables, "simulate_takes", lambda glove, seed, done: takes)
    assert tables(["table4", "--num-frames", "100"]) == 0
    said = capsys.readouterr().out
    for figure, words in FIGURES.items():
        row = cells(said, words)
        assert len(row) == len(TEST_SETS)
        for cell, paper in zip(row, TABLE4.get(figure, [None] * 5), strict=True):
            assert cell.endswith(f"({100 * paper:.2f})") if paper is not None else "(" not in cell
    pen = evaluate_labeler(load_labeler("dense19"), [takes["hand-pen"]]).figures
    column = TEST_SETS.index("hand-pen")
    assert cells(said, "Accuracy (slots)")[column].startswith(f"{100 * pen['slot_accuracy']:.2f} ")
    assert cells(said, "G recall")[column].startswith(f"{100 * pen['ghost_recall']:.2f} ")
