"""A live stream of points from an OptiTrack server (Motive) over NatNet."""

from __future__ import annotations

import ipaddress
import math
import os
import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import Final
from urllib.parse import urlsplit

from handsim._closing import Closing
from handsim.errors import CaptureError
from track.streams import natnet
from track.streams.frame_source import StreamedFrame
from track.streams.natnet import COMMAND_PORT, DamagedPacket, Kind, MarkerFrame, ServerInfo, Version

_PATIENCE: Final = 3.0  # [s] to wait for a server
_RETRY: Final = 0.5  # [s] between requests to a server that does not answer
_KEEP_ALIVE: Final = 2.0  # [s] between keep-alive packets to one that does
_DRAIN: Final = 1.0  # [s] to read the packets that have arrived at the end, at most: others keep coming
_STOP: Final = 0.1  # [s] between two looks at whether the stream shall end
_BUFFER: Final = 1 << 20  # bytes of frames that may wait for the reader


def open_stream(
    url: str,
    *,
    local: str | None = None,
) -> PointStream:
    """Connect to a NatNet server.

    Args:
        url: `natnet://host` or `natnet://host:port`, with the port for commands.
        local: Address of the network card to listen at; the one that leads to the host when not given.

    Raises:
        CaptureError: The address is invalid, no server answers, or its NatNet is older than 3.0.
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
    return PointStream(sockets, address, info)


class PointStream(Closing, Iterator[StreamedFrame]):
    """Iterator of the frames of a stream as they arrive, in any order; a `LiveStream` puts them in order.

    Packets are taken from the server's address, and its ports for commands and for data, only.
    """

    def __init__(self, sockets: list[socket.socket], address: tuple[str, int], server: ServerInfo) -> None:
        self.server = server
        """The server's description of itself."""
        self.packets = 0
        """Number of packets that came."""
        self.damaged = 0
        """Number of damaged packets, which were left out."""
        self.foreign = 0
        """Number of packets of other senders, which were left out."""
        self._sockets, self._address = sockets, address
        self._version = min(server.version, natnet.NEWEST)
        self._kept_alive = self._heard = time.monotonic()
        self._ended = threading.Event()
        self._drained_until = math.inf

    @property
    def counts(self) -> dict[str, int]:
        """What became of other packets so far, as a take records it."""
        return {"damaged_packets": self.damaged, "foreign_packets": self.foreign}

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame, until `end`."""
        while self._sockets:
            if self._ended.is_set():
                self._drained_until = min(self._drained_until, time.monotonic() + _DRAIN)
                received = self._receive(0.0) if time.monotonic() < self._drained_until else None
                if received is None:
                    break
            else:
                received = self._receive(self._keep_alive())
            frame = None if received is None else self._take(*received)
            if frame is not None:
                return frame
        raise StopIteration

    def end(self) -> None:
        """No frame is wanted but those that have arrived; may be called from another thread."""
        self._ended.set()

    def close(self) -> None:
        """Disconnect from the server; no further frame comes."""
        if self._sockets:
            _send(self._sockets[0], natnet.pack(Kind.DISCONNECT), self._address)
        for one in self._sockets:
            one.close()
        self._sockets = []

    def _keep_alive(self) -> float:
        """Send a keep-alive packet when it is due; returns how long to wait for a packet [s]."""
        now = time.monotonic()
        if now >= self._kept_alive + _KEEP_ALIVE:
            _send(self._sockets[0], natnet.pack(Kind.KEEP_ALIVE), self._address)
            if now >= self._heard + _KEEP_ALIVE:  # a restarted server does not know this client
                _send(self._sockets[0], natnet.pack_connect(), self._address)
            self._kept_alive = now
        return max(0.0, min(self._kept_alive + _KEEP_ALIVE - now, _STOP))

    def _receive(self, seconds: float) -> tuple[bytes, tuple[str, int]] | None:
        """Wait for a packet and its sender; None if none came."""
        ready, _, _ = select.select(self._sockets, [], [], seconds)
        return _receive(ready[0]) if ready else None

    def _take(self, packet: bytes, sender: tuple[str, int]) -> StreamedFrame | None:
        """The frame of a packet, if it holds one."""
        self.packets += 1
        if sender[0] != self._address[0] or sender[1] not in (self._address[1], self.server.data_port):
            self.foreign += 1
            return None
        try:
            kind, payload = natnet.unpack(packet)
            if kind == Kind.SERVER_INFO and sender == self._address:
                self.server = natnet.parse_server_info(payload)
                self._version = min(self.server.version, natnet.NEWEST)
            if kind != Kind.FRAME:
                return None
            frame = self._parse(payload)
        except DamagedPacket:
            self.damaged += 1
            return None
        self._heard = time.monotonic()
        return StreamedFrame(frame.number, frame.time, frame.points, frame.ids, arrived=self._heard)

    def _parse(self, payload: bytes) -> MarkerFrame:
        """A frame of the server's version, or of the other layout: some servers send an older one."""
        try:
            return natnet.parse_frame(payload, self._version)
        except DamagedPacket:
            other: Version = natnet.OLDEST if self._version == natnet.NEWEST else natnet.NEWEST
            frame = natnet.parse_frame(payload, other)
            self._version = other
            return frame


def _split(url: str) -> tuple[str, int]:
    """Host and port of an address."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or parts.scheme != "natnet" or parts.path not in ("", "/") or port == 0:
        raise CaptureError(
            f"'{url}' is not an address of a stream, expected natnet://host or natnet://host:port"
        )
    return host, port or COMMAND_PORT


def _own_address(server: tuple[str, int]) -> str:
    """Address of the network card that leads to the server, the only one to listen at. No packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(server)
        own: str = probe.getsockname()[0]
        return own


def _bind(address: str, port: int) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        if port:  # of a multicast: other programs on this machine may listen too
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind((address, port))
        one.setblocking(False)
    except OSError:
        one.close()
        raise
    return one


def _connect(commands: socket.socket, server: tuple[str, int], url: str) -> ServerInfo:
    """Send requests until the server describes itself."""
    for _ in range(round(_PATIENCE / _RETRY)):
        _send(commands, natnet.pack_connect(), server)
        until = time.monotonic() + _RETRY
        while (seconds := until - time.monotonic()) > 0.0:
            ready, _, _ = select.select([commands], [], [], seconds)
            info = _server_info(_receive(commands), server) if ready else None
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


def _server_info(
    received: tuple[bytes, tuple[str, int]] | None, server: tuple[str, int]
) -> ServerInfo | None:
    if received is None or received[1] != server:
        return None
    try:
        kind, payload = natnet.unpack(received[0])
        return natnet.parse_server_info(payload) if kind == Kind.SERVER_INFO else None
    except DamagedPacket:
        return None


def _join(info: ServerInfo, commands: socket.socket, url: str) -> socket.socket:
    """Listen to the group that the server multicasts to."""
    group, local = str(info.group), commands.getsockname()[0]
    if not ipaddress.ip_address(group).is_multicast:
        raise CaptureError(
            f"{url}: the server says that it multicasts to {group}, which is not a multicast address"
        )
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
        pass  # the network is down for now: the stream yields silent frames


def _receive(one: socket.socket) -> tuple[bytes, tuple[str, int]] | None:
    """A packet and its sender; None if there is none."""
    try:
        packet, (host, port) = one.recvfrom(natnet.LARGEST)
    except OSError:  # no packet, or a message that a port is closed
        return None
    return packet, (host, port)
