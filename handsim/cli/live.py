"""The live part of `handsim track`: a stream is tracked and recorded until it ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from gloves.takes.take import Take
from handsim.app.interrupts import interrupt_flag
from handsim.app.live_status import LiveStatus
from track.capture_tracking import track_stream
from track.live_recording import LiveRecorder
from track.sinks.sink_group import SinkGroup
from track.streams.addresses import LiveStream, open_source
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker

_MEASURED: Final = 1.0  # [s] of frames that show enough to measure hands
_LONGEST_WAIT: Final = 10.0  # [s] for them
_FOREIGN: Final = "foreign_packets"
_LEFT_OUT: Final = {
    "late_frames": "that came late or twice",
    "frames_with_wild_times": "with a wild time",
    "damaged_packets": "damaged",
    _FOREIGN: "of other senders",
}
"""Counts of what does not go on, in words."""


class TrackedSource(NamedTuple):
    """What was made of a capture or a stream, and written."""

    take: Take
    """The take; of a long stream, parts of it."""
    num_frames: int
    """Number of all frames."""
    notes: tuple[str, ...] = ()
    """What is to be told, one line each."""

    @property
    def whole(self) -> bool:
        """Whether `take` is all of it."""
        return self.take.num_frames == self.num_frames


class Start(Protocol):
    """Makes a tracker."""

    @property
    def settings(self) -> dict[str, Any]:
        """What makes the take, as JSON; complete once the tracker is made."""
        ...

    def __call__(self, frames: Sequence[StreamedFrame]) -> Tracker:
        """The tracker; its hands are measured in some frames, if there are any."""
        ...


def track_live(
    url: str,
    seconds: float | None,
    start: Start,
    out: Path,
    *,
    fewest_points: float | None,
    sinks: SinkGroup,
) -> TrackedSource:
    """Track and record a stream until time is up or a signal ends it.

    Args:
        url: The address of the stream, see `open_source`.
        seconds: How long to record [s]; None for as long as it comes.
        start: Makes the tracker, from the first frames if there is something to be measured in them.
        out: The take's file; until its end the recording is beside it.
        fewest_points: Points of a frame in which something can be measured; None where nothing is.
        sinks: Take every frame before it is recorded.

    Raises:
        CaptureError: No server answers, fewer than two frames came, or a file cannot be written.
    """
    with (
        interrupt_flag() as interrupted,  # the frames so far are kept
        closing(open_source(url, ended=interrupted)) as stream,
        LiveStatus() as status,
        ExitStack() as stack,
    ):
        first = [] if fewest_points is None else first_frames(stream, fewest_points, seconds, status)
        tracker = start([frame for frame in first if len(frame.points) >= (fewest_points or 0)])
        sinks.start(tracker.hands, tracker.bodies)
        recorder = stack.enter_context(LiveRecorder(tracker, out, start.settings))
        status.say(f"recording to {recorder.part}, which becomes {out} at the end; Ctrl-C ends it")
        try:
            _record(track_stream(chain(first, stream), tracker), seconds, recorder, sinks, stream, status)
            status.show(f"writing {out}", now=True)
            take, step = recorder.finish(
                stream.counts,
                told=lambda: status.show(f"writing {out}; {recorder.part} is kept until then"),
            )
        except KeyboardInterrupt:
            status.say(f"the recording is kept in {recorder.part}")
            raise
        return TrackedSource(take, recorder.num_frames, (*_notes(stream.counts, step), *sinks.notes()))


def first_frames(
    stream: LiveStream, fewest_points: float, seconds: float | None, status: LiveStatus
) -> list[StreamedFrame]:
    """The first frames of a stream, until there were enough points for a second, or ten seconds are over."""
    frames: list[StreamedFrame] = []
    began = shown = np.inf
    status.show("waiting for hands, to measure their size")
    for frame in stream:
        now = perf_counter()
        if frame.silent and frames:
            break
        if not frame.silent:
            frames.append(frame)
            began = min(began, now)
        if len(frame.points) >= fewest_points:
            shown = min(shown, now)
        if now >= min(began + min(_LONGEST_WAIT, seconds or np.inf), shown + _MEASURED):
            break
    return frames


def _record(
    frames: Iterator[tuple[StreamedFrame, TrackedFrame]],
    seconds: float | None,
    recorder: LiveRecorder,
    sinks: SinkGroup,
    stream: LiveStream,
    status: LiveStatus,
) -> None:
    """Send and record frames until the stream ends or time is up."""
    status.show("waiting for the first frame")
    start = perf_counter()
    for frame, tracked in frames:
        sinks.send(frame, tracked)
        recorder.add(frame, tracked)
        elapsed = perf_counter() - start if frame.silent else recorder.duration
        if seconds is not None and elapsed >= seconds:
            break
        if frame.silent or status.due:
            status.show(_status_line(frame, tracked, stream.counts, sinks.counts), now=frame.silent)


def _notes(counts: dict[str, int], step: int) -> tuple[str, ...]:
    """What is to be told of a stream at its end."""
    notes = []
    if counts.get("missing_frames"):
        notes.append(f"{counts['missing_frames']} frames are missing by their numbers")
    told = [f"{counts[name]} {what}" for name, what in _LEFT_OUT.items() if counts.get(name)]
    if told:
        notes.append(f"packets left out: {', '.join(told)}")
    if counts.get("restarts"):
        notes.append(f"the time of the stream began anew {counts['restarts']} times")
    if step > 1:
        notes.append(f"the following figures are of one half second in {step}")
    return tuple(notes)


def _status_line(
    frame: StreamedFrame, tracked: TrackedFrame, counts: dict[str, int], dropped: dict[str, int]
) -> str:
    """Status of a live stream, in one line."""
    if frame.silent:
        if foreign := counts.get(_FOREIGN):
            return f"no frames arrive, but {foreign} packets of other senders; is this the right port?"
        return "no frames arrive; is the server playing?"
    words = [f"{hand.side} {hand.status.value}" for hand in tracked.hands]
    words += [f"{body.name} {body.status.value}" for body in tracked.bodies]
    left_out = sum(counts.get(name, 0) for name in _LEFT_OUT if name != _FOREIGN)
    for count, what in (
        (counts.get("missing_frames", 0), "missing"),
        (left_out, "left out"),
        (sum(dropped.values()), "not sent"),
    ):
        words += [f"{count} {what}"] if count else []
    return f"frame {frame.number}: {', '.join(words)}; Ctrl-C ends it"
