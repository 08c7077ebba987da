"""The command `handsim label`."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from jaxtyping import Bool

from handsim.hand.shape import Side

if TYPE_CHECKING:
    from train.labelers.protocol import Labeler


def label(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    glove: str = "dense19",
    hands: tuple[Side, ...] | None = None,
    labeler: str | None = None,
    threads: int = 1,
) -> None:
    """Label the hands in every frame of captures: none, one or two; their columns' names are not used.

    Where a frame holds two hands, the columns are called right:ThumbTip and so on, as by handsim track. Of
    several captures those that fail are reported and skipped, and what OUT has of the same captures and
    options stays.

    Args:
        captures: .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) files, folders searched for them, or the
            table of a study (.csv), see docs/how_to/study.md.
        out: Labeled .trc, .c3d or Motive .csv file; points that are not markers become columns Unlabeled1,
            Unlabeled2, ... For several captures or a folder of them a folder, whose files have the captures'
            names; those of .tsv files end in .c3d.
        glove: Marker layout: a shipped name or the path of a .toml file.
        hands: Which hands are in the captures; all that the glove is made for when not given.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    from gloves.captures.formats import WRITABLE, check_suffix
    from handsim.cli.study import Step, StudyFile, is_study, run_study, study_files
    from handsim.files.outputs import check_outputs
    from train.labelers.protocol import label_on

    label_on(threads)
    load = lru_cache(maxsize=1)(partial(_load_labeler, labeler=labeler))
    if not is_study(captures, out):
        check_suffix(out, WRITABLE)
        check_outputs((*captures, glove, labeler), [out])
        _label(load, captures[0], out, glove, hands)
        return

    def plan(file: StudyFile) -> Step:
        is_writable = file.name.suffix.lower() in WRITABLE
        name = file.name if is_writable else file.name.with_suffix(".c3d")
        own = file.options(glove=glove, hands=hands)
        return Step((out / name,), (own["glove"], labeler), {**own, "labeler": labeler})

    def label_one(captures: tuple[Path, ...], labeler: object, **given: Any) -> None:
        _label(load, captures[0], **given)

    run_study(study_files(captures, out, WRITABLE), out, label_one, plan, "labeled")


def _load_labeler(glove: str, labeler: str | None) -> Labeler:
    """The labeler of a glove, which may have to be learned."""
    from handsim.app.messages import named_steps
    from track.settings import LabelSettings, TrackerSetup

    with named_steps(""):
        return TrackerSetup.of(LabelSettings(glove, labeler=labeler)).labeler


def _label(
    load: Callable[[str], Labeler], capture: Path, out: Path, glove: str, hands: tuple[Side, ...] | None
) -> None:
    """Label a capture, and print a line on it."""
    from gloves.captures.formats import write_capture
    from handsim.app.messages import print_line, progress_bar
    from track.captures import label_capture
    from track.frames import read_points

    source = read_points(capture)  # before a glove is learned
    with progress_bar("frames") as bar:
        take = label_capture(source, glove=glove, hands=hands, labeler=load(glove), progress=bar)
    points = take.point_list
    labeled = points.labels >= 0
    side_of = np.array([*(name.split(":")[0] for name in take.label_names), ""])  # -1 is the last one
    sides = side_of[points.labels]
    right, left = (
        np.bincount(points.frames[sides == side], minlength=take.num_frames) > 0 for side in ("right", "left")
    )
    write_capture(out, take.labeled_capture(sides=bool((right & left).any())), source=capture)
    sure = f", median confidence {np.median(points.confidence[labeled]):.3f}" if labeled.any() else ""
    print_line(
        f"{out}: {take.num_frames} frames, {labeled.sum()} of {len(labeled)} points labeled{sure}; "
        f"{_counts(right, left)}"
    )


def _counts(right: Bool[np.ndarray, "T"], left: Bool[np.ndarray, "T"]) -> str:
    """The numbers of frames with two hands, one and none, in words."""
    counts = ((right & left, "two hands"), (right & ~left, "a right hand"), (left & ~right, "a left hand"))
    said = [f"{words} in {there.sum()} frames" for there, words in counts if there.any()]
    none = (~right & ~left).sum()
    return ", ".join([*said, f"no hand in {none} frames"] if none or not said else said)
