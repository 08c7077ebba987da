"""The command `handsim generate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import tyro
from rich.console import Console

from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from train.data.shards import Dataset
from train.reports.dataset_page import write_report
from train.simulation.dataset_config import DatasetConfig
from train.simulation.generation import generate_dataset
from train.simulation.takes import TakeConfig, simulate_take

_TAKE_FRAMES: Final = 1200  # of the continuous take for the report's gaps


def generate(
    out: Path, config: Annotated[DatasetConfig, tyro.conf.arg(name="")], workers: int | None = None
) -> None:
    """Make a training set and a page of plots of it; run it again to continue where it was stopped.

    Args:
        out: Folder for the shards, their manifest and report.html.
        config: What to make.
        workers: Processes; all cores when not given.
    """
    with progress_bar("frames") as (bar, task):
        manifest = generate_dataset(
            config,
            out,
            workers=workers,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    # Not in generate_dataset: a set is complete without its report, whose bytes depend on matplotlib.
    with Console(stderr=True).status("drawing the report"):
        take = simulate_take(
            TakeConfig(kind="hand-hand", num_frames=_TAKE_FRAMES, glove=config.glove, rig=config.rig)
        )
        report = write_report(Dataset(out), present=take.markers_present(), rate=take.rate)
    print_line(f"{manifest.num_frames} frames of {config.glove} in {out}")
    print_line(f"report in {report}")
