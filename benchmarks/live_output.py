"""Live output: frames lost from a NatNet server to other programs, and the latency that is added.

A simulated capture of two hands is replayed at 120 Hz by a process of its own, tracked here, and sent to
readers, which are processes of their own. They read as fast as they can, at half the rate, or five times a
second. In the middle the server is restarted. The latency that is added to the tracker's own time is from
when the server takes up a frame to when the reader has it.

python -m benchmarks.live_output [--seconds 600]
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.sharedctypes import Synchronized
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from pythonosc.osc_bundle import OscBundle
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.paper.take_evaluation import true_users
from benchmarks.record import describe, run
from gloves import Take
from track import ReplayServer, StreamedFrame, Tracker, open_sinks, open_source
from track.streams import LOOPBACK
from train import load_labeler, simulate_take

RATE = 120.0
PAUSES: Final = (0.0, 2.0 / RATE, 0.2)  # [s]
SPAWN = multiprocessing.get_context("spawn")
Times = Any  # a shared array of monotonic times [s] by frame


def osc_document(datagram: bytes) -> dict[str, Any]:
    """The frame of a bundle of OSC."""
    contents = {message.address: list(message.params) for message in OscBundle(datagram)}
    number, _, silent = contents.get("/handsim/frame", (0, 0.0, 1))
    return {"type": "frame", "number": number, "silent": silent}


READERS: Final[dict[str, str | Callable[[bytes], dict[str, Any]]]] = {
    "ws://?every=1": "?every=1",
    "ws://": "",
    "/newest": "newest",
    "osc://": osc_document,
    "udp://": json.loads,
}
"""The end of a WebSocket's address, or what decodes a datagram."""


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


def listen(reader: str, port: int, times: Times, ready: Synchronized[int], half: int, pause: float) -> None:
    """Note when which frame arrives at a reader; numbers begin anew at the restart."""
    first, last = 0, -1
    with suppress(ConnectionClosed):
        for now, document in _documents(reader, port, ready, pause):
            if document["type"] == "frame" and not document["silent"]:
                first = half if document["number"] < last else first
                last = document["number"]
                times[first + last] = now


def _documents(
    reader: str, port: int, ready: Synchronized[int], pause: float
) -> Iterator[tuple[float, dict[str, Any]]]:
    """What a reader gets, with the time; it pauses after each [s]."""
    way = READERS[reader]
    if callable(way):
        yield from _datagrams(port, ready, pause, way)
        return
    with connect(f"ws://{LOOPBACK}:{port}/{way}") as server:
        with ready.get_lock():
            ready.value += 1
        yield from messages(server, pause, asks=reader == "/newest")


def messages(server: Any, pause: float, *, asks: bool) -> Iterator[tuple[float, dict[str, Any]]]:
    """Each message of a server after its header, with the time; `asks` for each, pauses after each [s]."""
    json.loads(server.recv())  # the header, for which nobody asks
    while True:
        if asks:
            server.send("")
        text = server.recv()
        yield time.monotonic(), json.loads(text)
        time.sleep(pause)


def _datagrams(
    port: int, ready: Synchronized[int], pause: float, decode: Callable[[bytes], dict[str, Any]]
) -> Iterator[tuple[float, dict[str, Any]]]:
    """Each datagram, or after a pause the newest one that waits."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    one.bind((LOOPBACK, port))
    with ready.get_lock():
        ready.value += 1
    while True:
        waiting = [one.recv(1 << 16)]
        with suppress(BlockingIOError):
            while True:
                waiting.append(one.recv(1 << 16, socket.MSG_DONTWAIT))
        for document in map(decode, waiting[-1:] if pause else waiting):
            yield time.monotonic(), document
        time.sleep(pause)


def main(seconds: float = 600.0) -> None:
    print(describe("numba", "torch", "websockets", "python-osc"))
    take = simulate_take(kind="hand-hand", num_frames=1200)
    for pause in PAUSES:
        print(f"readers that pause for {1e3 * pause:.0f} ms after each frame")
        measure(take, round(seconds * RATE), pause)


def measure(take: Take, frames: int, pause: float) -> None:
    """Run a session with readers that pause after each frame [s], and print what they got."""
    half = frames // 2
    ready, over = SPAWN.Value("i", 0), SPAWN.Value("i", 0)
    command, web, bundles, datagrams = free_ports(
        socket.SOCK_DGRAM, socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_DGRAM
    )
    ports = {"osc": bundles, "udp": datagrams}
    sent = SPAWN.Array("d", frames, lock=False)
    arrived = {name: SPAWN.Array("d", frames, lock=False) for name in READERS}
    tracker = Tracker(true_users(take), load_labeler("dense19"))
    tracker.warm_up()
    ranges = [(0, half), (half, frames - half)]
    addresses = [f"{one}://{LOOPBACK}:{port}" for one, port in {"ws": web, **ports}.items()]
    with open_sinks(addresses) as sinks:
        sinks.start(tracker.hands, tracker.bodies)
        jobs: list[tuple[Any, tuple[Any, ...]]] = [(serve, (take, command, ranges, sent, over))]
        for name, times in arrived.items():
            jobs.append((listen, (name, ports.get(name[:3], web), times, ready, half, pause)))
        processes = [SPAWN.Process(target=target, args=given, daemon=True) for target, given in jobs]
        for process in processes:
            process.start()
        while ready.value < len(READERS):
            time.sleep(0.1)
        own, counts = _track(f"natnet://{LOOPBACK}:{command}", tracker, sinks, half, frames, over)
        print(f"{frames} frames at {RATE:g} Hz; {counts}; dropped {sinks.counts}")
        time.sleep(0.5)
    for process in processes:
        process.terminate()
    _tell(np.array(sent), own, {name: np.array(times) for name, times in arrived.items()})


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
        if not added.size:
            print(f"{name}: no frame read")
            continue
        p50, p90, p99 = np.percentile(added, [50, 90, 99])
        print(
            f"{name}: {(~there).sum()} frames not read; added p50 {p50:.2f} ms, p90 {p90:.2f} ms, "
            f"p99 {p99:.2f} ms, most {added.max():.1f} ms"
        )


def free_ports(*kinds: int) -> list[int]:
    """A free port of this machine for each kind of socket."""
    sockets = [socket.socket(socket.AF_INET, kind) for kind in kinds]
    for one in sockets:
        one.bind((LOOPBACK, 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


if __name__ == "__main__":
    run(main, __doc__)
