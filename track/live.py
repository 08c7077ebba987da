"""Live streams: hands are measured in the first frames, then tracked, sent on and recorded until the end."""

from __future__ import annotations

import gc
import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

import numpy as np

from gloves.takes.archives import check_unused, growing_path
from gloves.takes.take import Take
from handsim.app.messages import LiveStatus
from handsim.files.signals import InterruptFlag, Stopped, interrupt_flag, interrupts_bare
from track.captures import OnFrame
from track.frames import FARTHEST, StreamedFrame, TrackedFrame
from track.recorder import Recorder
from track.settings import TrackerSetup
from track.sinks import SinkGroup
from track.streams.live_stream import MOST_LAG, LiveStream, open_source

_MEASURED: Final = 1.0  # [s] of frames that show enough to measure hands
_LONGEST_WAIT: Final = 10.0  # [s] for them
_TOLD: Final = 1.0  # [s] between two lines about frames that are dropped
_LAGS: Final = 100_000  # newest frames whose lag is kept
_MANY_FAR: Final = 0.5  # share of the points out of range from which their unit is asked for
_FOREIGN: Final = "foreign_packets"
_PACKETS: Final = {"damaged_packets": "damaged", _FOREIGN: "of other senders"}
"""Counts of packets that do not go on, in words."""
_FRAMES: Final = {
    "frames_in_order": "in order",
    "reordered_frames": "put in order",
    "doubled_frames": "doubled",
    "late_frames": "too late",
    "frames_with_wild_times": "with a wild time",
}
"""Counts of all frames that came, in words."""
_OF_THEM: Final = {
    "dropped_frames": "of them dropped, as they were not kept up with",
    "frames_after_end": "of them after the end",
}
"""Counts of some of them, in words."""


class _Now:
    """How far a stream is kept up with: its rate, lags and what was dropped in the last second."""

    def __init__(self) -> None:
        self.lags: deque[float] = deque(maxlen=_LAGS)
        """From the arrival of each frame to its output [s], once it was caught up with the stream."""
        self.first_lags: list[float] = []
        """Those before: of frames that came while hands were measured."""
        self._begin, self._received, self._dropped = monotonic(), 0, 0
        self._words = ""

    def add(self, frame: StreamedFrame, forgiven_until: float) -> None:
        """Take on a frame that has been sent on; until some time [s] a lag is that of the start."""
        if frame.silent:
            return
        now = monotonic()
        lag = now - frame.arrived
        if not self.lags and lag > MOST_LAG and now < forgiven_until:
            self.first_lags.append(lag)
        else:
            self.lags.append(lag)

    def tick(self, counts: dict[str, int]) -> bool:
        """Once a second sum up what became of it; returns whether frames were dropped."""
        now = monotonic()
        span = now - self._begin
        if span < _TOLD:
            return False
        received = counts["received_frames"] - self._received
        dropped = counts["dropped_frames"] - self._dropped
        newest = [*self.first_lags, *self.lags][-max(received, 1) :]
        lag = float(np.median(newest)) if newest else 0.0
        share = f"{100.0 * dropped / max(received, dropped, 1):.0f} % dropped, " if dropped else ""
        self._words = f"{received / span:.0f} Hz, {share}{1e3 * lag:.0f} ms behind"
        self._begin, self._received, self._dropped = now, counts["received_frames"], counts["dropped_frames"]
        return dropped > 0

    def __str__(self) -> str:
        """The last second in words; empty before."""
        return self._words


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
        setup: What the tracker is made of; a stream is not waited for if its hands are known.
        status: Says what is waited for.
        seconds: How long to wait [s], ten seconds at most.
    """
    gc.freeze()  # to look through all that was loaded took the collector a quarter of a second now and then
    if not setup.is_auto:
        stream.forgive()
        return setup, stream
    first = _first_frames(stream, setup.fewest_points, seconds, status)
    setup = setup.measured([frame for frame in first if len(frame.points) >= setup.fewest_points])
    status.say(f"size of the hands: {setup.user}")
    return setup, _first_and_others(first, stream)


@contextmanager
def recording_kept(recorder: Recorder) -> Iterator[None]:
    """An interrupt that ends the block closes the recording as it is, and says where it is kept."""
    try:
        with interrupts_bare():
            yield
    except KeyboardInterrupt as stop:
        recorder.close()
        raise Stopped.again(stop, f"the recording is kept in {recorder.part}") from stop


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

    At the first signal the take is written, without the frames that still wait. The recording is kept as it
    is at the second one.

    Args:
        address: The stream, see `open_source`.
        out: The take's file; until its end the recording is beside it.
        setup: What the tracker is made of; its hands may be measured in the first second.
        seconds: How long to record [s], by this machine's clock from the first frame's arrival; None for as
            long as it comes.
        sinks: Take every frame before it is recorded.
        on_frame: Called with each frame, its time in [s], and what the tracker made of it.

    Raises:
        CaptureError: No server answers, fewer than two frames came, or a file cannot be written.
        Stopped: A signal came before the recording began, or a second one after that.
    """
    check_unused(growing_path(out))
    until = [math.inf]  # [s], when it is over by this machine's clock
    interrupted = InterruptFlag()

    def over() -> bool:
        return interrupted() or monotonic() >= until[0]

    with open_source(address, ended=over) as stream, LiveStatus() as status:
        setup, frames = measured_setup(stream, setup, status, seconds=seconds)
        tracker = setup.tracker()
        sinks.start(tracker.hands, tracker.bodies)
        with (
            interrupt_flag(interrupted),  # the frames so far are kept
            Recorder(out, tracker, {"capture": address, **setup.settings}) as recorder,
            recording_kept(recorder),
        ):
            status.say(f"recording to {recorder.part}, which becomes {out} at the end; Ctrl-C ends it")
            status.show("waiting for the first frame")
            kept_up, asked = _Now(), False
            for frame in frames:
                if seconds is not None and not frame.silent:
                    until[0] = min(until[0], frame.arrived + seconds)
                if interrupted() or frame.arrived > until[0]:
                    break
                tracked = tracker.step(frame.points, frame.ids, frame.time)
                sinks.send(frame, tracked)
                kept_up.add(frame, stream.forgiven_until)
                recorder.add(frame, tracked)
                on_frame(frame, tracked)
                dropping = kept_up.tick(stream.counts)
                if frame.silent or dropping or status.due:
                    line = _status_line(frame, tracked, stream.counts, sinks.counts, kept_up)
                    status.show(line, now=frame.silent or dropping)
                if not asked and (doubt := _unit_doubt(stream)):
                    asked = True
                    status.say(doubt)
            stream.end(until[0])
            counts = stream.counts
            status.show(f"writing {out}", now=True)
            take, step = recorder.finish(
                counts,
                told=lambda: status.show(f"writing {out}; {recorder.part} is kept until then"),
            )
        after = counts["frames_in_order"] + counts["reordered_frames"] - counts["dropped_frames"]
        counts["frames_after_end"] = max(0, after - recorder.num_frames)
        notes = (*_notes(counts, step, kept_up, stream.order.interval), *sinks.notes())
        doubt = _unit_doubt(stream)
        return LiveTake(take, recorder.num_frames, (*notes, doubt) if doubt else notes)


def _first_and_others(first: list[StreamedFrame], stream: LiveStream) -> Iterator[StreamedFrame]:
    """All frames of a stream; those that came while the first ones were looked at are caught up with."""
    stream.forgive(math.inf)
    yield from first
    stream.forgive()
    yield from stream


def _first_frames(
    stream: LiveStream, fewest_points: float, seconds: float | None, status: LiveStatus
) -> list[StreamedFrame]:
    """The first frames of a stream, until there were enough points for a second, or ten seconds are over."""
    frames: list[StreamedFrame] = []
    began = shown = np.inf
    status.show("waiting for hands, to measure their size")
    for frame in stream:
        now = monotonic()
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


def _notes(counts: dict[str, int], step: int, now: _Now, interval: float) -> tuple[str, ...]:
    """What is to be told of a stream at its end; `interval` is from frame to frame [s]."""
    told = ", ".join(f"{counts[name]} {what}" for name, what in _FRAMES.items())
    others = ", ".join(f"{counts[name]} {what}" for name, what in _OF_THEM.items() if counts[name])
    others = f" ({others})" if others else ""
    notes = [
        f"{counts['received_frames']} frames received: {told}{others}; {counts['missing_frames']} missing"
    ]
    if now.lags:
        median, late, most = 1e3 * np.percentile(now.lags, [50, 99, 100])
        notes.append(
            f"output {median:.0f} ms behind the arrival of frames (median), {late:.0f} ms in the worst "
            f"hundredth, {most:.0f} ms at most"
        )
    if now.first_lags:
        notes.append(
            f"the first {len(now.first_lags)} frames, which came while hands were measured, were up to "
            f"{max(now.first_lags):.1f} s behind"
        )
    if counts["missing_at_end"]:
        lacking = counts["missing_at_end"]
        quiet = f"no frame came in the last {lacking * interval:.2f} s"
        notes.append(f"{quiet}, in which {lacking} could have been sent")
    packets = [f"{counts[name]} {what}" for name, what in _PACKETS.items() if counts.get(name)]
    if packets:
        notes.append(f"packets left out: {', '.join(packets)}")
    if counts.get("restarts"):
        notes.append(f"the time of the stream began anew {counts['restarts']} times")
    if step > 1:
        notes.append(f"the following figures are of one half second in {step}")
    return tuple(notes)


def _unit_doubt(stream: LiveStream) -> str:
    """A question about the unit of a stream whose points lie out of range; empty if they do not."""
    if stream.far_points <= _MANY_FAR * stream.points or not stream.far_points:
        return ""
    return (
        f"{stream.far_points} of {stream.points} points lie {FARTHEST:.0f} m or more from the origin and are "
        "left out; are they millimeters? Set the unit of the stream to meters"
    )


def _status_line(
    frame: StreamedFrame,
    tracked: TrackedFrame,
    counts: dict[str, int],
    dropped: dict[str, int],
    now: _Now,
) -> str:
    """Status of a live stream, in one line."""
    if frame.silent:
        if foreign := counts.get(_FOREIGN):
            return f"no frames arrive, but {foreign} packets of other senders; is this the right port?"
        return "no frames arrive; is the server playing?"
    words = [f"{hand.side} {hand.status}" for hand in tracked.hands]
    words += [f"{body.name} {body.status}" for body in tracked.bodies]
    rms = [hand.rms for hand in tracked.hands if np.isfinite(hand.rms)]
    words += [f"RMS {1e3 * max(rms):.1f} mm"] if rms else []
    words += [str(now)] if str(now) else []
    left_out = sum(
        counts.get(name, 0) for name in ("late_frames", "frames_with_wild_times", "damaged_packets")
    )
    for count, what in (
        (counts.get("missing_frames", 0), "missing"),
        (counts.get("dropped_frames", 0), "dropped"),
        (left_out, "left out"),
        (sum(dropped.values()), "not sent"),
    ):
        words += [f"{count} {what}"] if count else []
    return f"frame {frame.number}: {', '.join(words)}; Ctrl-C ends it"
