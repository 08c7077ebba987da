"""The WebSocket server with clients of the real library on real sockets."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import threading
import time

import msgpack
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from handsim.errors import ArgumentError
from tests.sentences import error_names
from tests.waiting import LONG, wait_for
from track import sinks
from track.sinks import open_sink


@pytest.fixture
def sink():
    one = open_sink("ws://:0")
    yield one
    one.close()


def url(sink) -> str:
    return f"ws://127.0.0.1:{sink.port}"


def read(client, count: int) -> list[dict]:
    return [json.loads(client.recv(timeout=LONG)) for _ in range(count)]


def test_clients_get_the_header_and_every_frame(sink, message):
    with connect(url(sink)) as one, connect(url(sink)) as two:
        wait_for(lambda: sink.num_clients == 2)
        for number in range(100):
            sink.send(message(number))
        for client in (one, two):
            header, *frames = read(client, 101)
            assert header["type"] == "header" and [frame["number"] for frame in frames] == list(range(100))
    assert sink.dropped == 0
    wait_for(lambda: sink.num_clients == 0)


def test_a_late_client_gets_the_header_first(sink, message):
    with connect(url(sink)) as early:
        wait_for(lambda: sink.num_clients == 1)
        for number in range(10):
            sink.send(message(number))
        read(early, 11)
        with connect(url(sink)) as late:
            wait_for(lambda: sink.num_clients == 2)
            sink.send(message(10))
            header, frame = read(late, 2)
    assert header["type"] == "header" and frame["number"] == 10
    assert header["angles"][0] == "thumb_CMC_abduction"


def test_a_slow_client_loses_frames_and_delays_nobody(message):
    """It reads nothing at all: sending goes on, and the other client gets everything."""
    sink = open_sink("ws://:0?points=yes")
    slow = raw_client(sink.port)
    with connect(url(sink)) as quick:
        wait_for(lambda: sink.num_clients == 2)
        got: list[str] = []
        reader = threading.Thread(target=lambda: got.extend(read_until_closed(quick)))
        reader.start()
        frame, sent = message(0, points=800), 0  # large: they soon fill the system's buffers
        while sink.dropped < 50 and sent < 5000:
            sink.send(frame)
            sent += 1
            wait_for(lambda least=sent - sinks._WAITING // 2: len(got) > least)
        assert sink.dropped >= 50, "the slow client lost frames"
        wait_for(lambda: len(got) == sent + 1)
        slow.close()
        sink.close()
        reader.join()


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
        assert read(client, 2)[1]["number"] == 3
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
        assert read(client, 2)[1]["number"] == 1


def test_pages_of_other_machines_are_refused(sink):
    for origin in ("http://localhost:8000", "http://127.0.0.1", "https://[::1]:5173"):
        connect(url(sink), origin=origin).close()
    for origin in ("https://example.com", "http://localhost.example.com", "null", "http://127.0.0.1.evil"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(url(sink), origin=origin)


def test_an_address_of_the_network_serves_all_pages():
    sink = open_sink("ws://0.0.0.0:0")
    try:
        connect(url(sink), origin="https://example.com").close()
    finally:
        sink.close()


def test_it_listens_on_loopback(sink):
    assert sink._socket.getsockname()[0] == "127.0.0.1"


def test_the_last_frames_are_sent_before_it_closes(message, monkeypatch):
    monkeypatch.setattr(sinks, "_FLUSH", LONG)
    sink = open_sink("ws://:0?format=msgpack")
    got: list[bytes] = []
    with connect(url(sink)) as client:
        wait_for(lambda: sink.num_clients == 1)
        reader = threading.Thread(target=lambda: got.extend(read_until_closed(client)))
        reader.start()
        for number in range(200):
            sink.send(message(number))
        sink.close()
        reader.join()
    assert [msgpack.unpackb(one)["number"] for one in got[1:]] == list(range(200))


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
            assert [one["type"] for one in read(client, 2)] == ["header", "frame"]
            sink.close()


def test_a_port_in_use_is_told(sink):
    with error_names(ArgumentError, f"port {sink.port} of 127.0.0.1 cannot be listened at (Address"):
        open_sink(f"ws://127.0.0.1:{sink.port}")
    with pytest.raises(ArgumentError, match="cannot be listened at"):
        open_sink("ws://192.0.2.7:8765")
