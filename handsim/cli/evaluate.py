"""The command `handsim evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from handsim.app.messages import print_line
from handsim.errors import ArgumentError


def evaluate(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    *,
    glove: str = "dense19",
    labeler: str | None = None,
    occlude: int = 0,
    ghosts: int = 0,
    every: int = 1,
    seed: int = 0,
    json: Path | None = None,
    threads: int = 1,
) -> None:
    """Measure a labeler on labeled captures, corrupted as in the paper.

    Args:
        captures: Labeled .trc, .c3d, .csv or .tsv files, folders searched for them, or the .truth.npz of
            takes. Each hand of a capture of two, with columns right:ThumbTip and so on, is counted by itself.
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        occlude: Up to this many draws of a marker to drop, with replacement (the paper: 5 dense, 3 sparse).
        ghosts: Up to this many ghosts, uniform in the frame's box grown by a tenth (the paper: 2).
        every: Take one frame of this many of captures; 1 takes all.
        seed: Seed of the corruption.
        json: File for the figures.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    if occlude < 0 or ghosts < 0 or seed < 0:
        raise ArgumentError(
            f"occlude is {occlude}, ghosts {ghosts} and seed {seed}, expected 0 or more of each"
        )
    import numpy as np

    from handsim.files.json_files import save_json
    from handsim.files.outputs import check_outputs
    from train.data.batches import Corruption
    from train.evaluation import evaluate_labeler, print_figures
    from train.labelers.storage import load_labeler
    from train.threads import label_on

    label_on(threads)
    check_outputs((*captures, glove, labeler), [json])
    network = load_labeler(glove, labeler)
    corruption, rng = Corruption(occlude, ghosts), np.random.default_rng(seed)
    report = evaluate_labeler(network, captures, corruption, every=every, rng=rng)
    by_marker = dict(zip(network.marker_names, map(float, report.slot_accuracy_by_marker), strict=True))
    if json is not None:
        drawn = {"glove": glove, "occlude": occlude, "ghosts": ghosts, "every": every, "seed": seed}
        # JSON has no NaN, which stands where there was nothing to count.
        figures = {name: None if np.isnan(value) else value for name, value in report.figures.items()}
        found = {"frames": report.num_frames, "figures": figures, "numbers": report.numbers}
        save_json(json, {**drawn, **found, "slot_accuracy_by_marker": by_marker})
    hard = f", occlude {occlude}, ghosts {ghosts}" if occlude or ghosts else ""
    print_figures({"share": report.figures}, title=f"{report.num_frames} hands in frames{hard}")
    worst = sorted(by_marker, key=by_marker.__getitem__)[:3]
    print_line("worst markers: " + ", ".join(f"{name} {100 * by_marker[name]:.2f} %" for name in worst))
