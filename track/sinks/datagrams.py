"""Messages as UDP datagrams: each frame is one, and the header comes again every second."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Final

from handsim.errors import ArgumentError
from track.sinks.documents import Encode, frame_document, header_document
from track.sinks.message import LiveHeader, LiveMessage
from track.sinks.osc_bundles import OscEncoder

_HEADERS: Final = 1.0  # [s] between two headers: whoever listens later has not heard the first one


class DatagramSink:
    """Sends datagrams to one address and never waits: what the network does not take is dropped and counted.

    Args:
        host: Name or address of the receiver.
        port: Its UDP port.
        header: Makes the datagram of a header.
        frame: Makes the datagram of a frame.

    Raises:
        ArgumentError: The host is unknown.
    """

    def __init__(
        self,
        host: str,
        port: int,
        header: Callable[[LiveHeader], bytes],
        frame: Callable[[LiveMessage], bytes],
    ) -> None:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind)
        except OSError as error:
            raise ArgumentError(f"host '{host}' cannot be sent to ({error.strerror or error})") from error
        self._socket.setblocking(False)
        self._address, self._header, self._frame = address, header, frame
        self._due = 0.0
        self.dropped = 0
        """Number of datagrams that were not sent."""

    def send(self, message: LiveMessage) -> None:
        """Send a frame, and before it the header when that is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + _HEADERS
            self._say(self._header(message.header))
        self._say(self._frame(message))

    def close(self) -> None:
        """Send nothing more."""
        self._socket.close()

    def _say(self, datagram: bytes) -> None:
        try:
            self._socket.sendto(datagram, self._address)
        except OSError:  # the buffer is full, the network is down, or it is too large for a datagram
            self.dropped += 1


def osc_sink(host: str, port: int) -> DatagramSink:
    """A sink of OSC bundles.

    Raises:
        ArgumentError: The host is unknown, or the package python-osc is missing.
    """
    encoder = OscEncoder()
    return DatagramSink(host, port, encoder.header, encoder.frame)


def document_sink(host: str, port: int, encode: Encode, *, points: bool) -> DatagramSink:
    """A sink of documents.

    Args:
        host: Name or address of the receiver.
        port: Its UDP port.
        encode: Makes bytes of a document.
        points: Whether the points are sent too.

    Raises:
        ArgumentError: The host is unknown.
    """
    return DatagramSink(
        host,
        port,
        lambda header: encode(header_document(header)),
        lambda message: encode(frame_document(message, points=points)),
    )
