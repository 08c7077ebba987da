"""A NatNet server that replays a capture or a take, to try a live set-up without cameras."""

from __future__ import annotations

import select
import socket
import threading
import time
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture
from gloves.optics.reconstruction import number_runs
from handsim._checks import check_type
from handsim.callbacks import Closing
from handsim.errors import CaptureError, choices
from track.inputs import read_points
from track.streams import LOOPBACK, natnet
from track.streams.natnet import DamagedPacket, Kind, MarkerFrame, ServerInfo, Version

VERSIONS: Final[tuple[Version, ...]] = ((3, 0), (3, 1), (4, 0), (4, 1))
_MOST_POINTS: Final = 1500  # in a datagram
_MOST_CLIENTS: Final = 8
_CLIENT_TIMEOUT: Final = 10.0  # [s] without a packet from a client
_WAIT: Final = 0.05  # [s] for a client's packet, after which the end is looked at
_NUMBERS: Final = 1 << 31  # of frames and of IDs in a packet


class PointFrames(Protocol):
    """Points of frames with IDs, such as a take's."""

    @property
    def points(self) -> Float[np.ndarray, "T N 3"]:
        """Points of all frames [m]; NaN where there is no point."""
        ...

    @property
    def ids(self) -> Int[np.ndarray, "T N"]:
        """ID of each point, -1 where it has none."""
        ...

    @property
    def rate(self) -> float:
        """Frames per second [Hz]."""
        ...


class ReplayServer(Closing):
    """Streams frames at their rate over NatNet, while there is a client.

    Without a client it waits. The end of a `with` block or `close` ends it.

    Args:
        source: A capture, whose names are not sent and in which an ID lasts until its marker is lost; a take,
            of which only points and IDs are sent; or the path of one.
        rate: Frames per second [Hz]; those of the source when not given.
        version: NatNet version of the packets.
        host: Address to listen at; only this machine reaches the default.
        port: UDP port to listen at; a free one when not given.
        loop: Whether the first frame follows the last one, with later number and time, and as new points: no
            ID goes on.

    Raises:
        CaptureError: The file cannot be read, the arrays do not fit together, there are no frames or too many
            points, the version is unknown, or the port is taken.
    """

    def __init__(
        self,
        source: Capture | PointFrames | str | Path,
        *,
        rate: float | None = None,
        version: Version = natnet.NEWEST,
        host: str = LOOPBACK,
        port: int = 0,
        loop: bool = False,
    ) -> None:
        points, ids, own_rate = _point_frames(source)
        rate = own_rate if rate is None else rate
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
            raise CaptureError(choices(".".join(map(str, version)), known, noun="NatNet version"))
        if not 0.0 < rate < np.inf:
            raise CaptureError(f"the rate is {rate:g} Hz, expected a positive number")
        self._points, self._ids, self._version, self._loop = points, ids, version, loop
        self.rate = rate
        """Frames per second [Hz]."""
        self._ids_of_round = int(ids.max(initial=-1)) + 1
        self._host, self._socket = host, _listen(host, port)
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
                self._send_all(natnet.pack_frame(self._frame(number), self._version))
                self.sent += 1

    def _frame(self, number: int) -> MarkerFrame:
        played, row = divmod(number, len(self._points))
        there = np.isfinite(self._points[row]).all(axis=1)
        ids = self._ids[row, there].astype(np.int64)
        ids[ids >= 0] = (ids[ids >= 0] + played * self._ids_of_round) % _NUMBERS
        return MarkerFrame(number % _NUMBERS, number / self.rate, self._points[row, there], ids)

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
