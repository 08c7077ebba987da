"""A server that gives messages of live output to WebSocket clients, the newest first."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import re
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Final
from urllib.parse import parse_qsl

from handsim._plugins import import_extra
from handsim.errors import ArgumentError, HandSimWarning
from track.output.live_message import LiveHeader, LiveMessage, MessageFormat

EVERY: Final = ("no", "yes", "1")
"""Valid values of the option `every`, which clients may also request."""
_MOST_WAITING: Final = 256  # largest number of frames waiting for a client that wants every frame
_REPORTED_LAG: Final = 0.05  # [s] A longer lag is reported to a client that wants every frame.
_REPORT_PERIOD: Final = 1.0  # [s] least time between two reports of a client's lag, or two headers
_REQUEST_PATH: Final = "/newest"  # path for clients that request each frame
_QUEUEING_AGENT: Final = "websockets/"  # user agent of Python's websockets, which queues 16 parts of messages
_SLOW_READ: Final = 0.01  # [s] The server waits for a program that reads its frame later than this.
_BLOCKING_PARTS: Final = 17  # websockets stops reading after these parts until its program reads them.
_SEND_BUFFER: Final = 1 << 17  # [bytes] size of the system's send buffer for each client
MOST_CONNECTIONS: Final = 64
"""Largest number of open connections of a server."""
_FLUSH_TIME: Final = 1.0  # [s] time for clients to read waiting frames at the end
_OWN_PAGES: Final = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Origins of web pages that this machine serves; pages of other origins are refused."""


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
            limit = f"{MOST_CONNECTIONS} are open, or no other file may be opened"
            told = f"port {self.port} refuses further connections: {limit}; end receivers that are not needed"
            warnings.warn(told, HandSimWarning, stacklevel=2)
        if message.header is not self._described:
            self._described, (self._header,) = message.header, self._format.header(message.header)
        if self._clients:
            (frame,) = self._format.frame(message)
            self._loop.call_soon_threadsafe(self._queue_for_all, frame)

    def close(self) -> None:
        """Give clients a second to read what waits for them and the end message, then disconnect them."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end)
            self._thread.join()

    def _end(self) -> None:
        """Queue the end message, which clients get also if they do not ask for it."""
        self._ending.set()
        self._queue_for_all(*self._format.end())
        for client in self._clients:
            client.ask()

    def _queue_for_all(self, message: bytes) -> None:
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
            self._serve_client,
            sock=self._socket,
            origins=self._origins,
            process_request=_refuse_other_paths,
            compression=None,  # takes longer than a local network does
            # The content of clients' messages is ignored.
            max_size=1 << 10,
            close_timeout=_FLUSH_TIME,
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
        until = self._loop.time() + _FLUSH_TIME
        while there_is() and self._loop.time() < until:
            await asyncio.sleep(0.01)

    async def _serve_client(self, connection: Any) -> None:
        """Send messages to a client until it disconnects."""
        path, every = _requested(connection.request)
        requests = path == _REQUEST_PATH
        client = _Client(every=(every or self._every) and not requests, requests=requests)
        self._clients[client] = connection
        sending = asyncio.ensure_future(self._send_messages(connection, client))
        try:
            with suppress(self._closed_error):
                while True:
                    await connection.recv()  # also notices pongs and the end of the connection
                    if requests:
                        client.ask()
        finally:
            del self._clients[client]
            sending.cancel()

    async def _send_messages(self, connection: Any, client: _Client) -> None:
        """Send a client the header, then message after message."""
        told, sent, is_text = -math.inf, math.inf, self._format.is_text
        is_plain, is_slow = not (client.every or client.requests), False
        queues = is_plain and _QUEUEING_AGENT in connection.request.headers.get("User-Agent", "")
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
                if client.every and behind > _REPORTED_LAG and now > told + _REPORT_PERIOD:
                    told = now
                    await connection.send(self._format.lag(behind, client.dropped), text=is_text)
                message = self._take(client)
                if queues and not (is_slow or self._ending.is_set()):
                    _begin_message(connection, is_text=is_text)
                if connection.protocol.expect_continuation_frame:
                    _end_message(connection, message)
                else:
                    await connection.send(message, text=is_text)
                is_slow, sent = queues and client.asked > sent + _SLOW_READ, now

    def _take(self, client: _Client) -> bytes:
        """The message for a client: a changed header, once a second at most, or the oldest that waits."""
        now = time.monotonic()
        is_other = self._header != client.header and now > client.described + _REPORT_PERIOD
        if is_other and not self._ending.is_set():
            client.header, client.described = self._header, now
            return self._header
        return client.waiting.popleft()[1]


def _begin_message(connection: Any, *, is_text: bool) -> None:
    """Send the first parts of a message, which are empty, at once."""
    protocol = connection.protocol
    (protocol.send_text if is_text else protocol.send_binary)(b"", fin=False)
    for _ in range(_BLOCKING_PARTS - 1):
        protocol.send_continuation(b"", fin=False)
    connection.transport.write(b"".join(protocol.data_to_send()))


def _end_message(connection: Any, message: bytes) -> None:
    """Send the last part of a message, which holds all of it."""
    connection.protocol.send_continuation(message, fin=True)
    connection.transport.write(b"".join(connection.protocol.data_to_send()))


def _refuse_other_paths(connection: Any, request: Any) -> Any:
    """Refuse a misspelled /newest, whose client expects one frame per request and would get a stream."""
    known = _requested(request)[0] in ("", _REQUEST_PATH)
    return None if known else connection.respond(HTTPStatus.NOT_FOUND, f"expected / or {_REQUEST_PATH}\n")


def _requested(request: Any) -> tuple[str, bool]:
    """The path that a client requests, and whether its query requests every frame."""
    path, _, query = request.path.partition("?")
    return path.rstrip("/"), dict(parse_qsl(query)).get("every") in EVERY[1:]


class _Client:
    """Queue and requests of one WebSocket client."""

    def __init__(self, *, every: bool, requests: bool) -> None:
        self.waiting: deque[tuple[float, bytes]] = deque(maxlen=_MOST_WAITING if every else 1)
        """Messages with the times at which they were queued [s]."""
        self.every, self.requests = every, requests
        self.woken = asyncio.Event()
        self.dropped = 0
        self.header = b""
        """The last header that was sent; `described` is when a changed one was sent [s]."""
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
        except OSError as error:  # The system reports missing files before it looks for a connection.
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
