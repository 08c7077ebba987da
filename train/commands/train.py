"""The command `handsim train`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import tyro

from handsim.app.messages import print_line
from handsim.app.presets import PresetCommand, given_option
from handsim.app.progress import progress_bar
from train.config import KINDS, PRESETS, Kind, Preset, TrainConfig, default_config, preset_config
from train.data.shards import Dataset, load_manifest
from train.reports.figures_table import print_figures
from train.reports.run_page import PAGE

_PAPER_FRAMES: Final = 170_330  # for the help, which knows no training set


def _train(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")],
    preset: Preset | None = None,
    threads: int | None = None,
) -> None:
    """Train a labeler on a training set and write a page about it; run it again to continue a stopped run.

    Args:
        dataset: Folder that `handsim generate` wrote.
        out: Folder for the weights, the model card, the checkpoint and report.html.
        config: How to train.
        preset: A published recipe, which replaces the defaults; options given beside it hold.
        threads: Threads on a CPU; the faster of one and all when not given, measured now and then.
    """
    del preset  # it is in `config` already
    from train.loop import train_labeler

    rows = Dataset(dataset)
    with progress_bar("samples") as (bar, task):

        def report(done: int, total: int, loss: float) -> None:
            bar.update(task, completed=done, total=total, description=f"loss {loss:.3f}")

        card = train_labeler(rows, config, out, threads=threads, progress=report)
    print_figures(card["held_out_simulated"], title="Held-out simulated frames")
    print_line(f"weights and model card in {out}")
    print_line(f"report in {out / PAGE}")


def _with_recipe_as_default(args: Sequence[str], prog: str) -> Callable[..., None]:
    """`handsim train` with the settings of the given labeler or preset as the default of `config`."""
    name = given_option(args, "--preset")
    preset = next((preset for preset in PRESETS if preset == name), None)
    if preset is None:
        labeler = given_option(args, "--labeler")
        kind: Kind = next((kind for kind in KINDS if kind == labeler), "set")
        return functools.partial(_train, config=default_config(kind))
    # The recipe counts epochs, so the training set must be known before its defaults are.
    folder = tyro.cli(
        functools.partial(_dataset_of, config=preset_config(preset, _PAPER_FRAMES)), prog=prog, args=args
    )
    config = preset_config(preset, load_manifest(folder).num_frames)
    return functools.partial(_train, config=config)


@functools.wraps(_train)
def _dataset_of(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")],
    preset: Preset | None = None,
    threads: int | None = None,
) -> Path:
    del out, config, preset, threads
    return dataset


train: Final = PresetCommand(_with_recipe_as_default)
