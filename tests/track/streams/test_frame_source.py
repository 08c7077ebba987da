"""Frame sources of the user's own: what they deliver arrives, and what is wrong with them is told."""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
import pytest

from gloves import Capture
from handsim import HandSimWarning
from handsim.errors import CaptureError
from tests.waiting import LONG
from track import LiveStream, StreamedFrame
from track.frames import capture_frames
from track.streams import live_stream
from track.streams.frame_source import SourceStream


def frame(number: int, points: object = None, **changes: object) -> StreamedFrame:
    points = np.full((2, 3), 0.1) if points is None else points
    values = {"number": number, "time": number / 100, "points": points, "ids": np.array([4, -1]), **changes}
    return StreamedFrame(**values)  # type: ignore[arg-type]


class Listed:
    """A source of given frames; an exception among them is raised."""

    def __init__(self, *frames: object, waits: bool = False) -> None:
        self.frames, self.waits = frames, waits
        self.closed, self.waiting = threading.Event(), threading.Event()

    def __iter__(self):
        for one in self.frames:
            if isinstance(one, Exception):
                raise one
            yield one
        if self.waits:
            self.waiting.set()
            self.closed.wait()

    def close(self) -> None:
        self.closed.set()


def live(source: Listed, **options: object) -> LiveStream:
    return LiveStream(SourceStream(source, "mine"), **options)  # type: ignore[arg-type]


def test_all_frames_arrive_and_the_end_ends_the_stream():
    sent = [frame(number) for number in range(1000)]  # more than wait at once
    stream = live(Listed(*sent))
    time.sleep(0.05)
    assert [one.number for one in stream] == list(range(1000))
    counts = stream.counts
    assert counts.pop("received_frames") == counts.pop("frames_in_order") == 1000
    assert set(counts.values()) == {0}


def test_numbers_that_are_left_out_are_counted():
    stream = live(Listed(frame(1), frame(5), frame(2, restarted=True), frame(3), frame(9, restarted=True)))
    assert len(list(stream)) == 5 and stream.counts["missing_frames"] == 3


def test_points_that_are_missing_are_left_out():
    (one,) = live(Listed(frame(0, [[np.nan] * 3, [1, 2, 3]], ids=[3, 7])))
    assert one.points.tolist() == [[1.0, 2.0, 3.0]] and one.ids.tolist() == [7]


def test_a_silence_is_told_with_the_last_number():
    source = Listed(frame(3), waits=True)
    stream = live(source, silence=0.05)
    assert source.waiting.wait(LONG)
    first, second, third = itertools.islice(stream, 3)
    assert not first.silent and second.silent and third.silent
    assert second.number == 3 and second.points.shape == (0, 3)
    assert 0.03 < second.time < third.time
    stream.close()
    assert list(stream) == []


def test_it_ends_when_it_is_to_end_after_what_has_come():
    over = threading.Event()
    source = Listed(*map(frame, range(5)), waits=True)
    stream = live(source, ended=over.is_set)
    assert source.waiting.wait(LONG)
    over.set()
    assert [one.number for one in stream] == [0, 1, 2, 3, 4]
    stream.close()


@pytest.mark.parametrize("error", [None, OSError("bad file descriptor")])
def test_it_ends_while_frames_keep_coming(error):
    """Closed while it waits for the network, a source may fail; that is no failure of the stream."""
    over = threading.Event()

    class Endless(Listed):
        def __iter__(self):
            for number in itertools.count():
                if error is not None and self.closed.is_set():
                    raise error
                yield frame(number)

    stream = live(Endless(), ended=over.is_set)
    assert next(stream).number == 0
    over.set()
    assert len(list(itertools.islice(stream, 10_000))) < 10_000, "what waits, and no more"
    stream.close()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("frame", "ArgumentError: a str came, expected a track.StreamedFrame"),
        (
            frame(1, np.zeros((3, 3))),
            r"points have shape \(3, 3\) and IDs \(2,\), expected \(N, 3\) and \(N,\)",
        ),
        (frame(1, time=np.nan), "the time of frame 1 is nan, expected seconds"),
        (frame(1, ids=np.array([-2, 0])), "IDs are from -2 to 0, expected -1 to 2147483647"),
        (RuntimeError("the cable is out"), "RuntimeError: the cable is out"),
    ],
)
def test_what_is_wrong_ends_the_stream_and_is_told(wrong, words):
    stream = live(Listed(frame(0), wrong, frame(2)))
    assert next(stream).number == 0
    with pytest.raises(CaptureError, match=rf"^mine: the stream failed \(.*{words}"):
        next(stream)
    assert list(stream) == []


def test_a_close_that_fails_is_told_and_loses_nothing():
    class Stuck(Listed):
        def close(self) -> None:
            super().close()
            raise OSError("stuck")

    stream = live(Stuck(frame(0)))
    assert next(stream).number == 0
    with pytest.warns(HandSimWarning, match=r"mine: close failed \(OSError: stuck\)"):
        stream.close()


def test_a_column_is_an_id_until_its_point_is_lost():
    positions = np.full((5, 2, 3), np.nan)
    positions[[0, 1, 3, 4], 0], positions[1:, 1] = 0.0, 1.0
    frames = list(capture_frames(Capture(("a", "b"), positions, 100.0)))
    assert [frame.ids.tolist() for frame in frames] == [[0], [0, 1], [1], [2, 1], [2, 1]]
    assert [len(frame.points) for frame in frames] == [1, 2, 1, 2, 2]
    np.testing.assert_allclose([frame.time for frame in frames], 0.01 * np.arange(5))


class Arriving:
    """Frames that have arrived at given times, of which nothing else is counted."""

    is_live, lost, error = True, 0, None

    def __init__(self, frames: list[StreamedFrame], *, ends: bool = True) -> None:
        self.counts: dict[str, int] = {}
        self.frames, self.is_over = frames, False
        self.ends = ends

    def poll(self, seconds: float) -> list[StreamedFrame]:
        self.is_over |= self.ends
        arrived, self.frames = self.frames, []
        return arrived

    def end(self) -> None:
        self.is_over = True

    def close(self) -> None:
        self.end()


def test_time_goes_on_when_a_recording_begins_anew():
    told = [*(5.0 + 0.1 * n for n in range(10)), *(0.1 + 0.1 * n for n in range(6))]
    arriving = [frame(n, time=time, arrived=0.1 * n) for n, time in enumerate(told)]
    with LiveStream(Arriving(arriving)) as stream:
        times = [one.time for one in stream]
        assert stream.counts["restarts"] == 1
    np.testing.assert_allclose(times, 5.0 + 0.1 * np.arange(16), atol=0.005)


class Slow(Arriving):
    """A live stream of which all frames but the last have waited for long when they are first asked for."""

    def __init__(self, count: int) -> None:
        now = time.monotonic()
        super().__init__([frame(n, arrived=now - 60.0 + n / 100) for n in range(count)], ends=False)


class Clock:
    """The time of a machine, and a stream at 100 Hz that arrives by it."""

    is_live, is_over, lost, error = True, False, 0, None

    def __init__(self) -> None:
        self.now, self.sent = 1000.0, 0
        self.counts: dict[str, int] = {}

    def monotonic(self) -> float:
        return self.now

    def poll(self, seconds: float) -> list[StreamedFrame]:
        due = 1000.0 + self.sent / 100
        if due > self.now and seconds > 0.0:
            self.now = min(due, self.now + seconds)
        arrived = []
        while 1000.0 + self.sent / 100 <= self.now:
            arrived.append(frame(self.sent, arrived=1000.0 + self.sent / 100))
            self.sent += 1
        return arrived

    def end(self) -> None:
        self.is_over = True

    close = end


def lags_of(monkeypatch, seconds: list[float]) -> tuple[list[float], int]:
    """How late the frames are taken of a reader that needs so long for each [s]; how many were dropped."""
    clock, lags = Clock(), []
    monkeypatch.setattr(live_stream, "time", clock)
    with LiveStream(clock) as stream:
        for one in seconds:
            taken = next(stream)
            lags.append(clock.now - taken.arrived)
            clock.now += one
        return lags[5:], stream.counts["dropped_frames"]  # the first five are held until they fit together


def test_a_reader_that_is_too_slow_settles_close_to_now(monkeypatch):
    lags, dropped = lags_of(monkeypatch, [0.015] * 1000)
    assert max(lags) <= live_stream.MOST_LAG and max(lags[100:]) <= 0.0101
    assert dropped == pytest.approx(500, abs=10)


def test_a_reader_that_was_held_up_catches_up_without_a_loss(monkeypatch):
    late = [0.001] * 1000
    late[200] = late[500] = 0.029
    lags, dropped = lags_of(monkeypatch, late)
    assert dropped == 0 and max(lags) <= live_stream.MOST_LAG
    late[700] = 0.2
    lags, dropped = lags_of(monkeypatch, late)
    assert dropped in (16, 17, 18) and max(lags) <= live_stream.MOST_LAG, "what is older than may wait"


def test_a_lag_of_up_to_two_seconds_may_be_forgiven():
    now = time.monotonic()
    for lag, count in ((1.0, 100), (5.0, 500)):
        arriving = [frame(n, arrived=now - lag + n / 100) for n in range(count)]
        with LiveStream(Arriving(arriving, ends=False)) as stream:
            stream.forgive()
            first = next(stream).number
            assert first == stream.counts["dropped_frames"]
            assert first == 0 if lag < 2.0 else first >= 295
            assert [next(stream).number for _ in range(2)] == [first + 1, first + 2]
