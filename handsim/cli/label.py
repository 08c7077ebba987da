"""The command `handsim label`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Bool

from handsim.hand.shape import Side


def label(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Path,
    glove: str = "dense19",
    hands: tuple[Side, ...] | None = None,
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
        hands: Which hands are in the capture; both when not given.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    from gloves.captures.formats import WRITABLE, check_suffix, write_capture
    from handsim.app.messages import print_line, progress_bar
    from handsim.files.outputs import check_outputs
    from track.captures import label_capture
    from train.labelers.protocol import label_on

    label_on(threads)
    check_suffix(out, WRITABLE)  # before the work, not after it
    check_outputs((capture, glove, labeler), [out])
    with progress_bar("frames") as bar:
        take = label_capture(capture, glove=glove, hands=hands, labeler=labeler, progress=bar)
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
