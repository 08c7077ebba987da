"""Several sinks: none that fails stops the others."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim.errors import HandSimWarning
from track.sinks.sink_group import SinkGroup
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import Status, TrackedFrame, TrackedHand


class Keeper:
    def __init__(self, fails: int | None = None, dropped: int = 0) -> None:
        self.got, self.closed, self.fails, self.dropped = [], 0, fails, dropped

    def send(self, message):
        if message.number == self.fails:
            raise RuntimeError("full")
        self.got.append(message)

    def close(self):
        self.closed += 1
        if self.fails is not None:
            raise OSError("gone")


def frame(number: int):
    lost = np.full(27, np.nan)
    hand = TrackedHand("right", Status.LOST, lost, np.nan, np.zeros((19, 3)), np.zeros(0, dtype=int))
    points = np.zeros((0, 3))
    none = np.zeros(0, dtype=int)
    return StreamedFrame(number, number / 100, points, none), TrackedFrame(0.0, (hand,), none, none)


def test_a_sink_that_fails_is_told_and_left_out():
    good, bad = Keeper(dropped=3), Keeper(fails=2)
    hands = [nominal_fit(load_layout("dense19"), "M", "right")]
    with SinkGroup({"good": good, "bad": bad}) as sinks:
        sinks.start(hands, ())
        with pytest.warns(HandSimWarning) as told:
            for number in range(5):
                sinks.send(*frame(number))
        assert [str(one.message) for one in told] == [
            "bad failed and gets no further frame (RuntimeError: full)",
            "bad could not be closed (OSError: gone)",
        ]
        assert sinks.notes() == ("5 frames sent to good", "good: 3 frames dropped")
    assert [one.number for one in good.got] == list(range(5)) and len(bad.got) == 2
    assert good.got[0].header is good.got[-1].header
    assert (good.closed, bad.closed) == (1, 1)


def test_nothing_is_sent_before_the_tracker_is_there():
    keeper = Keeper()
    with SinkGroup({"keeper": keeper}) as sinks:
        sinks.send(*frame(0))
        assert sinks and not sinks.notes()
    assert not keeper.got and not SinkGroup({})
