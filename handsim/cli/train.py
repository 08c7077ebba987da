"""The commands `handsim train` and `handsim evaluate`."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import tyro

from handsim.app.messages import print_line, progress_bar
from handsim.cli.parsing import PresetCommand, given_option
from train.settings import KINDS, PRESETS, EvaluateSettings, Preset, TrainSettings, usual_settings


def _train(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    settings: Annotated[TrainSettings, tyro.conf.arg(name="")],
    preset: Preset | None = None,
    threads: int | None = None,
) -> None:
    """Train a labeler on a training set and write a page about it; run it again to continue a stopped run.

    Args:
        dataset: Folder that `handsim generate` wrote.
        out: Folder for the weights, the model card, the checkpoint and report.html.
        settings: How to train.
        preset: A published recipe, which replaces the defaults; options given beside it hold.
        threads: Threads on a CPU; when not given, one for the set labeler and all for the paper's network.
    """
    from train.evaluation import print_figures
    from train.loop import train_labeler
    from train.reports.run_page import PAGE

    del preset  # it is in `settings`
    if os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) != "0":  # the first process tells
        train_labeler(dataset, out, settings, threads=threads)
        return
    with progress_bar("samples") as bar:
        card = train_labeler(dataset, out, settings, threads=threads, progress=bar, on_step=bar.step)
    print_figures(card["held_out_simulated"], title="Held-out simulated frames")
    print_line(f"weights and model card in {out}")
    print_line(f"report in {out / PAGE}")


def _with_usual_settings(args: Sequence[str], prog: str) -> Callable[..., None]:
    """The command with the settings of the given labeler or preset as its defaults."""
    labeler, preset = given_option(args, "--labeler"), given_option(args, "--preset")
    kinds, presets = (one for one in KINDS if one == labeler), (one for one in PRESETS if one == preset)
    return functools.partial(_train, settings=usual_settings(next(kinds, "set"), next(presets, None)))


train: Final = PresetCommand(_with_usual_settings)


def evaluate(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    settings: Annotated[EvaluateSettings, tyro.conf.arg(name="")],
    *,
    glove: str = "dense19",
    labeler: str | None = None,
    json: Path | None = None,
    threads: int = 1,
) -> None:
    """Measure a labeler on labeled captures, corrupted as in the paper.

    Args:
        captures: Labeled .trc, .c3d, .csv or .tsv files, folders searched for them, or the .truth.npz of
            takes. Each hand of a capture of two, with columns right:ThumbTip and so on, is counted by itself.
        settings: What is evaluated.
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        json: File for the figures.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    import numpy as np

    from handsim.files.outputs import check_outputs, save_json
    from train.evaluation import evaluate_labeler, print_figures
    from train.labelers.protocol import label_on
    from train.labelers.storage import load_labeler

    label_on(threads)
    check_outputs((*captures, glove, labeler), [json])
    network = load_labeler(glove, labeler)
    report = evaluate_labeler(network, captures, settings=settings)
    by_marker = dict(zip(network.marker_names, map(float, report.slot_accuracy_by_marker), strict=True))
    if json is not None:
        # JSON has no NaN, which stands where there was nothing to count.
        figures = {name: None if np.isnan(value) else value for name, value in report.figures.items()}
        found = {"frames": report.num_frames, "figures": figures, "numbers": report.numbers}
        save_json(json, {"glove": glove, **settings.record(), **found, "slot_accuracy_by_marker": by_marker})
    hard = f", occlude {settings.occlude}, ghosts {settings.ghosts}"
    hard = hard if settings.occlude or settings.ghosts else ""
    print_figures({"share": report.figures}, title=f"{report.num_frames} hands in frames{hard}")
    worst = sorted(by_marker, key=by_marker.__getitem__)[:3]
    print_line("worst markers: " + ", ".join(f"{name} {100 * by_marker[name]:.2f} %" for name in worst))
