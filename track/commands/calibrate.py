"""The command `handsim calibrate`: a capture made for it in, the user's hands and gloves out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import tyro
from rich.console import Console
from scipy.spatial.distance import cdist

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture
from gloves.fit import GloveFit
from gloves.takes.tracked_take import FOUND, TRACKED, TrackedTake
from handsim.app.progress import progress_bar
from handsim.errors import HandSimError
from handsim.hand.topology import Side
from track.calibration.user_calibration import Calibration, calibrate_hands
from track.capture_tracking import track
from track.commands.user_options import BOTH, Size, users
from track.evaluation.take_summary import print_line
from track.tracker import Tracker
from track.user import save_user
from train.labelers.protocol import Labeler
from train.labelers.storage import labeler_for_glove

if TYPE_CHECKING:
    from jaxtyping import Bool

_SHOWN: Final = 0.05  # of the frames that a hand must be in to be calibrated
_NEAR: Final = 0.015  # [m] that a hand of another size may have a marker off
_LEFT_OVER: Final = 0.005  # of the markers that a first round may leave out


def calibrate(
    capture: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    glove: str = "dense19",
    size: Size = "M",
    hands: tuple[Side, ...] = BOTH,
    labeler: str | None = None,
) -> None:
    """Fit hands and gloves to a user, from a capture in which every joint moves and fingertips touch.

    The capture is labeled by the tracker. If that leaves markers out, it is labeled once more with the
    hands that came of it.

    Args:
        capture: A .trc, .c3d or Motive .csv file of half a minute or more; its names are not used.
        out: The user's file, .json, for handsim track --shape.
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: The size nearest to the hands.
        hands: Which hands there are.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
    """
    if out.suffix.lower() != ".json":
        raise HandSimError(f"--out is {out}, expected a file name that ends in .json")
    start = users(glove, size, hands)
    source = read_capture(capture)
    network = labeler_for_glove(glove, labeler)
    take, done = _round(source, start, start, network)
    if _leaves_out(take, done):
        known = [calibration.hand for calibration in done]
        take, done = _round(source, known, start, network)
    save_user(out, [one.hand for one in done], f"calibrated from {capture.name}, size {size} to begin with")
    print_line(f"{out}: {len(done)} hands in glove {glove}, from {take.num_frames} frames")
    for hand in start:
        report = [line for one in done if one.hand.side == hand.side for line in _tell(one)]
        for line in report or ["it is not in the capture and was left out"]:
            print_line(f"{hand.side} hand: {line}")


def _round(
    source: Capture, known: Sequence[GloveFit], start: Sequence[GloveFit], labeler: Labeler
) -> tuple[TrackedTake, tuple[Calibration, ...]]:
    """Label a capture with what is known of the hands, and calibrate those that are in it."""
    with progress_bar("frames") as (bar, task):
        take = track(
            source,
            Tracker(known, labeler),
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    shown = [side for side in take.sides if _sure(take, side).mean() > _SHOWN]
    if not shown:
        raise HandSimError(
            f"no {' and no '.join(take.sides)} hand was found in the capture; expected half a minute of one"
        )
    markers = {side: take.observed(side) for side in shown}
    for side in shown:
        markers[side][~_sure(take, side)] = np.nan
    with Console(stderr=True).status("calibrating") as status:
        return take, calibrate_hands(
            markers,
            [hand for hand in start if hand.side in shown],
            take.rate,
            progress=lambda side, step, *_: status.update(f"calibrating the {side} hand, step {step}"),
        )


def _sure(take: TrackedTake, side: Side) -> Bool[np.ndarray, "T"]:
    """Frames whose labels can be relied on."""
    sure: Bool[np.ndarray, "T"] = np.isin(take.status[:, take.hand(side)], (TRACKED, FOUND))
    return sure


def _leaves_out(take: TrackedTake, done: Sequence[Calibration]) -> bool:
    """Whether markers that lack a point had one nearby that nobody took."""
    left, whole = 0, 0
    for one in done:
        hand = take.hand(one.hand.side)
        whole += take.filled[:, hand].size
        for frame in np.flatnonzero(take.filled[:, hand].any(axis=1) & _sure(take, one.hand.side)):
            free = take.points[frame, take.labels[frame] < 0]
            wanted = take.markers[frame, hand, take.filled[frame, hand]]
            left += int((cdist(wanted, free[np.isfinite(free[:, 0])]) < _NEAR).any(axis=1).sum())
    return left > _LEFT_OVER * whole


def _tell(done: Calibration) -> list[str]:
    """How far markers and touches were off, and what a better capture would have."""
    line = f"markers {1e3 * done.rms_before:.2f} mm off before, {1e3 * done.rms_after:.2f} mm after"
    before, after = 1e3 * done.gaps()
    if np.isfinite(before):
        line += f"; thumb and fingers {before:.1f} mm from touching before, {after:.1f} mm after"
    line += f"; hand length {1e3 * done.hand.model.shape.length:.0f} mm"
    return [line, *done.suggestions()]
