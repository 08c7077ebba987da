"""QTM's real-time protocol: a server that speaks it as it is documented, and the published client."""

from __future__ import annotations

import itertools
import socket
import struct
import threading

import numpy as np
import pytest

from handsim.errors import CaptureError
from track import open_source
from track.streams import LOOPBACK, NoServerError
from track.streams.qualisys import QualisysSource

ERROR, COMMAND, DATA, NO_MORE_DATA, EVENT = 0, 1, 3, 4, 6
LABELED, UNLABELED = 1, 2
STARTED = 3


def packet(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", 8 + len(payload), kind) + payload


def component(kind: int, rows: bytes, count: int) -> bytes:
    return struct.pack("<IIIHH", 16 + len(rows), kind, count, 0, 0) + rows


def data(number: int, labeled: np.ndarray, unlabeled: np.ndarray, ids: list[int]) -> bytes:
    """A data packet: positions [m], which the protocol has in [mm]."""
    named = (1e3 * labeled).astype("<f4").tobytes()
    rows = zip(1e3 * unlabeled, ids, strict=True)
    others = b"".join(struct.pack("<fffI", *point, one) for point, one in rows)
    components = component(LABELED, named, len(labeled)) + component(UNLABELED, others, len(ids))
    return packet(DATA, struct.pack("<QII", number * 10_000, number, 2) + components)


def frame(number: int) -> bytes:
    labeled = np.array([[0.001 * number, 0.2, 0.3], [np.nan] * 3])
    return data(number, labeled, np.array([[0.5, 0.6, -0.7]]), [3_000_000_000])


def numbers(stream, count: int) -> list[int]:
    """The numbers of the next frames, whatever silences are between them, as long as somebody waits."""
    some = itertools.islice(stream, 400)
    return [one.number for one in itertools.islice((one for one in some if not one.silent), count)]


class Qtm:
    """A server for one client at a time; it streams when it is asked to and `measuring`."""

    def __init__(
        self, port: int = 0, *, measuring: bool = True, frames: int = 5, answers: bool = True
    ) -> None:
        self._socket = socket.create_server((LOOPBACK, port))
        self.port: int = self._socket.getsockname()[1]
        self._frames, self._answers = frames, answers
        self.measuring = measuring
        self.heard: list[bytes] = []
        self._client: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"qtm://{LOOPBACK}:{self.port}"

    def _serve(self) -> None:
        while True:
            try:
                self._client, _ = self._socket.accept()
                if self._answers:
                    self._client.sendall(packet(COMMAND, b"QTM RT Interface connected\0"))
                self._talk(self._client)
            except OSError:
                return

    def _talk(self, client: socket.socket) -> None:
        while head := client.recv(8, socket.MSG_WAITALL):
            size, _ = struct.unpack("<II", head)
            command = client.recv(size - 8, socket.MSG_WAITALL).rstrip(b"\0")
            self.heard.append(command)
            if not self._answers:
                continue
            if command.lower().startswith(b"version"):
                client.sendall(packet(COMMAND, b"Version set to 1.23\0"))
            elif command.lower().startswith(b"streamframes") and self.measuring:
                for number in range(1, 1 + self._frames):
                    client.sendall(frame(number))
                client.sendall(packet(NO_MORE_DATA, b""))
            else:
                client.sendall(packet(ERROR, b"QTM is not measuring\0"))

    def start_measuring(self) -> None:
        self.measuring = True
        assert self._client is not None
        self._client.sendall(packet(EVENT, bytes([STARTED])))

    def __enter__(self) -> Qtm:
        return self

    def __exit__(self, *_: object) -> None:
        for one in (self._client, self._socket):
            if one is not None:
                try:
                    one.shutdown(socket.SHUT_RDWR)
                except OSError:
                    pass
                one.close()


def test_frames_arrive_in_meters_with_ids():
    with Qtm() as server:
        stream = open_source(server.url)
        frames = list(itertools.islice(stream, 5))
        stream.close()
    for number, one in enumerate(frames, start=1):
        assert one.number == number and one.time == pytest.approx(0.01 * number)
        np.testing.assert_allclose(one.points, [[0.001 * number, 0.2, 0.3], [0.5, 0.6, -0.7]], atol=1e-7)
        assert one.ids[0] == 0 and one.ids[1] >= 1 << 16
    assert server.heard == [b"version 1.23", b"streamframes allframes 3d 3dnolabels"]


def test_a_measurement_that_begins_later_is_streamed():
    with Qtm(measuring=False) as server:
        stream = open_source(server.url, silence=0.3)
        assert next(stream).silent
        server.start_measuring()
        assert numbers(stream, 5) == [1, 2, 3, 4, 5]
        stream.close()


def test_it_connects_again_when_qtm_went_away():
    with Qtm() as server:
        stream = open_source(server.url, silence=0.5)
        assert numbers(stream, 5) == [1, 2, 3, 4, 5]
    with Qtm(server.port, frames=2):
        assert numbers(stream, 2) == [1, 2]
    stream.close()


def test_a_stream_that_is_closed_ends():
    with Qtm() as server:
        source = QualisysSource(LOOPBACK, server.port)
        frames = iter(source)
        assert len(list(itertools.islice(frames, 5))) == 5
        threading.Timer(0.2, source.close).start()
        assert list(frames) == []


def test_nobody_there_is_one_sentence():
    with socket.socket() as one:
        one.bind((LOOPBACK, 0))
        port = one.getsockname()[1]
        with pytest.raises(NoServerError, match=rf"^qtm://127.0.0.1:{port}: no QTM answers, expected one"):
            open_source(f"qtm://{LOOPBACK}:{port}")


def test_a_server_that_says_nothing_is_no_qtm(monkeypatch):
    monkeypatch.setattr("track.streams.qualisys._PATIENCE", 0.3)
    with Qtm(answers=False) as server, pytest.raises(CaptureError, match="no QTM answers"):
        open_source(server.url)
