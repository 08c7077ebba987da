"""QTM's real-time protocol: a server that speaks it as it is documented, and the published client."""

from __future__ import annotations

import contextlib
import itertools
import socket
import struct
import threading

import numpy as np
import pytest

from handsim.errors import CaptureError
from tests.sentences import error_names
from tests.waiting import wait_for
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
        self.junk = b""
        """Bytes that are sent once, before frames."""
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
            except OSError:
                return
            with contextlib.suppress(OSError):  # The client may end the connection at any time.
                if self._answers:
                    self._client.sendall(packet(COMMAND, b"QTM RT Interface connected\0"))
                self._talk(self._client)

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
                junk, self.junk = self.junk, b""
                client.sendall(junk)
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
        for one in (self._socket, self._client):  # Nobody can connect in between.
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


def lying(count: int = 1, size: int = 28, kind: int = LABELED, time: int = 0, components: int = 1) -> bytes:
    """A data packet of a single point whose head says something else."""
    content = struct.pack("<IIIHH", size, kind, count, 0, 0) + struct.pack("<fff", 1.0, 2.0, 3.0)
    return packet(DATA, struct.pack("<QII", time, 1, components) + content)


@pytest.mark.parametrize(
    "junk",
    [
        lying(count=2**31),
        lying(count=2**32 - 1),
        lying(components=2**31),
        lying(size=2**31, components=2),
        lying(kind=99),
        lying(time=2**63 - 1),
        lying(time=2**63),
        packet(DATA, b""),
        packet(99, b"what is this?"),
        packet(EVENT, b""),
    ],
)
def test_a_packet_that_lies_is_counted_and_left_out(junk):
    with Qtm() as server:
        server.junk = junk
        stream = open_source(server.url)
        assert numbers(stream, 5) == [1, 2, 3, 4, 5]
        assert stream.counts["damaged_packets"] == 1 and stream.counts["restarts"] == 0
        stream.close()


@pytest.mark.parametrize("size", [0, 7, 1 << 25, 1 << 31, (1 << 32) - 1])
@pytest.mark.parametrize("kind", [DATA, COMMAND])
def test_a_packet_of_a_false_size_ends_the_connection_and_a_new_one_begins(size, kind):
    with Qtm() as server:
        server.junk = struct.pack("<II", size, kind)
        stream = open_source(server.url)
        assert numbers(stream, 5) == [1, 2, 3, 4, 5]
        assert stream.counts["damaged_packets"] == 1
        stream.close()


def test_why_no_frame_comes_is_told():
    with Qtm(measuring=False) as server:
        stream = open_source(server.url, silence=0.3)
        assert next(stream).silent
        assert stream.silence_doubt.startswith("QTM answers, but sends no frame; start real time")
    assert next(stream).silent
    wait_for(lambda: stream.silence_doubt == f"QTM at {LOOPBACK} went away; it is called again and again")
    stream.close()


@pytest.mark.parametrize("scheme", ["qtm", "natnet"])
@pytest.mark.parametrize("host", ["no-such-host.invalid", "1.2.3.4.5", "a" * 70])
def test_a_name_that_is_no_machine_is_one_sentence(scheme, host):
    with error_names(CaptureError, f"'{host}' cannot be reached | such as 192.168.1.5"):
        open_source(f"{scheme}://{host}")


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
        with pytest.raises(
            NoServerError, match=rf"^qtm://127.0.0.1:{port}: no QTM answers, .* listens at port {port}"
        ):
            open_source(f"qtm://{LOOPBACK}:{port}")


def test_a_server_that_says_nothing_is_no_qtm(monkeypatch):
    monkeypatch.setattr("track.streams.qualisys._PATIENCE", 0.3)
    with Qtm(answers=False) as server, pytest.raises(CaptureError, match="no QTM answers"):
        open_source(server.url)
