"""The command `handsim label`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from jaxtyping import Bool

from handsim.hand.shape import Side

if TYPE_CHECKING:
    from track.settings import LabelSettings


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
    several captures one that cannot be labeled is told, and the others are labeled.

    Args:
        captures: .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) files, or folders searched for them.
        out: Labeled .trc, .c3d or Motive .csv file; points that are not markers become columns Unlabeled1,
            Unlabeled2, ... For several captures or a folder of them a folder, whose files have the captures'
            names; those of .tsv files end in .c3d.
        glove: Marker layout: a shipped name or the path of a .toml file.
        hands: Which hands are in the captures; all that the glove is made for when not given.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    from handsim.app.messages import named_steps, tell_state
    from handsim.errors import CaptureError, HandSimError
    from handsim.files.outputs import check_outputs
    from track.settings import LabelSettings, TrackerSetup
    from train.labelers.protocol import label_on

    label_on(threads)
    files = _files(captures, out)  # checked before the work, not after it
    check_outputs((*files, glove, labeler), list(files.values()))
    settings = LabelSettings(glove, hands, labeler=labeler)
    if len(files) > 1 and any(map(Path.exists, files)):
        with named_steps(""):  # a glove may have to be learned, once for all captures
            settings = dataclasses.replace(settings, labeler=TrackerSetup.of(settings).labeler)
    failed = 0
    for capture, labeled in files.items():
        try:
            _label(capture, labeled, settings)
        except HandSimError as error:
            if len(files) == 1:
                raise
            failed += 1
            tell_state(f"{capture}: not labeled: {str(error).removeprefix(f'{capture}: ')}")
    if failed:
        raise CaptureError(f"{failed} of {len(files)} captures were not labeled")


def _files(captures: tuple[Path, ...], out: Path) -> dict[Path, Path]:
    """The labeled file of each capture."""
    from gloves.captures.formats import WRITABLE, check_suffix, find_captures
    from handsim.errors import ArgumentError

    if len(captures) == 1 and not captures[0].is_dir() and not out.is_dir():
        check_suffix(out, WRITABLE)
        return {captures[0]: out}
    if captures and out.suffix.lower() in WRITABLE and not out.is_dir():
        raise ArgumentError(f"--out is {out} for several captures, expected a folder")
    files = {}
    for given in captures:
        # a folder of captures may hold what an earlier run labeled
        earlier = out.resolve() if given.resolve() in out.resolve().parents else None
        for file in find_captures([given]):
            if earlier not in file.resolve().parents:
                name = file.relative_to(given) if given.is_dir() else Path(file.name)
                files[file] = out / (name if name.suffix.lower() in WRITABLE else name.with_suffix(".c3d"))
    if not files:
        raise ArgumentError(f"no capture outside of {out} is given, expected files or folders")
    return files


def _label(capture: Path, out: Path, settings: LabelSettings) -> None:
    """Label a capture, and print a line on it."""
    from gloves.captures.formats import write_capture
    from handsim.app.messages import print_line, progress_bar
    from track.captures import label_capture

    with progress_bar("frames") as bar:
        take = label_capture(capture, settings, progress=bar)
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
