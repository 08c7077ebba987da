"""The command `handsim track`."""

from __future__ import annotations

import dataclasses
import warnings
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, perf_counter, sleep
from typing import Annotated, Any, Final

import numpy as np
import tyro
from jaxtyping import Float, Int
from rich.console import Console

from gloves.captures.capture import Capture
from gloves.captures.formats import WRITABLE, check_suffix, read_capture, write_capture
from gloves.captures.markers import labeled_capture
from gloves.fit import GloveFit
from gloves.optics.identities import number_runs
from gloves.takes.corrections import Correction, corrections_of, corrections_path, find_pins, told
from gloves.takes.take import SUFFIX, Take, label_names, load_take
from handsim.app.messages import print_line
from handsim.app.progress import progress_bar
from handsim.cli.live import TrackedSource, track_live
from handsim.cli.user_options import USUAL_SIZE, Size, measured_users, users_of
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from handsim.files.outputs import check_outputs
from handsim.hand.topology import Side
from track.bodies.body_file import load_bodies
from track.bodies.rigid_body import RigidTemplate
from track.calibration.hand_size import sample_frames
from track.capture_tracking import capture_frames, track_capture, warm_up
from track.corrected_take import correct_take
from track.evaluation.take_summary import summarize, suspicions
from track.sinks.addresses import open_sinks
from track.sinks.sink_group import SinkGroup
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker
from train.glove_labeler import labeler_for_glove
from train.labelers.protocol import Labeler

SHOWN: Final = 0.8
"""Share of one hand's markers in a frame in which its size can be measured."""
_TIMED: Final = 100_000  # frames whose computing time is kept


def track(
    capture: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    out: Path,
    live: str | None = None,
    seconds: float | None = None,
    send: tuple[str, ...] = (),
    glove: str = "dense19",
    size: Size | None = None,
    shape: Path | None = None,
    hands: tuple[Side, ...] | None = None,
    body: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    labeler: str | None = None,
    labeled: Annotated[Path | None, tyro.conf.arg(aliases=["--labelled"])] = None,
) -> None:
    """Track hands in a marker capture or a live stream; writes motion, labels and status.

    Corrections that handsim view saved beside OUT are applied again.

    Args:
        capture: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file; its names are not
            used.
        out: The tracked take, a .npz file.
        live: A stream instead of a capture: natnet://host or natnet://host:port (OptiTrack), qtm://host
            (Qualisys), or module:name, a frame source of your own. Ctrl-C or the end of the terminal ends it.
            Frames are written as they come, to OUT.part until then.
        seconds: How long to record a live stream [s].
        send: Where hands are sent as they are tracked, one or several of osc://host:port, udp://host:port,
            ws://host:port, which is a server, lsl:NAME, and module:name, a sink of your own. Without a host
            it is this machine. A capture is then played at its own rate.
        glove: Marker layout: a shipped name or the path of a .toml file; its labeler is used.
        size: Size of the hands; auto, which is the default, measures it in the capture or in the first second
            of a stream.
        shape: The user's file from handsim calibrate: hands and gloves.
        hands: Which hands to track; both, or those of --shape, when not given.
        body: A rigid body to track beside the hands, once per body: a .toml file, see handsim body, or one of
            handsim's own objects.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        labeled: File for the labeled points, .trc, .c3d or Motive .csv; markers are called right:ThumbTip and
            so on, other points Unlabeled1, Unlabeled2, ...
    """
    _check_options(capture, live, seconds, out, labeled)
    check_outputs((capture, shape, glove, labeler, *body), (out, labeled))
    user = users_of(glove, size, shape, hands)
    bodies = load_bodies(body)
    source = None if capture is None else read_capture(capture)
    corrections = _corrections_for(out, source, label_names(user, bodies))
    start = TrackerStart(user, labeler_for_glove(glove, labeler), bodies, glove)
    start.settings.update(
        capture=live if capture is None else capture.name,
        glove=glove,
        user=size or "auto" if shape is None else shape.name,
        labeler=labeler or glove,
    )
    measures = shape is None and size in (None, "auto")
    with open_sinks(send) as sinks:
        with Console(stderr=True).status("getting ready"):
            warm_up(user, start.labeler)
        if source is None:
            fewest = SHOWN * user[0].layout.num_markers if measures else None
            tracked = track_live(str(live), seconds, start, out, fewest_points=fewest, sinks=sinks)
        else:
            tracked = _track_file(source, start, out, corrections, sinks, measures=measures)
    if labeled is not None:
        write_capture(labeled, labeled_points(tracked.take if tracked.whole else load_take(out)))
    rate, frames = tracked.take.rate, tracked.num_frames
    print_line(f"{out}: {frames} frames, {frames / rate:.1f} s at {rate:.4g} Hz")
    for line in (
        *tracked.notes,
        *summarize(tracked.take),
        f"{1e3 * np.median(start.seconds):.2f} ms per frame",
    ):
        print_line(line)
    for suspicion in suspicions(tracked.take):
        warnings.warn(suspicion, HandSimWarning, stacklevel=2)


class TrackerStart:
    """Makes the tracker of a command, which measures its computing time.

    Args:
        user: The user's hands, as far as they are known.
        labeler: Labeler of their glove.
        bodies: Rigid bodies beside the hands.
        glove: Marker layout of hands that are measured.
    """

    def __init__(
        self, user: Sequence[GloveFit], labeler: Labeler, bodies: Sequence[RigidTemplate], glove: str
    ) -> None:
        self.user, self.labeler, self._bodies, self._glove = user, labeler, bodies, glove
        """The hands and their labeler; once a tracker is made, the hands as measured."""
        self.settings: dict[str, Any] = {}
        """What makes the take, as JSON."""
        self.seconds: deque[float] = deque(maxlen=_TIMED)
        """Computing time of each of the last frames [s]."""

    def __call__(self, frames: Sequence[StreamedFrame]) -> Tracker:
        """The tracker; its hands are measured in some frames, if there are any."""
        if frames:
            sides = [hand.side for hand in self.user]
            self.user, words = measured_users(self._glove, sides, frames, self.labeler)
            self.settings["user"] = f"auto, {words or USUAL_SIZE}"
            if words is None:
                warnings.warn(
                    f"no hand was found to measure its size; size {USUAL_SIZE} is used, or name a --size",
                    HandSimWarning,
                    stacklevel=2,
                )
            else:
                print_line(f"size of the hands: {words}")
        return TimedTracker(self.user, self.labeler, self._bodies, self.seconds)


class TimedTracker(Tracker):
    """A tracker that measures its computing time.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Labeler of the hands' glove.
        bodies: Rigid bodies beside the hands.
        seconds: Takes the computing time of each frame [s].
    """

    def __init__(
        self,
        hands: Sequence[GloveFit],
        labeler: Labeler,
        bodies: Sequence[RigidTemplate],
        seconds: deque[float],
    ) -> None:
        super().__init__(hands, labeler, bodies)
        self._seconds = seconds

    def step(
        self,
        points: Float[np.ndarray, "N 3"],
        ids: Int[np.ndarray, "N"] | None = None,
        time: float | None = None,
    ) -> TrackedFrame:
        """Track the next frame, see `Tracker.step`."""
        start = perf_counter()
        frame = super().step(points, ids, time)
        self._seconds.append(perf_counter() - start)
        return frame


def labeled_points(take: Take) -> Capture:
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


def _corrections_for(out: Path, source: Capture | None, names: Sequence[str]) -> tuple[Correction, ...]:
    """The corrections beside a take that is to be made, checked before the long work."""
    path = corrections_path(out)
    if source is None and path.exists():
        raise ArgumentError(
            f"{path} corrects the take that --live would replace, expected another --out than {out}"
        )
    corrections = corrections_of(out)
    if source is not None and corrections:
        try:
            ids = number_runs(np.isfinite(source.positions[..., 0]))
            find_pins(corrections, source.positions, ids, names)
        except CaptureError as error:
            raise CaptureError(f"{path}: {error}") from error
    return corrections


def _corrected(take: Take, out: Path, corrections: Sequence[Correction]) -> Take:
    """The take with its corrections, if there are any; what does not fit is told."""
    if not corrections:
        return take
    path, corrected = corrections_path(out), correct_take(take, corrections)
    for sentence in told(path, corrected.unfitting):
        warnings.warn(sentence, HandSimWarning, stacklevel=2)
    count = len(corrections) - len(corrected.unfitting)
    print_line(
        f"{path}: {count} correction{'s' * (count != 1)} applied, {corrected.labels} labels in "
        f"{corrected.frames} frames"
    )
    return corrected.take


def _track_file(
    source: Capture,
    start: TrackerStart,
    out: Path,
    corrections: Sequence[Correction],
    sinks: SinkGroup,
    *,
    measures: bool,
) -> TrackedSource:
    """Track a capture and write the take; where it is sent on, at the capture's own rate."""
    with Console(stderr=True).status("measuring the hands"):
        tracker = start(sample_frames(list(capture_frames(source))) if measures else ())
    sinks.start(tracker.hands, tracker.bodies)
    began = monotonic()

    def send(frame: StreamedFrame, tracked: TrackedFrame) -> None:
        sleep(max(0.0, began + frame.time - monotonic()))
        sinks.send(frame, tracked)

    with progress_bar("frames") as (bar, task):
        take = track_capture(
            source,
            tracker,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            taken=send if sinks else None,
        )
    take = dataclasses.replace(take, settings={**take.settings, **start.settings})
    take = _corrected(take, out, corrections)
    take.save(out)
    return TrackedSource(take, take.num_frames, sinks.notes())
