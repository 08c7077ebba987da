"""Frames of points, and what delivers them: a capture, a live stream, or a source of the user's own."""

from __future__ import annotations

import dataclasses
import queue
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Protocol, Self

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture
from gloves.captures.plausibility import check_place, check_unit
from gloves.optics.identities import number_runs
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from track.intake import FARTHEST
from track.streams.frame_order import LATEST

SILENCE: Final = 2.0
"""Time without a frame [s] after which a stream yields a silent frame."""
_LOOP_GAP: Final = 0.01  # [s] between the last frame of a recording and its first, when it starts again
_WAITING: Final = 256  # frames that may wait for the reader; the source waits after that
_STOP: Final = 0.1  # [s] between two looks at whether the stream shall end
_MOST_ID: Final = 1 << 31  # as takes store them
_LEAVE: Final = 1.0  # [s] for a source to end after `close`


@dataclass(frozen=True, slots=True, eq=False)
class StreamedFrame:
    """The points of one frame."""

    number: int
    """The server's number of the frame."""
    time: float
    """The server's time [s]."""
    points: Float[np.ndarray, "N 3"]
    """[m], in the server's axes."""
    ids: Int[np.ndarray, "N"]
    """The server's ID of each point, -1 where it gives none."""
    silent: bool = False
    """No frame arrived for a while: there are no points, and number and time are those of the last frame."""
    restarted: bool = False
    """The server's time began anew: it does not continue that of the frame before."""


class FrameSource(Protocol):
    """Delivers the frames of a system of the user's own, for `handsim track --live module:name`.

    The points of a frame are in [m], times in [s]. It is iterated in a thread of its own, once; waiting for
    the next frame is its own affair, and so is an end: after the last frame the take is written. An exception
    ends the stream in the same way, and is told.
    """

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The frames in the order of their times."""
        ...

    def close(self) -> None:
        """No further frame is wanted; called once, from another thread, while a frame may be waited for."""
        ...


def capture_frames(capture: Capture) -> Iterator[StreamedFrame]:
    """The frames of a capture as of a stream: points [m], IDs and times [s].

    Marker files have no IDs. Every format that is read has one column per trajectory, so a column is an ID
    for as long as it has a point. After a gap it is a new ID, because a column of unlabeled points may
    continue with another marker. Column names are not used.
    """
    present = np.isfinite(capture.positions[..., 0])
    ids = number_runs(present)
    for number, (points, seen) in enumerate(zip(capture.positions, present, strict=True)):
        yield StreamedFrame(number, number / capture.rate, points[seen], ids[number, seen])


def checked_frames(capture: Capture) -> list[StreamedFrame]:
    """The frames of a capture, if their points can be hands' markers.

    Args:
        capture: Positions (T, N, 3) [m].

    Raises:
        ArgumentError: The capture is not in meters.
        CaptureError: Most of its points are far from any room.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    check_place(capture, FARTHEST)
    return frames


class CountedFrames(Protocol):
    """Frames as they arrive, with silences; they end by themselves when the stream ends."""

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames so far, by name."""
        ...

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after each period of silence a silent frame."""
        ...

    def close(self) -> None:
        """End the stream."""
        ...


class LiveStream(Iterator[StreamedFrame]):
    """Frames of a live stream as a tracker takes them; the end of a `with` block or `close` ends it.

    Their time never goes back: when the stream's time begins anew, as in a recording that starts again, it
    continues. During a silence frames without points come, at the time that has passed.

    Args:
        frames: The frames as they arrive.
    """

    def __init__(self, frames: CountedFrames) -> None:
        self._frames = frames
        self._ahead, self._last = 0.0, -np.inf  # [s] of this time over the stream's; of the last frame
        self._heard = time.monotonic()

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames so far, by name."""
        return self._frames.counts

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after each period of silence a silent frame."""
        frame = next(self._frames)
        now = frame.time + self._ahead
        if frame.silent:
            return dataclasses.replace(frame, time=now + time.monotonic() - self._heard)
        waited, self._heard = time.monotonic() - self._heard, time.monotonic()
        if now <= self._last or frame.restarted:
            begin = self._last + max(_LOOP_GAP, waited) if self._last > -np.inf else 0.0
            self._ahead += begin - now
            now = begin
        self._last = now
        return dataclasses.replace(frame, time=now)

    def close(self) -> None:
        """End the stream; no further frame comes."""
        self._frames.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SourceStream(Iterator[StreamedFrame]):
    """Iterator of a source's frames; `close` ends it.

    A frame that comes while others wait is not lost: the source is asked for the next one later.

    Args:
        source: Delivers the frames.
        name: What messages call it.
        silence: Time without a frame after which the stream yields a silent frame [s].
        ended: The stream ends when this is true; it is asked several times a second.

    Raises:
        ArgumentError: The source is not a `FrameSource`.
    """

    def __init__(
        self,
        source: FrameSource,
        name: str,
        *,
        silence: float = SILENCE,
        ended: Callable[[], bool] = lambda: False,
    ) -> None:
        for method in ("__iter__", "close"):
            if not callable(getattr(source, method, None)):
                raise ArgumentError(
                    f"{name} has no method {method}, expected __iter__ and close of a frame source"
                )
        self._source, self._name, self._silence, self._ended = source, name, silence, ended
        self._missed = 0
        self._last: StreamedFrame | None = None
        self._left: int | None = None  # frames that are still read, once the stream shall end
        self._ready: queue.Queue[StreamedFrame | BaseException | None] = queue.Queue(_WAITING)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._read, name="frame source", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames so far."""
        return {"missing_frames": self._missed}

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after each period of silence a silent frame."""
        quiet = time.monotonic() + self._silence
        while not self._closed.is_set() and self._more():
            try:
                came = self._ready.get(timeout=min(_STOP, max(quiet - time.monotonic(), 1e-3)))
            except queue.Empty:
                if time.monotonic() < quiet:
                    continue
                number, last = (self._last.number, self._last.time) if self._last else (0, 0.0)
                return StreamedFrame(number, last, np.empty((0, 3)), np.empty(0, dtype=np.int64), silent=True)
            if came is None:
                break
            if isinstance(came, BaseException):
                self._left = 0
                raise CaptureError(f"{self._name}: the stream failed ({_told(came)})") from came
            return self._pass(came)
        self._left = 0
        raise StopIteration

    def close(self) -> None:
        """End the source; no further frame comes."""
        if self._closed.is_set():
            return
        self._closed.set()
        try:
            self._source.close()
        except Exception as error:  # of the user's code: any; what came before is kept
            warnings.warn(f"{self._name}: close failed ({_told(error)})", HandSimWarning, stacklevel=2)
        self._thread.join(_LEAVE)  # one that does not listen to `close` ends with the process

    def _more(self) -> bool:
        """Whether to wait for a frame; those that have come are still read when the stream shall end."""
        if self._left is None and self._ended():
            self._left = self._ready.qsize()
        if self._left is None:
            return True
        self._left -= 1
        return self._left >= 0

    def _pass(self, frame: StreamedFrame) -> StreamedFrame:
        if self._last is not None and not frame.restarted:
            self._missed += max(frame.number - self._last.number - 1, 0)
        self._last = frame
        return frame

    def _read(self) -> None:
        """Hand over every frame of the source, then its end or what ended it."""
        end: BaseException | None = None
        try:
            for frame in self._source:
                if not self._hand_over(_checked(frame)):
                    return
        except Exception as error:  # of the user's code: any
            end = error
        self._hand_over(end)

    def _hand_over(self, what: StreamedFrame | BaseException | None) -> bool:
        """Wait until there is room; returns whether the reader is still there."""
        while not self._closed.is_set():
            try:
                self._ready.put(what, timeout=_STOP)
            except queue.Full:
                continue
            return True
        return False


def _checked(frame: StreamedFrame) -> StreamedFrame:
    """The frame with arrays of the right types, without points that are missing."""
    if not isinstance(frame, StreamedFrame):
        raise ArgumentError(f"a {type(frame).__name__} came, expected a track.StreamedFrame")
    points, ids = np.asarray(frame.points, dtype=np.float64), np.asarray(frame.ids, dtype=np.int64)
    if points.ndim != 2 or points.shape != (*ids.shape, 3):
        raise ArgumentError(f"points have shape {points.shape} and IDs {ids.shape}, expected (N, 3) and (N,)")
    if not abs(frame.time) < LATEST:
        raise ArgumentError(f"the time of frame {frame.number} is {frame.time}, expected seconds")
    if ids.size and not -1 <= ids.min() <= ids.max() < _MOST_ID:
        raise ArgumentError(f"IDs are from {ids.min()} to {ids.max()}, expected -1 to {_MOST_ID - 1}")
    there = np.isfinite(points).all(axis=1)
    return dataclasses.replace(frame, points=points[there], ids=ids[there])


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
