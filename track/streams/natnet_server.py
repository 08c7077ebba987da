"""A NatNet server that replays a capture or a take on this machine, to try a live set-up without cameras."""

from __future__ import annotations

import select
import socket
import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from gloves.captures.capture import Capture
from gloves.optics.identities import number_runs
from gloves.takes.take import Take
from handsim.errors import CaptureError, choices
from track.streams import natnet
from track.streams.natnet import DamagedPacket, Kind, MarkerFrame, ServerInfo, Version

if TYPE_CHECKING:
    from jaxtyping import Float, Int

LOOPBACK: Final = "127.0.0.1"
VERSIONS: Final[tuple[Version, ...]] = ((3, 0), (3, 1), (4, 0), (4, 1))
_MOST_POINTS: Final = 1500  # in a datagram
_MOST_CLIENTS: Final = 8
_CLIENT_TIMEOUT: Final = 10.0  # [s] without a packet from a client


class ReplayServer:
    """Streams frames at their rate over NatNet, while there is a client.

    It listens on this machine only. The end of a `with` block or `close` ends it.

    Args:
        points: Points of all frames [m]; NaN where there is no point.
        ids: ID of each point, -1 where it has none.
        rate: Frames per second [Hz].
        version: NatNet version of the packets.
        port: UDP port to listen at; a free one when not given.

    Raises:
        CaptureError: The arrays do not fit together, there are too many points, the version is unknown, or
            the port is taken.
    """

    def __init__(
        self,
        points: Float[np.ndarray, "T N 3"],
        ids: Int[np.ndarray, "T N"],
        rate: float,
        *,
        version: Version = natnet.NEWEST,
        port: int = 0,
    ) -> None:
        if points.ndim != 3 or points.shape != (*ids.shape, 3):
            raise CaptureError(
                f"points have shape {points.shape} and IDs {ids.shape}, expected (T, N, 3) and (T, N)"
            )
        if ids.shape[1] > _MOST_POINTS:
            raise CaptureError(f"{ids.shape[1]} points per frame, expected at most {_MOST_POINTS}")
        if version not in VERSIONS:
            known = [f"{major}.{minor}" for major, minor in VERSIONS]
            raise CaptureError(choices(".".join(map(str, version)), known, noun="NatNet version"))
        if not 0.0 < rate < np.inf:
            raise CaptureError(f"the rate is {rate:g} Hz, expected a positive number")
        self._points, self._ids, self._rate, self._version = points, ids, rate, version
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise CaptureError(f"port {port} cannot be listened at ({error})") from error
        self._socket.setblocking(False)
        self._port: int = self._socket.getsockname()[1]
        self._clients: dict[tuple[str, int], float] = {}  # and the time of their last packets
        self.sent = 0
        """Number of frames that were sent so far."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="natnet replay", daemon=True)
        self._thread.start()

    @classmethod
    def of_capture(cls, capture: Capture, *, version: Version = natnet.NEWEST, port: int = 0) -> ReplayServer:
        """Replay a marker file; names are not sent, an ID lasts until its marker is lost."""
        ids = number_runs(np.isfinite(capture.positions[..., 0]))
        return cls(capture.positions, ids, capture.rate, version=version, port=port)

    @classmethod
    def of_take(cls, take: Take, *, version: Version = natnet.NEWEST, port: int = 0) -> ReplayServer:
        """Replay the points of a take with their IDs; its truth is not sent."""
        return cls(take.points, take.ids, take.rate, version=version, port=port)

    @property
    def url(self) -> str:
        """Address for `open_stream`."""
        return f"natnet://{LOOPBACK}:{self._port}"

    def close(self) -> None:
        """End the stream."""
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        start = 0.0
        while not self._ended.is_set():
            number = self.sent
            if not self._clients:
                start = time.monotonic() - number / self._rate  # continue at this frame
            due = start + number / self._rate if number < len(self._points) else np.inf
            self._answer(min(0.05, max(0.0, due - time.monotonic())))
            if self._clients and time.monotonic() >= due:
                self._send_all(natnet.pack_frame(self._frame(number), self._version))
                self.sent += 1

    def _frame(self, number: int) -> MarkerFrame:
        there = np.isfinite(self._points[number]).all(axis=1)
        points, ids = self._points[number, there], self._ids[number, there]
        return MarkerFrame(number, number / self._rate, points, ids)

    def _answer(self, seconds: float) -> None:
        """Wait for a client's packet and answer it."""
        ready, _, _ = select.select([self._socket], [], [], seconds)
        if not ready:
            return
        try:
            packet, client = self._socket.recvfrom(natnet.LARGEST)
            kind, _ = natnet.unpack(packet)
        except (OSError, DamagedPacket):
            return
        if kind == Kind.CONNECT and (client in self._clients or len(self._clients) < _MOST_CLIENTS):
            self._clients[client] = time.monotonic()
            info = ServerInfo("handsim replay", self._version, self._port, None)
            self._send(natnet.pack_server_info(info), client)
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
