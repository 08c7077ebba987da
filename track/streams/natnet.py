"""NatNet, the protocol in which OptiTrack servers (Motive) stream markers: packets, a client and a server.

Packets of versions 3.0 to 4.1 are little-endian: kind and payload size (two uint16), then the payload. Of a
frame only the lists of markers are read, and the points of marker sets and assets if no labeled marker is in
a list, because Motive can switch these off. Every count is checked against the remaining bytes before use.
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
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.optics.reconstruction import number_runs
from gloves.takes.take import Take
from handsim._checks import check_type
from handsim.arrays import Doubles, Integers
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, CaptureError, choices
from track.frames import StreamedFrame, read_points
from track.streams import COMMAND_PORT, NoServerError, ReplaySettings, find_host, split_address
from track.streams.frame_source import ArrivingFrames

Version = tuple[int, int]
LARGEST: Final = 65507  # largest UDP datagram [bytes]
OLDEST: Final[Version] = (3, 0)
NEWEST: Final[Version] = (4, 1)
"""Newest known layout, which servers are asked to send."""
_FIRST_SIZED: Final[Version] = (4, 1)
"""First version with section sizes, assets and a finer clock."""
_LOST_DISTANCE: Final = 9e6  # [m] Motive puts lost markers farther away.
_OCCLUDED, _SEEN, _FILLED, _UNLABELED = 1, 2, 4, 16  # flags of a marker
_NAME_SIZE: Final = 256  # size of a program's name [bytes]
_BODY_SIZE: Final = 38  # size of a rigid body: ID, position, orientation, error, flags [bytes]
_MARKER_TYPE: Final = np.dtype(
    {
        "names": ["id", "position", "size", "flags", "residual"],
        "formats": ["<i4", ("<f4", 3), "<f4", "<i2", "<f4"],
        "offsets": [0, 4, 16, 20, 22],
        "itemsize": 26,
    }
)
_PATIENCE: Final = 3.0  # longest wait for a server [s]
_RETRY: Final = 0.5  # time between requests to a server that does not answer [s]
_KEEP_ALIVE: Final = 2.0  # time between keep-alive packets [s]
_AWAY_TIME: Final = 7.0  # [s] A server that has been silent for this time is away: it missed three calls.
_ATTEND_PERIOD: Final = 0.1  # [s] The thread empties a socket that nobody has read for this time.
_BUFFER_SIZE: Final = 1 << 22  # size of the socket's receive buffer [bytes]
_STAMP_OPTION: Final = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python does not name
_STAMP: Final = struct.Struct("@ll")  # seconds and nanoseconds
_TICK_RATE: Final = 1_000_000  # ticks of our clock in a second
_LONGEST_LATENCY: Final = 10.0  # [s] A longer latency means that the server's times are of different clocks.
_LONGEST_IN_SOCKET: Final = 60.0  # [s] A longer time in the socket means that our clock was set meanwhile.
VERSIONS: Final[tuple[Version, ...]] = ((3, 0), (3, 1), (4, 0), (4, 1))
_MOST_POINTS: Final = 1500  # largest number of points that fit into a datagram
_MOST_CLIENTS: Final = 8
_CLIENT_TIMEOUT: Final = 10.0  # [s] A client without a packet for this time is gone.
_LONGEST_WAIT: Final = 0.05  # [s] longest wait of the server for a client's packet
_NUMBER_LIMIT: Final = 1 << 31  # frame numbers and IDs wrap around here


class Kind(IntEnum):
    """Kinds of packets in use."""

    CONNECT = 0
    SERVER_INFO = 1
    FRAME = 7
    DISCONNECT = 9
    KEEP_ALIVE = 10


class DamagedPacket(ValueError):
    """Bytes are not a packet of the expected kind and version."""


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """A server's description of itself."""

    application: str
    version: Version
    """NatNet version of its packets."""
    data_port: int
    group: str | None
    """Multicast address of its frames; None with unicast."""
    clock: int = _TICK_RATE
    """Ticks of its clock in a second."""


def pack(kind: Kind, payload: bytes = b"") -> bytes:
    """Make a packet."""
    return struct.pack("<HH", kind, len(payload)) + payload


def unpack(packet: bytes) -> tuple[int, bytes]:
    """Split a packet into kind and payload."""
    if len(packet) < 4:
        raise DamagedPacket("no header")
    kind, size = struct.unpack_from("<HH", packet)
    if size > len(packet) - 4:
        raise DamagedPacket("shorter than it says")
    return kind, packet[4 : 4 + size]


def pack_connect() -> bytes:
    """A client's first packet: its name and versions, and a request for all data in the newest layout."""
    versions = bytes((1, 0, 0, 0, *NEWEST, 0, 0, 0, *NEWEST, 0, 0, 0))
    return pack(Kind.CONNECT, b"handsim".ljust(_NAME_SIZE, b"\0") + versions)


def pack_server_info(info: ServerInfo) -> bytes:
    """Packet of a server's description of itself."""
    group = bytes(int(part) for part in info.group.split(".")) if info.group else bytes(4)
    name = info.application.encode()[: _NAME_SIZE - 1].ljust(_NAME_SIZE, b"\0")
    versions = bytes((1, 0, 0, 0, *info.version, 0, 0))
    ending = struct.pack("<QH?", info.clock, info.data_port, info.group is not None) + group
    return pack(Kind.SERVER_INFO, name + versions + ending)


def parse_server_info(payload: bytes) -> ServerInfo:
    """Read a server's description of itself."""
    reader = _Reader(payload)
    application = reader.take(_NAME_SIZE).split(b"\0")[0].decode(errors="replace")
    reader.take(4)
    major, minor = reader.take(4)[:2]
    clock, data_port, multicast = struct.unpack("<QH?", reader.take(11))
    group = ".".join(str(part) for part in reader.take(4)) if multicast else None
    return ServerInfo(application, (major, minor), data_port, group, clock)


def pack_frame(frame: StreamedFrame, version: Version) -> bytes:
    """Pack a frame: markers with IDs into the list of labeled markers, all points into the older list."""
    known = frame.ids >= 0
    markers = np.zeros(int(known.sum()), dtype=_MARKER_TYPE)
    markers["id"], markers["position"] = frame.ids[known], frame.points[known]
    markers["flags"] = _SEEN | _UNLABELED
    older = frame.points.astype("<f4").tobytes()
    sized = version >= _FIRST_SIZED
    parts = [struct.pack("<i", frame.number), _section(0, b"", sized), _section(len(known), older, sized)]
    parts += [_section(0, b"", sized)] * (3 if sized else 2)  # rigid bodies, skeletons, assets
    parts += [_section(len(markers), markers.tobytes(), sized)]
    parts += [_section(0, b"", sized)] * 2  # force plates, other devices
    ticks = (1, 1, 1 + round(_TICK_RATE * frame.latency)) if np.isfinite(frame.latency) else (0, 0, 0)
    parts += [struct.pack("<IId3Q", 0, 0, frame.time, *ticks), bytes(8 if sized else 0), bytes(2 + 4)]
    return pack(Kind.FRAME, b"".join(parts))


def _section(count: int, content: bytes, sized: bool) -> bytes:
    return struct.pack("<i", count) + (struct.pack("<i", len(content)) if sized else b"") + content


def parse_frame(
    payload: bytes, version: Version, arrived: float = np.nan, *, clock: int = _TICK_RATE
) -> StreamedFrame:
    """Read the observed markers of a frame, without what the server filled in.

    Those of marker sets and assets count if no labeled marker is in the list of markers.
    """
    reader, extra, size = _Reader(payload), 4 if version >= _FIRST_SIZED else 0, _MARKER_TYPE.itemsize
    number = reader.integer()
    in_sets, in_assets = b"", b""
    for _ in range(reader.count(5, extra)):  # marker sets: names, and markers again
        reader.skip_text()
        in_sets += reader.items(12)
    older = np.frombuffer(reader.items(12, extra), dtype="<f4").reshape(-1, 3)
    reader.items(_BODY_SIZE, extra)
    for _ in range(reader.count(8, extra)):  # skeletons
        reader.integer()
        reader.items(_BODY_SIZE)
    for _ in range(reader.count(12, extra) if extra else 0):  # assets
        reader.integer()
        reader.items(_BODY_SIZE)
        in_assets += reader.items(size)
    markers = np.frombuffer(reader.items(size, extra), dtype=_MARKER_TYPE)
    for _ in range(2):  # force plates, other devices
        for _ in range(reader.count(8, extra)):
            reader.integer()
            for _ in range(reader.count(4)):
                reader.items(4)
    reader.take(8)  # time code
    time, exposed, _, sent = struct.unpack("<d3Q", reader.take(32))  # ticks: exposed, received, sent
    reader.take(2 * extra + 2)  # another clock, flags
    if reader.integer() != 0 or reader.left > 4 or not np.isfinite(time):
        raise DamagedPacket("no end where it should be")
    if (markers["flags"] & _UNLABELED != 0).all():
        markers = np.concatenate([markers, np.frombuffer(in_assets, dtype=_MARKER_TYPE)])
        sets = np.frombuffer(in_sets, dtype="<f4").reshape(-1, 3)
        older = np.concatenate([older, sets[sets.any(axis=1)]])  # A marker that is not seen has zeros.
    points, ids = _observed_points(markers, older)
    latency = (sent - exposed) / clock if clock and exposed else np.nan
    known = 0.0 <= latency < _LONGEST_LATENCY
    return StreamedFrame(number, time, points, ids, arrived=arrived, latency=latency if known else np.nan)


def _observed_points(markers: NDArray[np.void], older: NDArray[np.float32]) -> tuple[Doubles, Integers]:
    """Points (N, 3) [m] and IDs (N,), each point once although both lists and two assets may contain it."""
    filled_in = (markers["flags"] & _OCCLUDED != 0) | (markers["flags"] & (_SEEN | _FILLED) == _FILLED)
    points = np.concatenate([markers["position"], older])
    ids = np.concatenate([markers["id"], np.full(len(older), -1)]).astype(np.int64)
    _, first = np.unique(np.ascontiguousarray(points).view("V12").ravel(), return_index=True)
    once = np.zeros(len(points), dtype=bool)
    once[first] = True
    once[: len(markers)] &= ~filled_in
    with np.errstate(invalid="ignore"):
        once &= (np.abs(points) < _LOST_DISTANCE).all(axis=1)
    return points[once].astype(np.float64), ids[once]


class _Reader:
    """Reads values from bytes; raises a `DamagedPacket` beyond their end."""

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

    def count(self, least: int, extra: int = 0) -> int:
        """A number of items of at least `least` bytes each, with `extra` bytes between number and items."""
        count = self.integer()
        self.take(extra)
        if not 0 <= count * least <= self.left:
            raise DamagedPacket("counts more than there is")
        return count

    def items(self, size: int, extra: int = 0) -> bytes:
        """The bytes of a list of items of `size` bytes each."""
        return self.take(size * self.count(size, extra))

    def skip_text(self) -> None:
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise DamagedPacket("a name without an end")
        self._at = end + 1


def open_stream(url: str) -> PointStream:
    """Connect to the server at `natnet://host:port`."""
    host, port, _ = split_address(url, options={}, port=COMMAND_PORT)
    address = find_host(url, host, socket.AF_INET), port
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(address)  # sends nothing, but selects the network card towards the server
            commands = _bind(probe.getsockname()[0], 0)
    except OSError as error:
        raise CaptureError(f"{url}: cannot be reached ({error.strerror or error})") from error
    try:
        info = _connect(commands, address, url)
        return PointStream(commands, address, info)
    except BaseException:
        commands.close()
        raise


class PointStream(ArrivingFrames):
    """Frames of a server as they arrive, even after the server restarts with other settings.

    Only packets from the server's address and its two ports are read. `poll` reads in the tracker's thread,
    because a reading thread would compete for the interpreter at every packet. While nobody polls, as during
    a measurement of hands, a thread empties the socket before it overflows.
    """

    without_points = "switch on Labeled Markers and Unlabeled Markers in Motive's streaming pane"

    def __init__(self, commands: socket.socket, address: tuple[str, int], server: ServerInfo) -> None:
        super().__init__()
        self._sockets, self._address = [commands], address
        self._joined: ServerInfo | None = None  # whose group was joined
        self.server = server
        """The server's description of itself."""
        self.damaged = 0
        """Number of damaged packets."""
        self.foreign = 0
        """Number of packets of other senders."""
        self._stranger = ""  # address of the last of them
        self._has_frames = False
        self._listen()
        self._version = min(server.version, NEWEST)
        self._polled_at = self._kept_alive_at = self._framed_at = self._answered_at = time.monotonic()
        self._reading = threading.Lock()
        self._ending = False
        self._closed = threading.Event()
        self._attendant = threading.Thread(target=self._attend, name="natnet client", daemon=True)
        self._attendant.start()

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of ignored packets, as a take records them."""
        return {"damaged_packets": self.damaged, "foreign_packets": self.foreign}

    @property
    def without_frames(self) -> str:
        """Why no frame comes, as far as the packets of the server and of others tell."""
        server = self.server
        if time.monotonic() > self._answered_at + _AWAY_TIME:
            return f"the server at {self._address[0]} no longer answers; it is called again and again"
        if self._has_frames:
            return super().without_frames
        if self.damaged:
            return f"the server answers, but its {self.damaged} packets are no frames of NatNet 3.0 to 4.1"
        if self.foreign:
            return (
                f"the server answers, but {self.foreign} packets came from {self._stranger} in place of its "
                "address and ports; is this the right address and port?"
            )
        if server.group is not None:
            return (
                f"the server answers, but no frame of its multicast group {server.group}, port "
                f"{server.data_port}, arrives: choose Unicast in Motive's streaming pane (WSL, Docker and "
                "some networks do not pass multicast)"
            )
        return "the server answers, but sends no frame; is it playing?"

    @property
    def is_over(self) -> bool:
        """Whether no further frame comes."""
        return self._closed.is_set() or (self._ending and not self._arrived)

    def poll(self, seconds: float) -> list[StreamedFrame]:
        """Return the frames that have arrived; wait up to `seconds` for one."""
        if self._closed.is_set():
            return []
        if self._joined != self.server:
            with self._reading, suppress(CaptureError):  # The next description may have a valid group.
                self._listen()
        if seconds > 0.0 and not (self._arrived or self._ending):
            select.select(self._sockets, [], [], seconds)
        with self._reading:
            self._polled_at = time.monotonic()
            self._drain()
            return self._take_all()

    def end(self) -> None:
        """Ignore all frames that arrive from now on."""
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

    def _listen(self) -> None:
        """Join the multicast group of the server, which may change after a restart."""
        server = self.server
        while len(self._sockets) > 1:
            self._sockets.pop().close()
        if server.group is not None:
            self._sockets.append(_join(server, self._sockets[0], f"natnet://{self._address[0]}"))
        self._joined = server

    def _attend(self) -> None:
        """Send keep-alive packets, and empty the socket while the reader is busy."""
        while not self._closed.wait(_ATTEND_PERIOD):
            now = time.monotonic()
            if now >= self._kept_alive_at + _KEEP_ALIVE:
                _send(self._sockets[0], pack(Kind.KEEP_ALIVE), self._address)
                if now >= self._framed_at + _KEEP_ALIVE:  # A restarted server does not know this client.
                    _send(self._sockets[0], pack_connect(), self._address)
                self._kept_alive_at = now
            if time.monotonic() > self._polled_at + _ATTEND_PERIOD:
                with self._reading:
                    self._drain()

    def _drain(self) -> None:
        """Read all packets that have arrived by now."""
        begin = time.monotonic()
        for one in () if self._ending or self._closed.is_set() else self._sockets:
            while (received := _receive(one)) is not None:
                frame = self._parse(*received)
                if frame is not None:
                    self._add(frame)
                if received.arrived > begin:
                    break

    def _parse(self, packet: bytes, sender: tuple[str, int], arrived: float) -> StreamedFrame | None:
        """The frame of a packet; None if it has none."""
        if sender[0] != self._address[0] or sender[1] not in (self._address[1], self.server.data_port):
            self.foreign += 1
            self._stranger = f"{sender[0]}:{sender[1]}"
            return None
        self._answered_at = time.monotonic()
        try:
            kind, payload = unpack(packet)
            if kind == Kind.SERVER_INFO and sender == self._address:
                self.server = parse_server_info(payload)
                self._version = min(self.server.version, NEWEST)
            if kind != Kind.FRAME:
                return None
            clock = self.server.clock
            try:
                frame = parse_frame(payload, self._version, arrived, clock=clock)
            except DamagedPacket:  # Some servers announce another version than they send.
                other: Version = OLDEST if self._version == NEWEST else NEWEST
                frame = parse_frame(payload, other, arrived, clock=clock)
                self._version = other
        except DamagedPacket:
            self.damaged += 1
            return None
        self._framed_at, self._has_frames = self._answered_at, True
        return frame


def _bind(address: str, port: int) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_SIZE)
        if port:  # Other programs on this machine may listen to the same group.
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if _STAMP_OPTION is not None:
            one.setsockopt(socket.SOL_SOCKET, _STAMP_OPTION, 1)
        one.bind((address, port))
        one.setblocking(False)
    except OSError:
        one.close()
        raise
    return one


def _connect(commands: socket.socket, server: tuple[str, int], url: str) -> ServerInfo:
    """Request the server's description until it answers."""
    strange = 0
    for _ in range(round(_PATIENCE / _RETRY)):
        _send(commands, pack_connect(), server)
        until = time.monotonic() + _RETRY
        while (seconds := until - time.monotonic()) > 0.0:
            ready, _, _ = select.select([commands], [], [], seconds)
            received = _receive(commands) if ready else None
            if received is None or received.sender != server:
                continue
            try:
                kind, payload = unpack(received.packet)
                if kind != Kind.SERVER_INFO:
                    continue
                info = parse_server_info(payload)
            except DamagedPacket:
                strange += 1
                continue
            if info.version < OLDEST:
                major, minor = info.version
                raise CaptureError(f"{url}: the server speaks NatNet {major}.{minor}, expected 3.0 or newer")
            return info
    if strange:
        heard = f"the program at port {server[1]} answers, but speaks no NatNet"
    elif _is_refused(server):
        heard = f"no NatNet server answers at port {server[1]}: no program of {server[0]} listens there"
    else:
        heard = f"no NatNet server answers at port {server[1]} of {server[0]}"
    raise NoServerError(
        f"{url}: {heard}; in Motive, switch streaming on, choose the network that this machine is in, and "
        "compare the command port"
    )


def _is_refused(server: tuple[str, int]) -> bool:
    """Whether a machine says that no program listens at its port; many firewalls keep silent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(server)
            probe.send(pack(Kind.KEEP_ALIVE))
            probe.settimeout(_RETRY)
            probe.recv(LARGEST)
        except ConnectionRefusedError:
            return True
        except OSError:
            pass
    return False


def _join(info: ServerInfo, commands: socket.socket, url: str) -> socket.socket:
    """Join the group to which the server multicasts."""
    group, local = str(info.group), commands.getsockname()[0]
    if not ipaddress.ip_address(group).is_multicast:
        raise CaptureError(
            f"{url}: the server says that it multicasts to {group}, which is not a multicast address"
        )
    try:
        one = _bind(local if os.name == "nt" else group, info.data_port)
        membership = socket.inet_aton(group) + socket.inet_aton(local)
        one.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError as error:
        raise CaptureError(f"{url}: cannot listen to {group} ({error.strerror or error})") from error
    return one


def _send(one: socket.socket, packet: bytes, address: tuple[str, int]) -> None:
    with suppress(OSError):  # the network is down or a buffer is full: the packet is lost as any other may be
        one.sendto(packet, address)


class _Received(NamedTuple):
    packet: bytes
    sender: tuple[str, int]
    arrived: float
    """Monotonic time of its arrival on this machine [s]."""


def _receive(one: socket.socket) -> _Received | None:
    """Next packet in a socket; None if there is none."""
    try:
        if _STAMP_OPTION is None:
            packet, (host, port) = one.recvfrom(LARGEST)
            return _Received(packet, (host, port), time.monotonic())
        packet, told, _, (host, port) = one.recvmsg(LARGEST, socket.CMSG_SPACE(_STAMP.size))
    except OSError:
        return None
    arrived = time.monotonic()
    for level, kind, data in told:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _STAMP_OPTION, _STAMP.size):
            seconds, nanoseconds = _STAMP.unpack(data)
            stayed = time.time() - seconds - 1e-9 * nanoseconds
            arrived -= stayed if 0.0 < stayed < _LONGEST_IN_SOCKET else 0.0
    return _Received(packet, (host, port), arrived)


class ReplayServer(Closing):
    """Streams frames at their rate over NatNet while a client is connected, and waits otherwise.

    The end of a `with` block or `close` ends it.

    Args:
        source: A capture, whose names are not sent and whose IDs last until the marker is lost; a take, of
            which only points and IDs are sent; or the path of either.
        settings: Settings of the replay; `ReplaySettings()` when not given.
        version: NatNet version of the packets.
        options: Fields of `ReplaySettings` that differ from `settings`, as `loop=True` or `rate=120.0`.

    Raises:
        ArgumentError: An option is refused, or the version is unknown.
        CaptureError: The file cannot be read, the arrays do not fit together, there are no frames or too many
            points, or the port is taken.
    """

    def __init__(
        self,
        source: Capture | Take | str | Path,
        settings: ReplaySettings | None = None,
        *,
        version: Version = NEWEST,
        **options: Any,
    ) -> None:
        settings = ReplaySettings.of(settings, options)
        if isinstance(source, str | Path):
            source = read_points(source)
        if isinstance(source, Capture):
            points, ids = source.positions, number_runs(np.isfinite(source.positions[..., 0]))
        else:
            if not all(hasattr(source, name) for name in ("rate", "ids")):
                check_type("source", source, Capture, "a Capture, a Take, or the path of a file")
            points, ids = source.points, source.ids
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
        self.rate = settings.rate or source.rate
        """Frames per second [Hz]."""
        self._ids_of_round = int(ids.max(initial=-1)) + 1
        self._host, port = settings.host, settings.port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((self._host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            what = (error.strerror if isinstance(error, OSError) else None) or str(error)
            raise CaptureError(
                f"port {port} cannot be listened at on {self._host} ({what}), expected a free port of this "
                "machine"
            ) from error
        self._socket.setblocking(False)
        self._port: int = self._socket.getsockname()[1]
        self._clients: dict[tuple[str, int], float] = {}  # time of each client's last packet [s]
        self.sent = 0
        """Number of frames sent so far."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="natnet replay", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address for `open_source` and `handsim track --live`."""
        return f"natnet://{self._host}:{self._port}"

    @property
    def num_clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    @property
    def num_frames(self) -> int:
        """Number of frames of the capture."""
        return len(self._points)

    @property
    def finished(self) -> bool:
        """Whether the last frame was sent; never with `loop`."""
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
                self._answer(_LONGEST_WAIT)
                start = time.monotonic() - number / self.rate  # continue at this frame
                continue
            due = np.inf if self.finished else start + number / self.rate
            self._answer(min(_LONGEST_WAIT, max(0.0, due - time.monotonic())))
            if self._clients and time.monotonic() >= due:
                packet, now = pack_frame(self._frame(number), self._version), time.monotonic()
                self._clients = {
                    client: heard for client, heard in self._clients.items() if now - heard < _CLIENT_TIMEOUT
                }
                for client in self._clients:
                    _send(self._socket, packet, client)
                self.sent += 1

    def _frame(self, number: int) -> StreamedFrame:
        played, row = divmod(number, len(self._points))
        there = np.isfinite(self._points[row]).all(axis=1)
        ids = self._ids[row, there].astype(np.int64)
        ids[ids >= 0] = (ids[ids >= 0] + played * self._ids_of_round) % _NUMBER_LIMIT
        return StreamedFrame(number % _NUMBER_LIMIT, number / self.rate, self._points[row, there], ids)

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
            _send(self._socket, pack_server_info(info), client)
        elif kind == Kind.KEEP_ALIVE and client in self._clients:
            self._clients[client] = time.monotonic()
        elif kind == Kind.DISCONNECT:
            self._clients.pop(client, None)
