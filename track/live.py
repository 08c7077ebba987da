"""Live streams: hands are measured in the first frames, then tracked, sent on and recorded until the end."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Final, NamedTuple

import numpy as np

from gloves.takes.take import Take
from handsim.app.interrupts import interrupt_flag
from handsim.app.messages import LiveStatus
from track.capture_tracking import OnFrame
from track.recorder import Recorder
from track.setup import TrackerSetup
from track.sinks.addresses import SinkGroup
from track.streams.addresses import open_source
from track.streams.frame_source import LiveStream, StreamedFrame
from track.tracked_frame import TrackedFrame

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


class LiveTake(NamedTuple):
    """What was recorded of a stream."""

    take: Take
    """The take; of a long stream, parts of it."""
    num_frames: int
    """Number of all frames."""
    notes: tuple[str, ...]
    """What is to be told, one line each."""

    @property
    def is_whole(self) -> bool:
        """Whether `take` is all of it."""
        return self.take.num_frames == self.num_frames


def measured_setup(
    stream: LiveStream, setup: TrackerSetup, status: LiveStatus, *, seconds: float | None = None
) -> tuple[TrackerSetup, Iterator[StreamedFrame]]:
    """The setup with the hands as measured in the first frames of a stream, and all its frames.

    Args:
        stream: The stream.
        setup: What the tracker is made of; a stream is not waited for if its hands are known.
        status: Says what is waited for.
        seconds: How long to wait [s], ten seconds at most.
    """
    if not setup.is_measured:
        return setup, stream
    first = _first_frames(stream, setup.fewest_points, seconds, status)
    setup = setup.measured([frame for frame in first if len(frame.points) >= setup.fewest_points])
    status.say(f"size of the hands: {setup.user}")
    return setup, chain(first, stream)


def track_live(
    address: str,
    out: Path,
    setup: TrackerSetup,
    *,
    seconds: float | None = None,
    sinks: SinkGroup,
    on_frame: OnFrame,
) -> LiveTake:
    """Track and record a stream until time is up, the stream ends, or a signal ends it.

    Args:
        address: The stream, see `open_source`.
        out: The take's file; until its end the recording is beside it.
        setup: What the tracker is made of; its hands may be measured in the first second.
        seconds: How long to record [s]; None for as long as it comes.
        sinks: Take every frame before it is recorded.
        on_frame: Called with each frame, its time in [s], and what the tracker made of it.

    Raises:
        CaptureError: No server answers, fewer than two frames came, or a file cannot be written.
    """
    with (
        interrupt_flag() as interrupted,  # the frames so far are kept
        open_source(address, ended=interrupted) as stream,
        LiveStatus() as status,
    ):
        setup, frames = measured_setup(stream, setup, status, seconds=seconds)
        tracker = setup.tracker()
        sinks.start(tracker.hands, tracker.bodies)
        with Recorder(out, tracker, {"capture": address, **setup.settings}) as recorder:
            status.say(f"recording to {recorder.part}, which becomes {out} at the end; Ctrl-C ends it")
            status.show("waiting for the first frame")
            try:
                start = perf_counter()
                for frame in frames:
                    tracked = tracker.step(frame.points, frame.ids, frame.time)
                    sinks.send(frame, tracked)
                    recorder.add(frame, tracked)
                    on_frame(frame, tracked)
                    elapsed = perf_counter() - start if frame.silent else recorder.duration
                    if seconds is not None and elapsed >= seconds:
                        break
                    if frame.silent or status.due:
                        line = _status_line(frame, tracked, stream.counts, sinks.counts)
                        status.show(line, now=frame.silent)
                status.show(f"writing {out}", now=True)
                take, step = recorder.finish(
                    stream.counts,
                    told=lambda: status.show(f"writing {out}; {recorder.part} is kept until then"),
                )
            except KeyboardInterrupt:
                status.say(f"the recording is kept in {recorder.part}")
                recorder.close()
                raise
        return LiveTake(take, recorder.num_frames, (*_notes(stream.counts, step), *sinks.notes()))


def _first_frames(
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
