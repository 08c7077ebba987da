"""NatNet, the protocol in which OptiTrack servers stream markers: packets of versions 3.0 to 4.1.

Packets are little-endian: kind and payload size (two uint16), then the payload. A tracker needs a frame's
list of markers with IDs, which holds labeled and unlabeled ones; all other sections are skipped. Every count
is checked against the number of remaining bytes before it is used.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """The markers of one frame."""

    number: int
    time: float
    """Time since the server was started [s]."""
    points: Float[np.ndarray, "N 3"]
    """[m], in the axes set at the server."""
    ids: Int[np.ndarray, "N"]
    """A marker keeps its ID for as long as it is tracked; -1 without an ID."""


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


def pack_frame(frame: MarkerFrame, version: Version) -> bytes:
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


def parse_frame(payload: bytes, version: Version) -> MarkerFrame:
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
    return MarkerFrame(number, time, points, ids)


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
