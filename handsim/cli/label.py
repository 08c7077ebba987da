"""The command `handsim label`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.captures.formats import WRITABLE, check_suffix, read_capture, write_capture
from gloves.captures.markers import labeled_capture, unlabeled_frames
from gloves.layout import load_layout
from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from handsim.errors import HandSimWarning
from handsim.files.outputs import check_outputs
from train.glove_labeler import load_labeler
from train.hands.frame_hands import HandFinder
from train.hands.labeling import FrameLabels, label_hands
from train.threads import label_on


def label(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Path,
    glove: str = "dense19",
    labeler: str | None = None,
    threads: int = 1,
) -> None:
    """Label the hands in every frame of a capture: none, one or two; its columns' names are not used.

    Where a frame holds two hands, the columns are called right:ThumbTip and so on, as by handsim track.

    Args:
        capture: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file.
        out: Labeled .trc, .c3d or Motive .csv file; points that are not markers become columns Unlabeled1,
            Unlabeled2, ...
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    label_on(threads)
    check_suffix(out, WRITABLE)  # before the work, not after it
    check_outputs((capture, glove, labeler), [out])
    network = load_labeler(glove, labeler)
    source = read_capture(capture)
    frames = unlabeled_frames(source)
    finder = HandFinder(network, load_layout(glove), rng=np.random.default_rng(0))
    with progress_bar("frames") as (bar, task):
        bar.update(task, total=len(frames))
        labelings = label_hands(
            frames, finder, source.rate, told=lambda count: bar.update(task, advance=count)
        )
    write_capture(out, _labeled(frames, labelings, network.marker_names, source.rate))
    confidence = [value for one in labelings for value in one.confidence[one.labels >= 0]]
    points = sum(len(one.labels) for one in labelings)
    sure = f", median confidence {np.median(confidence):.3f}" if confidence else ""
    print_line(
        f"{out}: {len(frames)} frames, {len(confidence)} of {points} points labeled{sure}; "
        f"{_counts(labelings)}"
    )
    if not confidence:
        told = f"no hand in {capture}, expected hands in glove '{glove}' (--glove names another)"
        warnings.warn(told, HandSimWarning, stacklevel=2)


def _labeled(
    frames: Sequence[NDArray[np.float64]],
    labelings: Sequence[FrameLabels],
    names: tuple[str, ...],
    rate: float,
) -> Capture:
    """The labeled points: plain marker names, or right:ThumbTip and so on if a frame holds two hands."""
    labels = [one.labels for one in labelings]
    if any(all(one.hands) for one in labelings):
        labels = [np.where(one.sides < 0, one.labels + len(names), one.labels) for one in labelings]
        names = tuple(f"{side}:{name}" for side in ("right", "left") for name in names)
    return labeled_capture(frames, labels, names, rate)


def _counts(labelings: Sequence[FrameLabels]) -> str:
    """How many frames hold how many hands, and which."""
    right, left = np.array([one.hands for one in labelings], dtype=bool).reshape(-1, 2).T
    counts = ((right & left, "two hands"), (right & ~left, "a right hand"), (left & ~right, "a left hand"))
    said = [f"{words} in {there.sum()} frames" for there, words in counts if there.any()]
    none = (~right & ~left).sum()
    return ", ".join([*said, f"no hand in {none} frames"] if none or not said else said)
