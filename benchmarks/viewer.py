"""The viewer on a take: how long it takes to open, what a picture costs, and how many reach a page.

The page here is a plain client of the socket, which takes what comes as fast as it can and draws nothing.

python -m benchmarks.viewer TAKE [--seconds 10]
"""

from __future__ import annotations

import argparse
import threading
import time

import numpy as np
import viser
from websockets.sync.client import ClientConnection, connect

from benchmarks.record import describe
from gloves.takes.take import load_take
from track.streams import LOOPBACK
from track.viewer import opened_server
from track.viewer.recordings import TakeRecording
from track.viewer.stage import FrameView
from track.viewer.timeline import Timeline


def take_packets(page: ClientConnection, seconds: float) -> tuple[int, int]:
    """Packets and bytes that come in so many seconds."""
    packets = size = 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            size += len(page.recv(timeout=max(end - time.monotonic(), 0.0)))
            packets += 1
        except TimeoutError:
            break
    return packets, size


def client(server: viser.ViserServer) -> ClientConnection:
    """A page that has been sent everything."""
    address = f"ws://{server.get_host()}:{server.get_port()}"
    page = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None)
    take_packets(page, 3.0)
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("take")
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    print(describe("viser"))
    start = time.perf_counter()
    recording = TakeRecording(load_take(options.take))
    print(f"{recording.num_frames} frames read in {time.perf_counter() - start:.2f} s")
    with opened_server(LOOPBACK, 0, "benchmark") as server:
        start = time.perf_counter()
        view = FrameView(server, recording)
        view.show(recording.frame(0))
        print(f"page ready after {time.perf_counter() - start:.2f} s")
        costs = []
        for index in range(0, recording.num_frames, max(recording.num_frames // 1000, 1)):
            begin = time.thread_time()
            view.show(recording.frame(index))
            costs.append(time.thread_time() - begin)
        print(f"a picture: {1e3 * np.median(costs):.2f} ms, p99 {1e3 * np.percentile(costs, 99):.2f} ms")
        page, shown, ended = client(server), list[int](), threading.Event()

        def show(frame: int) -> None:
            shown.append(frame)
            view.show(recording.frame(frame))

        timeline = Timeline(server, recording.times, show)
        timeline.play(True)
        playing = threading.Thread(target=timeline.run, args=(ended.is_set,))
        playing.start()
        packets, size = take_packets(page, options.seconds)
        ended.set()
        playing.join()
        page.close()
    print(
        f"playing: {len(shown) / options.seconds:.1f} pictures/s made; "
        f"{packets / options.seconds:.1f} packets/s and {size / options.seconds / 1e3:.0f} kB/s reach a page"
    )


if __name__ == "__main__":
    main()
