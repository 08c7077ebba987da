"""The commands `handsim simulate` and `handsim reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from gloves.captures import WRITABLE, write_capture
from gloves.captures.capture import Capture, check_suffix
from gloves.captures.markers import UNLABELED
from gloves.gaps import count_gaps, run_lengths
from gloves.take import SUFFIX, Take, save_take
from train.commands import progress_bar
from train.twins import KINDS, TWINS, TwinConfig, simulate_twin

PUBLISHED_GAPS = "3-4", "24-43"  # median and p90 of real finger markers' gaps [frames]; docs/room.md


def simulate(out: Path, config: Annotated[TwinConfig, tyro.conf.arg(name="")]) -> None:
    """Simulate a capture of two hands; the truth goes beside it.

    Args:
        out: Unlabelled .c3d or .trc file; OUT.truth.npz takes IDs, labels, poses and shapes.
        config: What to simulate.
    """
    check_suffix(out, WRITABLE)
    take = simulate_twin(config)
    names = tuple(f"{UNLABELED}{number + 1}" for number in range(take.points.shape[1]))
    write_capture(out, Capture(names, take.points, take.rate))
    truth = out.with_suffix(SUFFIX)
    save_take(truth, take)
    counts = count_gaps(take.markers_present())
    Console().print(
        f"{out}: {take.num_frames} frames, {counts.gaps} gaps; truth in {truth}",
        highlight=False,
        soft_wrap=True,
    )


def reproduce(
    table: Annotated[Literal["table3"], tyro.conf.Positional], glove: str = "dense19", seed: int = 0
) -> None:
    """Print a table of Han et al. 2018 with our figures beside the paper's.

    Args:
        table: Which one.
        glove: Marker layout: a shipped name or the path of a .toml file.
        seed: Seed of the captures; 0 gives the twins, others give other captures of the same kinds.
    """
    del table  # one so far; the name is part of the command line's contract
    takes: dict[str, Take] = {}
    with progress_bar("captures") as (bar, task):
        for kind in KINDS:
            takes[kind] = simulate_twin(TwinConfig(kind=kind, glove=glove, seed=seed))
            bar.update(task, completed=len(takes), total=len(TWINS))
    console = Console()
    console.print(_table3(takes))
    console.print(_by_marker(takes))


def _table3(takes: dict[str, Take]) -> Table:
    table = Table(title="Table 3: ours, and the paper's in brackets")
    for column in ("Test set", "#Frame", "#Gap", "AGL", "AMF", "ghosts / labels"):
        table.add_column(
            column, justify="left" if column == "Test set" else "right", no_wrap=column == "Test set"
        )
    for kind, take in takes.items():
        present = take.markers_present()
        ours, paper = count_gaps(present), TWINS[kind].paper
        ghosts = int(((take.labels < 0) & np.isfinite(take.points[..., 0])).sum())
        table.add_row(
            kind,
            f"{ours.frames} ({paper.frames})",
            f"{ours.gaps} ({paper.gaps})",
            f"{ours.average_length:.2f} ({paper.average_length:.2f})",
            f"{ours.average_missing:.2f} ({paper.average_missing:.2f})",
            f"{100 * ghosts / present.size:.2f} % ({100 * TWINS[kind].ghost_ratio:.2f} %)",
        )
    return table


def _by_marker(takes: dict[str, Take]) -> Table:
    table = Table(title="Missing share and gap lengths, a marker at a time")
    for column in ("Test set", "mean", "least", "most", "median gap", "p90", "p99 [frames]"):
        table.add_column(
            column, justify="left" if column == "Test set" else "right", no_wrap=column == "Test set"
        )
    for kind, take in takes.items():
        missing = ~take.markers_present()
        share, lengths = missing.mean(axis=0), run_lengths(missing)
        quantiles = np.quantile(lengths, [0.5, 0.9, 0.99]) if len(lengths) else np.full(3, np.nan)
        table.add_row(
            kind,
            *(f"{100 * value:.2f} %" for value in (share.mean(), share.min(), share.max())),
            *(f"{value:.0f}" for value in quantiles),
        )
    table.add_row("real finger markers", "2.6-4.9 %", "0.2 %", "12.4 %", *PUBLISHED_GAPS, "320-340")
    return table
