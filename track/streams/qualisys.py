"""Frames from Qualisys Track Manager (QTM) over its real-time protocol, with the package qtm-rt."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np

from handsim._plugins import import_extra
from handsim.errors import CaptureError
from track.frames import LATEST_TIME, StreamedFrame
from track.streams import NoServerError, find_host

PORT: Final = 22223
"""QTM's port for little-endian clients."""
_VERSION: Final = "1.23"
_PATIENCE: Final = 3.0  # longest wait for an answer [s]
_RETRY: Final = 1.0  # time between attempts to reach a QTM that went away [s]
_COMPONENTS: Final = ["3d", "3dnolabels"]
_STARTS: Final = ("EventConnected", "EventCaptureStarted", "EventRTfromFileStarted")
_FIRST_ID: Final = 1 << 16  # first ID of unidentified markers; smaller ones are identified
_ID_LIMIT: Final = 1 << 30
_PACKET_HEAD: Final = struct.Struct("<2I")  # size and kind of a packet
_DAMAGED: Final = "damaged_packets"
_LOST, _CLOSED = "lost", "closed"  # queued after the last frame of a connection, or of the source


class QualisysSource:
    """A `FrameSource` of QTM's real-time 3D points, which reconnects after QTM was away.

    The ID of an identified marker is its index in QTM's list; other markers have QTM's IDs plus 65536.
    """

    without_points = "in QTM switch on real-time 3D tracking: Project Options, Processing, Real-Time Actions"

    def __init__(self, host: str, port: int = PORT) -> None:
        self._qtm: Any = import_extra("qtm_rt", "qtm://", "qualisys")
        logging.getLogger("qtm_rt").setLevel(logging.CRITICAL + 1)  # our errors say the same
        self._host, self._port = host, port
        self.without_frames = "is QTM measuring?"
        """Why no frame comes, as far as QTM tells."""
        self.counts = {_DAMAGED: 0}
        """Number of packets that were left out."""
        self._arrived: asyncio.Queue[StreamedFrame | str] = asyncio.Queue()
        self._subscribing: asyncio.Task[None] | None = None
        self._loop = asyncio.new_event_loop()
        try:
            self._connection = self._loop.run_until_complete(self._connect())
        except BaseException:
            self._loop.close()
            raise

    def __iter__(self) -> Iterator[StreamedFrame]:
        """Yield the frames in the order of their times, until `close`."""
        self._subscribe()
        again = False
        while (arrived := self._loop.run_until_complete(self._arrived.get())) != _CLOSED:
            if isinstance(arrived, StreamedFrame):
                yield dataclasses.replace(arrived, restarted=True) if again else arrived
                again = False
            elif not self._loop.run_until_complete(self._reconnect()):
                break
            else:
                again = True
        if self._connection.has_transport():
            self._connection.disconnect()

    def close(self) -> None:
        """End the frames."""
        self._loop.call_soon_threadsafe(self._arrived.put_nowait, _CLOSED)

    async def _connect(self) -> Any:
        url = f"qtm://{self._host}:{self._port}"
        machine = find_host(url, self._host)
        try:
            async with asyncio.timeout(_PATIENCE):
                _, protocol = await self._loop.create_connection(self._make_protocol, machine, self._port)
                await protocol.set_version(_VERSION)
        except self._qtm.QRTCommandException as error:
            raise CaptureError(f"{url}: QTM refuses version {_VERSION} of its protocol ({error})") from error
        except OSError as error:  # TimeoutError is one
            refused = f"no program of {machine} listens at port {self._port}"
            cause = refused if isinstance(error, ConnectionRefusedError) else error.strerror or "it is silent"
            raise NoServerError(
                f"{url}: no QTM answers, expected one that runs there: {cause}; start QTM, or compare the "
                "port with that of its real-time output"
            ) from error
        return self._qtm.QRTConnection(protocol, timeout=_PATIENCE)

    def _make_protocol(self) -> Any:
        """Make the protocol of qtm-rt, whose packets are checked first."""
        protocol = import_extra("qtm_rt.protocol", "qtm://", "qualisys").QTMProtocol(
            loop=self._loop, on_event=self._react, on_disconnect=self._leave
        )
        protocol._receiver = _Packets(protocol, self.counts)
        return protocol

    def _leave(self, _: object) -> None:
        """Note that the connection is lost."""
        self.without_frames = f"QTM at {self._host} went away; it is called again and again"
        self._arrived.put_nowait(_LOST)

    async def _reconnect(self) -> bool:
        """Connect again as soon as QTM is back; return False if `close` was called before."""
        while True:
            while not self._arrived.empty():  # a failed attempt queues "lost", too
                if self._arrived.get_nowait() == _CLOSED:
                    return False
            try:
                self._connection = await self._connect()
            except NoServerError:
                await asyncio.sleep(_RETRY)
                continue
            self._subscribe()
            return True

    def _react(self, event: Any) -> None:
        """Subscribe to the next measurement, as a subscription ends with its measurement."""
        if event.name in _STARTS:
            self._subscribe()

    def _subscribe(self) -> None:
        self._subscribing = self._loop.create_task(self._stream())

    async def _stream(self) -> None:
        self.without_frames = "QTM answers, but sends no frame; start real time or a measurement in QTM"
        with suppress(TimeoutError, self._qtm.QRTCommandException):  # An event announces a measurement.
            await self._connection.stream_frames(components=_COMPONENTS, on_packet=self._take)

    def _take(self, packet: Any) -> None:
        self._arrived.put_nowait(frame_of(packet))


class _Packets:
    """Divides a connection's bytes into packets for the receiver of qtm-rt, and leaves out damaged ones.

    qtm-rt alone waits for ever for a packet of a false size, and loses the connection to one of false counts.
    """

    def __init__(self, protocol: Any, counts: dict[str, int]) -> None:
        self._protocol, self._receiver, self._counts = protocol, protocol._receiver, counts
        self._rest = bytearray()

    def data_received(self, data: bytes) -> None:
        """Pass whole packets on; end the connection at a size that no packet has."""
        self._rest += data
        while len(self._rest) >= _PACKET_HEAD.size:
            size, kind = _PACKET_HEAD.unpack_from(self._rest)
            # This is far more than a packet of markers has.
            if not _PACKET_HEAD.size <= size <= 1 << 24:
                self._counts[_DAMAGED] += 1
                self._rest.clear()
                self._protocol.transport.abort()
            if not _PACKET_HEAD.size <= size <= len(self._rest):
                return
            packet = bytes(self._rest[_PACKET_HEAD.size : size])
            del self._rest[:size]
            try:
                self._receiver._parse_received(packet, kind)
            except Exception:  # qtm-rt does not say which errors damaged packets raise
                self._counts[_DAMAGED] += 1


def frame_of(packet: Any) -> StreamedFrame:
    """The frame of a data packet of qtm-rt."""
    _, identified = packet.get_3d_markers() or (None, [])
    _, others = packet.get_3d_markers_no_label() or (None, [])
    positions = [(one.x, one.y, one.z) for one in identified + others]  # [mm], NaN if not seen
    points = 1e-3 * np.array(positions, dtype=np.float64).reshape(-1, 3)
    ids = [*range(len(identified)), *(_FIRST_ID + other.id % _ID_LIMIT for other in others)]
    there, time = np.isfinite(points).all(axis=1), 1e-6 * packet.timestamp
    if not abs(time) < LATEST_TIME:
        raise ValueError(f"a time of {time} s")
    return StreamedFrame(packet.framenumber, time, points[there], np.array(ids, dtype=np.int64)[there])
