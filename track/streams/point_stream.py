"""Live points from an OptiTrack server (Motive), frame by frame, over NatNet."""

from __future__ import annotations

import ipaddress
import os
import select
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import urlsplit

import numpy as np

from handsim.errors import CaptureError
from track.streams import natnet
from track.streams.natnet import COMMAND_PORT, DamagedPacket, Kind, MarkerFrame, ServerInfo, Version

if TYPE_CHECKING:
    from jaxtyping import Float, Int

SILENCE: Final = 2.0
"""Time without a frame [s] after which a stream says that it is silent."""
_PATIENCE: Final = 3.0  # [s] to wait for a server
_GREETING: Final = 0.5  # [s] between calls to a server that does not answer
_ALIVE: Final = 2.0  # [s] between signs of life to one that does
_REORDERED: Final = 1.0  # [s]: time that runs back by more is a take that starts again
_BUFFER: Final = 1 << 20  # bytes that may wait while somebody is busy


@dataclass(frozen=True, slots=True, eq=False)
class StreamedFrame:
    """The points of a frame."""

    number: int
    """The server's number of the frame."""
    time: float
    """The server's time [s]."""
    points: Float[np.ndarray, "N 3"]
    """[m], in the server's axes."""
    ids: Int[np.ndarray, "N"]
    """The server's ID of each, -1 where it gives none."""
    silent: bool = False
    """Nothing came for a while: there are no points, and number and time are the last ones."""


def open_stream(url: str, *, local: str | None = None, silence: float = SILENCE) -> PointStream:
    """Listen to a server.

    Args:
        url: `natnet://host` or `natnet://host:port`, where the port is the one for commands.
        local: Address of the network card to listen at; the one that leads to the host when not given.
        silence: Time without a frame after which the stream says so [s].

    Raises:
        CaptureError: The address is none, no server answers there, or it speaks an older NatNet.
    """
    host, port = _split(url)
    try:
        server = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
        address = (str(server[0]), port)
        commands = _bind(local or _own_address(address), 0)
    except OSError as error:
        raise CaptureError(f"{url}: cannot be reached ({error.strerror or error})") from error
    try:
        info = _connect(commands, address, url)
        sockets = [commands] if info.group is None else [commands, _join(info, commands, url)]
    except BaseException:
        commands.close()
        raise
    return PointStream(sockets, address, info, silence)


class PointStream(Iterator[StreamedFrame]):
    """Frames as they come; a block of a `with` statement or `close` ends it.

    Whoever takes frames more slowly than they come finds them late, not lost, until a megabyte waits.
    """

    def __init__(
        self, sockets: list[socket.socket], address: tuple[str, int], server: ServerInfo, silence: float
    ) -> None:
        self.server = server
        """What the server said of itself."""
        self.damaged = 0
        """Packets that were no frames; they were left out."""
        self.late = 0
        """Frames that came twice or after a newer one; they were left out."""
        self._sockets, self._address, self._silence = sockets, address, silence
        self._version = min(server.version, natnet.NEWEST)
        self._last: StreamedFrame | None = None
        self._greeted = self._heard = time.monotonic()

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after a silence an empty one says so, and again after another."""
        quiet = time.monotonic() + self._silence
        while self._sockets:
            frame = self._receive(self._stay_in_touch(quiet))
            if frame is not None:
                self._last, self._heard = frame, time.monotonic()
                return frame
            if time.monotonic() >= quiet:
                number, last = (self._last.number, self._last.time) if self._last else (0, 0.0)
                return StreamedFrame(number, last, np.empty((0, 3)), np.empty(0, dtype=np.int64), silent=True)
        raise StopIteration

    def close(self) -> None:
        """Take leave of the server; no further frame comes."""
        if self._sockets:
            _send(self._sockets[0], natnet.pack(Kind.DISCONNECT), self._address)
        for one in self._sockets:
            one.close()
        self._sockets = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _stay_in_touch(self, quiet: float) -> float:
        """Greet the server if it is time to; returns how long to wait for a packet [s]."""
        now = time.monotonic()
        if now >= self._greeted + _ALIVE:
            _send(self._sockets[0], natnet.pack(Kind.KEEP_ALIVE), self._address)
            if now >= self._heard + _ALIVE:  # a server that was started anew does not know us
                _send(self._sockets[0], natnet.pack_connect(), self._address)
            self._greeted = now
        return max(0.0, min(quiet, self._greeted + _ALIVE) - now)

    def _receive(self, seconds: float) -> StreamedFrame | None:
        """One packet's frame, if one comes and is good."""
        ready, _, _ = select.select(self._sockets, [], [], seconds)
        packet = _receive(ready[0], self._address[0]) if ready else None
        if packet is None:
            return None
        try:
            kind, payload = natnet.unpack(packet)
            if kind == Kind.SERVER_INFO:
                self._version = min(natnet.parse_server_info(payload).version, natnet.NEWEST)
            if kind != Kind.FRAME:
                return None
            frame = self._parse(payload)
        except DamagedPacket:
            self.damaged += 1
            return None
        if self._last is not None and 0.0 <= self._last.time - frame.time < _REORDERED:
            self.late += 1
            return None
        return StreamedFrame(frame.number, frame.time, frame.points, frame.ids)

    def _parse(self, payload: bytes) -> MarkerFrame:
        """A frame of the version that was said, or of the other layout: some servers speak an older one."""
        try:
            return natnet.parse_frame(payload, self._version)
        except DamagedPacket:
            other: Version = natnet.OLDEST if self._version == natnet.NEWEST else natnet.NEWEST
            frame = natnet.parse_frame(payload, other)
            self._version = other
            return frame


def _split(url: str) -> tuple[str, int]:
    """Host and port."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or parts.scheme != "natnet" or parts.path not in ("", "/") or port == 0:
        raise CaptureError(f"'{url}' is no address of a stream, expected natnet://host or natnet://host:port")
    return host, port or COMMAND_PORT


def _own_address(server: tuple[str, int]) -> str:
    """Address of the network card that leads to the server: nothing else shall hear us. No packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(server)
        own: str = probe.getsockname()[0]
        return own


def _bind(address: str, port: int) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        if port:  # of a multicast: others on this machine may listen too
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind((address, port))
        one.setblocking(False)
    except OSError:
        one.close()
        raise
    return one


def _connect(commands: socket.socket, server: tuple[str, int], url: str) -> ServerInfo:
    """Call until the server says who it is."""
    for _ in range(round(_PATIENCE / _GREETING)):
        _send(commands, natnet.pack_connect(), server)
        until = time.monotonic() + _GREETING
        while (seconds := until - time.monotonic()) > 0.0:
            ready, _, _ = select.select([commands], [], [], seconds)
            info = _server_info(_receive(commands, server[0])) if ready else None
            if info is None:
                continue
            if info.version < natnet.OLDEST:
                major, minor = info.version
                raise CaptureError(f"{url}: the server speaks NatNet {major}.{minor}, expected 3.0 or newer")
            return info
    raise CaptureError(
        f"{url}: no NatNet server answers; in Motive, switch streaming on and choose the network that this "
        "machine is in"
    )


def _server_info(packet: bytes | None) -> ServerInfo | None:
    try:
        kind, payload = natnet.unpack(packet or b"")
        return natnet.parse_server_info(payload) if kind == Kind.SERVER_INFO else None
    except DamagedPacket:
        return None


def _join(info: ServerInfo, commands: socket.socket, url: str) -> socket.socket:
    """Listen to the group that the server multicasts to."""
    group, local = str(info.group), commands.getsockname()[0]
    if not ipaddress.ip_address(group).is_multicast:
        raise CaptureError(f"{url}: the server says that it multicasts to {group}, which is no such address")
    try:
        one = _bind(local if os.name == "nt" else group, info.data_port)
        one.setsockopt(
            socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + socket.inet_aton(local)
        )
    except OSError as error:
        raise CaptureError(f"{url}: cannot listen to {group} ({error.strerror or error})") from error
    return one


def _send(one: socket.socket, packet: bytes, address: tuple[str, int]) -> None:
    try:
        one.sendto(packet, address)
    except OSError:
        pass  # a network that is down for now: silence will be told


def _receive(one: socket.socket, host: str) -> bytes | None:
    """A packet from the host, if there is one."""
    try:
        packet, (sender, _) = one.recvfrom(natnet.LARGEST)
    except OSError:  # nothing there after all, or word that a port is closed
        return None
    return packet if sender == host else None
