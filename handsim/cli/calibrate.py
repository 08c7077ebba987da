"""The command `handsim calibrate`: the user's hands and gloves from a capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import tyro
from jaxtyping import Bool
from rich.console import Console
from scipy.spatial.distance import cdist

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture
from gloves.fit import GloveFit, attach
from gloves.takes.take import INITIALIZED, TRACKED, Take
from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from handsim.cli.user_options import BOTH, Size, measured_users, users_of
from handsim.errors import ArgumentError
from handsim.files.outputs import check_outputs
from handsim.hand.topology import Side
from track.calibration.hand_size import sample_frames
from track.calibration.user_calibration import Calibration, CalibrationError, calibrate_hands
from track.capture_tracking import capture_frames, track_capture
from track.tracker import Tracker
from track.user import save_user
from train.glove_labeler import labeler_for_glove
from train.labelers.protocol import Labeler

_SHOWN: Final = 0.05  # share of the frames in which a hand must be tracked to be calibrated
_NEAR: Final = 0.015  # [m]: largest residual of a marker on a hand of another size
_LEFT_OVER: Final = 0.005  # share of the markers that the first round may leave unlabeled


def calibrate(
    capture: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    glove: str = "dense19",
    size: Size = "auto",
    hands: tuple[Side, ...] = BOTH,
    labeler: str | None = None,
) -> None:
    """Fit hands and gloves to a user, from a capture in which every joint moves and fingertips touch.

    The capture is labeled by the tracker. If some markers stay unlabeled, it is labeled once more with the
    calibrated hands.

    Args:
        capture: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file of half a minute or more; its
            names are not used.
        out: The user's file, .json, for handsim track --shape.
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: The size nearest to the hands; auto measures it in the capture.
        hands: Which hands are in the capture.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
    """
    if out.suffix.lower() != ".json":
        raise ArgumentError(f"--out is {out}, expected a file name that ends in .json")
    check_outputs((capture, glove, labeler), [out])
    tracked = start = users_of(glove, size, None, hands)
    source, words = read_capture(capture), None
    network = labeler_for_glove(glove, labeler)
    if size == "auto":
        tracked, words = measured_users(glove, hands, sample_frames(list(capture_frames(source))), network)
        start = tuple(attach(hand.layout, hand.model) for hand in tracked)
    take, done = _round(source, tracked, start, network)
    if _leaves_markers(take, done):
        known = [calibration.hand for calibration in done]
        take, done = _round(source, known, start, network)
    save_user(
        out, [one.hand for one in done], f"calibrated from {capture.name}, {words or size} to begin with"
    )
    print_line(f"{out}: {len(done)} hands in glove {glove}, from {take.num_frames} frames")
    for hand in start:
        report = [line for one in done if one.hand.side == hand.side for line in _report(one)]
        for line in report or ["it is not in the capture and was left out"]:
            print_line(f"{hand.side} hand: {line}")


def _round(
    source: Capture, known: Sequence[GloveFit], start: Sequence[GloveFit], labeler: Labeler
) -> tuple[Take, tuple[Calibration, ...]]:
    """Label a capture with the hands `known` so far, and calibrate those that are in it."""
    with progress_bar("frames") as (bar, task):
        take = track_capture(
            source,
            Tracker(known, labeler),
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    shown = [side for side in take.sides if _reliable(take, side).mean() > _SHOWN]
    if not shown:
        raise CalibrationError(
            f"no {' and no '.join(take.sides)} hand was found in the capture; expected half a minute of one"
        )
    markers = {side: take.observed(side) for side in shown}
    for side in shown:
        markers[side][~_reliable(take, side)] = np.nan
    with Console(stderr=True).status("calibrating") as status:
        return take, calibrate_hands(
            markers,
            [hand for hand in start if hand.side in shown],
            take.rate,
            progress=lambda side, step, *_: status.update(f"calibrating the {side} hand, step {step}"),
        )


def _reliable(take: Take, side: Side) -> Bool[np.ndarray, "T"]:
    """Frames whose labels are reliable."""
    reliable: Bool[np.ndarray, "T"] = np.isin(take.status[:, take.hand(side)], (TRACKED, INITIALIZED))
    return reliable


def _leaves_markers(take: Take, done: Sequence[Calibration]) -> bool:
    """Whether too many missing markers had an unlabeled point nearby."""
    left, total = 0, 0
    for one in done:
        side = one.hand.side
        filled, markers = take.filled(side), take.markers(side)
        total += filled.size
        for frame in np.flatnonzero(filled.any(axis=1) & _reliable(take, side)):
            free = take.points[frame, take.labels[frame] < 0]
            expected = markers[frame, filled[frame]]
            left += int((cdist(expected, free[np.isfinite(free[:, 0])]) < _NEAR).any(axis=1).sum())
    return left > _LEFT_OVER * total


def _report(done: Calibration) -> list[str]:
    """Residuals before and after, and suggestions for a better capture, as lines."""
    line = f"markers {1e3 * done.rms_before:.2f} mm off before, {1e3 * done.rms_after:.2f} mm after"
    before, after = 1e3 * done.gaps()
    if np.isfinite(before):
        line += f"; thumb and fingers {before:.1f} mm from touching before, {after:.1f} mm after"
    line += f"; hand length {1e3 * done.hand.model.shape.length:.0f} mm"
    return [line, *done.suggestions()]
