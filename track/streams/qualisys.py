"""Frames from Qualisys Track Manager (QTM) over its real-time protocol, with the package qtm-rt."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from handsim._plugins import import_extra
from track.frames import StreamedFrame
from track.streams import NoServerError

PORT: Final = 22223
"""QTM's port for little-endian clients."""
_VERSION: Final = "1.23"
_PATIENCE: Final = 3.0  # longest wait for an answer [s]
_RETRY: Final = 1.0  # time between attempts to reach a QTM that went away [s]
_COMPONENTS: Final = ["3d", "3dnolabels"]
_STARTS: Final = ("EventConnected", "EventCaptureStarted", "EventRTfromFileStarted")
_FIRST_ID: Final = 1 << 16  # first ID of unidentified markers; smaller ones are identified
_IDS: Final = 1 << 30
_LOST, _CLOSED = "lost", "closed"  # queued after the last frame of a connection, or of the source


class QualisysSource:
    """A `FrameSource` of QTM's real-time 3D points, which reconnects after QTM was away.

    The ID of an identified marker is its index in QTM's list; other markers have QTM's IDs plus 65536.
    """

    without_points = (
        "in QTM switch on 3D tracking in real time: Project Options, Processing, Real-Time Actions"
    )

    def __init__(self, host: str, port: int = PORT) -> None:
        self._qtm: Any = import_extra("qtm_rt", "qtm://", "qualisys")
        logging.getLogger("qtm_rt").setLevel(logging.CRITICAL + 1)  # our errors say the same
        self._host, self._port = host, port
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
        try:
            connection = await asyncio.wait_for(
                self._qtm.connect(
                    self._host,
                    self._port,
                    version=_VERSION,
                    on_event=self._react,
                    on_disconnect=lambda _: self._arrived.put_nowait(_LOST),
                    timeout=_PATIENCE,
                ),
                _PATIENCE,
            )
        except TimeoutError:
            connection = None
        if connection is None:
            raise NoServerError(
                f"qtm://{self._host}:{self._port}: no QTM answers, expected one that runs there"
            )
        return connection

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
        try:
            await self._connection.stream_frames(components=_COMPONENTS, on_packet=self._take)
        except (TimeoutError, self._qtm.QRTCommandException):
            pass  # No measurement is running; an event announces the next one.

    def _take(self, packet: Any) -> None:
        self._arrived.put_nowait(frame_of(packet))


def frame_of(packet: Any) -> StreamedFrame:
    """The frame of a data packet of qtm-rt."""
    _, identified = packet.get_3d_markers() or (None, [])
    _, others = packet.get_3d_markers_no_label() or (None, [])
    positions = [(one.x, one.y, one.z) for one in identified + others]  # [mm], NaN if not seen
    points = 1e-3 * np.array(positions, dtype=np.float64).reshape(-1, 3)
    ids = [*range(len(identified)), *(_FIRST_ID + other.id % _IDS for other in others)]
    there = np.isfinite(points[:, 0])
    return StreamedFrame(
        packet.framenumber, 1e-6 * packet.timestamp, points[there], np.array(ids, dtype=np.int64)[there]
    )
