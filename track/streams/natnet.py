"""NatNet, the protocol in which OptiTrack servers (Motive) stream markers: packets, a client and a server.

Packets of versions 3.0 to 4.1 are little-endian: kind and payload size (two uint16), then the payload. A
tracker needs a frame's list of markers with IDs, which holds labeled and unlabeled ones; all other sections
are skipped. Every count is checked against the number of remaining bytes before it is used.
"""

from __future__ import annotations

import ipaddress
import os
import select
import socket
import struct
import sys
import threading
import time
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.optics.reconstruction import number_runs
from handsim._checks import check_type
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, CaptureError, choices
from handsim.settings import Limits, Settings
from track.frames import StreamedFrame, read_points
from track.streams import LOOPBACK, split_address
from track.streams.frame_source import ArrivingFrames

Version = tuple[int, int]
COMMAND_PORT: Final = 1510
LARGEST: Final = 65507  # bytes of a UDP datagram
OLDEST: Final[Version] = (3, 0)
NEWEST: Final[Version] = (4, 1)
"""The newest known layout; servers are asked for it."""
_SIZED: Final[Version] = (4, 1)
"""The first version whose sections have a size, and with assets and a finer clock."""
_LOST: Final = 9e6  # [m]: a lost marker is sent as a point beyond
_OCCLUDED, _SEEN, _FILLED, _UNLABELED = 1, 2, 4, 16  # flags of a marker
_NAME: Final = 256  # bytes of a program's name
_BODY: Final = 38  # bytes of a rigid body: ID, position, orientation, error, flags
_MARKER: Final = np.dtype(
    {
        "names": ["id", "position", "size", "flags", "residual"],
        "formats": ["<i4", ("<f4", 3), "<f4", "<i2", "<f4"],
        "offsets": [0, 4, 16, 20, 22],
        "itemsize": 26,
    }
)
_PATIENCE: Final = 3.0  # [s] to wait for a server
_RETRY: Final = 0.5  # [s] between requests to a server that does not answer
_KEEP_ALIVE: Final = 2.0  # [s] between keep-alive packets to one that does
_ATTENDED: Final = 0.1  # [s] between two looks at whether the reader is busy and packets wait for it
_BUFFER: Final = 1 << 22  # bytes of frames that may wait in the socket
_STAMPS: Final = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python does not name
_STAMP: Final = struct.Struct("@ll")  # seconds and nanoseconds
_LONGEST_STAY: Final = 60.0  # [s] in the socket; more is a clock that was set
VERSIONS: Final[tuple[Version, ...]] = ((3, 0), (3, 1), (4, 0), (4, 1))
_MOST_POINTS: Final = 1500  # in a datagram
_MOST_CLIENTS: Final = 8
_CLIENT_TIMEOUT: Final = 10.0  # [s] without a packet from a client
_WAIT: Final = 0.05  # [s] for a client's packet, after which the end is looked at
_NUMBERS: Final = 1 << 31  # of frames and of IDs in a packet


class Kind(IntEnum):
    """Kinds of packets that are used here."""

    CONNECT = 0
    SERVER_INFO = 1
    FRAME = 7
    DISCONNECT = 9
    KEEP_ALIVE = 10


class DamagedPacket(ValueError):
    """Bytes that are not a packet of the expected kind and version."""


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """A server's description of itself."""

    application: str
    version: Version
    """Its NatNet version."""
    data_port: int
    group: str | None
    """Multicast address of its frames; None if it sends them to each client."""


def pack(kind: Kind, payload: bytes = b"") -> bytes:
    """A packet of a kind."""
    return struct.pack("<HH", kind, len(payload)) + payload


def unpack(packet: bytes) -> tuple[int, bytes]:
    """Kind and payload of a packet."""
    if len(packet) < 4:
        raise DamagedPacket("no header")
    kind, size = struct.unpack_from("<HH", packet)
    if size > len(packet) - 4:
        raise DamagedPacket("shorter than it says")
    return kind, packet[4 : 4 + size]


def pack_connect() -> bytes:
    """A client's first packet: its name and versions, and a request for all data in the newest layout."""
    name = b"handsim".ljust(_NAME, b"\0")
    return pack(
        Kind.CONNECT, name + bytes((1, 0, 0, 0)) + bytes((*NEWEST, 0, 0)) + bytes((0, *NEWEST, 0, 0, 0))
    )


def pack_server_info(info: ServerInfo) -> bytes:
    """A server's answer to it; its clock has a million ticks per second."""
    group = bytes(int(part) for part in info.group.split(".")) if info.group else bytes(4)
    name = info.application.encode()[: _NAME - 1].ljust(_NAME, b"\0")
    versions = bytes((1, 0, 0, 0, *info.version, 0, 0))
    ending = struct.pack("<QH?", 1_000_000, info.data_port, info.group is not None) + group
    return pack(Kind.SERVER_INFO, name + versions + ending)


def parse_server_info(payload: bytes) -> ServerInfo:
    """Read a server's answer.

    Raises:
        DamagedPacket: It is truncated.
    """
    reader = _Reader(payload)
    application = reader.take(_NAME).split(b"\0")[0].decode(errors="replace")
    reader.take(4)
    major, minor = reader.take(4)[:2]
    reader.take(8)
    data_port, multicast = struct.unpack("<H?", reader.take(3))
    group = ".".join(str(part) for part in reader.take(4)) if multicast else None
    return ServerInfo(application, (major, minor), data_port, group)


def pack_frame(frame: StreamedFrame, version: Version) -> bytes:
    """A packet with the markers of a frame: those with IDs in the labeled list, all in the older one."""
    known = frame.ids >= 0
    markers = np.zeros(int(known.sum()), dtype=_MARKER)
    markers["id"], markers["position"] = frame.ids[known], frame.points[known]
    markers["flags"] = _SEEN | _UNLABELED
    older = frame.points.astype("<f4").tobytes()
    sized = version >= _SIZED
    parts = [struct.pack("<i", frame.number), _section(0, b"", sized), _section(len(known), older, sized)]
    parts += [_section(0, b"", sized)] * (3 if sized else 2)  # rigid bodies, skeletons, assets
    parts += [_section(len(markers), markers.tobytes(), sized)]
    parts += [_section(0, b"", sized)] * 2  # force plates, other devices
    parts += [struct.pack("<IId3Q", 0, 0, frame.time, 0, 0, 0), bytes(8 if sized else 0), bytes(2 + 4)]
    return pack(Kind.FRAME, b"".join(parts))


def _section(count: int, content: bytes, sized: bool) -> bytes:
    return struct.pack("<i", count) + (struct.pack("<i", len(content)) if sized else b"") + content


def parse_frame(payload: bytes, version: Version, arrived: float = np.nan) -> StreamedFrame:
    """Read the observed markers of a frame; markers that the server filled in are left out."""
    reader, sized = _Reader(payload), version >= _SIZED
    number = reader.integer()
    for _ in range(reader.section(5, sized)):  # marker sets: names, and markers once more
        reader.skip_text()
        reader.skip(12, reader.count(12))
    older = np.frombuffer(reader.take(12 * reader.section(12, sized)), dtype="<f4").reshape(-1, 3)
    reader.skip(_BODY, reader.section(_BODY, sized))
    for _ in range(reader.section(8, sized)):  # skeletons
        reader.integer()
        reader.skip(_BODY, reader.count(_BODY))
    for _ in range(reader.section(12, sized) if sized else 0):  # assets
        reader.integer()
        reader.skip(_BODY, reader.count(_BODY))
        reader.skip(_MARKER.itemsize, reader.count(_MARKER.itemsize))
    size = _MARKER.itemsize
    markers = np.frombuffer(reader.take(size * reader.section(size, sized)), dtype=_MARKER)
    for _ in range(2):  # force plates, other devices
        for _ in range(reader.section(8, sized)):
            reader.integer()
            for _ in range(reader.count(4)):
                reader.skip(4, reader.count(4))
    reader.take(8)  # time code
    (time,) = struct.unpack("<d", reader.take(8))
    reader.take(24 + (8 if sized else 0) + 2)  # clocks, flags
    if reader.integer() != 0 or reader.left > 4 or not np.isfinite(time):
        raise DamagedPacket("no end where it should be")
    points, ids = _seen(markers, older)
    return StreamedFrame(number, time, points, ids, arrived=arrived)


def _seen(
    markers: NDArray[np.void], older: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (N, 3) [m] and IDs (N,), each once: the older list repeats points, two assets may share one."""
    filled_in = (markers["flags"] & _OCCLUDED != 0) | (markers["flags"] & (_SEEN | _FILLED) == _FILLED)
    points = np.concatenate([markers["position"], older])
    ids = np.concatenate([markers["id"], np.full(len(older), -1)]).astype(np.int64)
    _, first = np.unique(np.ascontiguousarray(points).view("V12").ravel(), return_index=True)
    once = np.zeros(len(points), dtype=bool)
    once[first] = True
    once[: len(markers)] &= ~filled_in
    with np.errstate(invalid="ignore"):
        once &= (np.abs(points) < _LOST).all(axis=1)
    return points[once].astype(np.float64), ids[once]


class _Reader:
    """Reads values from bytes, never beyond their end."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    @property
    def left(self) -> int:
        return len(self._content) - self._at

    def take(self, size: int) -> bytes:
        if size > self.left:
            raise DamagedPacket("truncated")
        self._at += size
        return self._content[self._at - size : self._at]

    def integer(self) -> int:
        number: int = struct.unpack("<i", self.take(4))[0]
        return number

    def count(self, least: int, between: int = 0) -> int:
        """A number of items of at least `least` bytes each, with so many other bytes between."""
        count = self.integer()
        self.take(between)
        if not 0 <= count * least <= self.left:
            raise DamagedPacket("counts more than there is")
        return count

    def section(self, least: int, sized: bool) -> int:
        """The number of items of a section; its size, if it has one, is not needed to skip it."""
        return self.count(least, 4 if sized else 0)

    def skip(self, size: int, count: int) -> None:
        self.take(size * count)

    def skip_text(self) -> None:
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise DamagedPacket("a name without an end")
        self._at = end + 1


def open_stream(url: str, *, local: str | None = None) -> PointStream:
    """Connect to the server at `natnet://host:port`, the port for commands.

    It listens at the network card of the address `local`, or at the one that leads to the host.
    """
    host, port, _ = split_address(url, options={}, port=COMMAND_PORT)
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


class PointStream(ArrivingFrames):
    """The frames of a server as they arrive; one that is gone may come again.

    Packets are taken from the server's address, and its ports for commands and for data, only. They wait in
    the socket, and whoever asks takes them out of it: a thread that reads would contend with the tracker for
    the interpreter at every packet. While nobody asks for long, as when hands are measured, a thread keeps
    the socket from running over.
    """

    def __init__(self, sockets: list[socket.socket], address: tuple[str, int], server: ServerInfo) -> None:
        super().__init__()
        self.server = server
        """The server's description of itself."""
        self.damaged = 0
        """Number of damaged packets, which were left out."""
        self.foreign = 0
        """Number of packets of other senders, which were left out."""
        self._sockets, self._address = sockets, address
        self._version = min(server.version, NEWEST)
        self._asked = self._kept_alive = self._heard = time.monotonic()
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
            return self._take_all()

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
        _send(self._sockets[0], pack(Kind.DISCONNECT), self._address)
        for one in self._sockets:
            one.close()

    def _attend(self) -> None:
        """Keep the server sending, and the socket from running over while the reader is busy."""
        while not self._closed.wait(_ATTENDED):
            now = time.monotonic()
            if now >= self._kept_alive + _KEEP_ALIVE:
                _send(self._sockets[0], pack(Kind.KEEP_ALIVE), self._address)
                if now >= self._heard + _KEEP_ALIVE:  # a restarted server does not know this client
                    _send(self._sockets[0], pack_connect(), self._address)
                self._kept_alive = now
            if time.monotonic() > self._asked + _ATTENDED:
                with self._reading:
                    self._drain()

    def _drain(self) -> None:
        """Take what has arrived until now out of the sockets."""
        begin = time.monotonic()
        for one in () if self._ending or self._closed.is_set() else self._sockets:
            while (received := _receive(one)) is not None:
                frame = self._parse(*received)
                if frame is not None:
                    self._add(frame)
                if received.arrived > begin:  # others keep coming
                    break

    def _parse(self, packet: bytes, sender: tuple[str, int], arrived: float) -> StreamedFrame | None:
        """The frame of a packet, if it holds one."""
        if sender[0] != self._address[0] or sender[1] not in (self._address[1], self.server.data_port):
            self.foreign += 1
            return None
        try:
            kind, payload = unpack(packet)
            if kind == Kind.SERVER_INFO and sender == self._address:
                self.server = parse_server_info(payload)
                self._version = min(self.server.version, NEWEST)
            if kind != Kind.FRAME:
                return None
            try:
                frame = parse_frame(payload, self._version, arrived)
            except DamagedPacket:  # some servers send another layout than they say
                other: Version = OLDEST if self._version == NEWEST else NEWEST
                frame = parse_frame(payload, other, arrived)
                self._version = other
        except DamagedPacket:
            self.damaged += 1
            return None
        self._heard = time.monotonic()
        return frame


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
        _send(commands, pack_connect(), server)
        until = time.monotonic() + _RETRY
        while (seconds := until - time.monotonic()) > 0.0:
            ready, _, _ = select.select([commands], [], [], seconds)
            info = _server_info(_receive(commands), server) if ready else None
            if info is None:
                continue
            if info.version < OLDEST:
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
        kind, payload = unpack(received.packet)
        return parse_server_info(payload) if kind == Kind.SERVER_INFO else None
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
            packet, (host, port) = one.recvfrom(LARGEST)
            return _Received(packet, (host, port), time.monotonic())
        packet, told, _, (host, port) = one.recvmsg(LARGEST, socket.CMSG_SPACE(_STAMP.size))
    except OSError:  # no packet, or a message that a port is closed
        return None
    arrived = time.monotonic()
    for level, kind, data in told:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _STAMPS, _STAMP.size):
            seconds, nanoseconds = _STAMP.unpack(data)
            stayed = time.time() - seconds - 1e-9 * nanoseconds
            arrived -= stayed if 0.0 < stayed < _LONGEST_STAY else 0.0
    return _Received(packet, (host, port), arrived)


class PointFrames(Protocol):
    """Points of frames with IDs, such as a take's."""

    @property
    def points(self) -> Float[np.ndarray, "T N 3"]:
        """Points of all frames [m]; NaN where there is no point."""

    @property
    def ids(self) -> Int[np.ndarray, "T N"]:
        """ID of each point, -1 where it has none."""

    @property
    def rate(self) -> float:
        """Frames per second [Hz]."""


@dataclass(frozen=True, slots=True)
class ReplaySettings(Settings):
    """How a capture is played: keyword arguments of `ReplayServer`, and options of `handsim replay`."""

    loop: bool = False
    """Start again at the end, with later numbers and times, and with points of new IDs."""
    rate: Annotated[float | None, Limits(0.0, above=True)] = None
    """Frames per second [Hz]; the capture's own when not given."""
    host: str = LOOPBACK
    """Address of this machine to listen at; other machines do not reach the default."""
    port: Annotated[int, Limits(0, 65535)] = 0
    """UDP port to listen at; 0 takes a free one."""


class ReplayServer(Closing):
    """Streams frames at their rate over NatNet while there is a client, and waits without one.

    The end of a `with` block or `close` ends it.

    Args:
        source: A capture, whose names are not sent and in which an ID lasts until its marker is lost; a take,
            of which only points and IDs are sent; or the path of one.
        settings: How to play it; as `ReplaySettings()` when not given.
        version: NatNet version of the packets.
        options: Fields of `ReplaySettings` that differ from `settings`, as `loop=True` or `rate=120.0`.

    Raises:
        ArgumentError: An option is refused, or the version is unknown.
        CaptureError: The file cannot be read, the arrays do not fit together, there are no frames or too many
            points, or the port is taken.
    """

    def __init__(
        self,
        source: Capture | PointFrames | str | Path,
        settings: ReplaySettings | None = None,
        *,
        version: Version = NEWEST,
        **options: Any,
    ) -> None:
        settings = ReplaySettings.of(settings, options)
        points, ids, own_rate = _point_frames(source)
        if points.ndim != 3 or points.shape != (*ids.shape, 3):
            raise CaptureError(
                f"points have shape {points.shape} and IDs {ids.shape}, expected (T, N, 3) and (T, N)"
            )
        most = int(np.isfinite(points[..., 0]).sum(axis=1).max(initial=0))
        if most > _MOST_POINTS:
            raise CaptureError(f"{most} points in a frame, expected at most {_MOST_POINTS}")
        if not len(points):
            raise CaptureError("there are no frames to replay")
        if version not in VERSIONS:
            known = [f"{major}.{minor}" for major, minor in VERSIONS]
            raise ArgumentError(choices(".".join(map(str, version)), known, noun="NatNet version"))
        self._points, self._ids, self._version, self._loop = points, ids, version, settings.loop
        self.rate = settings.rate or own_rate
        """Frames per second [Hz]."""
        self._ids_of_round = int(ids.max(initial=-1)) + 1
        self._host, self._socket = settings.host, _listen(settings.host, settings.port)
        self._port: int = self._socket.getsockname()[1]
        self._clients: dict[tuple[str, int], float] = {}  # and the time of their last packets
        self.sent = 0
        """Number of frames that were sent so far."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="natnet replay", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address for `open_source` and `handsim track --live`."""
        return f"natnet://{self._host}:{self._port}"

    @property
    def num_clients(self) -> int:
        """Number of clients at this moment."""
        return len(self._clients)

    @property
    def num_frames(self) -> int:
        """Number of frames of a round."""
        return len(self._points)

    @property
    def finished(self) -> bool:
        """Whether the last frame was sent; never in a loop."""
        return not self._loop and self.sent >= len(self._points)

    def close(self) -> None:
        """End the stream."""
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        start = 0.0
        while not self._ended.is_set():
            number = self.sent
            if not self._clients:
                self._answer(_WAIT)
                start = time.monotonic() - number / self.rate  # continue at this frame
                continue
            due = np.inf if self.finished else start + number / self.rate
            self._answer(min(_WAIT, max(0.0, due - time.monotonic())))
            if self._clients and time.monotonic() >= due:
                self._send_all(pack_frame(self._frame(number), self._version))
                self.sent += 1

    def _frame(self, number: int) -> StreamedFrame:
        played, row = divmod(number, len(self._points))
        there = np.isfinite(self._points[row]).all(axis=1)
        ids = self._ids[row, there].astype(np.int64)
        ids[ids >= 0] = (ids[ids >= 0] + played * self._ids_of_round) % _NUMBERS
        return StreamedFrame(number % _NUMBERS, number / self.rate, self._points[row, there], ids)

    def _answer(self, seconds: float) -> None:
        """Wait for a client's packet and answer it."""
        ready, _, _ = select.select([self._socket], [], [], seconds)
        if not ready:
            return
        try:
            packet, client = self._socket.recvfrom(LARGEST)
            kind, _ = unpack(packet)
        except (OSError, DamagedPacket):
            return
        if kind == Kind.CONNECT and (client in self._clients or len(self._clients) < _MOST_CLIENTS):
            self._clients[client] = time.monotonic()
            info = ServerInfo("handsim replay", self._version, self._port, None)
            self._send(pack_server_info(info), client)
        elif kind == Kind.KEEP_ALIVE and client in self._clients:
            self._clients[client] = time.monotonic()
        elif kind == Kind.DISCONNECT:
            self._clients.pop(client, None)

    def _send_all(self, packet: bytes) -> None:
        now = time.monotonic()
        self._clients = {
            client: heard for client, heard in self._clients.items() if now - heard < _CLIENT_TIMEOUT
        }
        for client in self._clients:
            self._send(packet, client)

    def _send(self, packet: bytes, client: tuple[str, int]) -> None:
        try:
            self._socket.sendto(packet, client)
        except OSError:
            pass  # the client is gone, or its buffer is full


def _point_frames(
    source: Capture | PointFrames | str | Path,
) -> tuple[Float[np.ndarray, "T N 3"], Int[np.ndarray, "T N"], float]:
    """Points [m], IDs and rate [Hz] of what is to be played."""
    if isinstance(source, str | Path):
        source = read_points(source)
    if not all(hasattr(source, name) for name in ("rate", "ids")):
        check_type("source", source, Capture, "a Capture, a Take, or the path of a file")
    if isinstance(source, Capture):
        return source.positions, number_runs(np.isfinite(source.positions[..., 0])), source.rate
    return source.points, source.ids, source.rate


def _listen(host: str, port: int) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.bind((host, port))
    except (OSError, OverflowError) as error:
        one.close()
        what = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise CaptureError(
            f"port {port} cannot be listened at on {host} ({what}), expected a free port of this machine"
        ) from error
    one.setblocking(False)
    return one
