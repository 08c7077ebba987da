"""The command `handsim track`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import tyro
from rich.console import Console

from gloves.captures.capture import Capture
from gloves.captures.formats import WRITABLE, check_suffix, read_capture, write_capture
from gloves.captures.markers import labeled_capture
from gloves.fit import GloveFit
from gloves.takes.take import SUFFIX
from gloves.takes.tracked_take import TrackedTake
from handsim.app.interrupts import interrupt_flag
from handsim.app.progress import progress_bar
from handsim.errors import ArgumentError, CaptureError
from handsim.files.outputs import check_outputs
from handsim.hand.topology import Side
from track.bodies.body_file import load_bodies
from track.bodies.rigid_body import RigidTemplate
from track.capture_tracking import TakeRecorder, track_capture, track_stream, warm_up
from track.commands.user_options import BOTH, Size, calibrated_users, uncalibrated_users
from track.evaluation.take_summary import print_line, summarize
from track.streams.point_stream import StreamedFrame, open_stream
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker
from train.labelers.protocol import Labeler
from train.labelers.storage import labeler_for_glove

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_REFRESH: Final = 0.2  # [s] between updates of a live stream's status


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
    body: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    labeler: str | None = None,
    labeled: Annotated[Path | None, tyro.conf.arg(aliases=["--labelled"])] = None,
) -> None:
    """Track hands in a marker capture or a live stream; writes motion, labels and status.

    Args:
        capture: A .trc, .c3d or Motive .csv file; its names are not used.
        out: The tracked take, a .npz file.
        live: Address of a NatNet server instead of a capture: natnet://host or natnet://host:port. Ctrl-C
            ends it, and the frames until then are written.
        seconds: How long to record a live stream [s].
        glove: Marker layout: a shipped name or the path of a .toml file; its labeler is used.
        size: Size of the hands; M when neither this nor --shape is given.
        shape: The user's file from handsim calibrate: hands and gloves.
        hands: Which hands to track; both, or those of --shape, when not given.
        body: A rigid body to track beside the hands, once per body: a .toml file, see handsim body, or one of
            handsim's own objects.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        labeled: File for the labeled points, .trc or .c3d; markers are called right:ThumbTip and so on, other
            points Unlabeled1, Unlabeled2, ...
    """
    _check_options(capture, live, seconds, out, labeled)
    check_outputs((capture, shape, glove, labeler, *body), (out, labeled))
    if shape is None:
        user = uncalibrated_users(glove, size or "M", BOTH if hands is None else hands)
    else:
        user = calibrated_users(shape, glove, size, hands)
    bodies = load_bodies(body)
    source = None if capture is None else read_capture(capture)
    network = labeler_for_glove(glove, labeler)
    with Console(stderr=True).status("getting ready"):
        warm_up(user, network)
        timed = TimedTracker(user, network, bodies)
    take, notes = _track_live(str(live), seconds, timed) if source is None else _track_file(source, timed)
    settings = {
        "capture": live if capture is None else capture.name,
        "glove": glove,
        "user": size or "M" if shape is None else shape.name,
        "labeler": labeler or glove,
    }
    take = dataclasses.replace(take, settings={**take.settings, **settings})
    take.save(out)
    if labeled is not None:
        write_capture(labeled, labeled_points(take))
    print_line(f"{out}: {take.num_frames} frames, {take.num_frames / take.rate:.1f} s at {take.rate:.4g} Hz")
    for line in (*summarize(take), *notes, f"{1e3 * np.median(timed.seconds):.2f} ms per frame"):
        print_line(line)


class TimedTracker(Tracker):
    """A tracker that measures its computing time.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Labeler of the hands' glove.
        bodies: Rigid bodies beside the hands.
    """

    def __init__(
        self, hands: Sequence[GloveFit], labeler: Labeler, bodies: Sequence[RigidTemplate] = ()
    ) -> None:
        super().__init__(hands, labeler, bodies)
        self.seconds: list[float] = []
        """Computing time of each frame [s]."""

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Track the next frame, see `Tracker.step`."""
        start = perf_counter()
        frame = super().step(points, ids, time)
        self.seconds.append(perf_counter() - start)
        return frame


def labeled_points(take: TrackedTake) -> Capture:
    """The labeled points of a take as a capture: one column per marker, then columns for the other points."""
    there = np.isfinite(take.points[..., 0])
    frames = [points[seen] for points, seen in zip(take.points, there, strict=True)]
    labels = [row[seen] for row, seen in zip(take.labels, there, strict=True)]
    return labeled_capture(frames, labels, take.label_names, take.rate)


def _check_options(
    capture: Path | None, live: str | None, seconds: float | None, out: Path, labeled: Path | None
) -> None:
    if (capture is None) == (live is None):
        given = (
            "neither a capture nor --live" if capture is None else f"a capture, {capture}, and --live {live}"
        )
        raise ArgumentError(f"given {given}, expected a capture or --live natnet://host")
    if seconds is not None and live is None:
        raise ArgumentError(f"--seconds is {seconds:g} without --live, expected both or neither")
    if seconds is not None and not 0.0 < seconds < np.inf:
        raise ArgumentError(f"--seconds is {seconds:g}, expected a positive number")
    if out.suffix.lower() != ".npz" or out.name.endswith(SUFFIX):
        raise ArgumentError(f"--out is {out}, expected a file name that ends in .npz and not in {SUFFIX}")
    if labeled is not None:
        check_suffix(labeled, WRITABLE)


def _track_file(source: Capture, timed: TimedTracker) -> tuple[TrackedTake, tuple[str, ...]]:
    """The take of a capture, and no notes."""
    with progress_bar("frames") as (bar, task):
        take = track_capture(
            source,
            timed,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    return take, ()


def _track_live(url: str, seconds: float | None, timed: TimedTracker) -> tuple[TrackedTake, tuple[str, ...]]:
    """The take of a stream until it ends, time is up or the user interrupts; notes on frames left out."""
    recorder = TakeRecorder(timed)
    console = Console(stderr=True)
    with (
        closing(open_stream(url)) as stream,
        console.status("waiting for the first frame") as status,
        interrupt_flag() as interrupted,  # the frames so far are kept
    ):
        start, shown = perf_counter(), 0.0
        for frame, tracked in track_stream(stream, timed):
            recorder.add(frame, tracked)
            elapsed = perf_counter() - start if frame.silent else recorder.duration
            if interrupted() or (seconds is not None and elapsed >= seconds):
                break
            if frame.silent or perf_counter() > shown + _REFRESH:
                shown = perf_counter()
                status.update(_status_line(frame, tracked))
    if recorder.num_frames < 2:
        raise CaptureError(f"{url}: {recorder.num_frames} frames came, expected two or more")
    notes = []
    if stream.late or stream.damaged:
        notes.append(f"left out: {stream.late} frames that came late or twice, {stream.damaged} damaged ones")
    return recorder.take(), tuple(notes)


def _status_line(frame: StreamedFrame, tracked: TrackedFrame) -> str:
    """Status of a live stream, in one line."""
    if frame.silent:
        return "no frames arrive; is the server playing?"
    words = [f"{hand.side} {hand.status.value}" for hand in tracked.hands]
    words += [f"{body.name} {body.status.value}" for body in tracked.bodies]
    return f"frame {frame.number}: {', '.join(words)}; Ctrl-C ends it and writes the take"
