"""The command `handsim train`."""

from __future__ import annotations

import contextlib
import functools
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import tyro

from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from handsim.cli.command_table import PresetCommand, given_option
from handsim.cli.parsing import run_command
from handsim.errors import DatasetError, HandSimError
from handsim.files.signals import Stopped
from train.devices.world import world_of
from train.evaluation import print_figures
from train.settings import KINDS, PRESETS, Kind, Preset, TrainSettings, default_config, preset_config

_PAPER_FRAMES: Final = 170_330  # for the help, which knows no training set


def _train(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainSettings, tyro.conf.arg(name="")],
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
    from train.reports.run_page import PAGE

    del preset  # it is in `config` already
    from train.devices.agreement import PeerError
    from train.loop import train_labeler

    try:
        if world_of().rank:
            _train_silently(dataset, out, config, threads)
            return
        with progress_bar("samples") as (bar, task):
            card = train_labeler(
                dataset,
                out,
                config,
                threads=threads,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
                on_step=lambda step: bar.update(task, description=step),
            )
    except PeerError as error:  # another process has told it
        raise SystemExit(1) from error
    print_figures(card["held_out_simulated"], title="Held-out simulated frames")
    print_line(f"weights and model card in {out}")
    print_line(f"report in {out / PAGE}")


def _train_silently(dataset: Path, out: Path, config: TrainSettings, threads: int | None) -> None:
    """Train in a process other than the first of several, which tells what there is to tell."""
    from train.loop import train_labeler

    try:
        train_labeler(dataset, out, config, threads=threads)
    except KeyboardInterrupt as stop:
        raise SystemExit(128 + (stop.number if isinstance(stop, Stopped) else 2)) from stop


def _command_of_rank(args: Sequence[str], prog: str) -> Callable[..., None]:
    """The command; of several processes the first alone tells mistakes in the options, which all have."""
    if not world_of().rank:
        return _with_recipe_as_default(args, prog)
    try:
        # A silent tyro still prints values it cannot read.
        with contextlib.redirect_stderr(io.StringIO()):
            command = _with_recipe_as_default(args, prog)
            parsed = functools.partial(_dataset_of, **command.keywords)
            run_command(parsed, prog=prog, args=args, is_silent=True)
        return command
    except DatasetError:  # this one may not see the set
        raise
    except HandSimError as error:
        raise SystemExit(1) from error


def _with_recipe_as_default(args: Sequence[str], prog: str) -> functools.partial[None]:
    """`handsim train` with the settings of the given labeler or preset as the default of `config`."""
    from train.data.shards import load_manifest

    name = given_option(args, "--preset")
    preset = next((preset for preset in PRESETS if preset == name), None)
    if preset is None:
        labeler = given_option(args, "--labeler")
        kind: Kind = next((kind for kind in KINDS if kind == labeler), "set")
        return functools.partial(_train, config=default_config(kind))
    # The recipe counts epochs, so the training set must be known before its defaults are.
    recipe = functools.partial(_dataset_of, config=preset_config(preset, _PAPER_FRAMES))
    folder = run_command(recipe, prog=prog, args=args)
    config = preset_config(preset, load_manifest(folder).num_frames)
    return functools.partial(_train, config=config)


@functools.wraps(_train)
def _dataset_of(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainSettings, tyro.conf.arg(name="")],
    preset: Preset | None = None,
    threads: int | None = None,
) -> Path:
    del out, config, preset, threads
    return dataset


train: Final = PresetCommand(_command_of_rank)
