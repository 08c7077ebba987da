"""Tables of a sweep: means and worst in the right direction, failures counted and shown."""

from __future__ import annotations

import csv

from track.evaluation.sweep.results import MAIN, PAGE, TABLE, Row, summary, write_results


def row(glove: str, seed: int, right: float | None, error: float | None = None, told: str = "") -> Row:
    figures = {} if told else {"slot_accuracy": right, "joint_error_mm": error}
    return Row({"glove": glove, "rig": "figure5", "seed": seed, "person": 0}, figures, told, "labeler")


ROWS = [
    row("a", 0, 0.99, 2.0),
    row("a", 1, 0.97, 3.0),
    row("b", 0, 0.5, None),
    row("b", 1, None, None, "nobody <can>, do that"),
]


def test_the_worst_share_is_the_least_and_the_worst_error_the_largest():
    assert summary(ROWS) == [
        ["glove", "cells", "slots right [%]", "joints [mm]"],
        ["a", "2", "98.00/97.00", "2.50/3.00"],
        ["b", "1", "50.00/50.00", "-"],
    ]
    assert summary(ROWS, MAIN) == summary(ROWS)
    assert summary(ROWS[:2])[0][0] == "sweep" and summary(ROWS[:2])[1][0] == "all"


def test_the_table_has_every_cell_and_the_page_every_failure(tmp_path):
    write_results(ROWS, tmp_path)
    with (tmp_path / TABLE).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [one["slot_accuracy"] for one in rows] == ["0.99", "0.97", "0.5", ""]
    assert rows[3]["error"] == "nobody <can>, do that" and rows[0]["labeler"] == "labeler"
    page = (tmp_path / PAGE).read_text()
    assert "1 cells failed" in page and "nobody &lt;can&gt;, do that" in page
