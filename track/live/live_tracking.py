"""Tracking of a live stream: hands are tracked, measured meanwhile, sent on and recorded."""

from __future__ import annotations

import gc
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final, NamedTuple, NoReturn, Protocol

import numpy as np

from gloves.fit import GloveFit
from gloves.takes.archives import check_unused, growing_path
from gloves.takes.take import Take, load_take
from handsim.app.messages import LiveStatus, named_steps
from handsim.errors import CaptureError
from handsim.files.signals import InterruptFlag, Stopped, interrupt_flag, interrupts_bare
from track.bodies.rigid_body import RigidTemplate
from track.captures import OnFrame
from track.frames import StreamedFrame, TrackedFrame
from track.live.live_sizing import LiveSizing
from track.output.recorder import Recorder
from track.settings import TrackerSetup
from track.streams import NoServerError
from track.streams.live_stream import LiveStream, open_source
from track.tracker import Tracker

_PACE_PERIOD: Final = 1.0  # [s] between two reports on dropped frames
_RETRY_PERIOD: Final = 0.5  # [s] between two attempts to reach a server
_FIRST_FRAME_WAIT: Final = 10.0  # [s] least wait for the first frame of a session with a length
_PACKET_WORDS: Final = {"damaged_packets": "damaged", "foreign_packets": "of other senders"}
"""Words for the counts of ignored packets."""
_FRAME_WORDS: Final = {
    "frames_in_order": "in order",
    "reordered_frames": "put in order",
    "doubled_frames": "doubled",
    "late_frames": "too late",
    "frames_with_wild_times": "with a wild time",
}
"""Words for the counts that add up to all received frames."""
_PART_WORDS: Final = {
    "dropped_frames": "of them dropped, as they were not kept up with",
    "frames_after_end": "of them after the end",
}
"""Words for the counts of some of these frames."""


class FrameOutput(Protocol):
    """Receives tracked frames as they are made: a `SinkGroup` or a `LiveView`."""

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of dropped frames, by destination."""

    def start(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        """Prepare for the tracker's hands and bodies; called again when their size changes."""

    def send(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Receive a frame, without waiting."""

    def notes(self) -> tuple[str, ...]:
        """Lines to print at the end."""


class LiveTake(NamedTuple):
    """The result of tracking a stream."""

    take: Take | None
    """The take; of a long one only some blocks; None if nothing was recorded."""
    num_frames: int
    """Number of all tracked frames."""
    duration: float
    """Duration of all frames [s], missing ones included."""
    notes: tuple[str, ...]
    """Lines to print at the end."""

    def whole_take(self, path: Path) -> Take:
        """The whole recorded take; a long one is read from its file."""
        take = self.take
        return load_take(path) if take is None or take.num_frames < self.num_frames else take


def track_live(
    address: str,
    setup: TrackerSetup,
    outputs: Sequence[FrameOutput] = (),
    *,
    out: Path | None = None,
    seconds: float | None = None,
    on_frame: OnFrame = lambda frame, tracked: None,
    guide: Callable[[TrackedFrame], str | None] = lambda tracked: "",
) -> LiveTake:
    """Track a stream, into `out` if given, until `seconds` are over, the stream ends or a signal comes.

    The `seconds` count from the first frame. That frame is awaited for `seconds`, at least ten, and without
    `seconds` until a signal comes. After each frame the text of `guide` is shown; if it is None, tracking
    ends. The first signal writes the take without the waiting frames; a second one keeps the recording as it
    is. If the recording fails, outputs still get all frames.

    Raises:
        CaptureError: No server answered or no frame came in time, or the recording failed.
    """
    if out is not None:
        check_unused(growing_path(out))
    tracker = _ready_tracker(setup, outputs)
    patience = math.inf if seconds is None else max(seconds, _FIRST_FRAME_WAIT)
    until = monotonic() + patience  # [s] end of tracking on the monotonic clock
    interrupted = InterruptFlag()
    with (
        LiveStatus() as status,
        _open_answered(address, lambda: interrupted() or monotonic() >= until, until, status) as stream,
        ExitStack() as stack,
    ):
        stack.enter_context(interrupt_flag(interrupted))  # From here on a signal keeps the frames so far.
        settings = {"capture": address, **setup.settings}
        recording = _Recording(stack, out, tracker, settings, outputs, status)
        sizing = stack.enter_context(LiveSizing(setup))
        status.show("waiting for the first frame")
        stream.forgive()
        pace, doubt = _Pace(), ""
        for frame in stream:
            if seconds is not None and not frame.silent and not pace.frames:
                until = frame.arrived + seconds
            if interrupted() or frame.arrived > until:
                break
            tracked = sizing.eased(tracker.step(frame.points, frame.ids, frame.time), tracker)
            for output in outputs:
                output.send(frame, tracked)
            pace.add(frame)
            recording.add(frame, tracked)
            on_frame(frame, tracked)
            if sizing.step(frame, tracked, tracker):
                _start(outputs, tracker)
                if sizing.is_settled:
                    status.say(f"size of the hands: {tracker.user}")
            if (wish := guide(tracked)) is None:
                break
            new = pace.tick(stream.counts) or frame.silent > pace.is_silent
            pace.is_silent = frame.silent
            if new or status.due:
                line = _status_line(frame, tracked, stream, outputs, pace, sizing.state)
                status.show(line if frame.silent else wish or line, now=new)
            if not doubt and (doubt := stream.point_doubt):
                status.say(doubt)
        stream.end(until)
        counts = stream.counts
        if not pace.frames and (out is not None or monotonic() >= until):
            waited = f" in {patience:g} s" if monotonic() >= until else ""
            recording.discard(f"{address}: 0 frames came{waited}; {stream.silence_doubt}")
        take, step = recording.finish(counts, pace, sizing.state)
    after = counts["frames_in_order"] + counts["reordered_frames"] - counts["dropped_frames"]
    counts["frames_after_end"] = max(0, after - pace.frames)
    notes = list(_notes(counts, step, pace, stream.order.interval))
    if sizing.state and pace.frames:
        notes.append(f"the last hands are {sizing.state.replace(' yet', '')}; track the recording again")
    sent = (note for output in outputs for note in output.notes())
    duration = pace.duration + (1.0 / take.rate if take is not None else 0.0)
    return LiveTake(take, pace.frames, duration, (*notes, *sent, *filter(None, [stream.point_doubt])))


def _ready_tracker(setup: TrackerSetup, outputs: Sequence[FrameOutput]) -> Tracker:
    """The tracker of a session, after all work that would delay its first frames."""
    with named_steps("getting ready"):
        tracker = setup.tracker()
        tracker.warm_up()
        _start(outputs, tracker)
        gc.freeze()  # A garbage collection would stop tracking for up to 0.25 s.
    return tracker


def _start(outputs: Sequence[FrameOutput], tracker: Tracker) -> None:
    """Start all outputs with a tracker's hands and bodies."""
    for output in outputs:
        output.start(tracker.hands, tracker.bodies)


def _open_answered(address: str, ended: Callable[[], bool], until: float, status: LiveStatus) -> LiveStream:
    """Open a stream as soon as its server answers, by a monotonic time `until` [s]."""
    while True:
        try:
            return open_source(address, ended=ended)
        except NoServerError as error:
            if monotonic() >= until:
                raise
            status.show(f"{error}; it is waited for, Ctrl-C ends it")
            sleep(_RETRY_PERIOD)  # a refused connection returns at once


class _Recording:
    """The recording of a session; if it fails, outputs still get frames."""

    def __init__(
        self,
        stack: ExitStack,
        out: Path | None,
        tracker: Tracker,
        settings: Mapping[str, Any],
        outputs: Sequence[FrameOutput],
        status: LiveStatus,
    ) -> None:
        self._outputs, self._status = outputs, status
        self._recorder: Recorder | None = None
        self._failure: CaptureError | None = None
        if out is not None:
            recorder = self._recorder = stack.enter_context(Recorder(out, tracker, settings))
            stack.enter_context(_kept_on_interrupt(recorder))
            status.say(f"recording to {recorder.part}, which becomes {out} at the end; Ctrl-C ends it")

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Record a frame unless the recording has failed; raise a failure if there are no outputs."""
        if self._recorder is None or self._failure is not None:
            return
        try:
            self._recorder.add(frame, tracked)
        except CaptureError as error:
            if not any(self._outputs):
                raise
            self._failure = error
            self._status.say(f"{error}; tracking goes on without a recording")

    def discard(self, reason: str) -> NoReturn:
        """Remove a recording without frames, and say why there are none."""
        if self._recorder is not None:
            with suppress(CaptureError):
                self._recorder.finish()
        raise CaptureError(reason)

    def finish(self, counts: dict[str, int], pace: _Pace, size: str) -> tuple[Take | None, int]:
        """Write the take, see `Recorder.finish`; `size` says why the last hands are not measured."""
        recorder = self._recorder
        if recorder is None:
            return None, 1
        if self._failure is not None:
            lost = pace.frames - recorder.num_frames
            raise CaptureError(f"{self._failure}; {lost} frames after them were not recorded")
        self._status.show(f"writing {recorder.out}", now=True)
        kept = f"writing {recorder.out}; {recorder.part} is kept until then"
        return recorder.finish(counts, size=size, told=lambda: self._status.show(kept))


@contextmanager
def _kept_on_interrupt(recorder: Recorder) -> Iterator[None]:
    """On an interrupt, close the recording and say where it is kept."""
    try:
        with interrupts_bare():
            yield
    except KeyboardInterrupt as stop:
        recorder.close()
        raise Stopped.again(stop, recorder.kept()) from stop


class _Pace:
    """Measures rate, lag and dropped frames of a stream."""

    def __init__(self) -> None:
        self.lags: deque[float] = deque(maxlen=100_000)
        """Times from the arrival of frames to their output [s]."""
        self.frames = 0
        """Number of frames."""
        self.words = ""
        """Summary of the last second."""
        self.is_silent = False
        """Whether the last frame stood for a silence."""
        self._times = (0.0, 0.0)  # of the first and the last frame [s]
        self._begin, self._received, self._dropped = monotonic(), 0, 0

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._times[1] - self._times[0]

    def add(self, frame: StreamedFrame) -> None:
        """Count a frame and its lag."""
        if not frame.silent:
            self.lags.append(monotonic() - frame.arrived)
            self._times = (self._times[0] if self.frames else frame.time, frame.time)
            self.frames += 1

    def tick(self, counts: dict[str, int]) -> bool:
        """Renew the summary once a second; return whether frames were dropped in that second."""
        now = monotonic()
        span = now - self._begin
        if span < _PACE_PERIOD:
            return False
        received = counts["received_frames"] - self._received
        dropped = counts["dropped_frames"] - self._dropped
        newest = list(self.lags)[-max(received, 1) :]
        lag = float(np.median(newest)) if newest else 0.0
        share = f"{100.0 * dropped / max(received, dropped, 1):.0f} % dropped, " if dropped else ""
        self.words = f"{received / span:.0f} Hz, {share}{1e3 * lag:.0f} ms behind"
        self._begin, self._received, self._dropped = now, counts["received_frames"], counts["dropped_frames"]
        return dropped > 0


def _notes(counts: dict[str, int], step: int, pace: _Pace, interval: float) -> Iterator[str]:
    """Lines to print at the end of a stream; `interval` is the time between frames [s]."""
    told = ", ".join(f"{counts[name]} {what}" for name, what in _FRAME_WORDS.items())
    others = ", ".join(f"{counts[name]} {what}" for name, what in _PART_WORDS.items() if counts[name])
    others = f" ({others})" if others else ""
    yield f"{counts['received_frames']} frames received: {told}{others}; {counts['missing_frames']} missing"
    if pace.lags:
        median, late, most = 1e3 * np.percentile(pace.lags, [50, 99, 100])
        yield (
            f"output {median:.0f} ms behind the arrival of frames (median), {late:.0f} ms in the worst "
            f"hundredth, {most:.0f} ms at most"
        )
    if lacking := counts["missing_at_end"]:
        quiet = f"no frame came in the last {lacking * interval:.2f} s"
        yield f"{quiet}, in which {lacking} could have been sent"
    packets = [f"{counts[name]} {what}" for name, what in _PACKET_WORDS.items() if counts.get(name)]
    if packets:
        yield f"packets left out: {', '.join(packets)}"
    if counts["restarts"]:
        yield f"the time of the stream began anew {counts['restarts']} times"
    if step > 1:
        yield f"the following figures are of one half second in {step}"


def _status_line(
    frame: StreamedFrame,
    tracked: TrackedFrame,
    stream: LiveStream,
    outputs: Sequence[FrameOutput],
    pace: _Pace,
    size: str,
) -> str:
    """Status line of a live stream; `size` says why hands are not measured."""
    if frame.silent:
        return f"no frames arrive; {stream.silence_doubt}"
    counts = stream.counts
    words = [f"{hand.side} {hand.status}" for hand in tracked.hands]
    words += [f"{body.name} {body.status}" for body in tracked.bodies]
    rms = [hand.rms for hand in tracked.hands if np.isfinite(hand.rms)]
    words += [f"RMS {1e3 * max(rms):.1f} mm"] if rms else []
    words += [f"hands {size}"] if size else []
    words += [pace.words] if pace.words else []
    left_out = counts["late_frames"] + counts["frames_with_wild_times"] + counts.get("damaged_packets", 0)
    for number, what in (
        (counts["missing_frames"], "missing"),
        (counts["dropped_frames"], "dropped"),
        (left_out, "left out"),
        (sum(sum(output.counts.values()) for output in outputs), "not sent"),
    ):
        words += [f"{number} {what}"] if number else []
    return f"frame {frame.number}: {', '.join(words)}; Ctrl-C ends it"
