"""The command `handsim label`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import tyro

from gloves.captures.formats import WRITABLE, check_suffix, read_capture, write_capture
from gloves.captures.markers import labeled_capture, unlabeled_frames
from gloves.layout import load_layout
from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from handsim.errors import HandSimWarning
from handsim.files.outputs import check_outputs
from train.labelers.storage import labeler_for_glove
from train.threads import label_on

_SIDE_FRAMES: Final = 100


def label(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Path,
    glove: str = "dense19",
    labeler: str | None = None,
    threads: int = 1,
) -> None:
    """Label every frame of a capture on its own; names and order of its columns are not used.

    Args:
        capture: A .trc, .c3d or Motive .csv file.
        out: Labeled .trc or .c3d file; points that are not markers become columns Unlabeled1, Unlabeled2, ...
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    label_on(threads)
    check_suffix(out, WRITABLE)  # before the work, not after it
    check_outputs((capture, glove, labeler), [out])
    network = labeler_for_glove(glove, labeler)
    source = read_capture(capture)
    frames = unlabeled_frames(source)
    with progress_bar("frames") as (bar, task):
        labelings = []
        for first in range(0, len(frames), 1024):
            labelings += network.label_frames(frames[first : first + 1024])
            bar.update(task, completed=len(labelings), total=len(frames))
    labels = [labeling.labels for labeling in labelings]
    write_capture(out, labeled_capture(frames, labels, network.marker_names, source.rate))
    labeled = sum(int((label >= 0).sum()) for label in labels)
    points = sum(len(label) for label in labels)
    confidence = [labeling.confidence[labeling.labels >= 0] for labeling in labelings]
    sure = f", median confidence {np.median(np.concatenate(confidence)):.3f}" if labeled else ""
    print_line(
        f"{out}: {len(frames)} frames, {labeled} of {points} points labeled{sure}"
        f"{_side(glove, frames, labels)}"
    )
    if not labeled:
        told = (
            f"no point of {capture} was labeled, expected a hand in glove '{glove}' (--glove names another)"
        )
        warnings.warn(told, HandSimWarning, stacklevel=2)


def _side(glove: str, frames: list[np.ndarray], labels: list[np.ndarray]) -> str:
    """Which hand it probably is, from the frames with the most markers."""
    from train.labelers.side import SideClassifier

    best = sorted(range(len(frames)), key=lambda frame: -int((labels[frame] >= 0).sum()))[:_SIDE_FRAMES]
    classifier = SideClassifier(load_layout(glove), rng=np.random.default_rng(0))
    sides = [classifier.classify(frames[frame], labels[frame]) for frame in best]
    votes = sum(clear if side == "right" else -clear for side, clear in sides)
    return "" if votes == 0.0 else f", a {'right' if votes > 0.0 else 'left'} hand"
