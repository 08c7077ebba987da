"""Datagrams over real sockets: OSC to python-osc's server, documents to a socket."""

from __future__ import annotations

import dataclasses
import json
import socket
import threading
from types import SimpleNamespace

import msgpack
import numpy as np
import pytest
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_server import BlockingOSCUDPServer

from handsim.errors import ArgumentError
from tests.waiting import LONG, wait_for
from track import sinks
from track.sinks import open_sink, osc_format

ENCODER = osc_format()


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
    got = [decode(receiver.recv(65536)) for _ in range(4)]
    assert got[0]["type"] == "header" and [one["number"] for one in got[1:]] == [0, 1, 2]
    assert "points" not in got[1]
    sink.close()


def test_who_listens_later_hears_the_header_too(receiver, message, monkeypatch):
    now = [50.0]
    monkeypatch.setattr(sinks, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sink = open_sink(f"udp://127.0.0.1:{receiver.getsockname()[1]}?points=yes")
    for number in range(8):
        sink.send(message(number))
        now[0] += 0.25
    got = [json.loads(receiver.recv(65536)) for _ in range(10)]
    assert [one["type"] for one in got] == ["header", *["frame"] * 4] * 2
    assert len(got[1]["points"]) == len(got[1]["labels"]) == 5
    sink.close()


def test_nobody_listening_is_no_error_and_too_much_is_counted(receiver, message):
    port = receiver.getsockname()[1]
    receiver.close()
    sink = open_sink(f"udp://127.0.0.1:{port}?points=yes")
    for number in range(5):
        sink.send(message(number))
    assert sink.dropped == 0
    sink.send(message(5, points=5000))  # no datagram holds it
    assert sink.dropped == 1
    sink.close()


def test_an_unknown_host_is_told():
    with pytest.raises(ArgumentError, match=r"host 'no-such-host\.invalid' cannot be sent to"):
        open_sink("osc://no-such-host.invalid:9000")


def read(datagram: bytes) -> dict[str, list]:
    assert OscBundle.dgram_is_bundle(datagram)
    return {one.address: list(one.params) for one in OscBundle(datagram)}


def test_a_frame(message):
    one = message(7)
    got = read(ENCODER.frame(one))
    assert got.pop("/handsim/frame") == [7, one.time, 0]
    for hand in one.hands:
        assert got.pop(f"/handsim/{hand.side}/status") == ["tracked"]
        wrist = [*hand.position, *hand.quaternion]
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/wrist"), np.float32(wrist))
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/angles"), np.float32(hand.angles))
        positions = np.reshape(got.pop(f"/handsim/{hand.side}/positions"), (21, 3))
        np.testing.assert_array_equal(positions, np.float32(hand.positions))
    assert got.pop("/handsim/body/mug/status") == ["tracked"]
    np.testing.assert_allclose(got.pop("/handsim/body/mug/pose"), [0.1, 0.2, 0.3, 1, 0, 0, 0], rtol=1e-6)
    assert not got


def test_of_a_lost_hand_only_the_status_is_sent(message):
    got = read(ENCODER.frame(message(lost=True)))
    assert got["/handsim/left/status"] == got["/handsim/body/mug/status"] == ["lost"]
    assert [address for address in got if "left" in address or "mug" in address] == [
        "/handsim/left/status",
        "/handsim/body/mug/status",
    ]


def test_the_names(message):
    header = message().header
    got = read(ENCODER.header(header))
    assert got["/handsim/schema"] == [1] and got["/handsim/sides"] == ["right", "left"]
    assert got["/handsim/angles"] == list(header.angles)
    assert got["/handsim/positions"] == list(header.positions)
    assert got["/handsim/bodies"] == ["mug"]


def test_names_of_bodies_become_parts_of_addresses(message):
    one = message()
    odd = dataclasses.replace(one.bodies[0], name="my pen #2/ä")
    got = read(ENCODER.frame(dataclasses.replace(one, bodies=(odd,))))
    assert "/handsim/body/my_pen__2__/status" in got


def test_a_late_number_is_one_of_osc_s(message):
    assert read(ENCODER.frame(message(2**31 + 5)))["/handsim/frame"][0] == 5


def test_two_hands_fit_into_one_packet_of_ethernet(message):
    assert len(ENCODER.frame(message())) < 1472
