"""The command `handsim sweep`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Final

import tyro
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from handsim.app.cluster import chosen_workers
from handsim.app.messages import print_line
from handsim.app.progress import print_above, progress_bar
from handsim.errors import HandSimWarning
from handsim.files.outputs import check_outputs
from track.evaluation.sweep.sweep_file import load_sweep

_MOST_SHOWN: Final = 3  # cells that failed


def sweep(
    file: Annotated[Path, tyro.conf.Positional],
    out: Path,
    workers: int | None = None,
    cluster: str | None = None,
) -> None:
    """Train and measure for every combination of gloves, rigs, people and seeds; run it again to go on.

    Args:
        file: What to vary, a .toml file (docs/sweeps.md).
        out: Folder for training sets, labelers, figures, results.csv and report.html.
        workers: Processes; all cores when not given.
        cluster: Where else to do the steps: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    asked = load_sweep(file)
    check_outputs((file, *asked.gloves, *asked.rigs), [out])
    from track.evaluation.sweep.results import MAIN, PAGE, TABLE, summary, write_results
    from track.evaluation.sweep.running import run_sweep

    check_outputs((file, *asked.gloves, *asked.rigs), [out / TABLE, out / PAGE])
    with (
        progress_bar("steps") as (bar, task),
        chosen_workers(cluster, workers, print_above(bar)) as chosen,
    ):
        rows = run_sweep(
            asked,
            out,
            workers=chosen,
            progress=lambda what, done, total: bar.update(
                task, description=what, completed=done, total=total
            ),
        )
    table, page = write_results(rows, out)
    _print_table(summary(rows, MAIN))
    failed = [row.error for row in rows if row.error]
    if failed:
        few = "; ".join(dict.fromkeys(failed[:_MOST_SHOWN]))
        warnings.warn(
            f"{len(failed)} of {len(rows)} cells have no figures: {few}", HandSimWarning, stacklevel=2
        )
    print_line(f"{len(rows)} cells in {table}, their summary in {page}")


def _print_table(rows: list[list[str]]) -> None:
    """A summary, mean / worst."""
    header, *body = rows
    table = Table(title="mean/worst over seeds and people", box=SIMPLE, padding=0)
    for column in header:
        table.add_column(Text(column), justify="left" if column == header[0] else "right", overflow="fold")
    for row in body:
        table.add_row(*map(Text, row))
    Console().print(table)
