"""Sources of frames: the protocol for users' own sources, and the threads and queues that read them."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from typing import Final, Protocol

import numpy as np

from handsim._checks import as_numbers, check_methods
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from track.frames import LATEST_TIME, StreamedFrame

END_TIME: Final = 1.0
"""Time for a source to end after `close` [s]."""
_QUEUE_SIZE: Final = 1 << 14  # largest number of frames that wait for a reader
_MOST_WAITING: Final = 256  # A source that is not live has to wait when this many frames wait.
_PACE_FRAMES: Final = 64  # newest frames that show the pace of a source
_FEWEST_PACE: Final = 5  # The pace is known from this many frames on.
_SAME_PACE: Final = 1.0  # longest step in time within one pace [s]
# A source whose frames come this many times faster than their time stamps is not live.
_PACE_RATIO: Final = 1.5
_PACE_SLACK: Final = 0.01  # [s] Any source may be ahead of its time stamps by this.
_ID_LIMIT: Final = 1 << 31  # IDs of takes are smaller


class FrameSource(Protocol):
    """A user's own source of frames, for `handsim track --live module:name`.

    Points of a frame are in [m], times in [s]. A source is iterated once, in its own thread, which may wait
    for the next frame. After its last frame the take is written; an exception ends the stream in the same
    way, and is reported. A `ConnectionError` or `TimeoutError` in the constructor means that the server is
    not there yet; the command then tries again. A source that delivers frames faster than their time stamps
    has to wait; from one at the pace of its time stamps, the oldest frames are dropped when tracking is
    slower.
    """

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The frames in the order of their times."""
        ...

    def close(self) -> None:
        """End the source. Called once, from another thread, possibly while a frame is awaited."""
        ...


class ArrivingFrames(ABC):
    """Frames as they arrive, in any order; when too many wait, the oldest are dropped."""

    is_live = True
    """Whether frames come at their own pace, however slow the reader is."""
    error: Exception | None = None
    """Why no further frame comes, if the source failed."""
    without_points = "does the camera system see markers?"
    """Hint for frames without any point."""

    def __init__(self) -> None:
        self.lost = 0
        """Number of dropped frames."""
        self._arrived: deque[StreamedFrame] = deque(maxlen=_QUEUE_SIZE)

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of ignored packets, by name."""
        return {}

    @property
    def without_frames(self) -> str:
        """Why no frame comes, as far as the source knows."""
        return "is the server playing?"

    @property
    @abstractmethod
    def is_over(self) -> bool:
        """Whether no further frame comes."""

    @abstractmethod
    def poll(self, seconds: float) -> list[StreamedFrame]:
        """Return the frames that have arrived; wait up to `seconds` for one."""

    @abstractmethod
    def end(self) -> None:
        """Ignore all frames that arrive from now on."""

    @abstractmethod
    def close(self) -> None:
        """End the source, and drop waiting frames."""

    def _add(self, frame: StreamedFrame) -> None:
        self.lost += len(self._arrived) == _QUEUE_SIZE  # drops the oldest frame
        self._arrived.append(frame)

    def _take_all(self) -> list[StreamedFrame]:
        arrived, self._arrived = list(self._arrived), deque[StreamedFrame](maxlen=_QUEUE_SIZE)
        return arrived


class SourceStream(ArrivingFrames):
    """Validated frames of a source, which is iterated in its own thread.

    With `waits`, a source that is faster than the time stamps of its frames has to wait. A source may have
    attributes: `without_points` and `without_frames` with hints for frames without points and for no frames,
    and `counts` of ignored packets.
    """

    def __init__(self, source: FrameSource, name: str, *, waits: bool = True) -> None:
        super().__init__()
        self.without_points = str(getattr(source, "without_points", self.without_points))
        check_methods(name, source, ("__iter__", "close"), "__iter__ and close of a frame source")
        self._source, self._name, self._waits = source, name, waits
        self._changed = threading.Condition()
        self._pace: deque[StreamedFrame] = deque(maxlen=_PACE_FRAMES)
        self._read_all = self._ended = self._closed = False
        self._thread = threading.Thread(target=self._read, name="frame source", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of ignored packets, by name."""
        return dict(getattr(self._source, "counts", {}))

    @property
    def without_frames(self) -> str:
        """Why no frame comes, as far as the source knows."""
        return str(getattr(self._source, "without_frames", super().without_frames))

    @property
    def is_over(self) -> bool:
        """Whether no further frame comes."""
        with self._changed:
            return (self._read_all or self._closed) and not self._arrived

    def poll(self, seconds: float) -> list[StreamedFrame]:
        """Return the frames that have arrived; wait up to `seconds` for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._read_all or self._closed, seconds)
            self._changed.notify_all()
            return self._take_all()

    def end(self) -> None:
        """Close the source, once."""
        if self._ended:
            return
        self._ended = True
        try:
            self._source.close()
        except Exception as error:  # A user's source may raise anything; earlier frames are kept.
            text = f"{self._name}: close failed ({type(error).__name__}: {error})"
            warnings.warn(text, HandSimWarning, stacklevel=3)

    def close(self) -> None:
        """Close the source, and end the thread."""
        self.end()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(END_TIME)  # A source that does not return now ends with the process.

    def _read(self) -> None:
        """Take frames from the source until it ends or is closed."""
        try:
            for frame in self._source:
                if self._ended or not self._put(_checked(frame)):
                    break
        except Exception as error:  # A user's source may raise anything.
            if not self._ended:  # A source closed while it waits may fail.
                text = f"{self._name}: the stream failed ({type(error).__name__}: {error})"
                self.error = CaptureError(text)
                self.error.__cause__ = error
        with self._changed:
            self._read_all = True
            self._changed.notify_all()

    def _put(self, frame: StreamedFrame) -> bool:
        """Queue a frame for the reader; return whether the reader is still there."""
        with self._changed:
            while len(self._arrived) >= _MOST_WAITING and not self.is_live and not self._closed:
                self._changed.wait()
            if math.isnan(frame.arrived):
                frame = dataclasses.replace(frame, arrived=time.monotonic())
            if self._pace and not abs(frame.time - self._pace[-1].time) < _SAME_PACE:
                self._pace.clear()
            self._pace.append(frame)
            if self._waits and len(self._pace) >= _FEWEST_PACE:
                first, last = self._pace[0], self._pace[-1]
                span = last.arrived - first.arrived
                self.is_live = last.time - first.time <= _PACE_RATIO * span + _PACE_SLACK
            self._add(frame)
            self._changed.notify_all()
            return not self._closed


def _checked(frame: StreamedFrame) -> StreamedFrame:
    """Validate a frame: arrays of the right types, and points without missing ones."""
    if not isinstance(frame, StreamedFrame):
        raise ArgumentError(f"a {type(frame).__name__} came, expected a track.StreamedFrame")
    points, ids = as_numbers("points", frame.points), as_numbers("ids", frame.ids, np.int64)
    if points.ndim != 2 or points.shape != (*ids.shape, 3):
        raise ArgumentError(f"points have shape {points.shape} and IDs {ids.shape}, expected (N, 3) and (N,)")
    if not abs(frame.time) < LATEST_TIME:
        raise ArgumentError(f"the time of frame {frame.number} is {frame.time}, expected seconds")
    if ids.size and not -1 <= ids.min() <= ids.max() < _ID_LIMIT:
        raise ArgumentError(f"IDs are from {ids.min()} to {ids.max()}, expected -1 to {_ID_LIMIT - 1}")
    there = np.isfinite(points).all(axis=1)
    return dataclasses.replace(frame, points=points[there], ids=ids[there])
