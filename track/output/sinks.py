"""Live output: sinks send tracked frames to other programs immediately.

An address selects a sink, see `VALID`. Each frame goes to all sinks. A failing one does not stop the tracker.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import os
import re
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qsl

import numpy as np

from gloves.fit import GloveFit
from gloves.takes.points import Status
from handsim._checks import check_methods, check_type
from handsim._plugins import import_extra, is_plugin, list_plugins, make_plugin
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, HandSimWarning
from handsim.space.transforms import FORWARD, PROGRAMS, room_axes
from track.bodies.rigid_body import RigidTemplate
from track.frames import StreamedFrame, TrackedFrame
from track.output.live_message import (
    FORMATS,
    LARGEST_DATAGRAM,
    SCHEMA,
    WORLD,
    Content,
    LiveHeader,
    LiveMessage,
    LiveSink,
    MessageEncoder,
    MessageFormat,
    document_format,
    in_axes,
)
from track.streams import split_address

VALID: Final = (*(f"{one}://host:port" for one in ("osc", "udp", "ws")), "lsl:NAME", "module:name")
"""Valid forms of an address."""
GROUP: Final = "handsim.sinks"
"""Entry points of packages that provide sinks."""
_LSL_FILES: Final = ("lsl_api.cfg", "~/lsl_api/lsl_api.cfg", "/etc/lsl_api/lsl_api.cfg")
_LSL_QUIET: Final = "[log]\nlevel = -1\n"  # LSL writes warnings alone, where the user has not configured it.
STATUSES: Final = tuple(reversed(Status))
"""A status channel of LSL holds an index into these."""
_METHODS: Final = (("send", "close"), "the methods send and close of a sink")
_YES: Final = ("no", "yes")  # valid values of an option
_EVERY: Final = (*_YES, "1")  # the same of `every`, for which clients ask, too
_AXES: Final = {
    "axes": (WORLD, *PROGRAMS),
    "up": ("z", "y"),
    "forward": FORWARD,
    "unit": ("auto", "m", "cm"),
    "velocities": _YES,
}
_DOCUMENTS: Final = {"format": FORMATS, "points": _YES, "joints": ("no", "openxr"), **_AXES}
_OPTIONS: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "osc": _AXES,
    "udp": _DOCUMENTS,
    "ws": {**_DOCUMENTS, "every": _EVERY, "pages": ("own", "all")},
}
_RESERVED: Final = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # not allowed in a part of an OSC address
_LARGEST_BUNDLE: Final = 8000  # [bytes] A frame is one bundle, which networks carry in several packets.
_BUNDLE_HEAD, _BUNDLE_ENTRY = 16, 4  # [bytes] overhead of an OSC bundle and of each message in it
_LARGEST_INTEGER: Final = 0x7FFFFFFF  # largest integer of an OSC message
_HEADER_PERIOD: Final = 1.0  # [s] The header is repeated after this time for receivers that came late.
_WAITING: Final = 256  # largest number of frames waiting for a client that wants every frame
_BEHIND: Final = 0.05  # [s] A client that wants every frame is told of a longer lag.
_TELL: Final = 1.0  # [s] least time between two reports of a client's lag, or two headers
_ON_REQUEST: Final = "/newest"  # path for clients that request each frame
_QUEUEING: Final = "websockets/"  # user agent of Python's websockets, which holds 16 parts of messages
_SLOW: Final = 0.01  # [s] A program that reads its frame later than this is waited for.
_PARTS: Final = 17  # With this many it reads no further, nor answers a ping, until its program reads.
_SEND_BUFFER: Final = 1 << 17  # [bytes] size of the system's send buffer for each client
MOST_CONNECTIONS: Final = 64
"""Largest number of open connections of a server."""
_FLUSH: Final = 1.0  # [s] time for clients to read waiting frames at the end
_OWN_PAGES: Final = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pages from this machine; the sink refuses other pages in its browsers."""
_XYZ: Final = ("x", "y", "z")
_POSE: Final = (*[(f"position_{axis}", "meters") for axis in _XYZ], *[(f"rotation_{c}", "") for c in "wxyz"])

_Content = tuple[str, str, Sequence[Any]]
"""Address, types and values of an OSC message."""


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
        told = [f"{at}: {note}" for at, sink in self._all.items() if (note := getattr(sink, "note", ""))]
        return (*sent, *dropped, *told)

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
        every, all_pages = options.get("every") in _EVERY[1:], options.get("pages") == "all"
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


def osc_format(content: Content = Content()) -> MessageFormat:  # noqa: B008 (immutable)
    """Messages as bundles of Open Sound Control 1.0; docs/live_output.md lists the addresses."""
    program = content.program
    messages: Any = import_extra("pythonosc.osc_message_builder", "osc://", "send")
    bundles: Any = import_extra("pythonosc.osc_bundle_builder", "osc://", "send")

    def built(content: _Content) -> Any:
        address, types, values = content
        message = messages.OscMessageBuilder(address)
        for kind, value in zip(types, values, strict=True):
            message.add_arg(value, kind)
        return message.build()

    def divided(contents: Iterable[_Content]) -> list[bytes]:
        """Bundles that fit into packets; each begins with the first message."""
        first, *others = map(built, contents)
        made, room = [], 0
        for message in others or [first]:
            if message.size + _BUNDLE_ENTRY > room:
                made.append(bundles.OscBundleBuilder(bundles.IMMEDIATELY))
                room = _LARGEST_BUNDLE - _BUNDLE_HEAD
                if message is not first:
                    made[-1].add_content(first)
                    room -= first.size + _BUNDLE_ENTRY
            made[-1].add_content(message)
            room -= message.size + _BUNDLE_ENTRY
        return [one.build().dgram for one in made]

    def frame(message: LiveMessage) -> list[bytes]:
        return divided(_osc_frame(message if program is None else in_axes(message, program), content))

    return MessageFormat(
        lambda header: divided(_osc_header(header)), frame, lambda: divided([("/handsim/end", "", [])])
    )


def _osc_header(header: LiveHeader) -> Iterator[_Content]:
    """Messages of the header: names in the order of the numbers in frames."""
    yield "/handsim/schema", "i", [SCHEMA]
    yield _strings("/handsim/sides", header.sides)
    yield _strings("/handsim/angles", header.angles)
    yield _strings("/handsim/positions", header.positions)
    yield _strings("/handsim/digits", header.digits)
    yield _strings("/handsim/bodies", [_part(name) for name in header.bodies])


def _osc_frame(message: LiveMessage, content: Content) -> Iterator[_Content]:
    """Messages of a frame; a hand or body without a pose has only a status."""
    yield "/handsim/frame", "idi", [message.number & _LARGEST_INTEGER, message.time, int(message.silent)]
    for name, seconds in (("lag", message.lag), ("latency", message.latency)):
        if not math.isnan(seconds):
            yield f"/handsim/{name}", "f", [seconds]
    for hand in message.hands:
        address = f"/handsim/{hand.side}"
        yield _strings(f"{address}/status", [str(hand.status)])
        if hand.has_pose:
            yield _floats(f"{address}/seen", np.array([hand.seen]))
            yield _strings(f"{address}/digits", [str(status) for status in hand.digits])
            yield _floats(f"{address}/wrist", hand.position, hand.quaternion)
            yield _floats(f"{address}/angles", hand.angles)
            yield _floats(f"{address}/positions", hand.positions.ravel())
        if not np.isnan(hand.angle_spread).any():
            yield _floats(f"{address}/angle_spread", hand.angle_spread)
            yield _floats(f"{address}/position_spread", hand.position_spread)
        if content.velocities and not np.isnan(hand.angle_velocities).any():
            yield _floats(f"{address}/angle_velocities", hand.angle_velocities)
            yield _floats(f"{address}/velocities", hand.find_velocities().ravel())
    for body in message.bodies:
        address = f"/handsim/body/{_part(body.name)}"
        yield _strings(f"{address}/status", [str(body.status)])
        if body.has_pose:
            yield _floats(f"{address}/pose", body.position, body.quaternion)


def _part(name: str) -> str:
    """Make a name valid as a part of an OSC address."""
    return _RESERVED.sub("_", name)


def _floats(address: str, *values: np.ndarray) -> _Content:
    numbers = np.concatenate(values).tolist()
    return address, "f" * len(numbers), numbers


def _strings(address: str, values: Sequence[str]) -> _Content:
    return address, "s" * len(values), values


_Channel = tuple[str, str, str]
"""Label, unit and kind of one channel of an LSL stream."""


class LabStreamingSink:
    """Pushes a sample per frame into a stream of the Lab Streaming Layer; missing numbers are NaN."""

    def __init__(self, name: str) -> None:
        self._lsl: Any = import_extra("pylsl", "lsl:", "send")
        configured = "LSLAPICFG" in os.environ or any(Path(one).expanduser().exists() for one in _LSL_FILES)
        if not configured:
            with suppress(AttributeError, NotImplementedError):  # old versions cannot be told
                self._lsl.set_config_content(_LSL_QUIET)
        self._name = name
        self._outlet: Any = None

    def send(self, message: LiveMessage) -> None:
        """Push a sample; the first one opens the stream, whose channels depend on the header."""
        if self._outlet is None:
            self._outlet = self._open(message.header)
        self._outlet.push_sample(sample_of(message).tolist())

    def close(self) -> None:
        """End the stream."""
        self._outlet = None

    def _open(self, header: LiveHeader) -> Any:
        channels = list(channels_of(header))
        info = self._lsl.StreamInfo(
            self._name,
            "MoCap",
            len(channels),
            self._lsl.IRREGULAR_RATE,
            self._lsl.cf_double64,
            f"handsim:{self._name}",  # Clients find the stream again by this ID.
        )
        description = info.desc()
        description.append_child_value("manufacturer", "handsim")
        description.append_child_value("schema", str(SCHEMA))
        description.append_child_value("statuses", " ".join(str(status) for status in STATUSES))
        listed = description.append_child("channels")
        for channel in channels:
            one = listed.append_child("channel")
            for name, value in zip(("label", "unit", "type"), channel, strict=True):
                one.append_child_value(name, value)
        return self._lsl.StreamOutlet(info)


def channels_of(header: LiveHeader) -> Iterator[_Channel]:
    """The channels of a stream, in the order of `sample_of`."""
    yield ("frame", "", "FrameNumber")
    yield ("time", "seconds", "Time")
    for side in header.sides:
        yield from _pose_channels(f"{side}_status", f"{side}_wrist")
        for joint in header.angles:
            yield (f"{side}_{joint}", "radians", "JointAngle")
        for place in header.positions:
            for axis in _XYZ:
                yield (f"{side}_{place}_{axis}", "meters", f"Position{axis.upper()}")
    for body in header.bodies:
        yield from _pose_channels(f"{body}_status", body)
    yield ("lag", "seconds", "Lag")
    for side in header.sides:
        yield (f"{side}_seen", "", "Share")
        yield from ((f"{side}_{digit}_status", "", "Status") for digit in header.digits)
        yield from ((f"{side}_{joint}_spread", "radians", "Spread") for joint in header.angles)
        yield from ((f"{side}_{place}_spread", "meters", "Spread") for place in header.positions)


def _pose_channels(status: str, name: str) -> Iterator[_Channel]:
    """Channels of status, position and orientation, with XDF's kinds of motion capture, as PositionX."""
    yield (status, "", "Status")
    for label, unit in _POSE:
        what, _, axis = label.partition("_")
        kind = ("Position" if what == "position" else "Orientation") + axis.upper()
        yield (f"{name}_{label}", unit, kind)


def sample_of(message: LiveMessage) -> np.ndarray:
    """The numbers of a message, one per channel."""
    parts: list[Any] = [[message.number, message.time]]
    for hand in message.hands:
        parts.append([STATUSES.index(hand.status)])
        parts += [hand.position, hand.quaternion, hand.angles, hand.positions.ravel()]
    for body in message.bodies:
        parts += [[STATUSES.index(body.status)], body.position, body.quaternion]
    parts.append([message.lag])
    for hand in message.hands:
        parts += [[hand.seen if hand.has_pose else math.nan], [STATUSES.index(one) for one in hand.digits]]
        parts += [hand.angle_spread, hand.position_spread]
    return np.concatenate(parts)


class WebSocketSink:
    """Serves messages to any number of WebSocket clients from its own thread; port 0 selects a free port.

    A client receives the header, again when the hands change their size and thus the header, and the newest
    frame whenever it answers a ping, which libraries do as their programs read. A client of the path /newest
    gets one frame for each message that it sends. For a client of /?every=1 all frames wait, at most 256, and
    it receives its lag; with `every` they do for each client. A slow client delays nobody. Browsers' pages
    are served if they are of this machine, or with `all_pages`; other programs always are. At most 64
    connections are open at a time; further ones are refused.
    """

    def __init__(
        self, host: str, port: int, format: MessageFormat, *, every: bool = False, all_pages: bool = False
    ) -> None:
        self._serve: Any = import_extra("websockets.asyncio.server", "ws://", "send").serve
        errors: Any = import_extra("websockets.exceptions", "ws://", "send")
        self._closed_error, self._state_error = errors.ConnectionClosed, errors.InvalidState
        self._format, self._every, self._socket = format, every, _listen(host, port)
        self._origins = None if all_pages else [None, _OWN_PAGES]
        self.port: int = self._socket.getsockname()[1]
        self._is_told = False  # of refused connections
        self.dropped = 0
        """Number of frames dropped for slow clients."""
        self._header = b""
        self._described: LiveHeader | None = None  # the header encoded in `_header`
        self._clients: dict[_Client, Any] = {}  # clients with their connections
        self._loop = asyncio.new_event_loop()
        self._ending, self._ready = asyncio.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="websocket server", daemon=True)
        self._thread.start()
        self._ready.wait()

    @property
    def num_clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    @property
    def note(self) -> str:
        """How many connections were refused."""
        refused = self._socket.refused
        return f"{refused} connections were refused" if refused else ""

    def send(self, message: LiveMessage) -> None:
        """Pass a message on to the clients."""
        if self._socket.refused and not self._is_told:
            self._is_told = True
            told = (
                f"port {self.port} refuses further connections: {MOST_CONNECTIONS} are open, or no other file"
            )
            told += " may be opened; end receivers that are not needed"
            warnings.warn(told, HandSimWarning, stacklevel=2)
        if message.header is not self._described:
            self._described, (self._header,) = message.header, self._format.header(message.header)
        if self._clients:
            (frame,) = self._format.frame(message)
            self._loop.call_soon_threadsafe(self._spread, frame)

    def close(self) -> None:
        """Give clients a second to read what waits for them and the end message, then disconnect them."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end)
            self._thread.join()

    def _end(self) -> None:
        """Queue the end message, which clients get also if they do not ask for it."""
        self._ending.set()
        self._spread(*self._format.end())
        for client in self._clients:
            client.ask()

    def _spread(self, message: bytes) -> None:
        """Queue a message for every client; a full queue drops its oldest message."""
        for client in self._clients:
            full = len(client.waiting) == client.waiting.maxlen
            self.dropped += full
            client.dropped += full
            client.waiting.append((time.monotonic(), message))
            client.woken.set()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._listen_until_the_end())
        finally:
            self._loop.close()
            self._ready.set()

    async def _listen_until_the_end(self) -> None:
        quiet = logging.getLogger("handsim.websocket")  # Invalid requests are not the user's mistakes.
        quiet.setLevel(logging.CRITICAL + 1)
        server = await self._serve(
            self._talk,
            sock=self._socket,
            origins=self._origins,
            process_request=_refuse_other_paths,
            compression=None,  # takes longer than a local network does
            # The content of clients' messages is ignored.
            max_size=1 << 10,
            close_timeout=_FLUSH,
            logger=quiet,
        )
        self._ready.set()
        await self._ending.wait()
        await self._wait_while(lambda: any(client.waiting for client in self._clients))
        for client, connection in self._clients.items():
            if client.waiting:
                connection.transport.abort()  # a closing handshake would wait, too
        server.close()
        await self._wait_while(lambda: bool(self._clients))
        for connection in self._clients.values():
            connection.transport.abort()
        await server.wait_closed()

    async def _wait_while(self, there_is: Callable[[], bool]) -> None:
        """Wait while a condition holds, at most one second."""
        until = self._loop.time() + _FLUSH
        while there_is() and self._loop.time() < until:
            await asyncio.sleep(0.01)

    async def _talk(self, connection: Any) -> None:
        """Send messages to a client until it disconnects."""
        path, every = _wishes(connection.request)
        requests = path == _ON_REQUEST
        client = _Client(every=(every or self._every) and not requests, requests=requests)
        self._clients[client] = connection
        sending = asyncio.ensure_future(self._deliver(connection, client))
        try:
            with suppress(self._closed_error):
                while True:
                    await connection.recv()  # also notices pongs and the end of the connection
                    if requests:
                        client.ask()
        finally:
            del self._clients[client]
            sending.cancel()

    async def _deliver(self, connection: Any, client: _Client) -> None:
        """Send a client the header, then message after message."""
        told, sent, is_text = -math.inf, math.inf, self._format.is_text
        is_plain, is_slow = not (client.every or client.requests), False
        queues = is_plain and _QUEUEING in connection.request.headers.get("User-Agent", "")
        with suppress(self._closed_error, self._state_error, OSError):
            await client.woken.wait()
            if header := self._header:
                client.header = header
                await connection.send(header, text=is_text)
            while client.waiting or not self._ending.is_set():
                if is_slow:  # It gets the rest when its program asks.
                    _begin_message(connection, is_text=is_text)
                if queues:  # It reads the first ping with the message, and the second one when it reads on.
                    await (await connection.ping())
                if is_plain:
                    (await connection.ping()).add_done_callback(lambda _: client.ask())
                await client.next()
                now = time.monotonic()
                behind = now - client.waiting[0][0]
                if client.every and behind > _BEHIND and now > told + _TELL:
                    told = now
                    await connection.send(self._format.lag(behind, client.dropped), text=is_text)
                message = self._take(client)
                if queues and not (is_slow or self._ending.is_set()):
                    _begin_message(connection, is_text=is_text)
                if connection.protocol.expect_continuation_frame:
                    _end_message(connection, message)
                else:
                    await connection.send(message, text=is_text)
                is_slow, sent = queues and client.asked > sent + _SLOW, now

    def _take(self, client: _Client) -> bytes:
        """The message for a client: a changed header, once a second at most, or the oldest that waits."""
        now = time.monotonic()
        is_other = self._header != client.header and now > client.described + _TELL
        if is_other and not self._ending.is_set():
            client.header, client.described = self._header, now
            return self._header
        return client.waiting.popleft()[1]


def _begin_message(connection: Any, *, is_text: bool) -> None:
    """Send the first parts of a message, which are empty, at once."""
    protocol = connection.protocol
    (protocol.send_text if is_text else protocol.send_binary)(b"", fin=False)
    for _ in range(_PARTS - 1):
        protocol.send_continuation(b"", fin=False)
    connection.transport.write(b"".join(protocol.data_to_send()))


def _end_message(connection: Any, message: bytes) -> None:
    """Send the last part of a message, which holds all of it."""
    connection.protocol.send_continuation(message, fin=True)
    connection.transport.write(b"".join(connection.protocol.data_to_send()))


def _refuse_other_paths(connection: Any, request: Any) -> Any:
    """Refuse a misspelled /newest: its client expects to ask, and would get a stream."""
    known = _wishes(request)[0] in ("", _ON_REQUEST)
    return None if known else connection.respond(HTTPStatus.NOT_FOUND, f"expected / or {_ON_REQUEST}\n")


def _wishes(request: Any) -> tuple[str, bool]:
    """The path of a client's request, and whether it asks for every frame."""
    path, _, query = request.path.partition("?")
    return path.rstrip("/"), dict(parse_qsl(query)).get("every") in _EVERY[1:]


class _Client:
    """Queue and requests of one WebSocket client."""

    def __init__(self, *, every: bool, requests: bool) -> None:
        self.waiting: deque[tuple[float, bytes]] = deque(maxlen=_WAITING if every else 1)
        """Messages with the times at which they were queued [s]."""
        self.every, self.requests = every, requests
        self.woken = asyncio.Event()
        self.dropped = 0
        self.header = b""
        """The last header that was sent, and in `described` when a changed one was [s]."""
        self.described = -math.inf
        self.asked = -math.inf
        """When it asked for a message, by a message or a pong [s]."""
        self._asks = every

    def ask(self) -> None:
        """Note that the client asks for a message."""
        self.asked, self._asks = time.monotonic(), True
        if self.waiting:
            self.woken.set()

    async def next(self) -> None:
        """Wait until a message may be sent."""
        while not (self.waiting and self._asks):
            self.woken.clear()
            await self.woken.wait()
        self._asks = self.every


class _Listener(socket.socket):
    """A listening socket that closes connections beyond `MOST_CONNECTIONS` as soon as they come.

    If the process may open no further file, a spare one makes room to take a connection and close it; asyncio
    would print a traceback a second.
    """

    def __init__(self, listening: socket.socket) -> None:
        super().__init__(fileno=listening.detach())
        self.refused = 0
        """Number of closed connections."""
        self._accepted: list[socket.socket] = []
        self._spare = socket.socket()

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection that is within the limit."""
        while True:
            try:
                connection, address = super().accept()
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    raise
                self._refuse_one()
                continue
            self._accepted = [one for one in self._accepted if one.fileno() >= 0]  # without closed ones
            if len(self._accepted) < MOST_CONNECTIONS:
                self._accepted.append(connection)
                return connection, address
            self.refused += 1
            connection.close()

    def _refuse_one(self) -> None:
        """Close the next connection with the spare file; `BlockingIOError` if none waits."""
        self._spare.close()
        try:
            super().accept()[0].close()
        except OSError as error:  # Without free files, the system tells of them before it looks for one.
            raise BlockingIOError(*error.args) from error
        else:
            self.refused += 1
        finally:
            self._spare = socket.socket()

    def close(self) -> None:
        """Close the socket and the spare file."""
        self._spare.close()
        super().close()


def _listen(host: str, port: int) -> _Listener:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        one = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise ArgumentError(
            f"port {port} of {host} cannot be listened at ({error.strerror or error}), expected a free port "
            "of this machine"
        ) from error
    # Connections inherit both. Without the second one a frame may wait 40 ms for TCP to confirm the last.
    one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return _Listener(one)
