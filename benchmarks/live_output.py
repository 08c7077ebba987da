"""Live output: frames lost from a NatNet server to WebSocket and OSC clients, and the latency that is added.

A simulated capture of two hands is replayed at 120 Hz by a process of its own, tracked here, and sent to two
clients, which are processes of their own. In the middle the server is restarted. The latency that is added to
the tracker's own time is from when the server takes up a frame to the client's `recv`.

python -m benchmarks.live_output [--seconds 600]
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import time
from collections.abc import Iterable, Iterator
from multiprocessing.sharedctypes import Synchronized
from types import SimpleNamespace
from typing import Any

import numpy as np
from pythonosc.osc_bundle import OscBundle
from websockets.sync.client import connect

from benchmarks.paper.take_evaluation import true_users
from benchmarks.record import describe, run
from gloves import Take
from track import ReplayServer, StreamedFrame, Tracker, open_sinks, open_source
from track.streams import LOOPBACK
from train import load_labeler, simulate_take

RATE = 120.0
SPAWN = multiprocessing.get_context("spawn")
Times = Any  # a shared array of monotonic times [s] by frame


class StampedServer(ReplayServer):
    """A server that notes when it sends which frame."""

    def __init__(self, take: Take, port: int, first: int, count: int, times: Times) -> None:
        self._first, self._times = first, times
        turns, rows = np.divmod(first + np.arange(count), take.num_frames)
        ids = take.ids[rows].astype(np.int64)
        ids = np.where(ids >= 0, ids + 100_000 * turns[:, None], ids)
        super().__init__(SimpleNamespace(points=take.points[rows], ids=ids, rate=RATE), port=port)

    def _frame(self, number: int) -> StreamedFrame:
        self._times[self._first + number] = time.monotonic()
        return super()._frame(number)


def serve(
    take: Take, port: int, ranges: list[tuple[int, int]], times: Times, over: Synchronized[int]
) -> None:
    """Send all frames, with a restart between two ranges."""
    for first, count in ranges:
        with StampedServer(take, port, first, count, times) as server:
            while not server.finished:
                time.sleep(0.05)
            time.sleep(0.2)
    over.value = 1


def listen_websocket(port: int, times: Times, ready: Synchronized[int], restarts: int) -> None:
    """Note when which frame arrives at a WebSocket client."""
    with connect(f"ws://{LOOPBACK}:{port}") as server:
        ready.value += 1
        _note(((time.monotonic(), json.loads(message)) for message in server), times, restarts)


def listen_osc(port: int, times: Times, ready: Synchronized[int], restarts: int) -> None:
    """Note when which frame arrives at an OSC client."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    one.bind((LOOPBACK, port))
    ready.value += 1
    _note(_osc_frames(one), times, restarts)


def _osc_frames(one: socket.socket) -> Iterator[tuple[float, dict[str, Any]]]:
    while True:
        datagram, now = one.recv(1 << 16), time.monotonic()
        contents = {message.address: list(message.params) for message in OscBundle(datagram)}
        number, _, silent = contents.get("/handsim/frame", (0, 0.0, 1))
        yield now, {"type": "frame", "number": number, "silent": silent}


def _note(documents: Iterable[tuple[float, dict[str, Any]]], times: Times, half: int) -> None:
    """Numbers begin anew at the restart."""
    first, last = 0, -1
    for now, document in documents:
        if document["type"] == "frame" and not document["silent"]:
            first = half if document["number"] < last else first
            last = document["number"]
            times[first + last] = now


def main(seconds: float = 600.0) -> None:
    frames = round(seconds * RATE)
    print(describe("numba", "torch", "websockets", "python-osc"))
    take, half = simulate_take(kind="hand-hand", num_frames=1200), frames // 2
    sent, websocket, osc = (SPAWN.Array("d", frames, lock=False) for _ in range(3))
    ready, over = SPAWN.Value("i", 0), SPAWN.Value("i", 0)
    command, web, bundles = _free_ports(socket.SOCK_DGRAM, socket.SOCK_STREAM, socket.SOCK_DGRAM)
    tracker = Tracker(true_users(take), load_labeler("dense19"))
    tracker.warm_up()
    ranges = [(0, half), (half, frames - half)]
    with open_sinks([f"ws://{LOOPBACK}:{web}?every=yes", f"osc://{LOOPBACK}:{bundles}"]) as sinks:
        sinks.start(tracker.hands, tracker.bodies)
        jobs: list[tuple[Any, tuple[Any, ...]]] = [
            (serve, (take, command, ranges, sent, over)),
            (listen_websocket, (web, websocket, ready, half)),
            (listen_osc, (bundles, osc, ready, half)),
        ]
        processes = [SPAWN.Process(target=target, args=given, daemon=True) for target, given in jobs]
        for process in processes:
            process.start()
        while ready.value < 2:
            time.sleep(0.1)
        own, counts = _track(f"natnet://{LOOPBACK}:{command}", tracker, sinks, half, frames, over)
        print(f"{frames} frames at {RATE:g} Hz; {counts}; dropped {sinks.counts}")
        time.sleep(0.5)
    _tell(np.array(sent), own, {"WebSocket": np.array(websocket), "OSC": np.array(osc)})


def _track(
    url: str, tracker: Tracker, sinks: Any, half: int, frames: int, over: Synchronized[int]
) -> tuple[np.ndarray, dict[str, int]]:
    """Track the stream; returns how long the tracker took for each frame [s]."""
    own = np.full(frames, np.nan)
    first = 0
    with open_source(url, ended=lambda: over.value > 0) as stream:
        for frame in stream:
            tracked = tracker.step(frame.points, frame.ids, frame.time)
            sinks.send(frame, tracked)
            first += half * frame.restarted
            if not frame.silent:
                own[first + frame.number] = tracked.seconds
        return own, stream.counts


def _tell(sent: np.ndarray, own: np.ndarray, arrived: dict[str, np.ndarray]) -> None:
    p50, p99 = 1e3 * np.nanpercentile(own, [50, 99])
    print(f"tracker: p50 {p50:.2f} ms, p99 {p99:.2f} ms a frame")
    for name, times in arrived.items():
        there = times > 0
        added = 1e3 * (times - sent - own)[there & np.isfinite(own)]
        p50, p99 = np.percentile(added, [50, 99])
        print(
            f"{name}: {(~there).sum()} frames lost; added p50 {p50:.2f} ms, p99 {p99:.2f} ms, "
            f"most {added.max():.1f} ms"
        )


def _free_ports(*kinds: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, kind) for kind in kinds]
    for one in sockets:
        one.bind((LOOPBACK, 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


if __name__ == "__main__":
    run(main, __doc__)
