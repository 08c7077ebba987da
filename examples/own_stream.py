"""A frame source and a sink of your own, as a module that handsim loads by name.

    python examples/own_stream.py
    cd examples
    handsim track --live "own_stream:Simulated?frames=600" --send own_stream:Fingertips --out take.npz

A package registers them under names of their own in its pyproject.toml:

    [project.entry-points."handsim.frame_sources"]
    simulated = "own_stream:Simulated"
    [project.entry-points."handsim.sinks"]
    fingertips = "own_stream:Fingertips"
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from track import LiveMessage, StreamedFrame
from train import simulate_take


class Simulated:
    """Frames as a camera system would send them: here from a simulated capture, at its own pace."""

    def __init__(self, frames: str = "120") -> None:  # what follows the name's "?" are strings
        self.take = simulate_take(kind="hand-controller", num_frames=int(frames))
        self.closed = False

    def __iter__(self) -> Iterator[StreamedFrame]:
        for number, (points, ids) in enumerate(zip(self.take.points, self.take.ids, strict=True)):
            if self.closed:
                break
            time.sleep(1 / self.take.rate)
            yield StreamedFrame(number, number / self.take.rate, points, ids)  # points [m], time [s]

    def close(self) -> None:
        """Called from another thread when no further frame is wanted."""
        self.closed = True


class Fingertips:
    """Prints how far thumb and index finger are apart, now and then."""

    def send(self, message: LiveMessage) -> None:
        """Called by the tracker with every frame; it waits until this returns."""
        thumb, index = (message.header.positions.index(name) for name in ("thumb_tip", "index_tip"))
        for hand in message.hands:
            if hand.has_pose and message.number % 60 == 0:
                apart = 1e3 * np.linalg.norm(hand.positions[thumb] - hand.positions[index])
                print(f"{message.time:.2f} s: {hand.side} thumb and index finger {apart:.0f} mm apart")

    def close(self) -> None:
        """Called at the end."""


def main() -> None:
    source = Simulated("3")
    for frame in source:
        print(f"frame {frame.number} at {frame.time:.3f} s: {len(frame.points)} points")
    source.close()


if __name__ == "__main__":
    main()
