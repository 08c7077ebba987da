"""Frames from Qualisys Track Manager (QTM) over its real-time protocol: TCP packets, little-endian.

A packet has its size, its kind (two uint32) and a payload. Frames are data packets with up to two components
here: identified markers, which keep their place in the list, and unidentified ones with IDs.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from handsim.errors import CaptureError
from track.streams.frame_source import StreamedFrame

if TYPE_CHECKING:
    from jaxtyping import Int

PORT: Final = 22223
"""QTM's port for little-endian clients."""
_VERSION: Final = b"1.23"
_PATIENCE: Final = 3.0  # [s] to wait for an answer
_RETRY: Final = 1.0  # [s] between attempts to reach a server that went away
_LARGEST: Final = 1 << 20  # bytes of a packet: 3D points of a frame take a few kilobytes
_STREAM: Final = b"StreamFrames AllFrames 3D 3DNoLabels"
_STARTS: Final = (1, 3, 8)  # events after which frames are to be asked for again: they end with a measurement
_LABELED: Final = np.dtype([("position", "<f4", 3)])
_UNLABELED: Final = np.dtype([("position", "<f4", 3), ("id", "<u4")])
_FIRST_ID: Final = 1 << 16  # of unidentified markers, beyond the places of the identified ones
_IDS: Final = 1 << 30


class PacketKind(IntEnum):
    """Kinds of packets that are used here."""

    ERROR = 0
    COMMAND = 1
    DATA = 3
    NO_MORE_DATA = 4
    EVENT = 6


class ComponentKind(IntEnum):
    """Components of a frame that are used here."""

    LABELED = 1
    UNLABELED = 2


class DamagedStream(ValueError):
    """Bytes that are not packets of the protocol."""


class QualisysSource:
    """A `FrameSource` of the 3D points that QTM computes in real time; it connects again when QTM went away.

    Args:
        host: The machine that QTM runs on.
        port: Its port.

    Raises:
        CaptureError: No QTM answers there.
    """

    def __init__(self, host: str, port: int = PORT) -> None:
        self._address = host, port
        self._closed = threading.Event()
        self._packets = self._connect()

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The frames in the order of their times; without an end."""
        while not self._closed.is_set():
            try:
                yield from self._frames()
            except OSError:
                pass
            self._packets.close()
            while not self._closed.wait(_RETRY):
                try:
                    self._packets = self._connect()
                    break
                except CaptureError:
                    continue

    def close(self) -> None:
        """Disconnect."""
        self._closed.set()
        self._packets.close()

    def _connect(self) -> _Connection:
        host, port = self._address
        try:
            connection = _Connection(socket.create_connection(self._address, _PATIENCE))
        except OSError as error:
            raise CaptureError(
                f"qtm://{host}:{port}: cannot be reached ({error.strerror or error}); is QTM running there?"
            ) from error
        try:
            _greet(connection)
        except (OSError, DamagedStream) as error:
            connection.close()
            raise CaptureError(f"qtm://{host}:{port}: QTM does not answer as expected ({error})") from error
        return connection

    def _frames(self) -> Iterator[StreamedFrame]:
        """The frames of a connection, until it ends."""
        connection = self._packets
        connection.send(_STREAM)
        while not self._closed.is_set():
            kind, payload = connection.receive()
            if kind == PacketKind.DATA:
                yield parse_frame(payload)
            elif kind == PacketKind.EVENT and payload[:1] in map(_byte, _STARTS):
                connection.send(_STREAM)
            elif kind == PacketKind.ERROR:
                raise CaptureError(f"QTM refuses to stream 3D points ({_text(payload)})")


def parse_frame(payload: bytes) -> StreamedFrame:
    """Read a data packet.

    The ID of an identified marker is its place in QTM's list; those of the others are QTM's, and lie beyond.

    Raises:
        DamagedStream: It is truncated.
    """
    if len(payload) < 16:
        raise DamagedStream("a frame without a header")
    stamp, number, count = struct.unpack_from("<QII", payload)
    points, ids, at = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)], 16
    for _ in range(count):
        if len(payload) - at < 8:
            raise DamagedStream("counts more components than there are")
        size, kind = struct.unpack_from("<II", payload, at)
        if not 8 <= size <= len(payload) - at:
            raise DamagedStream("a component larger than its frame")
        if kind in (ComponentKind.LABELED, ComponentKind.UNLABELED):
            markers = _markers(payload[at + 8 : at + size], kind)
            own = np.arange(len(markers)) if kind == ComponentKind.LABELED else _beyond(markers["id"])
            there = np.isfinite(markers["position"]).all(axis=1)
            points.append(1e-3 * markers["position"][there].astype(np.float64))
            ids.append(own[there])
        at += size
    return StreamedFrame(number, 1e-6 * stamp, np.concatenate(points), np.concatenate(ids))


def _markers(content: bytes, kind: int) -> Any:
    """The markers of a component, [mm]; those that are missing are NaN."""
    row = _LABELED if kind == ComponentKind.LABELED else _UNLABELED
    if len(content) < 8:
        raise DamagedStream("a component without a count")
    (count,) = struct.unpack_from("<I", content)  # two rates of lost pictures follow
    if count * row.itemsize > len(content) - 8:
        raise DamagedStream("counts more markers than there are")
    return np.frombuffer(content, row, count, offset=8)


def _beyond(ids: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    return _FIRST_ID + ids.astype(np.int64) % _IDS


def _greet(connection: _Connection) -> None:
    """Hear the welcome, and agree on a version."""
    kind, payload = connection.receive()
    if kind != PacketKind.COMMAND:
        raise DamagedStream(_text(payload) or "it does not greet")
    connection.send(b"Version " + _VERSION)
    kind, payload = connection.receive()
    while kind not in (PacketKind.COMMAND, PacketKind.ERROR):  # an event may come between
        kind, payload = connection.receive()
    if not payload.lower().startswith(b"version set"):
        raise DamagedStream(_text(payload))
    connection.await_frames()


class _Connection:
    """Packets over TCP."""

    def __init__(self, one: socket.socket) -> None:
        self._socket = one
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = bytearray()

    def await_frames(self) -> None:
        """From now on wait for packets however long it takes."""
        self._socket.settimeout(None)

    def send(self, command: bytes) -> None:
        """Send a command."""
        self._socket.sendall(struct.pack("<II", 8 + len(command) + 1, PacketKind.COMMAND) + command + b"\0")

    def receive(self) -> tuple[int, bytes]:
        """Wait for a packet: its kind and its payload.

        Raises:
            DamagedStream: There is none of a possible size.
            OSError: The connection ended.
        """
        size, kind = struct.unpack("<II", self._read(8))
        if not 8 <= size <= _LARGEST:
            raise DamagedStream(f"a packet of {size} bytes, expected 8 to {_LARGEST}")
        return kind, self._read(size - 8)

    def close(self) -> None:
        """End the connection; a `receive` in another thread ends too."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # it has ended already
        self._socket.close()

    def _read(self, count: int) -> bytes:
        while len(self._received) < count:
            part = self._socket.recv(1 << 16)
            if not part:
                raise ConnectionResetError("the connection ended")
            self._received += part
        content = bytes(self._received[:count])
        del self._received[:count]
        return content


def _byte(value: int) -> bytes:
    return bytes((value,))


def _text(payload: bytes) -> str:
    """A message of QTM, at most some words of it."""
    return payload.split(b"\0")[0][:200].decode("ascii", "replace")
