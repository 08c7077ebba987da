"""The command `handsim track`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
import tyro
from rich.console import Console

from gloves.captures import WRITABLE, Capture, read_capture, write_capture
from gloves.captures.capture import check_suffix
from gloves.captures.markers import labelled_capture
from gloves.layout import load_layout
from gloves.take import SUFFIX
from gloves.tracked_take import STATUSES, TrackedTake, save_tracked_take
from handsim.errors import CaptureError, HandSimError, choices
from handsim.topology import Side
from track.capture_tracking import TakeRecorder, follow, warm_up
from track.capture_tracking import track as track_capture
from track.streaming import StreamedFrame, open_stream
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker
from track.user import UserHand, load_user, usual_hand
from train.commands import progress_bar
from train.labeler import labeler_for_glove

if TYPE_CHECKING:
    from jaxtyping import Float, Int

Size = Literal["XS", "S", "M", "L", "XL"]
BOTH: Final[tuple[Side, ...]] = ("right", "left")
_REFRESH: Final = 0.2  # [s] between words about a live stream


def track(
    capture: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    out: Path,
    live: str | None = None,
    seconds: float | None = None,
    glove: str = "dense19",
    size: Size | None = None,
    shape: Path | None = None,
    hands: tuple[Side, ...] | None = None,
    labeler: str | None = None,
    labelled: Path | None = None,
) -> None:
    """Follow hands through a marker capture or a live stream; writes motion, labels and status.

    Args:
        capture: A .trc, .c3d or Motive .csv file; its names are not used.
        out: The tracked take, a .npz file.
        live: Address of a NatNet server instead of a capture: natnet://host or natnet://host:port. Ctrl-C
            ends it, and what came until then is written.
        seconds: How long to listen to it.
        glove: Marker layout: a shipped name or the path of a .toml file; its labeler is used.
        size: Size of the hands; M when neither this nor --shape is given.
        shape: The user's file from handsim calibrate: hands and gloves.
        hands: Which hands there are; both, or those of --shape, when not given.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        labelled: File for the labelled points, .trc or .c3d; markers are called right:ThumbTip and so on,
            points that are no markers Unlabeled1, Unlabeled2, ...
    """
    _check_options(capture, live, seconds, out, labelled)
    if shape is None:
        user = users(glove, size or "M", BOTH if hands is None else hands)
    else:
        user = _calibrated(shape, glove, size, hands)
    source = None if capture is None else read_capture(capture)
    network = labeler_for_glove(glove, labeler)
    with Console(stderr=True).status("getting ready"):
        warm_up(user, network)
    watch = Stopwatch(Tracker(user, network))
    if source is not None:
        with progress_bar("frames") as (bar, task):
            take = track_capture(
                source,
                watch,
                user,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
        notes: tuple[str, ...] = ()
    else:
        take, notes = _track_live(str(live), seconds, watch, user)
    made = {
        "capture": live if capture is None else capture.name,
        "glove": glove,
        "user": size or "M" if shape is None else shape.name,
        "labeler": labeler or glove,
    }
    take = dataclasses.replace(take, settings=made)
    save_tracked_take(out, take)
    if labelled is not None:
        write_capture(labelled, labelled_points(take))
    say(f"{out}: {take.num_frames} frames, {take.num_frames / take.rate:.1f} s at {take.rate:.4g} Hz")
    for line in (*summary(take), *notes, f"{1e3 * np.median(watch.spent):.2f} ms a frame"):
        say(line)


def users(glove: str, size: Size, hands: Sequence[Side]) -> tuple[UserHand, ...]:
    """Hands of one size in a glove.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        HandSimError: A hand is named twice, or none is.
    """
    check_hands(hands)
    layout = load_layout(glove)
    return tuple(usual_hand(layout, size, side) for side in hands)


def check_hands(hands: Sequence[Side]) -> None:
    """Raise a `HandSimError` unless each side is there once at most, and one is."""
    if not hands or len(set(hands)) < len(hands):
        raise HandSimError(f"--hands is '{' '.join(hands)}', wanted right, left, or one of each")


def _calibrated(
    shape: Path, glove: str, size: Size | None, hands: tuple[Side, ...] | None
) -> tuple[UserHand, ...]:
    """Hands of a user's file."""
    if size is not None:
        raise HandSimError(f"given --size {size} and --shape {shape}, wanted one of them")
    known = {hand.side: hand for hand in load_user(shape)}
    wanted_hands = tuple(known) if hands is None else hands
    check_hands(wanted_hands)
    for side in wanted_hands:
        if side not in known:
            raise HandSimError(f"{shape}: {choices(side, known, noun='hand')}")
    names, wanted = known[next(iter(known))].attachment.layout.names, load_layout(glove).names
    if names != wanted:
        raise HandSimError(
            f"{shape} is of a glove with the markers {', '.join(names)}, "
            f"but glove '{glove}' has {', '.join(wanted)}"
        )
    return tuple(known[side] for side in wanted_hands)


class Stopwatch:
    """A tracker, and how long it took for each frame.

    Args:
        tracker: The tracker.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self.spent: list[float] = []
        """[s], one a frame."""

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame."""
        began = perf_counter()
        frame = self._tracker.step(points, ids, time)
        self.spent.append(perf_counter() - began)
        return frame


def summary(take: TrackedTake) -> list[str]:
    """What became of each hand and of the points, a line each."""
    lines = []
    for number, side in enumerate(take.sides):
        status, rms = take.status[:, number], take.rms[:, number]
        shares = (
            f"{STATUSES[place]} {100 * np.mean(status == place):.1f} %"
            for place in reversed(range(len(STATUSES)))
        )
        fitted = rms[np.isfinite(rms)]
        line = f"{side} hand: {', '.join(shares)}"
        if len(fitted):
            missing = take.filled[:, number].mean(axis=1)[status > 0].mean()
            line += (
                f"; median RMS {1e3 * np.median(fitted):.2f} mm, {100 * missing:.1f} % of markers filled in"
            )
        else:
            line += "; it was never found: --hands says which hands there are"
        lines.append(line)
    there = np.isfinite(take.points[..., 0])
    unlabelled = int((there & (take.labels < 0)).sum())
    return [*lines, f"{unlabelled} of {int(there.sum())} points are no markers"]


def labelled_points(take: TrackedTake) -> Capture:
    """The labelled points of a take as a capture: a column a marker, then columns for the others."""
    there = np.isfinite(take.points[..., 0])
    frames = [points[seen] for points, seen in zip(take.points, there, strict=True)]
    labels = [row[seen] for row, seen in zip(take.labels, there, strict=True)]
    return labelled_capture(frames, labels, take.label_names, take.rate)


def _check_options(
    capture: Path | None, live: str | None, seconds: float | None, out: Path, labelled: Path | None
) -> None:
    if (capture is None) == (live is None):
        given = (
            "neither a capture nor --live" if capture is None else f"a capture, {capture}, and --live {live}"
        )
        raise HandSimError(f"given {given}, wanted a capture or --live natnet://host")
    if seconds is not None and live is None:
        raise HandSimError(f"--seconds is {seconds:g} without --live, wanted both or neither")
    if seconds is not None and not 0.0 < seconds < np.inf:
        raise HandSimError(f"--seconds is {seconds:g}, wanted a positive number")
    if out.suffix.lower() != ".npz" or out.name.endswith(SUFFIX):
        raise HandSimError(f"--out is {out}, wanted a file name that ends in .npz and not in {SUFFIX}")
    if labelled is not None:
        check_suffix(labelled, WRITABLE)


def _track_live(
    url: str, seconds: float | None, watch: Stopwatch, user: Sequence[UserHand]
) -> tuple[TrackedTake, tuple[str, ...]]:
    """What a stream brings until it ends, time is up or somebody interrupts."""
    recorder = TakeRecorder(user)
    console = Console(stderr=True)
    with closing(open_stream(url)) as stream, console.status("waiting for the first frame") as status:
        began, shown = perf_counter(), 0.0
        try:
            for frame, tracked in follow(stream, watch):
                recorder.add(frame, tracked)
                elapsed = perf_counter() - began if frame.silent else recorder.duration
                if seconds is not None and elapsed >= seconds:
                    break
                if frame.silent or perf_counter() > shown + _REFRESH:
                    shown = perf_counter()
                    status.update(_word(frame, tracked))
        except KeyboardInterrupt:  # what came so far is not lost
            pass
    if recorder.num_frames < 2:
        raise CaptureError(f"{url}: {recorder.num_frames} frames came, wanted two or more")
    notes = []
    if stream.late or stream.damaged:
        notes.append(f"left out: {stream.late} frames that came late or twice, {stream.damaged} damaged ones")
    return recorder.take(), tuple(notes)


def _word(frame: StreamedFrame, tracked: TrackedFrame) -> str:
    """How it goes, in a line."""
    if frame.silent:
        return "nothing comes; is the server playing?"
    hands = (f"{hand.side} {hand.status.value}" for hand in tracked.hands)
    return f"frame {frame.number}: {', '.join(hands)}; Ctrl-C ends it and writes the take"


def say(line: str) -> None:
    """Print a line as it is."""
    Console().print(line, highlight=False, soft_wrap=True, markup=False)
