"""A WebSocket server for any number of clients; one that reads too slowly loses frames and delays nobody."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import socket
import threading
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from handsim._plugins import import_extra
from handsim.errors import ArgumentError
from track.sinks.documents import Encode, frame_document, header_document
from track.sinks.message import LiveMessage

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

_WAITING: Final = 256  # frames that may wait for a client
_SEND_BUFFER: Final = 1 << 17  # bytes that the system holds for a client, older than those that wait
_LARGEST: Final = 1 << 10  # bytes of a message of a client, which is not read
_FLUSH: Final = 1.0  # [s] for clients to take what waits at the end
_OWN_PAGES: Final = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pages of this machine: without this rule any page in its browser could read along."""


class WebSocketSink:
    """Serves messages from a thread of its own.

    A client gets the header, then every frame from then on. On a loopback address pages of this machine are
    served, and programs that are no browsers; on another address everybody is.

    Args:
        port: TCP port to listen at; 0 for a free one.
        text: Whether these are text.
        points: Whether the points are sent too.

    Raises:
        ArgumentError: The package websockets is missing, or the port cannot be listened at.
    """

    def __init__(self, host: str, port: int, encode: Encode, *, text: bool, points: bool) -> None:
        self._serve: Any = import_extra("websockets.asyncio.server", "ws://", "send").serve
        self._closed_error: Any = import_extra("websockets.exceptions", "ws://", "send").ConnectionClosed
        self._encode, self._text, self._points = encode, text, points
        self._socket = _listen(host, port)
        address = self._socket.getsockname()
        self._origins = [None, _OWN_PAGES] if ipaddress.ip_address(address[0]).is_loopback else None
        self.port: int = address[1]
        """The port that it listens at."""
        self.dropped = 0
        """Number of frames that were dropped for slow clients."""
        self._header: bytes | None = None
        self._clients: set[_Client] = set()
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="websocket server", daemon=True)
        self._thread.start()
        self._ready.wait()

    @property
    def num_clients(self) -> int:
        """Number of clients at this moment."""
        return len(self._clients)

    def send(self, message: LiveMessage) -> None:
        """Hand a message over to the clients."""
        if self._header is None:
            self._header = self._encode(header_document(message.header))
        if self._clients:
            frame = self._encode(frame_document(message, points=self._points))
            self._loop.call_soon_threadsafe(self._spread, frame)

    def close(self) -> None:
        """Give clients a second for what they have not read, and disconnect them."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ending.set)
            self._thread.join()

    def _spread(self, frame: bytes) -> None:
        for client in self._clients:
            self.dropped += client.put(frame)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._listen_until_the_end())
        finally:
            self._loop.close()
            self._ready.set()

    async def _listen_until_the_end(self) -> None:
        quiet = logging.getLogger("handsim.websocket")  # what strangers send is not for the user's terminal
        quiet.setLevel(logging.CRITICAL + 1)
        server = await self._serve(
            self._talk,
            sock=self._socket,
            origins=self._origins,
            compression=None,  # costs more time than a local network does
            max_size=_LARGEST,
            close_timeout=_FLUSH,
            logger=quiet,
        )
        self._ready.set()
        await self._ending.wait()
        await self._flush()
        server.close()
        await server.wait_closed()

    async def _flush(self) -> None:
        """Let clients take what waits; those that do not are cut off: a farewell would wait for them too."""
        waiting = {asyncio.ensure_future(client.emptied()): client for client in self._clients}
        if waiting:
            _, late = await asyncio.wait(waiting, timeout=_FLUSH)
            for one in late:
                one.cancel()
                waiting[one].connection.transport.abort()

    async def _talk(self, connection: ServerConnection) -> None:
        """Send a client everything until it leaves."""
        client = _Client(connection)
        self._clients.add(client)
        sending = asyncio.ensure_future(self._deliver(client))
        try:
            while True:
                await connection.recv()  # and ignore it: so pongs and the leave are noticed
        except self._closed_error:
            pass
        finally:
            self._clients.discard(client)
            client.leave()
            sending.cancel()

    async def _deliver(self, client: _Client) -> None:
        """Send a client the header, and each frame when the one before is on its way."""
        connection = client.connection
        try:
            frame = await client.next()
            await connection.send(self._header or b"", text=self._text)
            while True:
                await connection.send(frame, text=self._text)
                client.sent()
                frame = await client.next()
        except self._closed_error:
            pass


class _Client:
    """The frames that wait for a client; the oldest is dropped for a new one."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self._frames: deque[bytes] = deque(maxlen=_WAITING)
        self._came, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()

    def put(self, frame: bytes) -> bool:
        """Add a frame; returns whether another was dropped for it."""
        full = len(self._frames) == _WAITING
        self._frames.append(frame)
        self._came.set()
        self._empty.clear()
        return full

    async def next(self) -> bytes:
        """Wait for the next frame."""
        await self._came.wait()
        frame = self._frames.popleft()
        if not self._frames:
            self._came.clear()
        return frame

    def sent(self) -> None:
        """The frame of the last `next` is on its way."""
        if not self._frames:
            self._empty.set()

    def leave(self) -> None:
        """Nothing waits any more."""
        self._empty.set()

    async def emptied(self) -> None:
        """Wait until nothing waits."""
        await self._empty.wait()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        one = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise ArgumentError(
            f"port {port} of {host} cannot be listened at ({error.strerror or error}), expected a free port "
            "of this machine"
        ) from error
    one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)  # of its connections too
    return one
