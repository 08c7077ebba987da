"""Figures of an evaluation as a table on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from train.metrics import percent


def print_figures(columns: dict[str, dict[str, float]], *, title: str) -> None:
    """Figures as a table in percent, a column each."""
    table = Table(title=title)
    table.add_column("figure")
    for name in columns:
        table.add_column(f"{name} [%]", justify="right")
    for figure in next(iter(columns.values())):
        table.add_row(
            figure.replace("_", " "), *map(percent, (column[figure] for column in columns.values()))
        )
    Console().print(table)
