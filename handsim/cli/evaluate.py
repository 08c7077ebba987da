"""The command `handsim evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from gloves.captures.collection import find_captures, read_markers
from gloves.takes.take import Take, load_take
from handsim.errors import CaptureError, HandSimError
from handsim.files.json_files import save_json
from handsim.files.outputs import check_outputs
from train.glove_labeler import labeler_for_glove
from train.reports.figures_table import print_figures
from train.threads import label_on


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
    from train.data.augmentation import Corruption
    from train.evaluation.labeler_evaluation import evaluate_labeler, evaluate_takes

    if occlude < 0 or ghosts < 0:
        raise HandSimError(f"occlude is {occlude} and ghosts {ghosts}, expected 0 or more of each")
    if seed < 0 or every < 1:
        raise HandSimError(f"seed is {seed} and every {every}, expected at least 0 and 1")
    label_on(threads)
    are_takes = _are_takes(captures)
    check_outputs((*captures, glove, labeler), [json])
    network = labeler_for_glove(glove, labeler)
    if are_takes:
        if occlude or ghosts or every > 1:
            raise HandSimError(
                "a simulated take is counted whole, with its own gaps and ghosts: leave out --occlude, "
                "--ghosts and --every"
            )
        report = evaluate_takes(network, [_load_truth(path) for path in captures])
        title = f"{len(captures)} takes, {report.num_frames} frames of one hand"
    else:
        files = find_captures(captures)
        markers = read_markers(files, network.marker_names)[::every]
        corruption = Corruption(occlude, ghosts)
        report = evaluate_labeler(network, markers, corruption, rng=np.random.default_rng(seed))
        title = f"{len(files)} captures, {report.num_frames} frames, occlude {occlude}, ghosts {ghosts}"
    if not any(report.confusion[:-1].ravel()):
        given = ", ".join(str(path) for path in captures)
        raise CaptureError(
            f"nothing to count: no frame of {given} holds a marker of glove '{glove}', expected labeled "
            "captures"
        )
    by_marker = dict(zip(network.marker_names, map(float, report.slot_accuracy_by_marker), strict=True))
    _print_report(report.figures, by_marker, title)
    if json is not None:
        drawn = {"glove": glove, "occlude": occlude, "ghosts": ghosts, "every": every, "seed": seed}
        # JSON has no NaN, which stands where there was nothing to count.
        figures = {name: None if np.isnan(value) else value for name, value in report.figures.items()}
        found = {"frames": report.num_frames, "figures": figures, "numbers": report.numbers}
        found["slot_accuracy_by_marker"] = by_marker
        save_json(json, {**drawn, **found})


def _load_truth(path: Path) -> Take:
    """A take whose labels are true.

    Raises:
        CaptureError: It cannot be read, or its labels are a tracker's.
    """
    take = load_take(path)
    if take.is_tracked:
        raise CaptureError(f"{path}: a tracked take, expected the truth of a simulated capture")
    return take


def _are_takes(captures: tuple[Path, ...]) -> bool:
    """Whether the truth of takes was given, not labeled captures.

    Raises:
        CaptureError: Nothing was given, or both.
    """
    if not captures:
        raise CaptureError(
            "no capture was given, expected labeled captures, folders or the .truth.npz of takes"
        )
    takes = [path for path in captures if path.suffix == ".npz"]
    if takes and len(takes) < len(captures):
        other = next(path for path in captures if path not in takes)
        raise CaptureError(
            f"given a take, {takes[0]}, and a capture, {other}, expected one kind; evaluate each on its own"
        )
    return bool(takes)


def _print_report(figures: dict[str, float], by_marker: dict[str, float], title: str) -> None:
    print_figures({"share": figures}, title=title)
    worst = sorted(by_marker, key=by_marker.__getitem__)[:3]
    Console().print("worst markers: " + ", ".join(f"{name} {100 * by_marker[name]:.2f} %" for name in worst))
