"""Order and time of a stream's frames: every frame that arrived goes on once, in order; the rest is counted.

A frame that continues the stream goes on at once. Only behind a gap in the numbers frames are held, until
the gap is closed, eight frames are held, or their time is up: 30 ms, or five frames of a slower stream; a
tenth of a second where others have come out of order in the last ten seconds. What is then still missing is
counted.

A frame continues the stream when its time and its number go on by no more than they explain each other, and
its time by no more than its arrival explains, and sixteen frames. Any other frame is a jump, which is
believed only when it lasts: when five frames in a row fit together, as those of a recording or a server that
starts again. Fewer are wild, and left out.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Final

import numpy as np

from gloves.captures.text import HIGHEST_RATE
from track.frames import LATEST_TIME
from track.streams.frame_source import StreamedFrame

WINDOW: Final = 8
"""Frames that are held behind a gap, at most."""
REACH: Final = 16
"""Frames by which a stream may go on at once, beside what the arrival explains."""
LASTING: Final = 5
"""Frames in a row that a jump is believed from."""
_WAIT: Final = 0.03  # [s] for which a frame is held behind a gap
_WAIT_FRAMES: Final = 5  # or so many frames, if they take longer
_LONGEST_WAIT: Final = 0.1  # [s], the most of either, and where frames come out of order
_REMEMBERED: Final = 10.0  # [s] for which a stream that was out of order is taken to be so
_OLD: Final = 1.0  # [s]: a frame that is older by more belongs to a recording that starts again
_BURST: Final = 0.5  # [s] from the last frame, within which frames of the same recording may arrive late
_GOES_ON: Final = 1.0  # [s] by which a jump that lasts may go on with the same recording
_FIRST_SLACK: Final = 0.05  # [s]: tolerance of a frame's time while the interval is unknown
_FIRST_WAIT: Final = 0.1  # [s] for which the first frame is held
_SLACK: Final = 0.001  # [s]: tolerance of time stamps beside half an interval
_DRIFT: Final = 0.01  # by which two clocks may run at another pace
_SMOOTHING: Final = 0.1  # share of the newest interval in the usual one
_MOST_CHANGE: Final = 2.0  # factor by which an interval differs from the usual one, at most, as it counts
_MOST_DOUBTFUL: Final = 4 * WINDOW  # frames of jumps that are held
_RECENT: Final = 256  # frames among which one that comes twice is found
_STRIDES: Final = 16  # frames whose numbers show the server's step


class FrameOrder:
    """Decides which frames go on, in which order, and counts what becomes of the others."""

    def __init__(self) -> None:
        self.received = 0
        """Number of frames that came."""
        self.passed = 0
        """Number of frames that went on."""
        self.reordered = 0
        """Number of those that came after one that they precede."""
        self.doubled = 0
        """Number of frames that came again."""
        self.late = 0
        """Number of frames that came too late to go on in order."""
        self.wild = 0
        """Number of frames with a time or a number that the stream did not follow."""
        self.missed = 0
        """Number of frames that never arrived, by the frame numbers."""
        self.restarts = 0
        """How often the time of the stream began anew."""
        self._last: StreamedFrame | None = None
        self._first: StreamedFrame | None = None  # since the time began
        self._held: list[StreamedFrame] = []  # behind a gap, by their times
        self._doubtful: list[StreamedFrame] = []  # that jump, as they came
        self._in_a_row = 0  # of them
        self._since: deque[int] = deque()  # how many had gone on when each came
        self._recent: dict[tuple[int, float], float] = {}  # number and time of those that went on: arrival
        self._strides: deque[int] = deque(maxlen=_STRIDES)
        self._interval: float | None = None  # [s] per frame number
        self._disordered = -math.inf  # [s], when a frame came out of order

    @property
    def interval(self) -> float:
        """Time from frame to frame [s]; NaN while it is not known."""
        return math.nan if self._interval is None else self._interval * self._stride

    def missing_at_end(self, end: float) -> int:
        """How many frames could have been sent after the last one, until some time [s]; 0 for one or two."""
        if self._last is None or self._interval is None:
            return 0
        missing = math.floor((end - self._last.arrived) / self.interval)
        return missing if missing > 2 else 0

    @property
    def deadline(self) -> float:
        """When `expire` is to be called [s]; infinite when nothing waits."""
        if self._held:
            return min(frame.arrived for frame in self._held) + self._wait
        if self._last is None and self._doubtful:
            return self._doubtful[0].arrived + _FIRST_WAIT
        return math.inf

    def add(self, frame: StreamedFrame) -> Iterator[StreamedFrame]:
        """The frames that go on now that another has arrived."""
        self.received += 1
        if not abs(frame.time) < LATEST_TIME:
            self.wild += 1
        elif frame.restarted:
            yield from self.end()
            yield from self._begin([frame], restarted=self._last is not None)
        elif self._is_again(frame):
            self.doubled += 1
        elif self._last is None or not (self._is_late(frame) or self._is_next(frame)):
            yield from self._doubt(frame)
        elif self._is_late(frame):
            self.late += 1
            if self._first is not None and frame.time > self._first.time:
                self.missed -= self.missed > 0  # it was missing when others went on
            self._remember(frame)
            self._disordered = frame.arrived
        else:
            self._settle(frame)
            self._hold(frame)
            yield from self._release()

    def expire(self, now: float) -> Iterator[StreamedFrame]:
        """The held frames whose time is up: what they waited for did not come."""
        if not self.deadline <= now:
            return
        if self._last is None:
            yield from self._begin(self._largest_group())
            return
        while self._held and self.deadline <= now:
            yield self._pass(self._held.pop(0))
        yield from self._release()

    def end(self) -> Iterator[StreamedFrame]:
        """All frames that are held; a jump that has not lasted is left out."""
        if self._last is None and self._doubtful:
            yield from self._begin(self._largest_group())
        while self._held:
            yield self._pass(self._held.pop(0))
        self._leave_out_doubtful(len(self._doubtful))

    @property
    def _wait(self) -> float:
        """For how long a frame is held behind a gap [s]."""
        newest = max(frame.arrived for frame in self._held)
        if newest - self._disordered < _REMEMBERED or self._interval is None:
            return _LONGEST_WAIT
        return min(max(_WAIT, _WAIT_FRAMES * self.interval), _LONGEST_WAIT)

    @property
    def _stride(self) -> int:
        """By how much numbers go on from frame to frame; some servers send every other frame only."""
        return max(1, min(self._strides)) if len(self._strides) == _STRIDES else 1

    def _hold(self, frame: StreamedFrame) -> None:
        """Put a frame among those that are held."""
        if self._held and frame.time < self._held[-1].time:
            self.reordered += 1
            self._disordered = frame.arrived
        bisect.insort(self._held, frame, key=lambda one: one.time)

    def _release(self) -> Iterator[StreamedFrame]:
        """Pass on what nothing is missing before, or too much is held behind."""
        while self._held and (len(self._held) > WINDOW or not self._is_behind_gap()):
            yield self._pass(self._held.pop(0))

    def _is_behind_gap(self) -> bool:
        """Whether a frame is missing before the first one that is held.

        Where a later one has the number that it should have, its own number is wrong, not the order.
        """
        last = self._last
        if last is None or not self._missing(last, self._held[0]):
            return False
        return all(one.number - last.number > place for place, one in enumerate(self._held, start=1))

    def _pass(self, frame: StreamedFrame) -> StreamedFrame:
        """Let a frame go on."""
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
            self._interval = usual + _SMOOTHING * (newest - usual)
        return frame

    def _doubt(self, frame: StreamedFrame) -> Iterator[StreamedFrame]:
        """Hold a frame that jumps, or believe it and those that it fits to."""
        self._doubtful.append(frame)
        self._since.append(self.passed)
        group = self._group_of(frame)
        self._in_a_row = min(self._in_a_row + 1, len(group))
        if self._in_a_row >= LASTING:
            yield from self._begin(group)
        elif len(self._doubtful) > _MOST_DOUBTFUL:
            self._leave_out_doubtful(1)

    def _settle(self, frame: StreamedFrame) -> None:
        """The stream goes on: of the frames that jump, those before this one were right."""
        self._in_a_row = 0
        if not self._doubtful or self._last is None:
            return
        right = [
            one
            for one in self._doubtful
            if self._last.time < one.time < frame.time and self._continues(one, frame)
        ]
        self._forget(right)
        for one in right:
            self._hold(one)
        self._leave_out_doubtful(sum(self.passed - passed > WINDOW for passed in self._since))

    def _leave_out_doubtful(self, count: int) -> None:
        """The oldest of the frames that jump were wild."""
        self.wild += count
        self._forget(self._doubtful[:count])

    def _forget(self, frames: list[StreamedFrame]) -> None:
        """Take frames from those that jump."""
        kept = [pair for pair in zip(self._doubtful, self._since, strict=True) if pair[0] not in frames]
        self._doubtful = [frame for frame, _ in kept]
        self._since = deque(passed for _, passed in kept)

    def _group_of(self, frame: StreamedFrame) -> list[StreamedFrame]:
        """The frames that jump to the same place as one of them, as they came."""
        group = [one for one in self._doubtful if one is frame or self._fit(one, frame)]
        ordered = _increasing(sorted(group, key=lambda one: one.time))
        return [one for one in group if one in ordered]

    def _largest_group(self) -> list[StreamedFrame]:
        return max((self._group_of(one) for one in self._doubtful), key=len)

    def _begin(
        self, group: Iterable[StreamedFrame], *, restarted: bool | None = None
    ) -> Iterator[StreamedFrame]:
        """Go on with frames that jumped: with the same recording, or with another one."""
        group = list(group)
        self._forget(group)
        self._leave_out_doubtful(len(self._doubtful))
        self._in_a_row = 0
        while self._held:
            yield self._pass(self._held.pop(0))
        ordered = sorted(group, key=lambda one: one.time)
        last = self._last
        if restarted is None:
            restarted = last is not None and not self._goes_on(ordered[0])
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
        """Whether a frame is one that came before."""
        key = new.number, new.time
        came = [one.arrived for one in (*self._held, *self._doubtful) if (one.number, one.time) == key]
        came.append(self._recent.get(key, -math.inf))
        return any(abs(arrived - new.arrived) < _BURST for arrived in came)

    def _remember(self, frame: StreamedFrame) -> None:
        """Know a frame that went on, or was too late, when it comes again."""
        self._recent[frame.number, frame.time] = frame.arrived
        if len(self._recent) > _RECENT:
            del self._recent[next(iter(self._recent))]

    def _is_late(self, new: StreamedFrame) -> bool:
        """Whether a frame precedes one that has gone on."""
        last = self._last
        if last is None:
            return False
        span = new.time - last.time
        return -_OLD < span <= 0.0 and new.arrived - last.arrived < _BURST

    def _is_next(self, new: StreamedFrame) -> bool:
        """Whether a frame follows the last one, or is one of those that are held behind a gap."""
        last, held = self._last, self._held
        if last is None or new.time <= last.time:
            return False
        return self._continues(last, new) or bool(held and self._fit(held[-1], new))

    def _continues(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether a frame follows another: time and number go on by no more than is explained."""
        return new.time - last.time <= self._reach(new.arrived - last.arrived) and self._agrees(last, new)

    def _fit(self, one: StreamedFrame, other: StreamedFrame) -> bool:
        """Whether two frames are of the same recording, in any order."""
        first, second = sorted((one, other), key=lambda frame: frame.time)
        waited = abs(one.arrived - other.arrived)
        span, steps = second.time - first.time, second.number - first.number
        if not 0.0 < span <= self._reach(waited):
            return False
        rate = HIGHEST_RATE if self._interval is None else 1.5 / self._interval
        return 0 <= steps <= rate * (span + _SLACK) + 1.0

    def _reach(self, waited: float) -> float:
        """By how much a frame's time may go on that came so much later than another [s]."""
        ahead = _FIRST_SLACK if self._interval is None else (REACH + 0.5) * self.interval + _SLACK
        return waited + ahead

    def _agrees(self, last: StreamedFrame, new: StreamedFrame) -> bool:
        """Whether time and number go on by no more than they explain each other, or the arrival the time."""
        span, waited = new.time - last.time, new.arrived - last.arrived
        steps = new.number - last.number
        if self._interval is None:
            return 0.0 < span <= waited + _FIRST_SLACK and 0 <= steps <= HIGHEST_RATE * span + 1.0
        longest = max(waited, max(steps, 1) * self._interval) + 0.5 * self._interval + _SLACK
        return 0.0 < span <= longest and 0 <= steps <= 1.5 * (span + _SLACK) / self._interval + 1.0

    def _goes_on(self, new: StreamedFrame) -> bool:
        """Whether a jump that lasts goes on with the recording, of which frames are missing.

        As many as could have been sent since the recording began, by when they arrived.
        """
        last, first = self._last, self._first
        if last is None or first is None:
            return True
        possible = (1.0 + _DRIFT) * (new.arrived - first.arrived) + _GOES_ON
        if new.time - first.time > possible:
            return False
        return 0.0 < new.time - last.time <= _GOES_ON or self._agrees(last, new)

    def _missing(self, last: StreamedFrame, new: StreamedFrame) -> int:
        """The number of frames between two, as far as their times agree with their numbers."""
        steps = new.number - last.number
        if self._interval is not None:
            steps = min(steps, round(1.5 * (new.time - last.time) / self._interval))
        return max(-(-steps // self._stride) - 1, 0)


def _increasing(ordered: list[StreamedFrame]) -> list[StreamedFrame]:
    """As many of some frames, by their times, as have numbers that do not go back."""
    longest: list[list[StreamedFrame]] = []
    for frame in ordered:
        before = [chain for chain in longest if chain[-1].number <= frame.number]
        longest.append([*max(before, key=len, default=[]), frame])
    return max(longest, key=len, default=[])


def _usual_interval(ordered: list[StreamedFrame]) -> float | None:
    """Time per number of frames in order [s]; None where their numbers do not go on."""
    intervals = [
        (second.time - first.time) / (second.number - first.number)
        for first, second in pairwise(ordered)
        if second.number > first.number and second.time > first.time
    ]
    return float(np.median(intervals)) if intervals else None
