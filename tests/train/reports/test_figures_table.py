"""Figures as a table."""

from __future__ import annotations

from train.reports.figures_table import print_figures


def test_figures_are_printed_in_percent(capsys):
    print_figures({"clean": {"macro_f1": 0.98765, "ghost_recall": float("nan")}}, title="Figures")
    said = capsys.readouterr().out
    assert "macro f1" in said and "98.77" in said and "-" in said
