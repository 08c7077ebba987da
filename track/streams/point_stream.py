"""A live stream of points from an OptiTrack server (Motive) over NatNet."""

from __future__ import annotations

import ipaddress
import os
import select
import socket
import struct
import sys
import threading
import time
from collections import deque
from typing import Final, NamedTuple
from urllib.parse import urlsplit

from handsim.callbacks import Closing
from handsim.errors import CaptureError
from track.streams import natnet
from track.streams.frame_source import StreamedFrame
from track.streams.natnet import COMMAND_PORT, DamagedPacket, Kind, MarkerFrame, ServerInfo, Version

_PATIENCE: Final = 3.0  # [s] to wait for a server
_RETRY: Final = 0.5  # [s] between requests to a server that does not answer
_KEEP_ALIVE: Final = 2.0  # [s] between keep-alive packets to one that does
_ATTENDED: Final = 0.1  # [s] between two looks at whether the reader is busy and packets wait for it
_BUFFER: Final = 1 << 22  # bytes of frames that may wait in the socket
_MOST_WAITING: Final = 1 << 14  # frames that may wait for the reader at all
_STAMPS: Final = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python does not name
_STAMP: Final = struct.Struct("@ll")  # seconds and nanoseconds
_LONGEST_STAY: Final = 60.0  # [s] in the socket; more is a clock that was set


def open_stream(
    url: str,
    *,
    local: str | None = None,
) -> PointStream:
    """Connect to a NatNet server at `natnet://host` or `natnet://host:port`, with the port for commands.

    It listens at the network card of this address, or at the one that leads to the host.
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


class PointStream(Closing):
    """The frames of a stream as they arrive, in any order; a `LiveStream` puts them in order.

    Packets are taken from the server's address, and its ports for commands and for data, only. They wait in
    the socket, and whoever asks takes them out of it: a thread that reads would contend with the tracker for
    the interpreter at every packet. While nobody asks for long, as when hands are measured, a thread keeps
    the socket from running over.
    """

    def __init__(self, sockets: list[socket.socket], address: tuple[str, int], server: ServerInfo) -> None:
        self.is_live = True
        """Whether frames come at their own pace."""
        self.error: Exception | None = None
        """Nothing makes it fail: a server that is gone may come again."""
        self.server = server
        """The server's description of itself."""
        self.packets = 0
        """Number of packets that came."""
        self.damaged = 0
        """Number of damaged packets, which were left out."""
        self.foreign = 0
        """Number of packets of other senders, which were left out."""
        self.lost = 0
        """Number of frames that waited too long for the reader, and were left out."""
        self._sockets, self._address = sockets, address
        self._version = min(server.version, natnet.NEWEST)
        self._asked = self._kept_alive = self._heard = time.monotonic()
        self._arrived: deque[StreamedFrame] = deque()
        self._reading = threading.Lock()
        self._ending = False
        self._closed = threading.Event()
        self._attendant = threading.Thread(target=self._attend, name="natnet client", daemon=True)
        self._attendant.start()

    @property
    def counts(self) -> dict[str, int]:
        """What became of other packets so far, as a take records it."""
        return {"damaged_packets": self.damaged, "foreign_packets": self.foreign}

    @property
    def is_over(self) -> bool:
        """Whether no further frame comes."""
        return self._closed.is_set() or (self._ending and not self._arrived)

    def poll(self, seconds: float) -> list[StreamedFrame]:
        """Wait for packets, so long at most [s]; returns the frames of all that have arrived."""
        if self._closed.is_set():
            return []
        if seconds > 0.0 and not (self._arrived or self._ending):
            select.select(self._sockets, [], [], seconds)
        with self._reading:
            self._asked = time.monotonic()
            self._drain()
            arrived, self._arrived = list(self._arrived), deque()
        return arrived

    def end(self) -> None:
        """No frame is wanted but those that have arrived."""
        with self._reading:
            self._drain()
            self._ending = True

    def close(self) -> None:
        """Disconnect from the server; no further frame comes."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._attendant.join()
        _send(self._sockets[0], natnet.pack(Kind.DISCONNECT), self._address)
        for one in self._sockets:
            one.close()

    def _attend(self) -> None:
        """Keep the server sending, and the socket from running over while the reader is busy."""
        while not self._closed.wait(_ATTENDED):
            now = time.monotonic()
            if now >= self._kept_alive + _KEEP_ALIVE:
                _send(self._sockets[0], natnet.pack(Kind.KEEP_ALIVE), self._address)
                if now >= self._heard + _KEEP_ALIVE:  # a restarted server does not know this client
                    _send(self._sockets[0], natnet.pack_connect(), self._address)
                self._kept_alive = now
            if time.monotonic() > self._asked + _ATTENDED:
                with self._reading:
                    self._drain()

    def _drain(self) -> None:
        """Take what has arrived until now out of the sockets."""
        begin = time.monotonic()
        for one in () if self._ending or self._closed.is_set() else self._sockets:
            while (received := _receive(one)) is not None:
                frame = self._take(*received)
                if frame is not None:
                    self._arrived.append(frame)
                if received.arrived > begin:  # others keep coming
                    break
        while len(self._arrived) > _MOST_WAITING:
            self._arrived.popleft()
            self.lost += 1

    def _take(self, packet: bytes, sender: tuple[str, int], arrived: float) -> StreamedFrame | None:
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
        return StreamedFrame(frame.number, frame.time, frame.points, frame.ids, arrived=arrived)

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
        if _STAMPS is not None:
            one.setsockopt(socket.SOL_SOCKET, _STAMPS, 1)
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


def _server_info(received: _Received | None, server: tuple[str, int]) -> ServerInfo | None:
    if received is None or received.sender != server:
        return None
    try:
        kind, payload = natnet.unpack(received.packet)
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


class _Received(NamedTuple):
    packet: bytes
    sender: tuple[str, int]
    arrived: float
    """Monotonic time at which it came to this machine [s], which may be long before it is read."""


def _receive(one: socket.socket) -> _Received | None:
    """A packet; None if there is none."""
    try:
        if _STAMPS is None:
            packet, (host, port) = one.recvfrom(natnet.LARGEST)
            return _Received(packet, (host, port), time.monotonic())
        packet, told, _, (host, port) = one.recvmsg(natnet.LARGEST, socket.CMSG_SPACE(_STAMP.size))
    except OSError:  # no packet, or a message that a port is closed
        return None
    arrived = time.monotonic()
    for level, kind, data in told:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _STAMPS, _STAMP.size):
            seconds, nanoseconds = _STAMP.unpack(data)
            stayed = time.time() - seconds - 1e-9 * nanoseconds
            arrived -= stayed if 0.0 < stayed < _LONGEST_STAY else 0.0
    return _Received(packet, (host, port), arrived)
