"""Addresses of sinks: what they open, what is told of those that are none, and that none stops the others."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from gloves import Status, load_layout
from gloves.fit import nominal_fit
from handsim import HandSimError, HandSimWarning
from handsim.errors import ArgumentError
from tests.sentences import error_names
from track import SinkGroup, StreamedFrame, TrackedFrame, TrackedHand, open_sinks
from track.sinks import VALID, open_sink

SOURCE = """
class Counter:
    sent, closed = [], False
    def __init__(self, step="1"):
        self.step = int(step)
    def send(self, message):
        Counter.sent.append(message.number * self.step)
    def close(self):
        Counter.closed = True

class NoSink:
    pass

class Failing(Counter):
    def send(self, message):
        raise ValueError("not today")
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_sinks.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("own_sinks", None)


@pytest.mark.parametrize(
    "address",
    ["", "osc", "http://localhost:80", "wss://localhost:1", "lsl:", "lsl://name", "localhost:9000", "a b:c",
     "ws:8765", "9module:name"],
)  # fmt: skip
def test_what_is_no_address_is_told_with_the_valid_ones(address):
    with pytest.raises(ArgumentError) as caught:
        open_sink(address)
    assert str(caught.value) == f"'{address}' is not an address to send to, expected {', '.join(VALID)}"


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("osc://localhost", "expected osc://host:port"),
        ("osc://localhost:0", "expected a port from 1 to 65535"),
        ("ws://localhost:99999", "expected ws://host:port"),
        ("udp://localhost:9000/path", "expected udp://host:port"),
        ("udp://user@localhost:9000", "expected udp://host:port"),
        ("udp://localhost:9000?format", "expected udp://host:port"),
        ("ws://:1?format=xml", "unknown format 'xml'; valid names: json, msgpack"),
        ("ws://:1?point=yes", "unknown option 'point' (did you mean 'points'?); valid names: format, points"),
        ("osc://:1?format=json", "osc://:1?format=json: unknown option 'format', there are none"),
    ],
)
def test_wrong_parts_are_told(address, words):
    with error_names(ArgumentError, words):
        open_sink(address)


@pytest.mark.parametrize(("address", "package"), [("ws://:0", "websockets"), ("lsl:hands", "pylsl")])
def test_a_missing_package_is_told(address, package, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ArgumentError) as caught:
        open_sink(address)
    assert f"needs the package {package}" in str(caught.value)
    assert "run `pip install 'handsim[send]'`" in str(caught.value) and "\n" not in str(caught.value)


def test_a_sink_of_the_user_s_own(own, message):
    with open_sinks(["own_sinks:Counter?step=3"]) as sinks:
        import own_sinks

        (sink,) = sinks._sinks.values()
        for number in range(3):
            sink.send(message(number))
    assert own_sinks.Counter.sent == [0, 3, 6] and own_sinks.Counter.closed


def test_what_is_no_sink_is_told(own):
    with pytest.raises(ArgumentError, match="own_sinks:NoSink has no method send, expected the methods"):
        open_sink("own_sinks:NoSink")
    with pytest.raises(ArgumentError, match=r"does not take the arguments \(, stop=...\)|unexpected keyword"):
        open_sink("own_sinks:Counter?stop=1")
    with pytest.raises(HandSimError, match="ValueError: invalid literal"):
        open_sink("own_sinks:Counter?step=x")
    with pytest.raises(ArgumentError, match="No module named 'no_such_module'"):
        open_sink("no_such_module:Sink")


def test_an_address_twice_and_a_bad_one_leave_nothing_open():
    with pytest.raises(ArgumentError, match="osc://:9000 is given twice"):
        open_sinks(["osc://:9000", "osc://:9000"])
    first = open_sink("ws://:0")
    port = first.port
    first.close()
    with pytest.raises(ArgumentError):
        open_sinks([f"ws://:{port}", "nonsense"])
    open_sink(f"ws://:{port}").close()  # the port is free again


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
