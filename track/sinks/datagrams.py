"""Messages as UDP datagrams: each frame is one, and the header comes again every second.

A datagram is a document, or a bundle of Open Sound Control 1.0 by python-osc (docs/live_output.md has the
addresses).
"""

from __future__ import annotations

import math
import re
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import numpy as np

from handsim._plugins import import_extra
from handsim.errors import ArgumentError
from track.sinks.documents import Encode, frame_document, header_document
from track.sinks.message import SCHEMA, LiveHeader, LiveMessage

_RESERVED: Final = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # not allowed in a part of an address
_MOST_NUMBER: Final = 0x7FFFFFFF

_Content = tuple[str, str, Sequence[Any]]
"""Address, types and values of an OSC message."""
_HEADERS: Final = 1.0  # [s] between two headers: whoever listens later has not heard the first one


class OscEncoder:
    """Makes bundles of messages.

    Raises:
        ArgumentError: The package python-osc is missing.
    """

    def __init__(self) -> None:
        self._messages: Any = import_extra("pythonosc.osc_message_builder", "osc://", "send")
        self._bundles: Any = import_extra("pythonosc.osc_bundle_builder", "osc://", "send")

    def header(self, header: LiveHeader) -> bytes:
        """The names in the order of the numbers."""
        names = {
            "sides": header.sides,
            "angles": header.angles,
            "positions": header.positions,
            "bodies": [_part(name) for name in header.bodies],
        }
        contents = [_strings(f"/handsim/{name}", values) for name, values in names.items()]
        return self._bundle([("/handsim/schema", "i", [SCHEMA]), *contents])

    def frame(self, message: LiveMessage) -> bytes:
        """A frame; of a hand or a body without a pose only the status."""
        number = message.number & _MOST_NUMBER
        contents: list[_Content] = [("/handsim/frame", "idi", [number, message.time, int(message.silent)])]
        if not math.isnan(message.lag):
            contents.append(("/handsim/lag", "f", [message.lag]))
        for hand in message.hands:
            address = f"/handsim/{hand.side}"
            contents.append(_strings(f"{address}/status", [str(hand.status)]))
            if hand.has_pose:
                contents.append(_floats(f"{address}/wrist", hand.position, hand.quaternion))
                contents.append(_floats(f"{address}/angles", hand.angles))
                contents.append(_floats(f"{address}/positions", hand.positions.ravel()))
        for body in message.bodies:
            address = f"/handsim/body/{_part(body.name)}"
            contents.append(_strings(f"{address}/status", [str(body.status)]))
            if body.has_pose:
                contents.append(_floats(f"{address}/pose", body.position, body.quaternion))
        return self._bundle(contents)

    def _bundle(self, contents: Iterable[_Content]) -> bytes:
        bundle = self._bundles.OscBundleBuilder(self._bundles.IMMEDIATELY)
        for address, types, values in contents:
            message = self._messages.OscMessageBuilder(address)
            for kind, value in zip(types, values, strict=True):
                message.add_arg(value, kind)
            bundle.add_content(message.build())
        datagram: bytes = bundle.build().dgram
        return datagram


def _part(name: str) -> str:
    """A name as a part of an address."""
    return _RESERVED.sub("_", name)


def _floats(address: str, *values: np.ndarray) -> _Content:
    numbers = np.concatenate(values).tolist()
    return address, "f" * len(numbers), numbers


def _strings(address: str, values: Sequence[str]) -> _Content:
    return address, "s" * len(values), values


class DatagramSink:
    """Sends datagrams to one address and never waits: what the network does not take is dropped and counted.

    Args:
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
