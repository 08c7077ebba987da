"""A live stream for an hour, on a bad network: frames lost, memory, and what is on disk after a kill.

Two hands at 120 Hz are tracked and recorded as `handsim track --live` does it. The server sends as fast as
the tracker reads. On the way 5 % of the packets are dropped, as many doubled, overtaken by the next one, and
corrupted; others bring junk, wild times and frames of another sender. The server restarts now and then, on
its port; another one on another port is not heard. Then the command itself is killed.

python -m benchmarks.live_stream [soak kill] [--seconds 3600]
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import tyro

from benchmarks.paper.take_evaluation import true_users
from benchmarks.record import describe, resident_memory, run
from gloves import Take, load_take
from gloves.takes.archives import GrownArchive
from track import LiveStream, Recorder, ReplayServer, StreamedFrame, Tracker
from track.streams import LOOPBACK, natnet
from track.streams.natnet import Kind, ServerInfo, open_stream
from train import load_labeler, simulate_take

RATE = 120.0
SHARE = 0.05  # of the packets, for each kind of damage
RARE = 0.002  # of the packets, for junk, wild times and other senders
AHEAD = 40  # frames that may wait for the reader
RESTARTS = 4
WARM = 10.0  # [s] of the stream before memory is measured
SETTLED = 12.0  # [s] of a recording before it is killed, in which the size of the hands is measured
PROGRAM = "import sys; from handsim.cli.main import main; sys.exit(main(sys.argv[1:]))"
WILD = (1e17, 1e9, -1e9, np.inf, 7e4, -3.0)


class BadServer(threading.Thread):
    """Sends a take again and again, and spoils packets; waits for the reader."""

    def __init__(self, take: Take, frames: int) -> None:
        super().__init__(daemon=True)
        self.lost = {"dropped": 0, "corrupted": 0}
        self.good = np.zeros(frames, dtype=bool)
        """Which frames were sent undamaged."""
        self.read = 0
        """The last frame that the reader has had."""
        self.segment = -(-frames // (RESTARTS + 1))
        """Frames from one start of the server to the next."""
        self._start = 0
        self._take, self._frames = take, frames
        self._socket, self._stranger = _socket(), _socket()
        self._port = self._socket.getsockname()[1]
        self.url = f"natnet://{LOOPBACK}:{self._port}"
        self.ended = threading.Event()
        self._rng = np.random.default_rng(0)
        self._overtaken: bytes | None = None

    def run(self) -> None:
        """Send all frames, with restarts."""
        for start in range(0, self._frames, self.segment):
            self._start = start
            if start:
                self._socket.close()
                time.sleep(1.0)
                self._socket = _socket(self._port)
            client = self._greet()
            for number in range(start, min(start + self.segment, self._frames)):
                while number > self.read + AHEAD:
                    time.sleep(0.001)
                self._send(number - start, client)
            self._flush(client)
        time.sleep(0.5)
        self.ended.set()

    def _greet(self) -> tuple[str, int]:
        """Wait for the client, and answer it."""
        self._socket.settimeout(None)
        while True:
            packet, client = self._socket.recvfrom(natnet.LARGEST)
            if natnet.unpack(packet)[0] == Kind.CONNECT:
                info = ServerInfo("bad server", natnet.NEWEST, self._port, None)
                self._socket.sendto(natnet.pack_server_info(info), client)
                return client

    def _send(self, number: int, client: tuple[str, int]) -> None:
        """Send a frame, or what becomes of it on the way."""
        chance, rare = self._rng.random(2)
        if rare < 4 * RARE:
            self._disturb(number, int(rare / RARE), client)
        packet = self._packet(number, number / RATE)
        edge = (
            number < 4
        )  # the first frames after a start are not spoiled: nothing shows yet which were right
        if chance < SHARE and not edge:
            self.lost["dropped"] += 1
        elif chance < 2 * SHARE and not edge:
            self.lost["corrupted"] += 1
            self._say(self._corrupt(packet), client)
        elif chance < 3 * SHARE and self._overtaken is None and not edge:
            self.good[self._start + number] = True
            self._overtaken = packet
            return
        else:
            self.good[self._start + number] = True
            self._say(packet, client)
            if chance < 4 * SHARE:
                self._say(packet, client)
        self._flush(client)

    def _flush(self, client: tuple[str, int]) -> None:
        if self._overtaken is not None:
            self._say(self._overtaken, client)
            self._overtaken = None

    def _disturb(self, number: int, kind: int, client: tuple[str, int]) -> None:
        if kind == 0:
            self._say(self._rng.bytes(int(self._rng.integers(1, 1400))), client)
        elif kind == 1:
            self._say(self._packet(number, float(self._rng.choice(WILD))), client)
        elif kind == 2:
            self._say(self._packet(number + 1, (number + 1) / RATE), client, self._stranger)
        else:
            self._say(natnet.pack(Kind.FRAME, self._rng.bytes(300)), client, self._stranger)

    def _say(self, packet: bytes, client: tuple[str, int], sender: socket.socket | None = None) -> None:
        (sender or self._socket).sendto(packet, client)

    def _corrupt(self, packet: bytes) -> bytes:
        """A packet with a few wrong bytes in its header, its counts or its time, or cut off."""
        damaged = bytearray(packet)
        if self._rng.random() < 0.5:
            return bytes(damaged[: self._rng.integers(1, len(damaged))])
        for _ in range(3):
            at = int(self._rng.integers(8)) if self._rng.random() < 0.5 else -int(self._rng.integers(1, 60))
            damaged[at] ^= int(self._rng.integers(1, 256))
        return bytes(damaged)

    def _packet(self, number: int, told: float) -> bytes:
        row = number % self._take.num_frames
        there = np.isfinite(self._take.points[row, :, 0])
        # A new round is as of new markers: their IDs do not go on.
        ids = self._take.ids[row, there].astype(np.int64) + number // self._take.num_frames * 100_000
        return natnet.pack_frame(
            StreamedFrame(number, told, self._take.points[row, there], ids % 2**31), natnet.NEWEST
        )


def _socket(port: int = 0) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    one.bind((LOOPBACK, port))
    return one


def main(
    parts: tyro.conf.Positional[tuple[Literal["soak", "kill"], ...]] = ("soak", "kill"),
    seconds: float = 3600.0,
) -> None:
    pace = np.inf
    print(describe("numba", "torch"))
    take = simulate_take(kind="hand-hand", num_frames=1200)
    with tempfile.TemporaryDirectory() as folder:
        if "soak" in parts:
            pace = soak(take, round(seconds * RATE), Path(folder))
        if "kill" in parts:
            kill(take, min(1.0, 0.4 * pace) * RATE, Path(folder))  # a busy machine needs a slower stream


def soak(take: Take, frames: int, folder: Path) -> float:
    """Track and record a stream on a bad network; returns how many times faster than its own pace."""
    tracker = Tracker(true_users(take), load_labeler("dense19"))
    server, out = BadServer(take, frames), folder / "soak.npz"
    server.start()
    start, memory, first = time.perf_counter(), [], 0
    there = np.zeros(frames, dtype=bool)
    packets = open_stream(server.url)
    packets.is_live = False  # this server waits for its reader
    with LiveStream(packets, ended=server.ended.is_set) as stream:
        with Recorder(out, tracker) as recorder:
            for frame in stream:
                tracked = tracker.step(frame.points, frame.ids, frame.time)
                recorder.add(frame, tracked)
                first += server.segment * frame.restarted
                if not frame.silent and first + frame.number < frames:
                    server.read = first + frame.number
                    there[server.read] = True
                if not frame.silent and recorder.num_frames % 600 == 0:
                    memory.append((frame.time, resident_memory()))
            seconds, size = time.perf_counter() - start, recorder.part.stat().st_size
            print(f"{frames} frames in {seconds:.0f} s, {frames / RATE / seconds:.1f} times their own pace")
            print(f"lost on the way: {server.lost}; arrived undamaged: {server.good.sum()}")
            print(f"recorded: {recorder.num_frames}; {stream.counts}")
            print(f"frames lost beyond those dropped: {(server.good & ~there).sum()}")
            recorded = recorder.num_frames
            before = [resident for told, resident in memory if told <= WARM] or [memory[0][1]]
            print(f"memory growth after {WARM:.0f} s: {(memory[-1][1] - before[-1]) / 1e6:+.1f} MB")
            print(f"on disk while recording: {size / recorded / 1e3:.2f} kB a frame")
            at = time.perf_counter()
            recorder.finish(stream.counts)
    print(f"written as .npz in {time.perf_counter() - at:.0f} s; {resident_memory() / 1e6:.0f} MB resident")
    if recorded < 200_000:
        loaded = load_take(out)
        gaps = np.diff(loaded.times).max()
        print(f"it opens: {loaded.num_frames} frames, {loaded.times[-1]:.1f} s, longest gap {gaps:.2f} s")
    return frames / RATE / seconds


def kill(take: Take, rate: float, folder: Path) -> None:
    """Kill the command; its recording must open."""
    print(f"handsim track --live at {rate:.0f} Hz, ended by signals:")
    for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        out = folder / f"{number.name}.npz"
        part = out.with_name(out.name + ".part")
        points, ids = np.tile(take.points, (20, 1, 1)), np.tile(take.ids, (20, 1))
        with ReplayServer(SimpleNamespace(points=points, ids=ids, rate=rate)) as server:
            command = [sys.executable, "-c", PROGRAM, "track", "--live", server.url, "--out", str(out)]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            fewest = SETTLED * rate
            while process.poll() is None and not (part.exists() and GrownArchive(part).num_frames > fewest):
                time.sleep(0.1)
            sent = server.sent
            os.kill(process.pid, number)
            code = process.wait()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            numbers = load_take(part if part.exists() else out).numbers
        assert numbers is not None
        missing = sent - len(numbers)
        name = (part if part.exists() else out).name
        told = f"{max(missing, 0)} of those sent are missing ({max(missing, 0) / rate:.2f} s)"
        print(f"{number.name}: exit code {code}, {name} has {len(numbers)} frames, {told}")


if __name__ == "__main__":
    run(main, __doc__)
