"""The command `handsim evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from handsim.app.messages import print_line
from handsim.files.outputs import check_outputs, save_json
from train.settings import EvaluateSettings


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
        captures: Labeled .trc, .c3d, .csv or .tsv files, folders searched for them, the .truth.npz of takes,
            or training sets, which without drops and ghosts are counted as their rig saw them. Each hand of
            a capture of two, with columns right:ThumbTip and so on, is counted by itself.
        settings: What is evaluated.
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        json: File for the figures.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    import numpy as np

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
