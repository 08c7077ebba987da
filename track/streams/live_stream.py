"""Live streams for a tracker: in order, on a clock that never goes back, without outdated frames.

Each arriving frame is passed on once, in order, or counted; docs/tracking.md says how long frames wait behind
a gap. A frame continues the stream if its steps in time and number agree, and its time is at most sixteen
frames ahead of its arrival. Any other frame is a jump. A jump is accepted only when five successive frames
fit together, as after a restart of a recording or server. Frames of shorter jumps are dropped as wild.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Final

import numpy as np

from gloves.captures.text import MAX_RATE
from handsim._checks import check_number, check_type
from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, HandSimError
from track.frames import FARTHEST, LATEST_TIME, StreamedFrame
from track.streams import NoServerError, split_address
from track.streams.frame_source import END_TIME, ArrivingFrames, FrameSource, SourceStream

VALID: Final = ("natnet://host", "natnet://host:port", "qtm://host", "qtm://host:port", "module:name")
"""Valid forms of an address."""
GROUP: Final = "handsim.frame_sources"
"""Entry points of packages that provide frame sources."""
MOST_LAG: Final = 0.03
"""Longest time that a frame waits for a reader that was briefly busy [s]."""
_EMPTY_TIME: Final = 2.0  # [s] Frames without any point are reported after this time.
_FAR_SHARE: Final = 0.5  # A larger share of points out of range suggests a wrong unit.
_SILENCE: Final = 2.0  # [s] A silent frame is produced after this time without a frame.
_LEAST_LAG: Final = 0.01  # [s] longest time that a frame waits for a reader that is always too slow
_TOO_SLOW_TIME: Final = 0.1  # [s] A reader is too slow if frames have waited without a break for this time.
_MOST_FORGIVEN: Final = 2.0  # [s] longest lag that is forgiven
_CATCH_UP_RATE: Final = 1.0  # [s/s] rate at which a forgiven lag must shrink
_LOOP_GAP: Final = 0.01  # [s] between the last frame of a recording and its first one when repeated
_POLL_PERIOD: Final = 0.1  # [s] longest time between calls of `ended`
_MOST_HELD: Final = 8  # largest number of frames held behind a gap
_MOST_LEAD: Final = 16  # largest lead of a frame's time over its arrival [frames]
_FEWEST_IN_A_ROW: Final = 5  # A jump is accepted after this many successive frames.
_GAP_WAIT: Final = 0.03  # [s] longest time that a frame is held behind a gap
_GAP_WAIT_FRAMES: Final = 5  # longest time behind a gap in slower streams [frames]
_LONGEST_WAIT: Final = 0.1  # [s] longest time that any stream holds a frame; disordered streams use it
_DISORDER_TIME: Final = 10.0  # [s] A stream counts as disordered for this time.
_RESTART_AGE: Final = 1.0  # [s] A frame older than the last by more is from a restarted recording.
_BURST_TIME: Final = 0.5  # [s] Late frames of a recording may arrive this long after the last one.
_MOST_JUMP: Final = 1.0  # [s] longest jump in time within one recording
_FIRST_SLACK: Final = 0.05  # [s] tolerance of a frame's time before the interval is known
_FIRST_WAIT: Final = 0.1  # [s] time that the first frame is held
_TIME_SLACK: Final = 0.001  # [s] tolerance of time stamps, added to half an interval
_CLOCK_DRIFT: Final = 0.01  # largest relative difference between two clocks' rates
_INTERVAL_WEIGHT: Final = 0.1  # weight of the newest interval in the mean
_MOST_CHANGE: Final = 2.0  # Intervals enter the mean with at most this ratio to it.
_MOST_JUMPING: Final = 4 * _MOST_HELD  # largest number of held frames of jumps
_MOST_RECENT: Final = 256  # number of newest frames searched for duplicates
_NUM_STRIDES: Final = 16  # number of frames that determine the server's step


def check_address(address: str) -> str:
    """Scheme of a stream's address, checked without asking a server."""
    check_type("address", address, str, f"one of {', '.join(VALID)}")
    scheme, _, rest = address.rpartition("://")
    name = rest.partition("?")[0]
    if scheme not in ("natnet", "qtm") and (scheme or not (is_plugin(name) or name in list_plugins(GROUP))):
        raise ArgumentError(f"'{address}' is not an address of a stream, expected {', '.join(VALID)}")
    return scheme


def open_source(
    address: str | FrameSource, *, silence: float = _SILENCE, ended: Callable[[], bool] = lambda: False
) -> LiveStream:
    """Open a live stream; its frames are iterated in a `with` block.

    A frame has `points` (N, 3) [m], `ids` (N,) and a `time` [s] that never goes back, as for `Tracker.step`.
    If the reader is too slow, the oldest frames are dropped, see `LiveStream`.

    Args:
        address: One of `VALID`. `module:name?option=value` passes options to a user's own source, which can
            also be given as an object.
        silence: A silent frame is produced after this time without a frame [s].
        ended: The stream ends when this returns True; it is called before each frame, and several times a
            second while none comes.

    Raises:
        ArgumentError: The address or the time is invalid, or there is no such source.
        CaptureError: No server answers.
    """
    check_number("silence", silence, 0.0, above=True)
    frames: ArrivingFrames
    if not isinstance(address, str):
        check_type("address", address, Iterable, f"one of {', '.join(VALID)}, or a frame source")
        frames = SourceStream(address, type(address).__name__)
    elif check_address(address) == "natnet":
        from track.streams.natnet import open_stream

        frames = open_stream(address)
    elif address.startswith("qtm://"):
        from track.streams.qualisys import PORT, QualisysSource

        host, port, _ = split_address(address, options={}, port=PORT)
        frames = SourceStream(QualisysSource(host, port), address, waits=False)
    else:
        try:
            source = make_plugin(address, group=GROUP, noun="frame source")
        except HandSimError as error:
            if isinstance(error.__cause__, ConnectionError | TimeoutError):
                raise NoServerError(str(error)) from error
            raise
        frames = SourceStream(source, address.partition("?")[0])
    return LiveStream(frames, silence=silence, ended=ended)


class LiveStream(Closing, Iterator[StreamedFrame]):
    """Frames of a live stream for a tracker; a `with` block or `close` ends it.

    Frames are in order, and their time never goes back: when the stream's time restarts, as in a repeated
    recording, the time here continues. During a silence frames without points come, with the current time.
    Points 1000 m or more from the origin are dropped and counted. A frame that has waited for `MOST_LAG`
    while newer ones came is dropped and counted; if the reader is too slow all the time, so that frames
    always wait, this limit is a third.

    Args:
        frames: Frames as they arrive.
        silence: A silent frame is produced after this time without a frame [s].
        ended: The stream ends when this returns True, after all that has arrived; it is called before each
            frame, and several times a second while none comes.
    """

    def __init__(
        self, frames: ArrivingFrames, *, silence: float = _SILENCE, ended: Callable[[], bool] = lambda: False
    ) -> None:
        self.order = FrameOrder()
        """Puts the frames in order."""
        self.dropped = 0
        """Number of frames dropped because the reader was too slow."""
        self.points = self.far_points = 0
        """Numbers of all points, and of those out of range."""
        self.forgiven_until = -math.inf
        """Monotonic time until which a lag is forgiven [s]."""
        self._frames, self._silence, self._ended = frames, silence, ended
        self._ahead = 0.0  # [s] of this clock over the stream's
        self._last: StreamedFrame | None = None  # on this clock
        self._began = math.inf  # [s] when the first frame was passed on
        self._ready: deque[tuple[StreamedFrame, float]] = deque()  # in order, with times of arrival [s]
        self._kept_up = time.monotonic()  # [s] when the reader last waited
        self._end_at = math.inf  # [s] when `end` was called
        self._over = self._closed = self._failed = False

    @property
    def counts(self) -> dict[str, int]:
        """Counts of the frames so far, by name.

        Received frames are in order, reordered, doubled, late, with wild times, or waiting; dropped frames
        are among those in order or reordered.
        """
        order, lost = self.order, self._frames.lost
        return {
            "received_frames": order.received + lost,
            "frames_in_order": order.passed - order.reordered,
            "reordered_frames": order.reordered,
            "doubled_frames": order.doubled,
            "late_frames": order.late,
            "frames_with_wild_times": order.wild,
            "dropped_frames": self.dropped + lost,
            "missing_frames": max(order.missed - lost, 0),
            "missing_at_end": order.missing_at_end(self._end_at) if self._end_at < math.inf else 0,
            "restarts": order.restarts,
            "points_out_of_range": self.far_points,
            **self._frames.counts,
        }

    @property
    def point_doubt(self) -> str:
        """A sentence if the stream has no points or too distant ones; otherwise an empty one."""
        if not self.points and time.monotonic() > self._began + _EMPTY_TIME:
            return f"frames arrive, but no point was in any of them; {self._frames.without_points}"
        if self.far_points <= _FAR_SHARE * self.points:
            return ""
        return (
            f"{self.far_points} of {self.points} points lie {FARTHEST:.0f} m or more from the origin and are "
            "left out; are they millimeters? Set the unit of the stream to meters"
        )

    @property
    def silence_doubt(self) -> str:
        """Why no frame comes, as far as the source knows."""
        return self._frames.without_frames

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; return a silent frame after each period of silence.

        Raises:
            CaptureError: A user's own source failed.
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

    def forgive(self) -> None:
        """Drop no frame because of the time that the reader has needed so far, if it catches up.

        The current lag, at most two seconds, is forgiven, less one second for each second from now on.
        """
        self._line_up(0.0)
        now = time.monotonic()
        oldest = min((since for _, since in self._ready), default=now)
        self.forgiven_until = now + min(now - oldest, _MOST_FORGIVEN) / _CATCH_UP_RATE

    def end(self, at: float = math.inf) -> None:
        """End the stream after what has arrived, or earlier at a monotonic time `at` [s]."""
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
        """Put the frames that have arrived in order; wait up to `seconds` for one."""
        if self._over or (self._ready and not self._frames.is_live):
            return
        for frame in self._frames.poll(min(max(seconds, 0.0), _POLL_PERIOD)):
            passed = (*self.order.expire(frame.arrived), *self.order.add(frame))
            self._ready.extend((one, frame.arrived) for one in passed)
        now = time.monotonic()
        self._over = self._frames.is_over or now > self._end_at + END_TIME
        waited = self.order.end() if self._over else self.order.expire(now)
        self._ready.extend((one, now) for one in waited)

    def _drop_old(self) -> None:
        """Drop frames that have waited for too long while newer ones came."""
        if self._over or not self._frames.is_live:
            return
        now = time.monotonic()
        most = MOST_LAG if now < self._kept_up + _TOO_SLOW_TIME else _LEAST_LAG
        most += max(0.0, _CATCH_UP_RATE * (self.forgiven_until - now))
        while len(self._ready) > 1 and now - self._ready[0][1] > most:
            dropped, _ = self._ready.popleft()
            self.dropped += 1
            if dropped.restarted:
                frame, waits_since = self._ready[0]
                self._ready[0] = (dataclasses.replace(frame, restarted=True), waits_since)

    def _continue(self, frame: StreamedFrame) -> StreamedFrame:
        """Put a frame onto this clock, and drop points out of range."""
        now, last = frame.time + self._ahead, self._last
        if last is not None and (now <= last.time or frame.restarted):
            begin = last.time + max(_LOOP_GAP, frame.arrived - last.arrived)
            self._ahead += begin - now
            now = begin
        near = (np.abs(frame.points) < FARTHEST).all(axis=1)
        self._began = min(self._began, time.monotonic())
        self.points += len(near)
        self.far_points += int((~near).sum())
        if not near.all():
            frame = dataclasses.replace(frame, points=frame.points[near], ids=frame.ids[near])
        self._last = dataclasses.replace(frame, time=now)
        return self._last

    def _silent(self) -> StreamedFrame:
        """A frame that stands for a silence, with the current time."""
        now, last = time.monotonic(), self._last
        number, shown = (last.number, last.time + now - last.arrived) if last is not None else (0, 0.0)
        points, ids = np.empty((0, 3)), np.empty(0, dtype=np.int64)
        return StreamedFrame(number, shown, points, ids, silent=True, arrived=now)


class FrameOrder:
    """Passes frames on in order, and counts all others.

    Each `received` frame is `passed` (perhaps `reordered`), `doubled`, too `late`, or `wild`: with a time or
    number that the stream did not follow. `missed` counts frames that never arrived, by the numbers of
    others; `restarts` counts those of the stream's time.
    """

    def __init__(self) -> None:
        self.received = self.passed = self.reordered = self.doubled = 0
        self.late = self.wild = self.missed = self.restarts = 0
        self._last: StreamedFrame | None = None
        self._first: StreamedFrame | None = None  # since the time began
        self._held: list[StreamedFrame] = []  # frames behind a gap, ordered by time
        self._jumping: dict[StreamedFrame, int] = {}  # frames of jumps by arrival, with `passed`
        self._in_a_row = 0  # number of successive frames of a jump
        self._recent: dict[tuple[int, float], float] = {}  # arrival by number and time
        self._strides: deque[int] = deque(maxlen=_NUM_STRIDES)
        self._interval: float | None = None  # [s] per frame number
        self._disordered = -math.inf  # [s] when a frame was last out of order

    @property
    def interval(self) -> float:
        """Time between frames [s]; NaN while unknown."""
        return math.nan if self._interval is None else self._interval * self._stride

    def missing_at_end(self, end: float) -> int:
        """Number of frames that could have been sent from the last one to `end` [s]; 0 if below three."""
        if self._last is None or self._interval is None:
            return 0
        missing = math.floor((end - self._last.arrived) / self.interval)
        return missing if missing > 2 else 0

    @property
    def deadline(self) -> float:
        """Time at which `expire` must be called [s]; infinite while no frame is held."""
        if self._held:
            return min(frame.arrived for frame in self._held) + self._wait
        if self._last is None and self._jumping:
            return next(iter(self._jumping)).arrived + _FIRST_WAIT
        return math.inf

    def add(self, frame: StreamedFrame) -> Iterator[StreamedFrame]:
        """Add an arrived frame; yield the frames to pass on now."""
        self.received += 1
        last = self._last
        if not abs(frame.time) < LATEST_TIME:
            self.wild += 1
        elif frame.restarted:
            yield from self.end()
            yield from self._begin([frame], restarted=self._last is not None)
        elif self._is_again(frame):
            self.doubled += 1
        elif last is not None and self._is_late(last, frame):
            self.late += 1
            if self._first is not None and frame.time > self._first.time:
                self.missed -= self.missed > 0  # it was counted as missing before
            self._remember(frame)
            self._disordered = frame.arrived
        elif last is not None and self._is_next(last, frame):
            self._hold_confirmed(last, frame)
            self._hold(frame)
            yield from self._release()
        else:
            yield from self._hold_jump(frame)

    def expire(self, now: float) -> Iterator[StreamedFrame]:
        """Yield held frames that have waited long enough for missing ones."""
        if not self.deadline <= now:
            return
        if self._last is None:
            yield from self._begin(max(map(self._group_of, self._jumping), key=len))
            return
        while self._held and self.deadline <= now:
            yield self._pass(self._held.pop(0))
        yield from self._release()

    def end(self) -> Iterator[StreamedFrame]:
        """Yield all held frames, without those of an unconfirmed jump."""
        if self._last is None and self._jumping:
            yield from self._begin(max(map(self._group_of, self._jumping), key=len))
        yield from self._release(every=True)
        self._leave_out_jumping(len(self._jumping))

    @property
    def _wait(self) -> float:
        """Time for which frames are held behind a gap [s]."""
        newest = max(frame.arrived for frame in self._held)
        if newest - self._disordered < _DISORDER_TIME or self._interval is None:
            return _LONGEST_WAIT
        return min(max(_GAP_WAIT, _GAP_WAIT_FRAMES * self.interval), _LONGEST_WAIT)

    @property
    def _stride(self) -> int:
        """Step of the frame numbers; some servers send only every other frame."""
        return max(1, min(self._strides)) if len(self._strides) == _NUM_STRIDES else 1

    def _hold(self, frame: StreamedFrame) -> None:
        """Insert a frame into the held ones."""
        if self._held and frame.time < self._held[-1].time:
            self.reordered += 1
            self._disordered = frame.arrived
        bisect.insort(self._held, frame, key=lambda one: one.time)

    def _release(self, *, every: bool = False) -> Iterator[StreamedFrame]:
        """Pass held frames on, up to the next gap unless too many are held; all with `every`."""
        while self._held and (every or len(self._held) > _MOST_HELD or not self._is_behind_gap()):
            yield self._pass(self._held.pop(0))

    def _is_behind_gap(self) -> bool:
        """Whether a frame is missing before the first held one."""
        last = self._last
        if last is None or not self._missing(last, self._held[0]):
            return False
        # If a later frame has the expected number, the first one's number is wrong: nothing is missing.
        return all(one.number - last.number > place for place, one in enumerate(self._held, start=1))

    def _pass(self, frame: StreamedFrame) -> StreamedFrame:
        """Count a frame that is passed on, and update the interval."""
        last, self._last = self._last, frame
        self.passed += 1
        self._remember(frame)
        if last is None or frame.restarted:
            return frame
        self.missed += self._missing(last, frame)
        span, steps = frame.time - last.time, frame.number - last.number
        if steps >= 1 and span > 0.0:
            self._strides.append(steps)
            newest = span / steps
            usual = newest if self._interval is None else self._interval
            newest = min(max(newest, usual / _MOST_CHANGE), usual * _MOST_CHANGE)
            self._interval = usual + _INTERVAL_WEIGHT * (newest - usual)
        return frame

    def _hold_jump(self, frame: StreamedFrame) -> Iterator[StreamedFrame]:
        """Hold a frame that jumps, or accept the jump if it has lasted."""
        self._jumping[frame] = self.passed
        group = self._group_of(frame)
        self._in_a_row = min(self._in_a_row + 1, len(group))
        if self._in_a_row >= _FEWEST_IN_A_ROW:
            yield from self._begin(group)
        elif len(self._jumping) > _MOST_JUMPING:
            self._leave_out_jumping(1)

    def _hold_confirmed(self, last: StreamedFrame, frame: StreamedFrame) -> None:
        """Hold frames of jumps that the stream's next frame confirms; drop old ones."""
        self._in_a_row = 0
        between = [one for one in self._jumping if last.time < one.time < frame.time]
        right = [one for one in between if self._continues(one, frame)]
        for one in right:
            del self._jumping[one]
            self._hold(one)
        self._leave_out_jumping(sum(self.passed - passed > _MOST_HELD for passed in self._jumping.values()))

    def _leave_out_jumping(self, count: int) -> None:
        """Drop the `count` oldest frames of jumps, and count them as `wild`."""
        self.wild += count
        for one in list(self._jumping)[:count]:
            del self._jumping[one]

    def _group_of(self, frame: StreamedFrame) -> list[StreamedFrame]:
        """Frames of jumps in the same recording as one of them, in order of arrival."""
        group = [one for one in self._jumping if one is frame or self._fits(one, frame)]
        ordered = _increasing(sorted(group, key=lambda one: one.time))
        return [one for one in group if one in ordered]

    def _begin(self, group: list[StreamedFrame], *, restarted: bool | None = None) -> Iterator[StreamedFrame]:
        """Continue the stream with frames of an accepted jump, in the same or another recording."""
        for one in group:
            self._jumping.pop(one, None)
        self._leave_out_jumping(len(self._jumping))
        self._in_a_row = 0
        yield from self._release(every=True)
        ordered = sorted(group, key=lambda one: one.time)
        last = self._last
        if restarted is None:
            restarted = last is not None and not self._is_same_recording(ordered[0])
        if last is None or restarted:
            self.restarts += restarted
            self._first = ordered[0]
            self._recent.clear()
            self._strides.clear()
            self._interval = _usual_interval(ordered)
        for one in group:
            self._hold(one)
        if restarted:
            self._held[0] = dataclasses.replace(self._held[0], restarted=True)
            yield self._pass(self._held.pop(0))
        yield from self._release()

    def _is_again(self, new: StreamedFrame) -> bool:
        """Whether the same frame came before."""
        key = new.number, new.time
        came = [one.arrived for one in (*self._held, *self._jumping) if (one.number, one.time) == key]
        came.append(self._recent.get(key, -math.inf))
        return any(abs(arrived - new.arrived) < _BURST_TIME for arrived in came)

    def _remember(self, frame: StreamedFrame) -> None:
        """Store a frame that was passed on or too late, to recognize it when it comes again."""
        self._recent[frame.number, frame.time] = frame.arrived
        if len(self._recent) > _MOST_RECENT:
            del self._recent[next(iter(self._recent))]

    def _is_late(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether a frame precedes one that was passed on."""
        return -_RESTART_AGE < new.time - last.time <= 0.0 and new.arrived - last.arrived < _BURST_TIME

    def _is_next(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether a frame follows the last one, or fits the frames held behind a gap."""
        if new.time <= last.time:
            return False
        return self._continues(last, new) or bool(self._held and self._fits(self._held[-1], new))

    def _continues(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether a frame follows another one: its steps in time and number agree and are short."""
        return new.time - last.time <= self._reach(new.arrived - last.arrived) and self._agrees(last, new)

    def _fits(self, one: StreamedFrame, other: StreamedFrame) -> bool:
        """Whether two frames, in any order, may be of the same recording."""
        first, second = sorted((one, other), key=lambda frame: frame.time)
        span, steps = second.time - first.time, second.number - first.number
        if not 0.0 < span <= self._reach(abs(one.arrived - other.arrived)):
            return False
        rate = MAX_RATE if self._interval is None else 1.5 / self._interval
        return 0 <= steps <= rate * (span + _TIME_SLACK) + 1.0

    def _reach(self, waited: float) -> float:
        """Largest step in time of a frame that arrived `waited` seconds after another [s]."""
        ahead = _FIRST_SLACK if self._interval is None else (_MOST_LEAD + 0.5) * self.interval + _TIME_SLACK
        return waited + ahead

    def _agrees(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether the steps in time and number agree, or those in time and arrival."""
        span, waited = new.time - last.time, new.arrived - last.arrived
        steps = new.number - last.number
        if self._interval is None:
            return 0.0 < span <= waited + _FIRST_SLACK and 0 <= steps <= MAX_RATE * span + 1.0
        longest = max(waited, max(steps, 1) * self._interval) + 0.5 * self._interval + _TIME_SLACK
        return 0.0 < span <= longest and 0 <= steps <= 1.5 * (span + _TIME_SLACK) / self._interval + 1.0

    def _is_same_recording(self, new: StreamedFrame) -> bool:
        """Whether an accepted jump continues the recording, judged by the time since its start."""
        last, first = self._last, self._first
        if last is None or first is None:
            return True
        possible = (1.0 + _CLOCK_DRIFT) * (new.arrived - first.arrived) + _MOST_JUMP
        if new.time - first.time > possible:
            return False
        return 0.0 < new.time - last.time <= _MOST_JUMP or self._agrees(last, new)

    def _missing(self, last: StreamedFrame, new: StreamedFrame) -> int:
        """Number of frames missing between two, by their numbers if these agree with their times."""
        steps = new.number - last.number
        if self._interval is not None:
            steps = min(steps, round(1.5 * (new.time - last.time) / self._interval))
        return max(-(-steps // self._stride) - 1, 0)


def _increasing(ordered: list[StreamedFrame]) -> list[StreamedFrame]:
    """Longest subsequence of frames, ordered by time, whose numbers do not decrease."""
    longest: list[list[StreamedFrame]] = []
    for frame in ordered:
        before = [chain for chain in longest if chain[-1].number <= frame.number]
        longest.append([*max(before, key=len, default=[]), frame])
    return max(longest, key=len, default=[])


def _usual_interval(ordered: list[StreamedFrame]) -> float | None:
    """Median time per frame number [s]; None if the numbers do not increase."""
    steps = [(second.time - first.time, second.number - first.number) for first, second in pairwise(ordered)]
    intervals = [span / count for span, count in steps if count > 0 and span > 0.0]
    return float(np.median(intervals)) if intervals else None
