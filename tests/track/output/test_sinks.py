"""Sinks over real sockets: addresses, OSC and documents, the Lab Streaming Layer, and WebSocket clients."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import logging
import os
import re
import socket
import subprocess
import sys
import threading
import time
import warnings
from types import SimpleNamespace

import msgpack
import numpy as np
import pytest
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_server import BlockingOSCUDPServer
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import connect

from gloves import Status, load_layout
from gloves.fit import nominal_fit
from handsim import HandSimError, HandSimWarning
from handsim.errors import ArgumentError
from tests.programs import ROOT, run_python
from tests.sentences import error_names
from tests.waiting import LONG, wait_for
from track import SinkGroup, StreamedFrame, TrackedFrame, TrackedHand, open_sinks
from track.output import sinks, web_socket
from track.output.lab_streaming import channels_of, sample_of
from track.output.live_message import Content
from track.output.osc import osc_format
from track.output.sinks import VALID, open_sink

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
NO_ADDRESSES = ("", "osc", "http://localhost:80", "wss://localhost:1", "lsl:", "lsl://name",
                "localhost:9000", "a b:c", "ws:8765", "9module:name",
                "tcp://localhost:9000", "tcp://:0?axes=unity")  # fmt: skip
ENCODER = osc_format()
FEW_FILES = """
import resource, socket, sys, time
from track.output.sinks import open_sink
resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
sink = open_sink(sys.argv[1])
print(sink.port, flush=True)
sys.stdin.readline()
time.sleep(0.5)
sink.close()
"""


@pytest.mark.parametrize(
    ("address", "words"),
    [
        *((address, f"'{address}' | {' | '.join(VALID)}") for address in NO_ADDRESSES),
        ("osc://no-such-host.invalid:9000", "'no-such-host.invalid' cannot be sent to"),
        ("osc://localhost", "expected osc://host:port"),
        ("osc://localhost:0", "expected a port from 1 to 65535"),
        ("ws://localhost:99999", "expected ws://host:port"),
        ("udp://localhost:9000/path", "expected udp://host:port"),
        ("ws://localhost:9000/newest", "expected ws://host:port without '/newest'"),
        ("udp://user@localhost:9000", "expected udp://host:port"),
        ("udp://localhost:9000?format", "expected udp://host:port"),
        ("ws://:1?format=xml", "unknown format 'xml'; valid names: json, msgpack"),
        ("ws://:1?point=yes", "unknown option 'point' (did you mean 'points'?) | format | axes | every"),
        ("ws://:1?unit=mm", "unknown unit 'mm' | auto, m, cm"),
        ("udp://:1?every=yes", "udp://:1?every=yes: unknown option 'every'; valid names: format, points"),
        ("osc://:1?format=json", "osc://:1?format=json: unknown option 'format' | valid names: axes, up"),
        ("ws://:1?axes=maya", "unknown axes 'maya' | world, ros, openxr, opengl, unity, unreal"),
    ],
)
def test_wrong_parts_are_told(address, words):
    with error_names(ArgumentError, words):
        open_sink(address)


@pytest.mark.parametrize(
    ("address", "package"),
    [("ws://:0", "websockets"), ("lsl:hands", "pylsl"), ("ws://:0?format=msgpack", "msgpack")],
)
def test_a_missing_package_is_told(address, package, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)
    with error_names(ArgumentError, f"needs the package {package} | pip install 'handsim[send]'"):
        open_sink(address)


def test_a_sink_of_the_user_s_own(own, message):
    with open_sinks(["own_code:Counter?step=3"]) as sinks:
        import own_code

        (sink,) = sinks._sinks.values()
        for number in range(3):
            sink.send(message(number))
    assert own_code.Counter.sent == [0, 3, 6] and own_code.Counter.closed


def test_what_is_no_sink_is_told(own):
    with pytest.raises(ArgumentError, match="own_code:NoSink has no method send, expected the methods"):
        open_sink("own_code:NoSink")
    with pytest.raises(ArgumentError, match=r"does not take the arguments \(, stop=...\)|unexpected keyword"):
        open_sink("own_code:Counter?stop=1")
    with pytest.raises(HandSimError, match="ValueError: invalid literal"):
        open_sink("own_code:Counter?step=x")
    with pytest.raises(ArgumentError, match="No module named 'no_such_module'"):
        open_sink("no_such_module:Sink")


def test_sinks_may_be_objects():
    own = {}
    exec(SOURCE, own)
    one = own["Counter"]()
    with open_sinks([one, "udp://127.0.0.1:9"]) as group:
        assert list(group.counts) == ["Counter", "udp://127.0.0.1:9"]
    assert open_sinks(one)
    with error_names(ArgumentError, "NoSink | send | close"):
        open_sinks([own["NoSink"]()])
    with error_names(ArgumentError, "addresses | 5"):
        open_sinks(5)


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
        good.note = "nobody heard them"
        told = "5 frames sent to good", "good: 3 frames dropped", "good: nobody heard them"
        assert sinks.notes() == told
    assert [one.number for one in good.got] == list(range(5)) and len(bad.got) == 2
    assert good.got[0].header is good.got[-1].header
    assert (good.closed, bad.closed) == (1, 1)


def test_nothing_is_sent_before_the_tracker_is_there():
    keeper = Keeper()
    with SinkGroup({"keeper": keeper}) as sinks:
        sinks.send(*frame(0))
        assert sinks and not sinks.notes()
    assert not keeper.got and not SinkGroup({})


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(LONG)
        yield one


def test_frames_reach_an_osc_server(message):
    heard, dispatcher = [], Dispatcher()
    dispatcher.set_default_handler(lambda address, *values: heard.append((address, values)))
    with BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        sink = open_sink(f"osc://localhost:{server.server_address[1]}")
        for number in range(20):
            sink.send(message(number))
        sink.close()
        wait_for(lambda: sum(address == "/handsim/frame" for address, _ in heard) == 20)
        server.shutdown()
    frames = [values[0] for address, values in heard if address == "/handsim/frame"]
    assert frames == list(range(20)) and heard[0] == ("/handsim/schema", (1,))
    assert len(next(values for address, values in heard if address == "/handsim/left/angles")) == 20


@pytest.mark.parametrize(("query", "decode"), [("", json.loads), ("?format=msgpack", msgpack.unpackb)])
def test_documents_reach_a_socket(query, decode, receiver, message):
    sink = open_sink(f"udp://:{receiver.getsockname()[1]}{query}")
    for number in range(3):
        sink.send(message(number))
    got = documents(receiver, sink.sent, decode)
    assert [one["type"] for one in got] == sorted([one["type"] for one in got], reverse=True)
    frames = [one for one in got if one["type"] == "frame"]
    assert sorted({one["number"] for one in frames}) == [0, 1, 2] and "points" not in frames[0]
    assert all({hand["side"] for hand in one.get("hands", [])} <= {"right", "left"} for one in frames)
    sink.close()
    assert decode(receiver.recv(1401)) == {"type": "end", "schema": 1}


def documents(receiver, count: int, decode=json.loads) -> list[dict]:
    datagrams = [receiver.recv(65536) for _ in range(count)]
    assert max(map(len, datagrams)) <= 1400
    return [decode(one) for one in datagrams]


def test_who_listens_later_hears_the_header_too(receiver, message, monkeypatch):
    now = [50.0]
    monkeypatch.setattr(sinks, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sink = open_sink(f"udp://127.0.0.1:{receiver.getsockname()[1]}?points=yes")
    for number in range(8):
        sink.send(message(number))
        now[0] += 0.25
    got = documents(receiver, sink.sent)
    heard = [one["type"] if one["type"] == "header" else one["number"] for one in got if one["part"] == 1]
    assert heard == ["header", 0, 1, 2, 3, "header", 4, 5, 6, 7]
    of_one = [one for one in got if one.get("number") == 3]
    assert sum(len(one.get("points", [])) for one in of_one) == 5
    assert sum(len(one.get("labels", [])) for one in of_one) == 5
    sink.close()


def test_that_nobody_listens_is_no_error_and_is_told(receiver, message):
    port = receiver.getsockname()[1]
    sink = open_sink(f"udp://127.0.0.1:{port}")
    sink.send(message(0))
    assert "UDP does not tell" in sink.note
    receiver.close()
    for number in range(1, 20):
        sink.send(message(number))
    assert sink.dropped == 0 and 10 < sink.refused <= sink.sent
    assert sink.note == f"nobody listened to {sink.refused} of {sink.sent} datagrams"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:  # a receiver that comes gets what follows
        late.bind(("127.0.0.1", port))
        late.settimeout(LONG)
        sink.send(message(20))
        numbers = {one["number"] for one in documents(late, sink.sent - 1 and 3) if "number" in one}
        assert numbers == {20}
    sink.close()


def read(datagram: bytes) -> dict[str, list]:
    assert OscBundle.dgram_is_bundle(datagram)
    return {one.address: list(one.params) for one in OscBundle(datagram)}


def test_a_frame(message):
    one = message(7)
    (sent,) = ENCODER.frame(one)
    got = read(sent)
    assert got.pop("/handsim/frame") == [7, one.time, 0]
    for hand in one.hands:
        assert got.pop(f"/handsim/{hand.side}/status") == ["tracked"]
        wrist = [*hand.position, *hand.quaternion]
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/wrist"), np.float32(wrist))
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/angles"), np.float32(hand.angles))
        positions = np.reshape(got.pop(f"/handsim/{hand.side}/positions"), (21, 3))
        np.testing.assert_array_equal(positions, np.float32(hand.positions))
        assert got.pop(f"/handsim/{hand.side}/seen") == [hand.seen]
        assert got.pop(f"/handsim/{hand.side}/digits") == ["tracked"] * 5
        for name in ("angle_spread", "position_spread"):
            found = got.pop(f"/handsim/{hand.side}/{name}")
            np.testing.assert_array_equal(found, np.float32(getattr(hand, name)))
    assert got.pop("/handsim/body/mug/status") == ["tracked"]
    np.testing.assert_allclose(got.pop("/handsim/body/mug/pose"), [0.1, 0.2, 0.3, 1, 0, 0, 0], rtol=1e-6)
    assert not got


def test_of_what_is_lost_only_the_status_is_sent(message):
    (sent,) = ENCODER.frame(message(lost=True))
    got = read(sent)
    lost = {address: words for address, words in got.items() if "left" in address or "mug" in address}
    assert lost == {"/handsim/left/status": ["lost"], "/handsim/body/mug/status": ["lost"]}


def test_the_names(message):
    header = message().header
    (sent,) = ENCODER.header(header)
    got = read(sent)
    assert got["/handsim/schema"] == [1] and got["/handsim/sides"] == ["right", "left"]
    assert got["/handsim/angles"] == list(header.angles)
    assert got["/handsim/positions"] == list(header.positions)
    assert got["/handsim/bodies"] == ["mug"]


def test_odd_names_and_late_numbers_are_ones_of_osc_in_one_bundle(message):
    one = message(2**31 + 5)
    odd = dataclasses.replace(one.bodies[0], name="my pen #2/ä")
    (packet,) = osc_format(Content(velocities=True)).frame(dataclasses.replace(one, bodies=(odd,)))
    got = read(packet)
    assert "/handsim/body/my_pen__2__/status" in got and got["/handsim/frame"][0] == 5


def test_a_frame_with_more_than_a_packet_holds_is_several_bundles(message):
    one = message(9)
    bodies = tuple(dataclasses.replace(one.bodies[0], name=f"body{number}") for number in range(100))
    sent = osc_format(Content(velocities=True)).frame(dataclasses.replace(one, bodies=bodies))
    assert len(sent) > 1 and max(map(len, sent)) <= 8000
    assert all(read(packet)["/handsim/frame"] == [9, one.time, 0] for packet in sent)
    addresses = [address for packet in sent for address in read(packet) if address != "/handsim/frame"]
    assert len(addresses) == len(set(addresses)) == 2 * (8 + 2) + 2 * 100
    got = {address: values for packet in sent for address, values in read(packet).items()}
    np.testing.assert_array_equal(
        got["/handsim/left/angle_velocities"], np.float32(one.hands[1].angle_velocities)
    )
    assert len(got["/handsim/right/velocities"]) == 63


def test_every_channel_has_a_name_and_a_unit(message):
    one = message(5)
    channels = list(channels_of(one.header))
    sample = dict(zip([label for label, _, _ in channels], sample_of(one), strict=True))
    assert len(sample) == len(channels), "no name twice"
    assert (sample["frame"], sample["time"]) == (5, one.time)
    assert sample["left_wrist_position_y"] == one.hands[1].position[1]
    assert (
        sample["right_index_PIP_flexion"] == one.hands[0].angles[one.header.angles.index("index_PIP_flexion")]
    )
    assert sample["right_ring_tip_z"] == one.hands[0].positions[one.header.positions.index("ring_tip"), 2]
    units = {label: unit for label, unit, _ in channels}
    assert units["right_index_PIP_flexion"] == "radians" and units["mug_position_x"] == "meters"


def test_a_lost_hand_is_nan(message):
    one = message(lost=True)
    labels = [label for label, _, _ in channels_of(one.header)]
    sample = sample_of(one)
    assert sample[labels.index("left_status")] == 3.0
    left = [label.startswith(("left_", "mug_", "lag")) and not label.endswith("status") for label in labels]
    assert all(sample[labels.index(f"left_{digit}_status")] == 3.0 for digit in one.header.digits)
    assert np.isnan(sample[left]).all(), "and it did not come live"
    assert np.isfinite(sample[~np.array(left)]).all()


def test_an_inlet_gets_samples_and_the_description(message, tmp_path):
    """In a process of its own: the library reads its configuration once; this one stays on the machine."""
    settings = tmp_path / "lsl_api.cfg"
    settings.write_text(
        "[multicast]\nResolveScope = machine\n[lab]\nKnownPeers = {127.0.0.1}\n[log]\nlevel = -3\n"
    )
    code = """
import json
import pylsl
from tests.track.conftest import make_message
from track.output.sinks import open_sink
sink = open_sink("lsl:hands")
sink.send(make_message(0))
(info,) = pylsl.resolve_byprop("name", "hands", timeout=120.0)
inlet = pylsl.StreamInlet(info)
inlet.open_stream(timeout=120.0)
for number in range(1, 6):
    sink.send(make_message(number))
samples = [inlet.pull_sample(timeout=120.0)[0] for _ in range(5)]
described = inlet.info(timeout=120.0)
labels, units = described.get_channel_labels(), described.get_channel_units()
print(json.dumps([samples, labels, units, described.type(), described.desc().child_value("schema")]))
sink.close()
"""
    done = run_python(code, LSLAPICFG=str(settings), OMP_NUM_THREADS="1")
    samples, labels, units, kind, schema = json.loads(done.stdout.splitlines()[-1])
    assert [sample[0] for sample in samples] == [1, 2, 3, 4, 5] and (kind, schema) == ("MoCap", "1")
    channels = list(channels_of(message().header))
    assert labels == [label for label, _, _ in channels]
    assert [unit or "" for unit in units] == [unit for _, unit, _ in channels]
    np.testing.assert_array_equal(samples[-1], sample_of(message(5)))


def test_lsl_writes_nothing_between_our_lines(tmp_path, monkeypatch):
    pytest.importorskip("pylsl")
    monkeypatch.delenv("LSLAPICFG", raising=False)
    code = """
from tests.track.conftest import make_message
from track.output.sinks import open_sink
sink = open_sink("lsl:quiet")
sink.send(make_message(0))
sink.close()
"""
    done = run_python(code, folder=tmp_path, PYTHONWARNINGS="ignore", HOME=str(tmp_path))
    assert (done.stdout, done.stderr) == ("", "")


@pytest.fixture
def sink():
    one = open_sink("ws://:0?every=yes")
    yield one
    one.close()


def url(sink) -> str:
    return f"ws://127.0.0.1:{sink.port}"


def received(client, count: int) -> list[dict]:
    """The next messages but those of lag, which a busy machine adds."""
    messages = (json.loads(client.recv(timeout=LONG)) for _ in itertools.count())
    return list(itertools.islice((one for one in messages if one["type"] != "lag"), count))


def test_clients_get_the_header_and_every_frame(sink, message):
    with connect(url(sink)) as one, connect(url(sink)) as two:
        wait_for(lambda: sink.num_clients == 2)
        for number in range(100):
            sink.send(message(number))
        for client in (one, two):
            header, *frames = received(client, 101)
            assert header["type"] == "header" and [frame["number"] for frame in frames] == list(range(100))
        with connect(url(sink)) as late:
            wait_for(lambda: sink.num_clients == 3)
            sink.send(message(100))
            header, frame = received(late, 2)
    assert header["type"] == "header" and frame["number"] == 100
    assert header["angles"][0] == "thumb_metacarpal_abduction"
    assert sink.dropped == 0
    wait_for(lambda: sink.num_clients == 0)


def test_a_slow_client_loses_frames_and_delays_nobody(message):
    """It reads nothing at all: sending goes on, and the other client gets everything."""
    sink = open_sink("ws://:0?points=yes&every=yes")
    slow = raw_client(sink.port)
    with connect(url(sink)) as quick:
        wait_for(lambda: sink.num_clients == 2)
        got: list[str] = []
        messages = (text for text in read_until_closed(quick) if json.loads(text)["type"] != "lag")
        reader = threading.Thread(target=lambda: got.extend(messages))
        reader.start()
        frame, sent = message(0, points=800), 0  # large: they soon fill the system's buffers
        while sink.dropped < 50 and sent < 5000:
            sink.send(frame)
            sent += 1
            wait_for(lambda least=sent - web_socket._MOST_WAITING // 2: len(got) > least)
        assert sink.dropped >= 50, "the slow client lost frames"
        wait_for(lambda: len(got) == sent + 1)
        slow.close()
        sink.close()
        reader.join()


@pytest.mark.parametrize("path", ["?every=1", "/?every=yes"])
def test_a_client_may_ask_for_every_frame(path, message):
    sink = open_sink("ws://:0")
    with connect(url(sink) + path) as every, connect(url(sink) + "/newest" + path.strip("/")) as newest:
        wait_for(lambda: sink.num_clients == 2)
        for number in range(100):
            sink.send(message(number))
        header, *frames = received(every, 101)
        assert header["type"] == "header" and [frame["number"] for frame in frames] == list(range(100))
        assert received(newest, 1)[0]["type"] == "header"
        newest.send("")
        assert received(newest, 1)[0]["number"] == 99
    sink.close()


def test_no_connection_waits_for_confirmations(sink):
    with connect(url(sink)):
        wait_for(lambda: sink.num_clients == 1)
        (connection,) = sink._clients.values()
        one = connection.transport.get_extra_info("socket")
        assert one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert sink._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def read_until_closed(client):
    try:
        while True:
            yield client.recv()
    except ConnectionClosed:
        return


def raw_client(port: int, origin: str = "") -> socket.socket:
    """A client that has shaken hands and reads no further."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.connect(("127.0.0.1", port))
    one.sendall(
        f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n{origin}\r\n".encode()
    )
    assert one.recv(13) == b"HTTP/1.1 101 "
    return one


@pytest.mark.parametrize(
    "junk",
    [
        b"\x00" * 64,
        b"GET / HTTP/1.1\r\n\r\n",
        b"POST /x HTTP/1.1\r\nHost: a\r\n\r\n",
        b"\xff" * 20000,
        b"GET ",
    ],
)
def test_junk_is_refused_and_says_nothing(junk, sink, message, caplog, capfd):
    with caplog.at_level(logging.DEBUG), connect(url(sink)) as client:
        wait_for(lambda: sink.num_clients == 1)
        with socket.create_connection(("127.0.0.1", sink.port)) as stranger:
            stranger.sendall(junk)
            time.sleep(0.05)
        sink.send(message(3))
        assert received(client, 2)[1]["number"] == 3
    assert capfd.readouterr() == ("", "") and "handsim.websocket" not in caplog.text


def test_what_a_client_says_is_not_read(sink, message):
    with connect(url(sink)) as client, connect(url(sink)) as babbler:
        wait_for(lambda: sink.num_clients == 2)
        client.send("hello")
        client.send(b"\x00" * 1000)
        for _ in range(200):
            babbler.send("x" * 1000)
        babbler.send("x" * 10_000)  # longer than a server that is told nothing has to take
        wait_for(lambda: sink.num_clients == 1)
        sink.send(message(1))
        assert received(client, 2)[1]["number"] == 1


def test_it_listens_on_loopback_and_refuses_pages_of_other_machines(sink):
    assert sink._socket.getsockname()[0] == "127.0.0.1"
    for origin in ("http://localhost:8000", "http://127.0.0.1", "https://[::1]:5173"):
        connect(url(sink), origin=origin).close()
    for origin in ("https://example.com", "http://localhost.example.com", "null", "http://127.0.0.1.evil"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(url(sink), origin=origin)


@pytest.mark.parametrize("path", ["", "/newest"])
@pytest.mark.parametrize("host", ["", "0.0.0.0", "[::1]"])
def test_pages_of_other_machines_are_served_if_they_are_allowed(host, path):
    for pages in ("own", "all"):
        with contextlib.closing(open_sink(f"ws://{host}:0?pages={pages}")) as sink:
            address = f"ws://{host if host == '[::1]' else '127.0.0.1'}:{sink.port}{path}"
            connect(address, origin="http://localhost:8000").close()
            connect(address).close()  # no browser
            refused = (
                pytest.raises(InvalidStatus, match="403") if pages == "own" else contextlib.nullcontext()
            )
            for origin in ("https://example.com", "null", f"http://127.0.0.1.example.com:{sink.port}"):
                with refused:
                    connect(address, origin=origin).close()


def read_nothing(port: int) -> socket.socket:
    return raw_client(port)


def say_nothing(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port))


def babble(port: int) -> socket.socket:
    one = say_nothing(port)
    one.sendall(b"GET / HTTP/1.1\r\nX: ")
    return one


def half_close(port: int) -> socket.socket:
    one = say_nothing(port)
    one.shutdown(socket.SHUT_WR)
    return one


@pytest.mark.parametrize("call", [read_nothing, say_nothing, babble, half_close])
def test_connections_that_stay_are_counted_and_bounded(call, message, capfd, caplog, monkeypatch):
    """A good receiver gets every frame meanwhile, and another one is let in when some of the others left."""
    monkeypatch.setattr(web_socket, "MOST_CONNECTIONS", 8)
    with contextlib.ExitStack() as stack:
        sink = open_sink("ws://:0")
        stack.callback(sink.close)
        good = stack.enter_context(connect(url(sink)))
        wait_for(lambda: sink.num_clients == 1)
        files = len(os.listdir("/proc/self/fd")) if os.path.exists("/proc/self/fd") else None
        others = []
        for _ in range(200):
            with contextlib.suppress(ConnectionError, AssertionError):  # refused
                others.append(call(sink.port))
        if call is not half_close:  # whose connections end at once
            wait_for(lambda: sink._socket.refused > 100)
            with pytest.warns(HandSimWarning, match=f"port {sink.port} refuses further connections: 8 are"):
                sink.send(message(0))
            assert re.fullmatch(r"\d+ connections were refused", sink.note)
            assert files is None or len(os.listdir("/proc/self/fd")) <= files + len(others) + 8
        else:
            with warnings.catch_warnings(action="ignore"):
                sink.send(message(0))
        assert received(good, 2)[1]["number"] == 0
        for one in others:
            one.close()
        wait_for(lambda: sink.num_clients == 1)

        def is_let_in() -> bool:
            with contextlib.suppress(OSError, WebSocketException):
                stack.enter_context(connect(url(sink)))
                return True
            return False

        wait_for(is_let_in)
    assert capfd.readouterr() == ("", "") and "Traceback" not in caplog.text


@pytest.mark.parametrize("pause", [0.0, 0.005])
def test_a_process_without_free_files_prints_no_traceback(pause):
    """The system allows fewer files than connections, which come at once or one after the other."""
    pytest.importorskip("resource")
    process = subprocess.Popen(
        [sys.executable, "-c", FEW_FILES, "ws://:0"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    port = int(process.stdout.readline())
    clients = []
    for _ in range(60):
        clients.append(socket.create_connection(("127.0.0.1", port)))
        time.sleep(pause)
    _, said = process.communicate("\n", timeout=LONG)
    for one in clients:
        one.close()
    assert (process.returncode, said) == (0, "")


def test_the_last_frames_are_sent_before_it_closes(message, monkeypatch):
    monkeypatch.setattr(web_socket, "_FLUSH_TIME", LONG)
    sink = open_sink("ws://:0?format=msgpack&every=yes")
    got: list[bytes] = []
    with connect(url(sink)) as client:
        wait_for(lambda: sink.num_clients == 1)
        reader = threading.Thread(target=lambda: got.extend(read_until_closed(client)))
        reader.start()
        for number in range(200):
            sink.send(message(number))
        sink.close()
        reader.join()
    *frames, end = [msgpack.unpackb(one) for one in got[1:]]
    assert [one["number"] for one in frames] == list(range(200))
    assert end == {"type": "end", "schema": 1}


@pytest.mark.parametrize("format", ["json", "msgpack"])
def test_a_slow_client_gets_the_newest_frame_whenever_it_reads(format, message, monkeypatch):
    """Whatever its library reads ahead: what comes while its program does other things is dropped."""
    monkeypatch.setattr(web_socket, "_FLUSH_TIME", LONG)
    sink = open_sink(f"ws://:0?format={format}")
    decode = json.loads if format == "json" else msgpack.unpackb
    for options in ({}, {"max_queue": 1}):
        with connect(url(sink), close_timeout=0.1, **options) as client:
            wait_for(lambda: sink.num_clients == 1)
            sink.send(message(0))
            assert decode(client.recv(timeout=LONG))["type"] == "header"
            for number in (1, 2):  # by which the sink knows that it is slow
                time.sleep(5.0 * web_socket._SLOW_READ)
                assert decode(client.recv(timeout=LONG))["type"] == "frame"
                sink.send(message(number))
            for last in range(10, 60, 10):
                dropped = sink.dropped
                for number in range(last - 9, last + 1):
                    sink.send(message(number))
                wait_for(lambda dropped=dropped: sink.dropped >= dropped + 9)
                time.sleep(5.0 * web_socket._SLOW_READ)
                assert decode(client.recv(timeout=LONG))["number"] == last
        wait_for(lambda: sink.num_clients == 0)
    sink.close()


@pytest.mark.parametrize("agent", ["Python websockets/16.1.1", "other"])
def test_clients_that_read_at_once_get_frames_until_the_end(agent, message, monkeypatch):
    monkeypatch.setattr(web_socket, "_FLUSH_TIME", LONG)
    sink, got = open_sink("ws://:0"), []
    with connect(url(sink), user_agent_header=agent) as client:
        wait_for(lambda: sink.num_clients == 1)
        reader = threading.Thread(target=lambda: got.extend(map(json.loads, client)))  # ends without an error
        reader.start()
        for number in range(20):
            sink.send(message(number))
            wait_for(lambda number=number: got and got[-1].get("number") == number)
        sink.close()
        reader.join()
    assert [one["type"] for one in got] == ["header", *["frame"] * 20, "end"] and sink.dropped == 0


def test_a_client_that_does_not_read_gets_one_old_frame_and_the_end(message, monkeypatch):
    monkeypatch.setattr(web_socket, "_FLUSH_TIME", LONG)
    sink = open_sink("ws://:0")
    with connect(url(sink)) as client:
        wait_for(lambda: sink.num_clients == 1)
        while sink.dropped < 50:
            sink.send(message())
            time.sleep(0.001)
        closing = threading.Thread(target=sink.close)
        closing.start()
        assert [json.loads(text)["type"] for text in client] == ["header", "frame", "end"]
    closing.join()


def test_a_client_of_every_frame_hears_how_far_it_is_behind(message):
    sink = open_sink("ws://:0?points=yes")
    with connect(f"{url(sink)}/?every=1", max_queue=1, close_timeout=0.1) as client:
        wait_for(lambda: sink.num_clients == 1)
        while sink.dropped < 20:
            sink.send(message(points=2000))
            time.sleep(0.001)
        got = []
        while not got or got[-1]["type"] != "lag":
            got.append(json.loads(client.recv(timeout=LONG)))
    assert got[-1]["lag"] > 0.05 and "/newest" in got[-1]["hint"]
    sink.close()


@pytest.mark.parametrize("path", ["/newest", "/newest/", "/newest?who=robot"])
def test_a_client_may_ask_for_the_newest_frame(path, message):
    sink = open_sink("ws://:0")
    with connect(url(sink) + path) as client:
        wait_for(lambda: sink.num_clients == 1)
        sink.send(message(0))
        assert received(client, 1)[0]["type"] == "header"
        for last in range(10, 60, 10):
            for number in range(last - 10, last + 1):
                sink.send(message(number))
            wait_for(lambda last=last: sink.dropped == last + 1)
            client.send("")
            assert received(client, 1)[0]["number"] == last
    sink.close()


def test_the_client_of_the_page_runs_as_it_stands_until_the_end(message, capsys):
    page = (ROOT / "docs" / "live_output.md").read_text()
    (code,) = re.findall(
        r"^import json\nimport time\nfrom websockets.*?(?=^```)", page, re.DOTALL | re.MULTILINE
    )
    sink = open_sink("ws://:0")
    client = threading.Thread(target=exec, args=(code.replace("8765", str(sink.port)), {}))
    client.start()
    wait_for(lambda: sink.num_clients == 1)
    for _ in range(20):
        sink.send(message())
        time.sleep(0.01)
    sink.close()
    client.join(LONG)
    assert not client.is_alive()
    lines, at = capsys.readouterr().out.splitlines(), message().header.positions.index("index_tip")
    assert len(lines) > 2
    for line, hand in zip(lines, message().hands, strict=False):
        side, _, tip = line.partition(" ")
        assert side == hand.side
        np.testing.assert_allclose(json.loads(tip), hand.positions[at], atol=1e-6)


def test_a_misspelled_path_is_refused(sink):
    connect(f"{url(sink)}/").close()
    for path in ("/Newest", "/latest", "/newest/frame"):
        with pytest.raises(InvalidStatus, match="404") as refused:
            connect(url(sink) + path)
        assert refused.value.response.body == b"expected / or /newest\n"


def test_clients_hear_of_a_new_size(message):
    sink = open_sink("ws://:0?joints=openxr")
    larger = dataclasses.replace(message(1).header, radii=((0.02,) * 26,) * len(message(1).header.sides))
    with connect(f"{url(sink)}/newest") as asking, connect(url(sink)) as client:
        wait_for(lambda: sink.num_clients == 2)
        sink.send(message(0))
        assert [one["type"] for one in received(client, 2)] == ["header", "frame"]
        assert received(asking, 1)[0]["radii"] != [[0.02] * 26] * len(larger.sides)
        for number in (1, 2):
            sink.send(dataclasses.replace(message(number), header=larger))
        asking.send("")
        (header,) = received(asking, 1)
        assert header["type"] == "header" and header["radii"] == [[0.02] * 26] * len(larger.sides)
        sink.send(dataclasses.replace(message(3), header=larger))
        asking.send("")
        assert received(asking, 1)[0]["number"] == 3
        heard = received(client, 2)
        assert [one["type"] for one in heard] == ["header", "frame"] and heard[0] == header
    sink.close()


def test_a_stalled_client_does_not_hold_up_the_end(sink, message):
    stalled = raw_client(sink.port)
    wait_for(lambda: sink.num_clients == 1)
    frame = message(0)
    for _ in range(3000):
        sink.send(frame)
    wait_for(lambda: sink.dropped > 0)
    sink.close()
    stalled.settimeout(LONG)
    with contextlib.suppress(ConnectionResetError):
        while stalled.recv(1 << 16):
            pass  # until it is cut off
    stalled.close()


def test_a_server_starts_again_at_the_same_port(message):
    port = 0
    for number in range(3):
        sink = open_sink(f"ws://127.0.0.1:{port}")
        port = sink.port
        with connect(url(sink)) as client:
            wait_for(lambda sink=sink: sink.num_clients == 1)
            sink.send(message(number))
            assert [one["type"] for one in received(client, 2)] == ["header", "frame"]
            sink.close()


def test_a_port_in_use_is_told(sink):
    with error_names(ArgumentError, f"port {sink.port} of 127.0.0.1 cannot be listened at (Address"):
        open_sink(f"ws://127.0.0.1:{sink.port}")
    with pytest.raises(ArgumentError, match="cannot be listened at"):
        open_sink("ws://192.0.2.7:8765")
