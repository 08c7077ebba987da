"""Live output: sinks send tracked frames to other programs immediately.

An address selects a sink, see `VALID`. Each frame goes to all sinks. A failing one does not stop the tracker.
"""

from __future__ import annotations

import math
import socket
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final

from gloves.fit import GloveFit
from handsim._checks import check_methods, check_type
from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, HandSimWarning
from handsim.space.transforms import FORWARD, PROGRAMS, room_axes
from track.bodies.rigid_body import RigidTemplate
from track.frames import StreamedFrame, TrackedFrame
from track.output.lab_streaming import LabStreamingSink
from track.output.live_message import (
    FORMATS,
    LARGEST_DATAGRAM,
    WORLD,
    Content,
    LiveMessage,
    LiveSink,
    MessageEncoder,
    MessageFormat,
    document_format,
)
from track.output.osc import osc_format
from track.output.web_socket import EVERY, WebSocketSink
from track.streams import split_address

VALID: Final = (*(f"{one}://host:port" for one in ("osc", "udp", "ws")), "lsl:NAME", "module:name")
"""Valid forms of an address."""
GROUP: Final = "handsim.sinks"
"""Entry points of packages that provide sinks."""
_METHODS: Final = (("send", "close"), "the methods send and close of a sink")
_NO_YES: Final = ("no", "yes")  # valid values of an option
_AXES_OPTIONS: Final = {
    "axes": (WORLD, *PROGRAMS),
    "up": ("z", "y"),
    "forward": FORWARD,
    "unit": ("auto", "m", "cm"),
    "velocities": _NO_YES,
}
_DOCUMENT_OPTIONS: Final = {"format": FORMATS, "points": _NO_YES, "joints": ("no", "openxr"), **_AXES_OPTIONS}
_OPTIONS: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "osc": _AXES_OPTIONS,
    "udp": _DOCUMENT_OPTIONS,
    "ws": {**_DOCUMENT_OPTIONS, "every": EVERY, "pages": ("own", "all")},
}
_HEADER_PERIOD: Final = 1.0  # [s] The header is repeated after this time for receivers that came late.


class SinkGroup(Closing):
    """Sends frames to sinks; the end of a `with` block closes them.

    Args:
        sinks: The sinks, by the addresses that opened them.
    """

    def __init__(self, sinks: Mapping[str, LiveSink]) -> None:
        self._sinks, self._all = dict(sinks), dict(sinks)
        self._encoder: MessageEncoder | None = None
        self._sent = 0

    def __bool__(self) -> bool:
        """Whether any sink is open."""
        return bool(self._sinks)

    def start(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        """Set the tracker's hands and bodies; nothing is sent before this call."""
        self._encoder = MessageEncoder(hands, bodies)

    def send(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Send a frame to every sink."""
        if self._encoder is None or not self._sinks:
            return
        message = self._encoder.encode(frame, tracked)
        self._sent += 1
        for address, sink in list(self._sinks.items()):
            try:
                sink.send(message)
            except Exception as error:  # A user's sink may raise anything; recording goes on.
                _warn(f"{address} failed and gets no further frame", error)
                self._close(address)

    @property
    def counts(self) -> dict[str, int]:
        """Number of frames that each sink has dropped, by address."""
        return {address: getattr(sink, "dropped", 0) for address, sink in self._all.items()}

    def notes(self) -> tuple[str, ...]:
        """Lines to print at the end."""
        sent = [f"{self._sent} frames sent to {', '.join(self._sinks)}"] if self._sinks and self._sent else []
        dropped = [f"{address}: {count} frames dropped" for address, count in self.counts.items() if count]
        noted = [f"{at}: {note}" for at, sink in self._all.items() if (note := getattr(sink, "note", ""))]
        return (*sent, *dropped, *noted)

    def close(self) -> None:
        """Close all sinks."""
        for address in list(self._sinks):
            self._close(address)

    def _close(self, address: str) -> None:
        try:
            self._sinks.pop(address).close()
        except Exception as error:  # A user's sink may raise anything.
            _warn(f"{address} could not be closed", error)


def _warn(what: str, error: Exception) -> None:
    warnings.warn(f"{what} ({type(error).__name__}: {error})", HandSimWarning, stacklevel=4)


def open_sinks(addresses: str | LiveSink | Sequence[str | LiveSink]) -> SinkGroup:
    """Open a sink for each address; sinks receive positions in [m] and angles in [rad].

    Args:
        addresses: One or several, each as in `VALID`, with the options of docs/live_output.md. A sink of your
            own may be given as an object.

    Raises:
        ArgumentError: An address is invalid or is given twice, a package is missing, or a port is taken.
    """
    chosen: Any = [addresses] if isinstance(addresses, str) or hasattr(addresses, "send") else addresses
    check_type("addresses", chosen, Sequence, f"a list of {', '.join(VALID)}, or of sinks")
    sinks: dict[str, LiveSink] = {}
    with ExitStack() as stack:
        for given in chosen:
            address = given if isinstance(given, str) else type(given).__name__
            if address in sinks:
                raise ArgumentError(f"--send {address} is given twice, expected once")
            if not isinstance(given, str):
                check_methods(address, given, *_METHODS)
            sinks[address] = open_sink(given) if isinstance(given, str) else given
            stack.callback(sinks[address].close)
        stack.pop_all()
    return SinkGroup(sinks)


def open_sink(address: str) -> LiveSink:
    """Open the sink of one address, see `open_sinks`."""
    scheme, _, rest = address.partition(":")
    if scheme in _OPTIONS and rest.startswith("//"):
        host, port, options = split_address(address, options=_OPTIONS[scheme], any_port=scheme == "ws")
        content = Content(
            points=options.get("points") == "yes",
            joints=options.get("joints") == "openxr",
            velocities=options["velocities"] == "yes",
            axes=options["axes"],
            up="y" if options["up"] == "y" else "z",
            unit=options["unit"],
            forward=options["forward"],
        )
        room_axes(content.up, content.forward)  # raises an error if these are one axis
        if scheme == "osc":
            return DatagramSink(host, port, osc_format(content))
        largest = LARGEST_DATAGRAM if scheme == "udp" else math.inf
        format = document_format(options.get("format", "json"), content, largest=largest)
        if scheme == "udp":
            return DatagramSink(host, port, format)
        every, all_pages = options.get("every") in EVERY[1:], options.get("pages") == "all"
        return WebSocketSink(host, port, format, every=every, all_pages=all_pages)
    if scheme == "lsl" and rest and not rest.startswith("//"):
        return LabStreamingSink(rest)
    name = address.partition("?")[0]
    if not (is_plugin(name) or name in list_plugins(GROUP)):
        raise ArgumentError(f"'{address}' is not an address to send to, expected {', '.join(VALID)}")
    sink: LiveSink = make_plugin(address, group=GROUP, noun="sink")
    check_methods(address, sink, *_METHODS)
    return sink


class DatagramSink:
    """Sends each frame as UDP datagrams, and the header every second; drops datagrams instead of waiting."""

    def __init__(self, host: str, port: int, format: MessageFormat) -> None:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind)
            self._socket.connect(address)  # so that the system reports if nobody listens at the port
        except OSError as error:
            raise ArgumentError(f"host '{host}' cannot be sent to ({error.strerror or error})") from error
        self._socket.setblocking(False)
        self._format, self._due = format, 0.0
        self.dropped = self.refused = self.sent = 0
        """Numbers of datagrams: not sent, refused because nobody listened, and all."""

    @property
    def note(self) -> str:
        """Whether anybody listened, as far as UDP reports it."""
        if self.refused:
            return f"nobody listened to {self.refused} of {self.sent} datagrams"
        return "UDP does not tell whether anybody listened"

    def send(self, message: LiveMessage) -> None:
        """Send a frame, and before it the header if it is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + _HEADER_PERIOD
            self._put(self._format.header(message.header))
        self._put(self._format.frame(message))

    def close(self) -> None:
        """Send the end message, and close the socket."""
        self._put(self._format.end())
        self._socket.close()

    def _put(self, datagrams: Iterable[bytes]) -> None:
        for datagram in datagrams:
            self.sent += 1
            try:
                try:
                    self._socket.send(datagram)
                except ConnectionRefusedError:  # The error is of an earlier datagram; this one was not sent.
                    self.refused += 1
                    self._socket.send(datagram)
            except OSError:  # full buffer, broken network or too large a datagram
                self.dropped += 1
