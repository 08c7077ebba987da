"""The command `handsim train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from handsim.app.progress import progress_bar
from train.config import Preset, TrainConfig, with_preset
from train.data.shards import Dataset
from train.reports.figures_table import print_figures
from train.reports.run_page import PAGE


def train(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")],
    preset: Preset | None = None,
) -> None:
    """Train a labeler on a training set and draw a page about it; run it again to go on where it was stopped.

    Args:
        dataset: Folder that `handsim generate` wrote.
        out: Folder for the weights, the model card, the checkpoint and report.html.
        config: How to train.
        preset: A published recipe; options given beside it hold all the same.
    """
    from train.loop import train_labeler

    rows = Dataset(dataset)
    if preset is not None:
        config = with_preset(preset, config, rows.manifest.num_frames)
    with progress_bar("samples") as (bar, task):

        def report(done: int, total: int, loss: float) -> None:
            bar.update(task, completed=done, total=total, description=f"loss {loss:.3f}")

        card = train_labeler(rows, config, out, progress=report)
    print_figures(card["held_out_simulated"], title="Held-out simulated frames")
    Console().print(f"weights and model card in {out}")
    Console().print(f"report in {out / PAGE}", soft_wrap=True, markup=False)
