"""The command `handsim train`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import tyro

from handsim._process import rank_and_size
from handsim.app.messages import print_line, progress_bar
from handsim.cli.parsing import PresetCommand, given_option
from train.settings import KINDS, PRESETS, Preset, TrainSettings, usual_settings


def _train(
    dataset: Annotated[str, tyro.conf.Positional],
    out: Path,
    settings: Annotated[TrainSettings, tyro.conf.arg(name="")],
    preset: Preset | None = None,
    threads: int | None = None,
) -> None:
    """Train a labeler on a training set and write a page about it; run it again to continue a stopped run.

    At the end the labeler is compared with the one that the glove has without training, on the same frames
    of people whom training did not see, and the better one is named.

    Args:
        dataset: Folder that `handsim generate` wrote, also in an object store, as s3://bucket/prefix.
        out: Folder for the weights, the model card, the checkpoint and report.html.
        settings: How to train.
        preset: A published recipe, which replaces the defaults; options given beside it hold.
        threads: Threads on a CPU; when not given, one for the set labeler and all for the paper's network.
    """
    from train.evaluation import SEEN, percent, print_figures
    from train.loop import train_labeler, untrained_report
    from train.reports.run_page import PAGE, held_out_people

    del preset  # it is in `settings`
    if rank_and_size()[0]:  # only the first process prints
        train_labeler(dataset, out, settings, threads=threads)
        return
    with progress_bar("samples") as bar:
        card = train_labeler(dataset, out, settings, threads=threads, progress=bar, on_step=bar.step)
    title = held_out_people(card)
    print_figures(card["held_out_simulated"], title=title[0].upper() + title[1:])
    for name, between in card["held_out_intervals"].items():
        ends = [
            f"{figure.partition('_')[0]} {' to '.join(map(percent, one))}" for figure, one in between.items()
        ]
        if ends:
            print_line(f"{name}, 95 % over people: accuracy by {', '.join(ends)} %")
    print_line(f"weights and model card in {out}")
    print_line(f"report in {out / PAGE}")
    ours, usual = (
        one["slot_accuracy"]
        for one in (card["held_out_simulated"][SEEN], untrained_report(dataset, settings).figures)
    )
    choice = f"use it, with --labeler {out}" if ours >= usual else "use that one, without --labeler"
    print_line(
        f"{percent(ours)} % of the slots are right {SEEN} with this labeler, {percent(usual)} % with the one "
        f"that the glove has without training: {choice}"
    )


def _with_usual_settings(args: Sequence[str], prog: str) -> Callable[..., None]:
    """The command with the settings of the given labeler or preset as its defaults."""
    labeler, preset = given_option(args, "--labeler"), given_option(args, "--preset")
    kinds, presets = (one for one in KINDS if one == labeler), (one for one in PRESETS if one == preset)
    kind = next(kinds, None)
    settings = usual_settings(kind or "set", next(presets, None))
    if kind == "set":  # keep the other settings of a preset for the paper's network
        usual = usual_settings(kind)
        settings = dataclasses.replace(settings, labeler=kind, knee=usual.knee, cnn=usual.cnn)
    return functools.partial(_train, settings=settings)


train: Final = PresetCommand(_with_usual_settings)
