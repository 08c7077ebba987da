"""Order and time of a stream's frames: what came late, twice or with a wild time is left out and counted.

A frame goes on at once when it continues the stream: its time is later than that of the frame before by no
more than its number or its arrival explains, and its number by no more than its time. A number alone explains
at most a second: a damaged header may hold any number and time that agree. Any other frame is held until the
next one shows what it was:

- after a gap in the numbers the missing frame may still arrive, and goes first; where more than four arrive
  and the gap is not closed, the held frame's header was wild;
- a wild time is followed by frames that continue the stream, and the held frame is left out;
- a longer gap that only the numbers explain is followed by frames that continue the held one;
- a recording that starts again, or a restarted server, is followed by frames that continue the held one.

So a doubtful frame waits for one more frame, and all others are not delayed.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Final

from track.streams.natnet import MarkerFrame

_REORDERED: Final = 1.0  # [s]: a frame that is older by more belongs to a recording that starts again
_BURST: Final = 0.5  # [s] from the last frame, within which frames of the same recording may arrive late
_FIRST_SLACK: Final = 0.05  # [s]: tolerance of a frame's time while the interval is unknown
_LONGEST_GAP: Final = 1.0  # [s] that a frame's number alone explains
_SLACK: Final = 0.001  # [s]: tolerance of time stamps beside half an interval
_FASTEST: Final = 2000.0  # [Hz], of any stream
_FIRST_WAIT: Final = 0.05  # [s] for which the first frame is held
_GAP_INTERVALS: Final = 2.5  # for which a frame after a gap is held
_GAP_WAIT: Final = 0.1  # [s], the most of it
_SMOOTHING: Final = 0.1  # share of the newest interval in the usual one
_MOST_CHANGE: Final = 2.0  # factor by which an interval differs from the usual one, at most, as it counts
_MOST_DOUBTFUL: Final = 4  # frames that are held at once
_MOST_OVERTAKEN: Final = 4  # frames that arrive after one that they precede, and others still miss
LATEST: Final = 1e11
"""A time [s] beyond which a clock of doubles does not move on by a frame."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame and when it came."""

    frame: MarkerFrame
    at: float
    """Monotonic time of its arrival [s]."""
    restarted: bool = False
    """Its time does not continue that of the frame before: a recording or a server started again."""


class FrameOrder:
    """Decides which frames go on, in which order."""

    def __init__(self) -> None:
        self.late = 0
        """Number of frames that came twice or too late, which were left out."""
        self.wild = 0
        """Number of frames with a wild time or number, which were left out."""
        self.missed = 0
        """Number of frames that never arrived, by the frame numbers."""
        self.restarts = 0
        """How often the time of the stream began anew."""
        self._last: Arrival | None = None
        self._after_gap: Arrival | None = None  # frames are missing before it
        self._overtaken = 0  # frames that arrived since, and precede it
        self._doubtful: list[Arrival] = []  # do not continue the stream, or nothing came before them
        self._interval: float | None = None  # [s] per frame number

    @property
    def deadline(self) -> float:
        """When `expire` is to be called [s]; infinite when nothing waits."""
        if self._after_gap is not None:
            newest = max(one.at for one in (self._last, self._after_gap) if one is not None)
            return newest + min(_GAP_WAIT, _GAP_INTERVALS * (self._interval or _GAP_WAIT))
        if self._last is None and self._doubtful:
            return self._doubtful[0].at + _FIRST_WAIT
        return math.inf

    def add(self, frame: MarkerFrame, at: float) -> Iterator[Arrival]:
        """The frames that go on now that another has arrived.

        Args:
            frame: The frame.
            at: Monotonic time [s].
        """
        if abs(frame.time) < LATEST:
            yield from self._add(Arrival(frame, at))
        else:
            self.wild += 1

    def expire(self, now: float) -> Iterator[Arrival]:
        """The held frame, if its time is up: nothing came that it could wait for."""
        if not self.deadline <= min(now, LATEST):
            return
        if self._after_gap is not None:
            yield self._pass_after_gap(self._after_gap)
        else:
            yield self._pass(self._doubtful.pop(0))

    def _add(self, new: Arrival) -> Iterator[Arrival]:
        last, gap = self._last, self._after_gap
        waiting = [*self._doubtful, *([] if gap is None else [gap])]
        if any(new.frame.time == held.frame.time for held in waiting):
            self.late += 1
        elif last is not None and self._is_late(last, new):
            self.late += 1
        elif last is not None and self._continues(last, new):
            following = yield from self._settle(last, new)
            yield from self._line_up(new)
            for one in following:
                yield from self._add(one)
        elif gap is not None:
            yield self._pass_after_gap(gap)
            yield from self._add(new)
        else:
            yield from self._begin_anew(new)

    def _line_up(self, new: Arrival) -> Iterator[Arrival]:
        """Pass on a frame that continues the stream, or hold it because others are missing."""
        last, gap = self._last, self._after_gap
        if gap is not None and gap.frame.time < new.frame.time:
            yield self._pass_after_gap(gap)
            yield from self._add(new)
        elif gap is not None:  # the new one was overtaken
            yield self._pass(new)
            self._overtaken += 1
            if not self._missing(new, gap):
                yield self._pass_after_gap(gap)
            elif self._overtaken > _MOST_OVERTAKEN:  # the stream goes on behind it: its header was wild
                self._after_gap = None
                self.wild += 1
        elif last is not None and self._missing(last, new):
            self._after_gap, self._overtaken = new, 0
        else:
            yield self._pass(new)

    def _settle(self, last: Arrival, new: Arrival) -> Generator[Arrival, None, list[Arrival]]:
        """The stream continues: doubtful frames between the two were right, all others were wild.

        Returns:
            Those that follow the new one: they were doubtful only because of a damaged header before it.
        """
        following: list[Arrival] = []
        others: list[Arrival] = []
        for one in self._doubtful:
            (following if self._follows(new, one) else others).append(one)
        self._doubtful = []
        for one in sorted(others, key=lambda arrival: arrival.frame.time):
            ordered = last.frame.time < one.frame.time < new.frame.time
            counted = last.frame.number <= one.frame.number <= new.frame.number
            if ordered and (counted or self._agrees(one, new)):  # or the last number was damaged
                yield self._pass(one)
            else:
                self.wild += 1
        return following

    def _begin_anew(self, new: Arrival) -> Iterator[Arrival]:
        """Two frames that fit together begin the stream anew; a frame that fits to none is held."""
        for fits in (self._continues, self._is_late):
            for one in self._doubtful:
                if fits(one, new):
                    first, second = sorted((one, new), key=lambda arrival: arrival.frame.time)
                    self.wild += len(self._doubtful) - 1
                    self._doubtful = []
                    yield self._pass(first, restarted=not self._goes_on(first))
                    yield from self._add(second)
                    return
        self._doubtful.append(new)
        if len(self._doubtful) > _MOST_DOUBTFUL:
            self._doubtful.pop(0)
            self.wild += 1

    def _pass_after_gap(self, gap: Arrival) -> Arrival:
        self._after_gap = None
        return self._pass(gap)

    def _pass(self, arrival: Arrival, *, restarted: bool = False) -> Arrival:
        """Let a frame go on."""
        last, self._last = self._last, arrival
        if restarted or last is None:
            self.restarts += restarted
            return Arrival(arrival.frame, arrival.at, restarted)
        self.missed += self._missing(last, arrival)
        span, steps = arrival.frame.time - last.frame.time, arrival.frame.number - last.frame.number
        if steps >= 1 and span > 0.0:
            newest = span / steps
            usual = newest if self._interval is None else self._interval
            newest = min(max(newest, usual / _MOST_CHANGE), usual * _MOST_CHANGE)
            self._interval = usual + _SMOOTHING * (newest - usual)
        return arrival

    def _is_late(self, last: Arrival, new: Arrival) -> bool:
        """Whether a frame came twice or was overtaken by the last one."""
        span = new.frame.time - last.frame.time
        return span == 0.0 or (-_REORDERED < span < 0.0 and new.at - last.at < _BURST)

    def _continues(self, last: Arrival, new: Arrival) -> bool:
        """Whether a frame follows another: its time and number go on, by no more than they explain.

        A time beyond `_LONGEST_GAP` is explained only by when the frame arrived.
        """
        waited = new.at - last.at
        return new.frame.time - last.frame.time <= waited + _LONGEST_GAP and self._agrees(last, new)

    def _follows(self, last: Arrival, new: Arrival) -> bool:
        """Whether a frame is the next after another."""
        return self._continues(last, new) and not self._missing(last, new)

    def _agrees(self, last: Arrival, new: Arrival) -> bool:
        """Whether time and number go on by no more than they explain each other, or the arrival the time."""
        span, waited = new.frame.time - last.frame.time, new.at - last.at
        steps = new.frame.number - last.frame.number
        if self._interval is None:
            return 0.0 < span <= waited + _FIRST_SLACK and 0 <= steps <= _FASTEST * span + 1.0
        longest = max(waited, max(steps, 1) * self._interval) + 0.5 * self._interval + _SLACK
        return 0.0 < span <= longest and 0 <= steps <= 1.5 * (span + _SLACK) / self._interval + 1.0

    def _goes_on(self, new: Arrival) -> bool:
        """Whether a frame that another confirms goes on with the recording.

        Then the last header was wrong, or many frames are missing.
        """
        last = self._last
        return last is None or 0.0 < new.frame.time - last.frame.time <= _REORDERED or self._agrees(last, new)

    def _missing(self, last: Arrival, new: Arrival) -> int:
        """The number of frames between two, as far as their times agree with their numbers."""
        steps = new.frame.number - last.frame.number
        if self._interval is not None:
            steps = min(steps, round(1.5 * (new.frame.time - last.frame.time) / self._interval))
        return max(steps - 1, 0)
