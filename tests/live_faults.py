"""A live session through faults: every frame that arrived is in the take, or is counted as missing from it.

    python -m tests.live_faults [--minutes 10 --rate 120 --seed 0]

A server streams a simulated capture to `handsim track --live`, which records it and sends it on. The server
restarts, the recording's folder is removed, the recording is cut, connections that never close crowd the
WebSocket sink, and packets of strangers and nonsense come. With `--kills` the command is killed as often by
SIGKILL at random moments, and what is left of the recording is counted. Exit code 1 when a frame is neither
in the take nor counted.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from gloves import Take, load_take
from gloves.takes.archives import GrownArchive
from tests.chaos import program
from tests.waiting import wait_for
from track import ReplayServer
from train import simulate_take

FAULTS = ("restart", "remove", "cut", "crowd", "strangers")


@dataclass
class Session:
    """A tracker that records a server's frames."""

    folder: Path
    capture: Take
    rate: float
    server: ReplayServer
    process: subprocess.Popen[str]
    sink: int
    """Port of the WebSocket sink."""

    @property
    def part(self) -> Path:
        """The recording while it grows."""
        return self.folder / "session" / "live.npz.part"

    def recorded(self) -> int:
        """The number of frames that are in the recording."""
        try:
            return GrownArchive(self.part, check=False).num_frames
        except (OSError, ValueError):
            return 0

    def wait_for_frames(self, count: int) -> None:
        """Wait until the server has sent some more frames and the recording has grown."""
        sent = self.server.sent + count
        while self.server.sent < sent and self.process.poll() is None:
            time.sleep(0.1)
        there = self.recorded()
        wait_for(lambda: self.recorded() > there or self.process.poll() is not None)


def started(folder: Path, capture: Take, rate: float) -> Session:
    """Start a server and a tracker, and wait until frames are recorded."""
    server = ReplayServer(capture, loop=True, rate=rate)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        sink = free.getsockname()[1]
    (folder / "session").mkdir()
    options = ("--size", "M", "--send", f"ws://:{sink}", "--out", f"{folder}/session/live.npz")
    process = subprocess.Popen(
        program(("track", "--live", server.url, *options)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    session = Session(folder, capture, rate, server, process, sink)
    wait_for(lambda: session.recorded() > 0 or process.poll() is not None)
    return session


def strike(session: Session, fault: str, clients: list[socket.socket]) -> None:
    """Let a fault happen."""
    if fault == "restart":
        port = session.server._port
        session.server.close()
        session.server = ReplayServer(session.capture, loop=True, rate=session.rate, port=port)
    elif fault == "remove":
        shutil.rmtree(session.part.parent)
    elif fault == "cut":
        os.truncate(session.part, session.part.stat().st_size * 9 // 10)
    elif fault == "crowd":
        for _ in range(300):
            with contextlib.suppress(OSError):
                clients.append(socket.create_connection(("127.0.0.1", session.sink)))
    else:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for client in list(session.server._clients):
                for number in range(200):
                    stranger.sendto(b"\x07\x00\xff\xffnonsense", client)
                    if number % 2:
                        session.server._socket.sendto(b"\x07\x00\xff\xffnonsense", client)


def run(frames: int, rate: float, *, seed: int = 0) -> dict[str, int]:
    """Record about `frames` frames through all faults; return counts, of which `unexplained` must be zero."""
    rng, clients = random.Random(seed), list[socket.socket]()
    capture = simulate_take(kind="hand-hand", num_frames=1200, seed=seed)
    with tempfile.TemporaryDirectory(prefix="faults-") as name, contextlib.ExitStack() as stack:
        session = started(Path(name), capture, rate)
        stack.callback(lambda: [one.close() for one in (*clients, session.server)])
        stack.callback(session.process.kill)
        for fault in FAULTS:
            session.wait_for_frames(rng.randrange(frames // 10, frames // len(FAULTS)))
            strike(session, fault, clients)
        session.wait_for_frames(frames // 10)
        session.process.send_signal(signal.SIGINT)
        out, said = session.process.communicate()
        if session.process.returncode:
            raise SystemExit(f"the session ended with {session.process.returncode}: {said}")
        take = load_take(Path(name) / "session" / "live.npz")
    stream = take.settings["stream"]
    lost = sum(map(int, re.findall(r"another program: (\d+) of its \d+ frames are lost", said)))
    after = re.search(r"(\d+) of them after the end", out)
    counted = {name: stream[name] for name in ("doubled_frames", "late_frames", "frames_with_wild_times")}
    counted |= {"dropped_frames": stream["dropped_frames"], "cut_frames": lost}
    counted["frames_after_end"] = int(after[1]) if after else 0
    unexplained = stream["received_frames"] - take.num_frames - sum(counted.values())
    others = {
        name: stream[name] for name in ("missing_frames", "restarts", "damaged_packets", "foreign_packets")
    }
    refused = re.search(r"(\d+) connections were refused", out)
    others["refused_connections"] = int(refused[1]) if refused else 0
    others["lines_on_stderr"] = len(said.splitlines())
    return (
        {"received_frames": stream["received_frames"], "frames": take.num_frames}
        | counted
        | others
        | {"unexplained": unexplained}
    )


def main(minutes: float = 10.0, rate: float = 120.0, seed: int = 0) -> None:
    begin = time.monotonic()
    counts = run(round(60.0 * minutes * rate), rate, seed=seed)
    for name, count in counts.items():
        print(f"{name:24s}{count:8d}")
    print(f"{time.monotonic() - begin:.0f} s")
    raise SystemExit(int(counts["unexplained"] != 0))


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__))
