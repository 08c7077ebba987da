"""The results of a sweep: a row a cell, and their means and worst over people and seeds."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from handsim.app.page import Section, write_page
from handsim.files.atomic import atomic_write
from track.evaluation.sweep.steps import LABELING, SEEN, TRACKING

TABLE: Final = "results.csv"
PAGE: Final = "report.html"
_REPEATED: Final = ("seed", "person")
"""Columns over which means are taken."""
_NOTHING: Final = "-"
_SHOWN: Final = {
    SEEN: "markers seen [%]",
    "slot_accuracy": "slots right [%]",
    "frame_accuracy": "hands right [%]",
    "frames_right": "tracked frames right [%]",
    "joint_error_mm": "joints [mm]",
    "angle_error_deg": "angles [deg]",
}
"""Figures of the summary, with their names there; of the others the .csv tells."""
MAIN: Final = ("slot_accuracy", "frame_accuracy", "frames_right", "joint_error_mm")
"""Those for which a terminal has room."""


@dataclass(frozen=True, slots=True)
class Row:
    """A cell and its figures."""

    varied: dict[str, Any]
    """What is varied, by column."""
    figures: dict[str, float | None]
    """Figures by name, see `steps`; None where nothing was counted, no figures where the cell failed."""
    error: str
    """Why there are none."""
    labeler: str
    """Folder of the labeler, below `labelers`; "" where none was trained."""


def write_results(rows: Sequence[Row], out: Path) -> tuple[Path, Path]:
    """Write the table of all rows and a page with their summary; equal rows give equal bytes.

    Returns:
        The table and the page.
    """
    table, page = out / TABLE, out / PAGE
    figures = _measured(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*rows[0].varied, *figures, "labeler", "error"])
    for row in rows:
        values = [_in_file(row.figures.get(name)) for name in figures]
        writer.writerow([*map(_word, row.varied.values()), *values, row.labeler, row.error])
    with atomic_write(table) as temporary:
        temporary.write_text(text.getvalue(), "utf-8")
    failed = [f"{_words(row.varied)}: {row.error}" for row in rows if row.error]
    write_page(
        page,
        [
            Section(
                "Results",
                "Mean over seeds and people, then the worst of them.",
                table=summary(rows),
                notes=[f"{len(failed)} cells failed.", *failed] if failed else (),
            )
        ],
        title="Sweep",
        lead=f"{len(rows)} cells; all their figures are in {TABLE}.",
    )
    return table, page


def summary(rows: Sequence[Row], names: Collection[str] = _SHOWN) -> list[list[str]]:
    """A table: what is varied, and the mean and worst of each figure over seeds and people.

    Args:
        rows: All cells.
        names: Which figures.

    Returns:
        Rows of cells, the header first; values of which there is one alone have no column.
    """
    columns = [
        key
        for key in rows[0].varied
        if key not in _REPEATED and len({_word(row.varied[key]) for row in rows}) > 1
    ]
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(_word(row.varied[key]) for key in columns), []).append(row)
    figures = [name for name in _measured(rows) if name in names]
    table = [[*(columns or ["sweep"]), "cells", *(_SHOWN[name] for name in figures)]]
    for values, members in groups.items():
        cells = [_mean_and_worst(name, members) for name in figures]
        table.append([*(values or ("all",)), str(sum(not row.error for row in members)), *cells])
    return table


def _measured(rows: Sequence[Row]) -> list[str]:
    """Names of the figures that there are."""
    return [name for name in (SEEN, *LABELING, *TRACKING) if any(name in row.figures for row in rows)]


def _mean_and_worst(name: str, rows: Sequence[Row]) -> str:
    """The mean and the worst of a figure, as a table shows them."""
    values = [value for row in rows if (value := row.figures.get(name)) is not None]
    if not values:
        return _NOTHING
    error = name.endswith(("_mm", "_deg"))
    scale, worst = (1.0, max(values)) if error else (100.0, min(values))
    return f"{scale * math.fsum(values) / len(values):.2f}/{scale * worst:.2f}"


def _in_file(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _word(value: Any) -> str:
    """A varied value as a table shows it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _words(varied: dict[str, Any]) -> str:
    return ", ".join(f"{key} {_word(value)}" for key, value in varied.items())
