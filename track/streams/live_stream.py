"""Live streams as a tracker takes them: in order, on a clock that never goes back, and now.

What the reader does not keep up with is dropped, oldest first, and counted.
"""

from __future__ import annotations

import dataclasses
import math
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

import numpy as np

from handsim.callbacks import Closing
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from track.frames import FARTHEST, LATEST_TIME
from track.streams.frame_order import FrameOrder
from track.streams.frame_source import FrameSource, StreamedFrame

SILENCE: Final = 2.0
"""Time without a frame [s] after which a stream yields a silent frame."""
MOST_LAG: Final = 0.03
"""Time [s] for which a frame waits for a reader that was held up, before it is dropped."""
_LEAST_LAG: Final = 0.01  # [s] for which it waits where the reader is too slow
_TOO_SLOW: Final = 0.1  # [s] for which frames have waited all the time, from which the reader is too slow
_FORGIVEN: Final = 2.0  # [s] of a lag that are forgiven, at most
_CATCHING_UP: Final = 1.0  # [s] per second by which it has to shrink
_WAITING: Final = 256  # frames that may wait of a source that is faster than its times; it waits after that
_MOST_WAITING: Final = 1 << 14  # frames that may wait at all
_PACE_FRAMES: Final = 64  # newest frames that show the pace of a source
_FEWEST_PACE: Final = 5  # of them
_SAME_PACE: Final = 1.0  # [s], the longest step of their times, beyond which it begins anew
_FASTER: Final = 1.5  # times as fast as its frames' times, from which a source is not live
_LOOP_GAP: Final = 0.01  # [s] between the last frame of a recording and its first, when it starts again
_STOP: Final = 0.1  # [s] between two looks at whether the stream shall end
_MOST_ID: Final = 1 << 31  # as takes store them
_LEAVE: Final = 1.0  # [s] for a source to end after `close`


class ArrivingFrames(Protocol):
    """Frames as they arrive, in any order."""

    @property
    def counts(self) -> dict[str, int]:
        """What became of other packets so far, by name."""
        ...

    @property
    def lost(self) -> int:
        """Number of frames that waited too long to be asked for, and were left out."""
        ...

    @property
    def is_live(self) -> bool:
        """Whether frames come at their own pace, however slow their reader is."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether no further frame comes."""
        ...

    @property
    def error(self) -> Exception | None:
        """Why it is over, if it failed."""
        ...

    def poll(self, seconds: float) -> Sequence[StreamedFrame]:
        """Wait for a frame, so long at most [s]; returns all that have arrived."""
        ...

    def end(self) -> None:
        """No frame is wanted but those that have arrived."""
        ...

    def close(self) -> None:
        """No frame is wanted."""
        ...


class LiveStream(Closing, Iterator[StreamedFrame]):
    """Frames of a live stream as a tracker takes them; the end of a `with` block or `close` ends it.

    They are in order (`track.streams.frame_order`), and their time never goes back: when the stream's time
    begins anew, as in a recording that starts again, it continues. During a silence frames without points
    come, at the time that has passed. Points 1000 m or more from the origin are left out and counted. A frame
    that has waited for `MOST_LAG` while newer ones came is dropped and counted; where the reader is too slow,
    so that frames wait all the time, a third of that.

    Args:
        frames: The frames as they arrive.
        silence: Time without a frame after which the stream yields a silent frame [s].
        ended: The stream ends when this is true, after what has arrived; it is asked before each frame, and
            several times a second while none comes.
    """

    def __init__(
        self,
        frames: ArrivingFrames,
        *,
        silence: float = SILENCE,
        ended: Callable[[], bool] = lambda: False,
    ) -> None:
        self.order = FrameOrder()
        """Puts the frames in order."""
        self.dropped = 0
        """Number of frames that were not kept up with."""
        self.points = self.far_points = 0
        """Numbers of points that came, and of those that were out of range."""
        self.forgiven_until = -math.inf
        """When a lag is no longer forgiven, by the monotonic clock [s]."""
        self._frames, self._silence, self._ended = frames, silence, ended
        self._ahead = 0.0  # [s] of this time over the stream's
        self._last: StreamedFrame | None = None  # on this clock
        self._ready: deque[tuple[StreamedFrame, float]] = deque()  # in order, and since when [s]
        self._kept_up = time.monotonic()  # [s], when the reader had to wait for a frame
        self._end_at = math.inf  # [s], when the stream was ended from here
        self._over = self._closed = self._failed = False

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames so far, by name.

        All that were received were in order, reordered, doubled, late or with wild times, or wait; those that
        were dropped were in order or reordered.
        """
        order = self.order
        return {
            "received_frames": order.received + self._frames.lost,
            "frames_in_order": order.passed - order.reordered,
            "reordered_frames": order.reordered,
            "doubled_frames": order.doubled,
            "late_frames": order.late,
            "frames_with_wild_times": order.wild,
            "dropped_frames": self.dropped + self._frames.lost,
            "missing_frames": max(order.missed - self._frames.lost, 0),
            "missing_at_end": order.missing_at_end(self._end_at) if self._end_at < math.inf else 0,
            "restarts": order.restarts,
            "points_out_of_range": self.far_points,
            **self._frames.counts,
        }

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after each period of silence a silent frame.

        Raises:
            CaptureError: A source of the user's own failed.
        """
        quiet = time.monotonic() + self._silence
        self._line_up(0.0)
        while not self._closed:
            if self._end_at == math.inf and self._ended():
                self.end()
            if not self._ready:
                self._kept_up = time.monotonic()
                self._line_up(min(quiet, self.order.deadline) - self._kept_up)
            self._drop_old()
            if self._ready:
                return self._continue(self._ready.popleft()[0])
            if self._over:
                break
            if time.monotonic() >= quiet and self.order.deadline == math.inf:
                return self._silent()
        if self._frames.error is not None and not self._failed:
            self._failed = True
            raise self._frames.error
        raise StopIteration

    def forgive(self, most: float = _FORGIVEN) -> None:
        """Drop nothing for the time that the reader needed until now, if it catches up.

        The lag may be what it is, but for the most [s], less a second for every second from now on.
        """
        self._line_up(0.0)
        now = time.monotonic()
        oldest = min((since for _, since in self._ready), default=now)
        self.forgiven_until = now + min(now - oldest, most) / _CATCHING_UP

    def end(self, at: float = math.inf) -> None:
        """End the stream after what has arrived; `at` is the monotonic time of its end, if before now [s]."""
        ended = self._end_at < math.inf
        self._end_at = min(self._end_at, at, time.monotonic())
        if not ended:
            self._frames.end()

    def close(self) -> None:
        """End the stream; no further frame comes."""
        self.end()
        self._closed = True
        self._frames.close()

    def _line_up(self, seconds: float) -> None:
        """Put what has arrived in order; wait for it, so long at most [s]."""
        if self._over or (self._ready and not self._frames.is_live):
            return
        for frame in self._frames.poll(min(max(seconds, 0.0), _STOP)):
            passed = (*self.order.expire(frame.arrived), *self.order.add(frame))
            self._ready.extend((one, frame.arrived) for one in passed)
        now = time.monotonic()
        if self._frames.is_over or now > self._end_at + _LEAVE:
            self._ready.extend((one, now) for one in self.order.end())
            self._over = True
        else:
            self._ready.extend((one, now) for one in self.order.expire(now))

    def _drop_old(self) -> None:
        """Leave out what has waited for too long while newer frames came."""
        if self._over or not self._frames.is_live:
            return
        now = time.monotonic()
        most = MOST_LAG if now < self._kept_up + _TOO_SLOW else _LEAST_LAG
        most += max(0.0, _CATCHING_UP * (self.forgiven_until - now))
        while len(self._ready) > 1 and now - self._ready[0][1] > most:
            dropped, _ = self._ready.popleft()
            self.dropped += 1
            if dropped.restarted:
                frame, waits_since = self._ready[0]
                self._ready[0] = (dataclasses.replace(frame, restarted=True), waits_since)

    def _continue(self, frame: StreamedFrame) -> StreamedFrame:
        """A frame on this clock, with the points that are in range."""
        now, last = frame.time + self._ahead, self._last
        if last is not None and (now <= last.time or frame.restarted):
            begin = last.time + max(_LOOP_GAP, frame.arrived - last.arrived)
            self._ahead += begin - now
            now = begin
        near = (np.abs(frame.points) < FARTHEST).all(axis=1)
        self.points += len(near)
        self.far_points += int((~near).sum())
        if not near.all():
            frame = dataclasses.replace(frame, points=frame.points[near], ids=frame.ids[near])
        self._last = dataclasses.replace(frame, time=now)
        return self._last

    def _silent(self) -> StreamedFrame:
        """A frame that stands for a silence."""
        now, last = time.monotonic(), self._last
        number, told = (last.number, last.time + now - last.arrived) if last is not None else (0, 0.0)
        return StreamedFrame(
            number, told, np.empty((0, 3)), np.empty(0, dtype=np.int64), silent=True, arrived=now
        )


class SourceStream:
    """The checked frames of a source of the user's own, which is iterated in a thread of its own.

    One that is faster than the times of its frames is made to wait.

    Args:
        source: Delivers the frames.
        name: What messages call it.
        waits: Whether it may be made to wait; a system that measures goes on.

    Raises:
        ArgumentError: The source is not a `FrameSource`.
    """

    def __init__(self, source: FrameSource, name: str, *, waits: bool = True) -> None:
        for method in ("__iter__", "close"):
            if not callable(getattr(source, method, None)):
                raise ArgumentError(
                    f"{name} has no method {method}, expected __iter__ and close of a frame source"
                )
        self.lost = 0
        """Number of frames that waited too long to be asked for, and were left out."""
        self.error: CaptureError | None = None
        """Why it is over, if it failed."""
        self._source, self._name, self._waits = source, name, waits
        self._changed = threading.Condition()
        self._arrived: deque[StreamedFrame] = deque()
        self._pace: deque[StreamedFrame] = deque(maxlen=_PACE_FRAMES)
        self._ahead = self._read_all = self._ended = self._closed = False
        self._thread = threading.Thread(target=self._read, name="frame source", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> dict[str, int]:
        """Nothing beside frames comes."""
        return {}

    @property
    def is_live(self) -> bool:
        """Whether frames come no faster than their times go on."""
        return not self._ahead

    @property
    def is_over(self) -> bool:
        """Whether no further frame comes."""
        with self._changed:
            return (self._read_all or self._closed) and not self._arrived

    def poll(self, seconds: float) -> list[StreamedFrame]:
        """Wait for a frame, so long at most [s]; returns all that have arrived."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._read_all or self._closed, seconds)
            arrived, self._arrived = list(self._arrived), deque()
            self._changed.notify_all()
        return arrived

    def _read(self) -> None:
        """Take every frame as it arrives, in a thread of its own."""
        try:
            for frame in self._source:
                if self._ended or not self._put(_checked(frame)):
                    break
        except Exception as error:  # of the user's code: any
            if not self._ended:  # one that is closed while it waits may fail
                self.error = CaptureError(
                    f"{self._name}: the stream failed ({type(error).__name__}: {error})"
                )
                self.error.__cause__ = error
        with self._changed:
            self._read_all = True
            self._changed.notify_all()

    def _put(self, frame: StreamedFrame) -> bool:
        """Let a frame wait for the reader; returns whether the reader is still there."""
        with self._changed:
            while len(self._arrived) >= _WAITING and self._ahead and not self._closed:
                self._changed.wait()
            if math.isnan(frame.arrived):
                frame = dataclasses.replace(frame, arrived=time.monotonic())
            if self._pace and not abs(frame.time - self._pace[-1].time) < _SAME_PACE:
                self._pace.clear()
            self._pace.append(frame)
            if self._waits and len(self._pace) >= _FEWEST_PACE:  # after a restart, it is as before until then
                first, last = self._pace[0], self._pace[-1]
                span = last.arrived - first.arrived
                self._ahead = last.time - first.time > _FASTER * span + _LOOP_GAP
            self._arrived.append(frame)
            if len(self._arrived) > _MOST_WAITING:
                self._arrived.popleft()
                self.lost += 1
            self._changed.notify_all()
            return not self._closed

    def end(self) -> None:
        """Close the source, once."""
        if self._ended:
            return
        self._ended = True
        try:
            self._source.close()
        except Exception as error:  # of the user's code: any; what came before is kept
            warnings.warn(
                f"{self._name}: close failed ({type(error).__name__}: {error})", HandSimWarning, stacklevel=3
            )

    def close(self) -> None:
        """Close the source."""
        self.end()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_LEAVE)  # a source that does not listen ends with the process


def _checked(frame: StreamedFrame) -> StreamedFrame:
    """The frame with arrays of the right types, without points that are missing."""
    if not isinstance(frame, StreamedFrame):
        raise ArgumentError(f"a {type(frame).__name__} came, expected a track.StreamedFrame")
    points, ids = np.asarray(frame.points, dtype=np.float64), np.asarray(frame.ids, dtype=np.int64)
    if points.ndim != 2 or points.shape != (*ids.shape, 3):
        raise ArgumentError(f"points have shape {points.shape} and IDs {ids.shape}, expected (N, 3) and (N,)")
    if not abs(frame.time) < LATEST_TIME:
        raise ArgumentError(f"the time of frame {frame.number} is {frame.time}, expected seconds")
    if ids.size and not -1 <= ids.min() <= ids.max() < _MOST_ID:
        raise ArgumentError(f"IDs are from {ids.min()} to {ids.max()}, expected -1 to {_MOST_ID - 1}")
    there = np.isfinite(points).all(axis=1)
    return dataclasses.replace(frame, points=points[there], ids=ids[there])
